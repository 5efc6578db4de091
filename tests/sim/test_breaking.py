"""Cables that break: when, what is left, and that the next episode has whole ones."""

import numpy as np
import pytest
from conftest import GRAVITY, hover_thrust, make, make_system, mask, refusal, same, zeros

from multilift_marl.sim import World

MODELS = pytest.mark.parametrize("model", ["massless", "chain"])
POINT = {"payload.shape": "point", "payload.mass": 0.4, "payload.drag_area": 0.0}


def make_world(model: str, num_envs: int = 1, num_drones: int = 1, load_factor: float = 2.0, num_threads: int = 1):
    """Return a world whose cables break at `load_factor` times the load's share of the weight."""
    limit = load_factor * 0.4 * GRAVITY / num_drones
    settings = {**POINT, "cable.model": model, "cable.breaking_load": limit, "vehicle.drag": (0.0, 0.0, 0.0)}
    return World(make_system(num_drones, **settings), num_envs, num_threads)


@pytest.mark.slow
@MODELS
def test_a_cable_breaks_when_its_tension_exceeds_the_breaking_load_and_not_before(model):
    world = make_world(model)
    thrust = hover_thrust(world)
    world.hidden_loads.payload_force[:] = [0, 0, -0.9 * 0.4 * GRAVITY]
    world.step(thrust, 25)
    assert not world.state.cable_broken.any() and world.stats.tension_max[0] > 1.2 * 0.4 * GRAVITY
    world.hidden_loads.payload_force[:] = [0, 0, -6 * 0.4 * GRAVITY]  # shared by drone and load, as accelerations go
    largest = [0.0]
    for _ in range(25):
        world.step(thrust)
        largest.append(world.stats.tension_peak[0])
        if world.state.cable_broken[0, 0]:
            break
    assert largest[-1] > 2.0 * 0.4 * GRAVITY >= largest[-2]


@pytest.mark.parametrize("model", ["massless", pytest.param("chain", marks=pytest.mark.slow)])
def test_drone_and_load_part_as_free_bodies(model):
    world = make_world(model)
    thrust = hover_thrust(world)
    world.break_cables(np.ones((1, 1), bool))
    world.step(thrust)  # chains: what the link pulled at the last moment still counts in this step
    load_speed, drone_speed = world.state.payload_velocity[0].copy(), world.state.drone_velocity[0, 0].copy()
    world.step(thrust, 100)
    system = world.system
    lift = thrust[0, 0].sum() / system.vehicle.mass - GRAVITY
    cable_mass = 0 if model == "massless" else system.cable_mass[0]
    assert world.state.payload_velocity[0, 2] - load_speed[2] == pytest.approx(-0.4 * GRAVITY, rel=1e-2 + cable_mass)
    assert world.state.drone_velocity[0, 0, 2] - drone_speed[2] == pytest.approx(0.4 * lift, rel=1e-3)
    assert world.state.cable_tension[0, 0] == 0 and not world.diverged.any()
    assert not any(shard.batch.warning[:, :, 1].any() for shard in world.shards)


@MODELS
def test_others_keep_their_cables_and_a_reset_makes_all_whole(model):
    world, fresh = make_world(model, 2, 3), make_world(model, 2, 3)
    thrust = hover_thrust(world)
    broken = np.zeros((2, 3), bool)
    broken[0, 1] = True
    world.break_cables(broken)
    for other in (world, fresh):
        other.step(thrust, 20)
    assert (world.state.payload_position[1] == fresh.state.payload_position[1]).all()
    assert world.state.payload_position[0, 2] < 1.499
    for other in (world, fresh):
        other.reset()
        other.step(thrust, 20)
    assert same(world.state_dict(), fresh.state_dict())


@MODELS
@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_saved_world_remembers_what_broke(model, num_threads):
    world, other = make_world(model, 2, 3), make_world(model, 2, 3, num_threads=num_threads)
    world.break_cables(np.array([[False, True, False], [False, False, False]]))
    thrust = hover_thrust(world)
    world.step(thrust, 10)
    saved = world.state_dict()
    other.load_state_dict(saved)
    for each in (world, other):
        each.step(thrust, 10)
    assert same(world.state_dict(), other.state_dict())


def test_an_episode_ends_with_the_named_cause():
    vec = make(num_envs=2, num_drones=3, **{"cable.breaking_load": 20.0})
    vec.reset(seed=0)
    vec.world.break_cables(np.array([[False, False, True], [False, False, False]]))
    _, _, terminated, _, info = vec.step(zeros(vec))
    assert terminated.tolist() == [True, False]
    assert vec.failure_causes[info["failure_cause"][0]] == "cable_broken"
    vec.reset(mask=mask(2, 0))
    assert not vec.world.state.cable_broken.any()
    assert not vec.step(zeros(vec))[2].any()


def test_a_cable_that_would_break_at_rest_is_refused():
    message = refusal(make_system, **{"cable.breaking_load": 2.0})
    assert "cable.breaking_load" in message and "would break at rest" in message
    assert "cable.breaking_load" in refusal(make_system, **{"cable.breaking_load": -1.0})
