"""The batched core: how episodes end, by time, by failure, by divergence."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import bold_actions, level, make, mask, mixed_actions, same, wide, zeros

from multilift_marl.math3d import axis_angle

# Steps and ends


def test_time_limit_is_exact_and_a_truncation(task, cables):
    vec = make(task, **{"env.episode_seconds": 0.5}, **cables)
    vec.reset()
    assert vec.max_steps == 25
    for step in range(1, 26):
        _, _, terminated, truncated, info = vec.step(zeros(vec))
        assert not terminated.any() and not info["failure"].any()
        assert truncated.all() == truncated.any() == (step == 25)


def test_a_reset_starts_the_clock_of_its_environments_only(task, cables):
    vec = make(task, num_envs=3, **{"env.episode_seconds": 0.5}, **cables)
    vec.reset()
    for _ in range(10):
        vec.step(zeros(vec))
    vec.reset(mask=mask(3, 1))
    for _ in range(15):
        *_, truncated, _ = vec.step(zeros(vec))
    assert truncated.tolist() == [True, False, True]


@pytest.mark.few_tasks
def test_ends_have_one_cause(task, num_drones, cables):
    harsh = {"task_options.grace": 0.0} if task == "recover" else {}
    vec = make(
        task, num_envs=12, num_drones=num_drones, **{"env.episode_seconds": 1.5, **harsh}, **wide(task), **cables
    )
    vec.reset(seed=0)
    terminations = truncations = 0
    for step in range(160):
        observation, reward, terminated, truncated, info = vec.step(mixed_actions(vec, step))
        assert not (terminated & truncated).any()
        assert same(info["failure"], terminated)
        assert ((info["failure_cause"] > 0) == terminated).all()
        assert not (info["success"] & ~truncated).any()
        assert not info["diverged"].any()
        assert np.isfinite(observation).all() and np.isfinite(reward).all() and np.isfinite(vec.state()).all()
        terminations, truncations = terminations + terminated.sum(), truncations + truncated.sum()
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    assert terminations > 0 and truncations > 0


def test_an_environment_that_was_never_reset_cannot_be_stepped(task, cables):
    vec = make(task, **cables)
    with pytest.raises(RuntimeError, match=r"environment 0 has ended or was never reset: call reset\(mask=\.\.\.\)"):
        vec.step(zeros(vec))


def test_an_ended_environment_cannot_be_stepped(task, cables):
    vec = make(task, num_envs=3, **{"env.episode_seconds": 0.1}, **cables)
    vec.reset()
    for _ in range(2):
        vec.step(zeros(vec))
    vec.reset(mask=mask(3, 0, 2))
    for _ in range(3):
        *_, truncated, _ = vec.step(zeros(vec))
    assert truncated.tolist() == [False, True, False]
    with pytest.raises(RuntimeError, match="environment 1 has ended"):
        vec.step(zeros(vec))
    vec.reset(mask=truncated)
    vec.step(zeros(vec))


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_environments_whose_step_was_interrupted_must_be_reset(monkeypatch, error):
    vec, twin = make("hover", num_envs=2), make("hover", num_envs=2)

    def interrupt():
        raise error

    for each in (vec, twin):
        each.reset(seed=3)
        each.step(zeros(each))
    with monkeypatch.context() as patch:
        patch.setattr(vec, "_parts", [*vec._parts, interrupt])
        with pytest.raises(error):
            vec.step(zeros(vec))
    with pytest.raises(RuntimeError, match="environment 0 has ended"):
        vec.step(zeros(vec))
    np.testing.assert_array_equal(vec.reset()[0], twin.reset()[0])  # the next episodes


def test_environments_whose_reset_was_interrupted_must_be_reset_again(monkeypatch):
    vec, twin = make("hover", num_envs=2), make("hover", num_envs=2)

    def interrupt(*_):
        raise KeyboardInterrupt

    vec.reset(seed=1)
    with monkeypatch.context() as patch:
        patch.setattr(vec, "_start", interrupt)
        with pytest.raises(KeyboardInterrupt):
            vec.reset(seed=3)
    with pytest.raises(RuntimeError, match="environment 0 has ended"):
        vec.step(zeros(vec))
    np.testing.assert_array_equal(vec.reset(seed=3)[0], twin.reset(seed=3)[0])


def test_a_refused_action_ends_nothing():
    vec = make("hover", num_envs=2)
    vec.reset()
    with pytest.raises(ValueError, match="not finite"):
        vec.step(np.full_like(zeros(vec), np.nan))
    vec.step(zeros(vec))


# Divergence


@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_diverged_environment_ends_alone_and_soundly(task, cables, num_threads):
    calm = {"task_options.absent": 0.0} if task == "regroup" else {}  # three of four often cannot hold its payload
    broken, sound = (make(task, num_envs=6, num_threads=num_threads, seed=3, **cables, **calm) for _ in range(2))
    for vec in (broken, sound):
        vec.reset()
    others = [0, 1, 3, 4, 5]
    for step in range(40):
        if step == 5:
            broken.world.hidden_loads.payload_force[2] = 1e9
        action = 0.2 * bold_actions(sound, step)
        expected, (observation, reward, terminated, truncated, info) = sound.step(action), broken.step(action)
        assert np.isfinite(observation).all() and np.isfinite(reward).all() and np.isfinite(broken.state()).all()
        assert same(observation[others], expected[0][others])
        assert same(reward[others], expected[1][others])
        assert not expected[2].any()
        assert info["diverged"].tolist() == terminated.tolist() == [False, False, step == 5, False, False, False]
        if terminated.any():
            assert not truncated.any() and not info["success"].any()
            assert vec.failure_causes[info["failure_cause"][2]] == "diverged"
            broken.reset(mask=terminated)


# Failures


def sink(state):
    state.payload_position[0, 2] -= 1.43
    state.drone_position[0, :, 2] -= 1.43


def collide(state):
    state.drone_position[0, 1] = state.drone_position[0, 0] + [0.0, -0.3, 0.05]


def cross(state):
    state.drone_position[0, [0, 1]] = state.drone_position[0, [1, 0]]


def lean(state):
    state.drone_rotation[0, 0] = np.reshape(axis_angle((0.0, 1.0, 0.0), -1.25), (3, 3))


def tumble(state):
    state.drone_rotation[0, 0] = np.reshape(axis_angle((1.0, 0.0, 0.0), 1.45), (3, 3))


def turn_over(state):
    state.payload_rotation[0] = np.reshape(axis_angle((1.0, 0.0, 0.0), np.pi), (3, 3))


def hang(state):
    state.drone_position[0, 2, 2] = state.payload_position[0, 2] - 0.1


def stray(state):
    state.payload_position[0, 0] += 3.1
    state.drone_position[0, :, 0] += 3.1


@pytest.mark.parametrize(
    "happen, cause",
    [
        (lambda state: None, "none"),
        (sink, "ground"),
        (collide, "drone_collision"),
        (cross, "cable_crossing"),
        (lean, "cable_angle"),
        (turn_over, "cable_angle"),
        (tumble, "tilt"),
        (hang, "below_payload"),
        (stray, "out_of_range"),
    ],
)
def test_each_failure_has_its_cause(happen, cause):
    vec = make("hover", num_envs=1)
    vec.reset(seed=0)
    level(vec)
    happen(vec.world.state)
    vec.task.stages["measure"](0, 1)
    assert vec.failure_causes[vec.task.cause[0]] == cause


def test_a_failure_ends_the_episode():
    vec = make("hover", num_envs=3)
    vec.reset(seed=0)
    vec.world.hidden_loads.payload_force[1] = [0, 0, -60]
    for _ in range(100):
        _, _, terminated, _, info = vec.step(zeros(vec))
        if terminated.any():
            break
    assert terminated.tolist() == info["failure"].tolist() == [False, True, False]
    assert not info["diverged"].any()


@pytest.mark.parametrize("seconds", [1.0, 1.01, 1.03, 1.05])
def test_success_is_asked_for_within_the_steps_that_an_episode_has(seconds):
    """An episode of 1.01 s has 50 steps of 20 ms: success throughout its last second is success throughout it."""
    easy = {"task_options.success_distance": 5.0, "task_options.success_angle": 90.0}
    calm = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}
    vec = make("hover", 2, **easy, **calm, **{"env.episode_seconds": seconds, "task_options.success_seconds": 9.0})
    vec.reset(seed=0)
    for _ in range(vec.max_steps):
        *_, info = vec.step(zeros(vec))
    assert info["success"].all()
