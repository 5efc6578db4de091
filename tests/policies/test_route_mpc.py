"""Routes flown by model-predictive control: maps passed, what is not in sight not known, refusals."""

import numpy as np
import pytest
from conftest import make, refusal

from multilift_marl.policies.baselines import make_scripted
from multilift_marl.rig.obstacles import BOX, NONE
from multilift_marl.sim.obstacles import clear_obstacles, place_obstacle

FLOWN = {"control.action": "acc_rates"}


def fly(vec, policy, seconds=60.0, look=lambda: None):
    """Fly to the first end; return info of the last step and who has ended."""
    observation, _ = vec.reset(seed=5)
    policy.reset()
    for _ in range(min(vec.max_steps, round(50 * seconds))):
        observation, _, terminated, truncated, info = vec.step(policy.act(observation))
        look()
        if (terminated | truncated).any():
            break
    return info, terminated, truncated


@pytest.mark.slow
@pytest.mark.parametrize("name", ["navigate_dense", "navigate_narrow", "navigate_low"])
@pytest.mark.parametrize("drones", [3, 4])
def test_maps_are_passed(name, drones):
    vec = make(name, num_envs=4, num_drones=drones, **FLOWN)
    info, terminated, _ = fly(vec, make_scripted("mpc_route", vec))
    assert not terminated.any() and info["success"].all()
    assert (vec.task.min_clearance > 0.03).all() and (vec.task.own.peak_tension < 2.0).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "drones"), [("window", 2), ("window3", 3), ("forest", 4), ("wall", 6)])
def test_public_maps_are_passed_by_points_on_cables(name, drones):
    vec = make(f"maps/coltrans_{name}", num_envs=3, num_drones=drones, **FLOWN)
    info, terminated, _ = fly(vec, make_scripted("mpc_route", vec))
    assert not terminated.any() and info["success"].all()
    assert (vec.task.min_clearance > 0.05).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["navigate_dense", "navigate_narrow"])
def test_one_drone_passes_with_a_point(name):
    vec = make(name, num_envs=3, num_drones=1, **FLOWN, **{"payload.shape": "point"})
    info, terminated, _ = fly(vec, make_scripted("mpc_route", vec))
    assert not terminated.any() and info["success"].all()


@pytest.mark.slow
def test_a_forest_is_passed_by_sensors_on_board():
    onboard = {"env.sensing": "onboard"}
    said = refusal(make_scripted, "mpc_route", make("navigate_dense", **FLOWN, **onboard))
    assert "set env.sensing=onboard env.communication=all" in said
    vec = make("navigate_dense", num_envs=4, **FLOWN, **onboard, **{"env.communication": "all"})
    info, terminated, _ = fly(vec, make_scripted("mpc_route", vec))
    assert not terminated.any() and info["success"].mean() >= 0.75


@pytest.mark.slow
def test_a_team_goes_around_what_comes_into_sight():
    vec = make("navigate_unknown", num_envs=2, **FLOWN)
    policy = make_scripted("mpc_route", vec)
    seen = []

    def look():
        seen.append((policy.known.kind != NONE).sum(axis=1))
        if len(seen) == 1:  # the drones are within 1.3 m of the payload, obstacles within 0.35 m of their middles
            offset = vec.world.obstacles.position - vec.world.state.payload_position[:, None]
            far = np.hypot(offset[..., 0], offset[..., 1]) > 2.5 + 1.3 + 0.35
            assert not (far & (policy.known.kind != NONE)).any()

    info, terminated, _ = fly(vec, policy, look=look)
    assert not terminated.any() and info["success"].all()
    assert (policy.searches > 1).all()
    assert (seen[0] < (vec.world.obstacles.kind != NONE).sum(axis=1)).all() and (np.diff(seen, axis=0) >= 0).all()


@pytest.mark.slow  # its planner takes a minute to compile
def test_without_a_way_the_team_waits():
    vec = make("navigate", num_envs=1, **FLOWN)
    policy = make_scripted("mpc_route", vec)
    observation, _ = vec.reset(seed=5)
    clear_obstacles(0, vec.world.obstacles)
    place_obstacle(0, 0, vec.world.obstacles, BOX, (0.1, 9.0, 3.0), (0.0, 0.0, 3.0))
    vec.world.load(np.ones(1, bool))
    policy.reset()
    start = vec.world.state.payload_position[0].copy()
    for _ in range(30):
        observation, _, terminated, _, _ = vec.step(policy.act(observation))
        assert not terminated[0]
    assert policy.routes == [None] and policy.searches[0] == 1
    assert np.linalg.norm(vec.world.state.payload_position[0] - start) < 0.1


def test_other_tasks_are_refused():
    assert "needs the map of task navigate, not hover" in refusal(make_scripted, "mpc_route", make(num_envs=1, **FLOWN))
    assert "acts by control.action=acc_rates" in refusal(make_scripted, "mpc_route", make("navigate", num_envs=1))
