"""Pushes: how large, how often, whom, and that nothing else of an episode changes."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import hover_thrust, make, make_system, refusal, zeros

import multilift_marl as ml
from multilift_marl.sim import World

PUSHES = {"push.payload_velocity": 0.4, "push.drone_velocity": 0.6, "push.drone_rates": 3.0, "push.interval": 2.0}
STEPS = 500


def changes(**overrides) -> dict[str, np.ndarray]:
    """Return what one push changes in 4000 worlds: two drones on slack cables, each body pushed in the first step."""
    found = []
    for pushed in (True, False):
        world = World(make_system(2, **(PUSHES if pushed else {}), **overrides), 4000, 1)
        world.state.drone_position[..., 2] -= 0.1  # cables exert nothing
        world.load(np.ones(4000, bool))
        if pushed:
            world.pushes.left[:] = 1
        world.step(hover_thrust(world))
        s = world.state
        found.append((s.payload_velocity, s.payload_body_rates, s.drone_velocity, s.drone_body_rates))
    names = "payload_velocity", "payload_rates", "drone_velocity", "drone_rates"
    return {name: with_push - without for name, with_push, without in zip(names, *found, strict=True)}


SETTINGS = {
    "box": {"payload.shape": "box"},
    "point": {"payload.shape": "point"},
    "mixed": {"vehicle.preset": ["falcon", "iris"]},
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_a_push_changes_the_velocity_in_any_direction(settings):
    found = changes(**settings)
    assert np.abs(found["payload_rates"]).max() < 1e-9
    for name, most in (("payload_velocity", 0.4), ("drone_velocity", 0.6), ("drone_rates", 3.0)):
        change = found[name].reshape(-1, 3)
        size = np.linalg.norm(change, axis=-1)
        assert 0.98 * most < size.max() <= 1.001 * most, name
        np.testing.assert_allclose([size.mean(), size.std()], [most / 2, most / np.sqrt(12)], rtol=0.05, err_msg=name)
        assert np.abs(change.mean(axis=0)).max() < 0.03 * most, name
        np.testing.assert_allclose((change**2).mean(axis=0), most**2 / 9, rtol=0.1, err_msg=name)
    apart = found["drone_velocity"]
    assert np.abs(np.mean(apart[:, 0] * apart[:, 1], axis=0)).max() < 0.01  # each drone's own


@pytest.mark.slow
def test_pushes_come_as_a_poisson_process():
    world = World(make_system(2, **PUSHES), 1500, 1)
    thrust, count, before = hover_thrust(world), np.zeros((1500, 3)), world.pushes.left.copy()
    for _ in range(STEPS):
        world.step(thrust)
        count += world.pushes.left != before - 1
        before = world.pushes.left.copy()
    expected = STEPS * world.system.timestep / 2.0
    np.testing.assert_allclose(count.mean(axis=0), expected, rtol=0.08)
    np.testing.assert_allclose(count.var(axis=0), expected, rtol=0.15)


def test_without_pushes_nothing_is_drawn():
    world = World(make_system(2, **{"push.interval": 0.5}), 2, 1)
    assert world.pushes is None and world.shards[0].push is None
    assert not any(name.startswith("pushes") for name in world.state_dict())


def test_only_the_bodies_that_are_asked_for_are_pushed():
    world = World(make_system(2, **{"push.drone_velocity": 0.5}), 8, 1)
    world.state.drone_position[..., 2] -= 0.1
    world.load(np.ones(8, bool))
    world.pushes.left[:] = 1
    before = world.state.payload_velocity.copy()
    world.step(hover_thrust(world))
    np.testing.assert_allclose(world.state.payload_velocity - before, np.tile([0, 0, -9.81 * 0.004], (8, 1)), atol=1e-4)
    assert np.abs(world.state.drone_body_rates).max() < 1e-3
    assert 0.2 < np.linalg.norm(world.state.drone_velocity, axis=-1).max() < 0.52


def fly(num_envs, threads, steps=60, saved=None):
    vec = make(num_envs=num_envs, num_threads=threads, **PUSHES)
    vec.reset(seed=5)
    if saved is not None:
        vec.load_state_dict(saved)
    seen = [vec.step(zeros(vec))[0] for _ in range(steps)]
    return vec, np.array(seen)


def test_they_are_the_same_whatever_is_simulated_beside():
    (vec, few), (_, many) = fly(3, 1), fly(6, 2)
    np.testing.assert_array_equal(few, many[:, :3])
    assert len(set(vec.world.pushes.left[:, 0])) == 3
    calm = make(num_envs=3)
    calm.reset(seed=5)
    unpushed = np.array([calm.step(zeros(calm))[0] for _ in range(60)])
    assert (np.abs(few - unpushed).max(axis=(0, 2, 3)) > 1e-3).sum() >= 2


def test_worlds_push_by_their_seed_alone():
    left = [World(make_system(2, **PUSHES), 2, 1, seed).pushes.left for seed in (0, 0, 1)]
    np.testing.assert_array_equal(left[0], left[1])
    assert (left[0] != left[2]).any() and (left[0][0] != left[0][1]).any()


def test_a_saved_state_goes_on_with_the_same_pushes():
    vec, _ = fly(2, 1, steps=30)
    saved = vec.state_dict()
    later = np.array([vec.step(zeros(vec))[0] for _ in range(60)])
    _, again = fly(2, 2, saved=saved)
    np.testing.assert_array_equal(again, later)


def test_they_change_neither_starts_nor_what_is_hidden():
    pushed, calm = make(num_envs=8, **PUSHES), make(num_envs=8)
    (first, info), (second, other) = pushed.reset(seed=2), calm.reset(seed=2)
    np.testing.assert_array_equal(first, second)
    for name, value in info["randomization"].items():
        np.testing.assert_array_equal(value, other["randomization"][name], err_msg=name)


@pytest.mark.parametrize("model", ["massless", "chain"])
def test_the_strongest_and_most_frequent_pushes_give_no_nan(model):
    strongest = {"push.payload_velocity": 10.0, "push.drone_velocity": 10.0, "push.drone_rates": 30.0}
    vec = make(num_envs=8, **strongest, **{"push.interval": 0.01, "cable.model": model})
    vec.reset(seed=0)
    for _ in range(50):
        observation, reward, terminated, _, _ = vec.step(zeros(vec))
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
        vec.reset(mask=terminated)


def test_impossible_pushes_are_refused():
    for key, value in {"push.interval": 0.0, "push.payload_velocity": -1.0, "push.drone_rates": float("nan")}.items():
        assert key in refusal(ml.load_config, "hover", {key: value})
