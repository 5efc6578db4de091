"""The batched core: shapes and types, what actions may be, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import INFO, bold_actions, make, same, zeros

# Shapes and contract


def test_shapes_and_types(task, num_drones, cables):
    vec = make(task, num_envs=3, num_drones=num_drones, **cables)
    observation, info = vec.reset()
    e, n, d, a, s = vec.num_envs, vec.num_drones, vec.observation_size, vec.action_size, vec.state_size
    assert (e, n) == (3, num_drones)
    assert set(info) == INFO
    assert (observation.shape, observation.dtype) == ((e, n, d), np.float32)
    observation, reward, terminated, truncated, info = vec.step(np.zeros((e, n, a), np.float32))
    assert (observation.shape, observation.dtype) == ((e, n, d), np.float32)
    assert (reward.shape, reward.dtype) == ((e, n), np.float32)
    assert (vec.state().shape, vec.state().dtype) == ((e, s), np.float32)
    for flag in (terminated, truncated, info["success"], info["failure"], info["diverged"]):
        assert (flag.shape, flag.dtype) == ((e,), bool)
    assert tuple(info["reward_terms"]) == vec.reward_terms
    assert all(values.shape == (e,) for values in info["reward_terms"].values())


def test_every_number_has_a_name(task, cables):
    vec = make(task, num_envs=1, **cables)
    for names, size in ((vec.observation_names, vec.observation_size), (vec.action_names, vec.action_size)):
        assert len(names) == len(set(names)) == size


def test_returned_arrays_are_the_callers_own(task, cables):
    vec = make(task, num_envs=2, **cables)
    first, _ = vec.reset()
    kept, state = first.copy(), vec.state()
    second, reward, *_, info = vec.step(zeros(vec))
    second[:], reward[:], state[:] = 9, 9, 9
    for values in info["reward_terms"].values():
        values[:] = 9
    assert same(first, kept)
    again = make(task, num_envs=2, **cables)
    again.reset()
    again.step(zeros(again))
    assert same(vec.step(zeros(vec)), again.step(zeros(again)))


def test_actions_beyond_one_are_clipped(task, cables):
    results = []
    for size in (1.0, 1.5, 1e6):
        vec = make(task, **cables)
        vec.reset(seed=0)
        results.append([vec.step(size * bold_actions(vec, step)) for step in range(5)])
    assert same(results[0], results[1])
    assert same(results[0], results[2])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_actions_of_any_floating_type_do(task, cables, dtype):
    vec, reference = make(task, **cables), make(task, **cables)
    vec.reset(seed=0), reference.reset(seed=0)
    action = np.full((4, 4, vec.action_size), 0.25)
    assert same(vec.step(action.astype(dtype)), reference.step(action))


# What is refused


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_action_that_is_not_finite_names_environment_drone_and_number(task, cables, wrong):
    vec = make(task, **cables)
    vec.reset()
    action = zeros(vec)
    action[2, 1, 3] = wrong
    name = vec.action_names[3]
    with pytest.raises(ValueError, match=rf"drone_1 in environment 2 is not finite \({name}={wrong}\); look for NaN"):
        vec.step(action)
    vec.step(zeros(vec))


@pytest.mark.parametrize("shape", [(4,), (4, 4), (3, 4, 4), (4, 3, 4), (4, 4, 5), (1, 4, 4)])
def test_action_of_wrong_shape_is_refused(shape):
    vec = make("hover")
    vec.reset()
    with pytest.raises(ValueError, match=r"action has shape .*, expected \(4, 4, 4\)"):
        vec.step(np.zeros(shape))


@pytest.mark.parametrize("dtype", [int, bool, complex, object])
def test_action_of_wrong_type_is_refused(task, cables, dtype):
    vec = make(task, **cables)
    vec.reset()
    with pytest.raises(ValueError, match=r"action has dtype .*, expected floating point numbers in \[-1, 1\]"):
        vec.step(zeros(vec).astype(dtype))


@pytest.mark.parametrize("wrong", [np.ones(4), np.ones(3, bool), np.ones((4, 1), bool), [0, 1]], ids=str)
def test_wrong_mask_is_refused(task, cables, wrong):
    with pytest.raises(ValueError, match=r"mask has shape .*, expected bool \(4,\)"):
        make(task, **cables).reset(mask=wrong)


def test_negative_seed_is_refused(task, cables):
    with pytest.raises(ValueError, match=r"seed must be a whole number from 0 .* but is -1"):
        make(task, **cables).reset(seed=-1)


@pytest.mark.parametrize("seed", [1.5, "3", 2**70])
def test_seed_that_is_no_whole_number_of_64_bits_is_refused(task, cables, seed):
    with pytest.raises(ValueError, match="seed must"):
        make(task, num_envs=1, **cables).reset(seed=seed)


def test_unknown_reset_option_is_refused(task, cables):
    with pytest.raises(ValueError, match="unknown reset option 'wind'"):
        make(task, **cables).reset(options={"wind": 1})
