"""Simple routes among obstacles: they fly an empty map, keep their distance, and fail as they are known to."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_system, refusal

import multilift_marl as ml
from multilift_marl.errors import ConfigError
from multilift_marl.navigation.formation_shapes import drone_places, find_breach
from multilift_marl.navigation.payload_path import POINT, SHARES, STEP, field_path, shortest_path
from multilift_marl.navigation.team_clearance import make_scene, measure_clearance
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.route_baselines import narrowest_mode
from multilift_marl.sim.obstacles import BOX, CYLINDER, Obstacles, clear_obstacles, place_obstacle

NAMES = ("mpc_payload", "mpc_narrow", "mpc_potential")
BY_RATES = {"control.action": "acc_rates"}
START, GOAL = np.array([-3.0, 0.0, 1.4, 0.0]), np.array([3.0, 0.0, 1.4, 0.0])
SPACE = np.array([[-4.0, -3.0, 0.8], [4.0, 3.0, 2.6]])
TRAP = [(BOX, (0.1, 1.5, 4.0), (-1.5, 0.0, 4.0), 0.0)]  # a U, open to the start
TRAP += [(BOX, (0.8, 0.1, 4.0), (-2.3, side * 1.5, 4.0), 0.0) for side in (-1.0, 1.0)]


def scene_of(rows):
    obstacles = Obstacles.zeros(1, len(rows))
    for row, each in enumerate(rows):
        place_obstacle(0, row, obstacles, *each)
    return make_scene(obstacles, 0)


def team_on(rows, **overrides):
    """Return one team 4.5 m before its goal on a map of these obstacles alone, and its first observation."""
    vec = ml.make_vec("navigate", num_envs=1, num_threads=1, **BY_RATES | overrides)
    observation, _ = vec.reset(seed=0)
    vec.task.own.goal[0] = vec.task.own.start[0] + [4.5, 0.0, 0.0]
    clear_obstacles(0, vec.world.obstacles)
    for row, each in enumerate(rows):
        place_obstacle(0, row, vec.world.obstacles, *each)
    vec.world.load(np.ones(1, bool))
    return vec, observation


def fly(vec, observation, policy):
    """Return what the last step said."""
    over = False
    while not over:
        observation, _, terminated, truncated, info = vec.step(policy.act(observation))
        over = (terminated | truncated)[0]
    return terminated[0], info


@pytest.mark.slow  # its planner takes a minute to compile
@pytest.mark.parametrize("name", NAMES)
def test_an_empty_map_is_flown_to_success(name):
    vec, observation = team_on([], **{"env.episode_seconds": 7.0, "task_options.speed": 2.0})
    policy = make_scripted(name, vec)
    failed, info = fly(vec, observation, policy)
    assert not failed and info["success"].all()
    assert policy.routes[0].report.length == pytest.approx(np.linalg.norm(vec.task.own.goal - vec.task.own.start), 0.05)


@pytest.mark.parametrize("radius", [0.3, 0.8])
def test_the_shortest_path_round_a_pillar_is_two_tangents_and_an_arc(radius):
    scene = scene_of([(CYLINDER, (0.3, 0.3, 4.0), (0.0, 0.0, 4.0), 0.0)])
    path = shortest_path(START, GOAL, SPACE, scene, radius)
    clearance = np.empty(len(path))
    measure_clearance(path, np.zeros((len(path), 0, 3)), POINT, scene, 9.0, clearance)
    assert radius - 0.02 < clearance.min() < radius + STEP
    ball, far = radius + 0.3, 3.0
    least = 2 * np.sqrt(far**2 - ball**2) + ball * (np.pi - 2 * np.arccos(ball / far))
    length = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).sum()
    assert 0.99 * least < length < 1.06 * least


def test_a_field_turns_round_a_pillar_and_ends_in_a_trap():
    beside = scene_of([(CYLINDER, (0.3, 0.3, 4.0), (0.0, 0.1, 4.0), 0.0)])
    path = field_path(START, GOAL, SPACE, beside, 0.9, 0.3)
    assert np.allclose(path[-1], GOAL) and path[:, 1].min() < -0.2
    path = field_path(START, GOAL, SPACE, scene_of(TRAP), 0.9, 0.3)
    assert path[-1, 0] < -1.6 and abs(path[-1, 1]) < 0.1
    # There the forces balance: 1 = gain (1/r - 1) / r².
    r = (-1.6 - path[-1, 0]) / 0.9
    assert 0.3 * (1 / r - 1) / r**2 == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow  # its planner takes a minute to compile
@pytest.mark.parametrize(("name", "arrives"), [("mpc_payload", True), ("mpc_potential", False)])
def test_in_a_trap_a_field_ends_where_a_search_finds_out(name, arrives):
    """The team on the field's path stays in the trap until time is out; nothing touches anything there."""
    vec, observation = team_on(TRAP, **{"env.episode_seconds": 7.0, "task_options.speed": 2.0})
    policy = make_scripted(name, vec)
    policy.update_routes()
    route = policy.routes[0]
    ends_at_goal = np.linalg.norm(route.evaluate(route.times[-1:])[0][0] - vec.task.own.goal) < 1e-6
    assert ends_at_goal == arrives
    if not arrives:
        failed, info = fly(vec, observation, policy)
        assert not failed and not info["success"].any()
        end = route.evaluate(route.times[-1:])[0][0]
        assert np.linalg.norm(vec.world.state.payload_position[0] - end) < 0.1


@pytest.mark.parametrize("drones", [2, 4, 6])
def test_the_narrowest_shape_is_narrower_than_at_rest_and_within_its_limits(drones):
    system = make_system(drones)
    modes, turned = narrowest_mode(system)
    across = 1 if turned == 0.0 else 0
    rest = np.abs(drone_places(system, system.formation_force)[:, :2]).max(axis=0)
    for mode in modes:
        drawn = system.formation_force + mode
        assert find_breach(drawn, system) is None
        assert np.abs(drone_places(system, drawn)[:, across]).max() < rest.min() - 0.1
    assert len(modes) == (drones > 2)  # two fly in line anyway


@pytest.mark.slow  # its planner takes a minute to compile
def test_a_narrow_formation_heads_along_its_path():
    vec, _ = team_on([(CYLINDER, (0.3, 0.3, 2.0), (-1.5, 0.0, 2.0), 0.0)])
    policy = make_scripted("mpc_narrow", vec)
    policy.update_routes()
    route = policy.routes[0]
    times = np.linspace(0.0, route.times[-1], 200)
    value, rate, *_ = route.sample(times)
    cruising = np.linalg.norm(rate[:, :2], axis=1) > 0.8
    _, turned = narrowest_mode(vec.world.system)
    off = value[:, 3] - turned - np.arctan2(rate[:, 1], rate[:, 0])
    assert cruising.sum() > 50 and np.abs(off[cruising]).max() < np.deg2rad(15.0)
    assert value[cruising, 4] == pytest.approx(policy.DRAWN, abs=0.1)
    assert value[[0, -1], 3:] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow  # its planner takes a minute to compile
@pytest.mark.parametrize("name", NAMES)
def test_what_comes_in_sight_is_replanned_for(name):
    """A pillar beyond the range is not known; once it is near, the route leads round it without a leap."""
    near = {"env.obstacle_sensing": "local", "env.obstacles.range": 2.5}
    vec, _ = team_on([(CYLINDER, (0.3, 0.3, 2.0), (-0.4, 0.2, 2.0), 0.0)], **near)
    policy = make_scripted(name, vec)
    policy.update_routes()
    first = policy.routes[0]
    assert first.report.length == pytest.approx(np.linalg.norm(vec.task.own.goal - vec.task.own.start), 0.05)
    time = 0.5 * first.times[-1]
    vec.task.time[:] = time
    moved = first.evaluate(np.array([time]))[0][0] - vec.world.state.payload_position[0]
    vec.world.state.payload_position[0] += moved
    vec.world.state.drone_position[0] += moved
    policy.update_routes()
    second = policy.routes[0]
    assert second is not first and policy.begun[0] > time
    at = np.array([policy.begun[0]])
    joined = second.sample(at - policy.begun[0])[:2, 0], first.sample(at)[:2, 0]
    assert joined[0] == pytest.approx(joined[1], abs=1e-6)
    assert second.report.length > 0.0 and policy.searches[0] == 2
    assert np.abs(second.sample(np.linspace(0, second.times[-1], 99))[0][:, 1] - 0.2).max() > 0.3


@pytest.mark.parametrize("name", NAMES)
def test_other_tasks_are_refused(name):
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, **BY_RATES)
    assert f"policy={name} needs the map of task navigate" in refusal(make_scripted, name, vec)


def test_a_gap_that_is_too_narrow_for_the_radius_is_passed_at_a_share_of_it():
    gap = scene_of([(BOX, (0.1, 2.0, 4.0), (0.0, side * 2.4 + 0.5, 4.0), 0.0) for side in (-1.0, 1.0)])  # of 0.8 m
    path = shortest_path(START, GOAL, SPACE, gap, 0.6)
    inside = np.abs(path[:, 0]) < 0.1
    most = 0.4 - min(SHARES) * 0.6 + 0.02
    assert inside.any() and np.abs(path[inside, 1] - 0.5).max() < most


def test_a_payload_without_a_way_is_refused():
    wall = scene_of([(BOX, (0.1, 4.0, 4.0), (0.0, 0.0, 4.0), 0.0)])
    with pytest.raises(ConfigError, match="lower the radius"):
        shortest_path(START, GOAL, SPACE, wall, 0.3)
