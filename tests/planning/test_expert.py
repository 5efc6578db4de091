"""The batched expert: goals of every kind, batches, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.errors import ConfigError
from multilift_marl.planning.expert import TeamExpert
from multilift_marl.planning.goals import path_goal, pose_goal, sampled_goal
from multilift_marl.planning.paths import CIRCLE, FILE, RAMP, Path

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

N = 3
HOME = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def expert():
    return TeamExpert(ml.load_config("hover", {"env.num_drones": N}))


def turned(yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def circles(count, rate=0.5):
    path = Path.zeros(count)
    path.kind[:], path.size[:], path.rate[:] = CIRCLE, 2.0, rate
    path.centre[:, 2] = np.arange(count)
    return path


def test_a_team_at_its_goal_stays_there_at_no_cost(expert):
    states = expert.rest_states(np.array([[0.0, 0.0, 1.0], [2.0, -1.0, 3.0]]))
    plans = expert.solve(states, pose_goal(expert.times, states[:, :3]))
    assert plans.converged.all() and not plans.active.any()
    assert plans.costs.sum() < 1e-9 and abs(plans.states - states[:, None]).max() < 1e-6


def test_a_pose_is_held_for_all_or_for_each():
    expert = TeamExpert(ml.load_config("hover", {"env.num_drones": N, "planner.steps": 5}))
    one = pose_goal(expert.times, HOME)
    assert one.positions.shape == (1, 6, 5, 3) and (one.positions == HOME).all()
    rotations = np.stack([turned(0.3), turned(-1.0)])
    each = pose_goal(expert.times, np.stack([HOME, 2 * HOME]), rotations)
    assert (each.positions[1] == 2 * HOME).all() and (each.rotations == rotations[:, None, None]).all()
    both = pose_goal(expert.times, HOME, rotations)
    assert both.positions.shape == (2, 6, 5, 3)


def test_a_sampled_trajectory_passes_its_samples_and_turns_smoothly(expert):
    at = np.arange(0.0, 2.01, 0.25)
    positions = np.stack([np.sin(at), 0.1 * at**2, 1.0 + 0.0 * at], axis=1)
    rotations = np.stack([turned(3.0 + 0.4 * t) for t in at])  # past π
    goal = sampled_goal(expert.times, at, positions, rotations, begin=0.5)
    middle = goal.positions[0, :, 2]
    assert middle[::5] == pytest.approx(positions[2:7], abs=1e-9)  # every 0.25 s
    assert goal.rotations[0, ::5, 2] == pytest.approx(rotations[2:7], abs=1e-9)
    between = goal.rotations[0, 2, 2]  # at 0.6 s
    assert between == pytest.approx(turned(3.0 + 0.4 * 0.6), abs=0.01)
    ended = sampled_goal(expert.times, at, positions, begin=5.0)
    assert ended.positions == pytest.approx(np.broadcast_to(positions[-1], ended.positions.shape))


def test_a_path_begins_where_it_is_asked_to(expert):
    path, begin = circles(2), np.array([3.0, 5.0])
    goal = path_goal(expert.times, path, begin)
    angle = 0.5 * (begin - RAMP / 2)  # the ramp costs half of itself
    expected = np.stack([2 * np.cos(angle), 2 * np.sin(angle), path.centre[:, 2]], axis=1)
    assert goal.positions[:, 0, 2] == pytest.approx(expected)
    speed = np.linalg.norm(np.diff(goal.positions[:, :, 2], axis=1), axis=-1) / 0.05
    assert speed == pytest.approx(1.0, rel=1e-3)


def test_plans_along_a_path_keep_to_it(expert):
    goal = path_goal(expert.times, circles(1), 4.0)
    start = expert.rest_states(goal.positions[0, 0, 2])
    later = expert.solve(start, goal)
    ready = expert.solve(later.targets[:, 0], goal)
    assert ready.converged.all() and later.costs.sum() > 100 * ready.costs.sum()
    assert np.linalg.norm(ready.states[0, :, :3] - goal.positions[0, :, 2], axis=-1).max() < 1e-3


def test_teams_do_not_depend_on_their_neighbours_or_on_threads(expert):
    states, goal = expert.random_states(5), pose_goal(expert.times, HOME)
    together, divided = expert.solve(states, goal), expert.solve(states, goal, threads=2)
    alone = expert.solve(states[3], goal)
    assert np.array_equal(together.inputs, divided.inputs) and np.array_equal(together.inputs[3], alone.inputs[0])


def test_loads_are_carried(expert):
    states, heavier = expert.rest_states(HOME), np.zeros((1, 7))
    heavier[0, 6] = 0.2 * expert.model.payload_mass
    plans = expert.solve(states, pose_goal(expert.times, HOME), heavier)
    lift = plans.states[0, -1, -3 * N :].reshape(N, 3)[:, 2].sum()
    weight = 9.81 * (1.2 * expert.model.payload_mass + expert.model.drone_mass.sum())
    assert lift == pytest.approx(weight, rel=0.02)


def call(expert, states=None, **changes):
    goal = changes.pop("goal", pose_goal(expert.times, HOME))
    return expert.solve(expert.rest_states(HOME) if states is None else states, goal, **changes)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda x: call(x, np.zeros((2, 12))), r"states have shape \(2, 12\); give \(E, 33\)"),
        (lambda x: call(x, np.full((2, 33), np.nan)), "state of team 0 holds numbers that are not finite"),
        (lambda x: call(x, np.r_[np.zeros(6), 1.0, 0.2, np.zeros(25)]), "cable of team 0 lies almost level"),
        (lambda x: call(x, loads=np.zeros((3, 7))), r"loads have shape \(3, 7\)"),
        (lambda x: call(x, loads=np.full((1, 7), np.inf)), "loads hold numbers that are not finite"),
        (lambda x: call(x, goal=pose_goal(x.times[:5], HOME)), "goal's positions have shape"),
        (lambda x: call(x, goal=pose_goal(x.times, np.zeros((4, 3)))), "goal's positions have shape"),
        (lambda x: call(x, threads=0), "threads=0"),
        (lambda x: call(x, elapsed=-1.0), "elapsed=-1.0"),
        (lambda x: call(x, x.random_states(2), last=call(x)), "last plans have shape"),
        (lambda x: pose_goal(x.times, np.zeros(2)), r"positions have shape \(2,\); give \(3,\)"),
        (lambda x: pose_goal(x.times, np.full(3, np.nan)), "positions hold numbers that are not finite"),
        (lambda x: pose_goal(x.times, HOME, 2 * np.eye(3)), "no rotation matrices"),
        (lambda x: pose_goal(x.times, np.zeros((2, 3)), np.stack([np.eye(3)] * 3)), "2 positions but 3 rotations"),
        (lambda x: sampled_goal(x.times, np.zeros(3), np.zeros((3, 3))), "two or more that increase"),
        (lambda x: sampled_goal(x.times, np.arange(3), np.zeros((4, 3))), r"positions have shape \(4, 3\)"),
        (lambda x: path_goal(x.times, circles(2), np.zeros(3)), "one for each of 2 paths"),
        (lambda x: path_goal(x.times, Path.zeros(1)._replace(kind=np.array([FILE]))), "needs its spline"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(expert, wrong, words):
    with pytest.raises(ConfigError, match=words):
        wrong(expert)


def test_bodies_on_one_cable_are_refused():
    with pytest.raises(ConfigError, match="two anchors or more, apart, and for points"):
        TeamExpert(ml.load_config("hover", {"env.num_drones": 1}))


@pytest.mark.parametrize("count", [1, 3])
def test_a_point_is_planned_from_a_swing_to_rest(count):
    expert = TeamExpert(ml.load_config("hover", {"env.num_drones": count, "payload.shape": "point"}))
    states = expert.rest_states(HOME)
    states[:, 0] += 0.3
    plans = expert.solve(states, pose_goal(expert.times, HOME))
    assert plans.converged.all()
    assert np.linalg.norm(plans.states[0, -1, :3] - HOME) < 0.1
    assert (plans.states[0, :, 3:6] == 0).all()  # nothing turns a point
