"""Task gate: the way through, what touches, and what drones are told."""

from functools import partial

import numpy as np
import pytest
from conftest import make, refusal, zeros

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import fitting_scripts, make_scripted


def reset(num_envs: int = 4, **options):
    """Return environments at their starts; options of the task by name."""
    vec = make("gate", num_envs=num_envs, **{f"task_options.{key}": value for key, value in options.items()})
    vec.reset(seed=0)
    return vec


def run(vec, seconds: float):
    """Fly the formation and return positions of the target (T, E, 3) and who ended with which cause."""
    path, causes = [], {}
    for _ in range(round(50 * seconds)):
        _, _, terminated, truncated, info = vec.step(zeros(vec))
        path.append(vec.task.goal.position.copy())
        for e in np.flatnonzero(terminated):
            causes[e] = vec.failure_causes[info["failure_cause"][e]]
        if (terminated | truncated).any():
            break
    return np.array(path), causes


@pytest.mark.parametrize(("gates", "reach"), [(1, 2.0), (2, 2.0), (3, 2.75)])
def test_the_target_flies_straight_through_every_gap(gates, reach):
    vec = reset(gates=gates, gap_width=4.0, gap_height=10.0)
    middles = vec.task.own.gap_y.copy()
    path, causes = run(vec, 12.0)
    assert not causes
    np.testing.assert_allclose(path[0], np.tile([-reach, 0, 1.3], (4, 1)), atol=1e-9)
    np.testing.assert_allclose(path[-1], np.tile([reach, 0, 1.3], (4, 1)), atol=1e-9)
    for e in range(4):
        for x, y in zip(vec.task.settings.x, middles[e], strict=True):
            inside = np.abs(path[:, e, 0] - x) < 0.2
            assert inside.sum() > 5
            np.testing.assert_allclose(path[inside, e, 1], y, atol=1e-9)
    assert np.abs(middles).max() <= 0.3 and np.ptp(middles) > 0.1


def test_the_formation_hits_the_wall_where_it_stands():
    vec = reset(num_envs=8)
    seen = {}
    for _ in range(500):
        _, _, terminated, _, info = vec.step(zeros(vec))
        for e in np.flatnonzero(terminated):
            seen[e] = (vec.failure_causes[info["failure_cause"][e]], vec.world.state.drone_position[e].copy())
        if terminated.any():
            break
    cause, drones = next(iter(seen.values()))
    assert cause == "wall"
    assert np.abs(drones[:, 0]).min() < 0.25


def test_a_wide_gap_lets_the_formation_pass_and_succeed():
    vec = reset(num_envs=8, gap_width=1.8)
    for _ in range(vec.max_steps):
        _, _, terminated, _, info = vec.step(zeros(vec))
        assert not terminated.any()
    assert info["success"].all()
    assert (1 < vec.task.own.peak_tension).all() and (vec.task.own.peak_tension < 1.5).all()


@pytest.mark.parametrize(
    ("field", "value", "option"),
    [
        ("payload_rotation", [[0, -1, 0], [1, 0, 0], [0, 0, 1]], {"success_angle": 91.0}),
        ("payload_velocity", [0.15, 0, 0], {"success_speed": 0.2}),
        ("payload_body_rates", [0, 0, 0.3], {"success_body_rate": 0.4}),
        ("cable_tension", [20.0] * 4, {"success_tension": 6.0}),
    ],
    ids=["attitude", "speed", "body rate", "tension"],
)
def test_success_asks_for_rest_in_the_target_attitude(field, value, option):
    for given, options in ((None, {}), (value, {}), (value, option)):
        vec = reset(num_envs=1, start_radius=0.0, **options)
        state, task = vec.world.state, vec.task
        state.payload_rotation[0] = task.goal.rotation[0] = np.eye(3)
        if given is not None:
            getattr(state, field)[0] = given
        task.stages["plan"](0, 1)
        task.time[0], task.goal.position[0] = 14.0, state.payload_position[0]
        task.goal.rotation[0] = np.eye(3)
        task.stages["measure"](0, 1)
        score = partial(task.stages["reward"], 0, 1)
        for _ in range(51):
            score()
        assert task.succeeded()[0] == (given is None or bool(options))


@pytest.mark.parametrize(
    "drone, touches",
    [((0.0, 0.0, 2.0), False), ((0.0, 0.44, 2.0), True), ((0.2, 0.44, 2.0), False), ((0.0, 0.0, 2.99), True)],
)
def test_a_drone_touches_beside_and_above_the_gap_alone(drone, touches):
    from multilift_marl.tasks.gate import least_room

    vec = reset(num_envs=1)
    state, task = vec.world.state, vec.task
    task.own.gap_y[0] = 0.0
    state.payload_position[0], state.payload_rotation[0] = [drone[0], 0, 1.3], np.eye(3)
    state.drone_position[0] = [[x, 0.0, 2.0] for x in (0.8, -0.8, 1.2, -1.2)]
    state.drone_rotation[0] = np.eye(3)
    state.drone_position[0, 0] = drone
    state.payload_position[0, 0] = 1.0  # the load is past the wall
    state.drone_position[0, 1:, 0] = [0.8, 1.0, 1.2]
    room = least_room(0, task.view)
    assert (room < 0) == touches


@pytest.mark.slow
def test_a_cable_touches_too():
    from multilift_marl.tasks.gate import _cable_room

    view = reset(num_envs=1).task.view
    view.own.gap_y[0] = 0.0
    assert _cable_room(0, 0, (-0.5, 0.0, 1.3), (0.5, 0.9, 2.0), view) > 0  # crosses at y = 0.45
    assert _cable_room(0, 0, (-0.5, 0.2, 1.3), (0.5, 0.9, 2.0), view) < 0
    assert _cable_room(0, 0, (0.3, 2.0, 1.3), (0.5, 2.0, 2.0), view) == 1


def test_each_gap_is_as_wide_as_was_drawn_for_it_and_the_walls_are_so():
    vec = reset(num_envs=200, gates=3, gap_width=[0.8, 1.2])
    widths = 2 * vec.task.own.half_width
    assert widths.shape == (200, 3) and (0.8 <= widths).all() and (widths <= 1.2).all()
    assert np.abs(np.quantile(widths, [0.25, 0.5, 0.75]) - [0.9, 1.0, 1.1]).max() < 0.02
    assert np.abs(np.corrcoef(widths.T) - np.eye(3)).max() < 0.2
    left, right = vec.task.scenery(7)[3:5]  # of the second wall
    np.testing.assert_allclose(right.position[1] - left.position[1] - 2 * left.size[1], widths[7, 1], rtol=1e-9)


def test_a_width_that_is_given_draws_nothing():
    given, drawn = reset(gates=2), reset(gates=2, gap_width=[0.8, 1.2])
    np.testing.assert_array_equal(given.task.own.gap_y, drawn.task.own.gap_y)
    assert (given.task.own.half_width == 0.5).all()


def test_a_drone_is_told_its_own_next_gap_and_its_room():
    vec = reset(num_envs=1, gates=2, gap_width=[0.8, 1.2])
    names, state, task = vec.observation_names, vec.world.state, vec.task
    task.own.gap_y[0] = [0.2, -0.1]
    edge = 0.05 + np.hypot(*task.settings.drone[0, :2]) + 0.05  # from where on nothing of a drone is in a wall
    x = np.array([-1.0, -0.75 + 0.9 * edge, -0.75 + 1.1 * edge, 0.75 + 1.1 * edge])
    state.drone_position[0] = [[at, 0.05, 2.0] for at in x]
    state.drone_rotation[0] = np.eye(3)
    task.stages["observe"](0, 1)
    observation = task.observation[0]
    half = task.own.half_width[0]
    told = {name: observation[:, names.index(name)] for name in ("gap_0", "gap_1", "clearance_0", "gap_distance_0")}
    c, s = task.goal.slot_frame[0].T
    across = np.array([-0.15, -0.15, 0.15, 0.0])  # y of the drones from the middles: of the first gap, second, none
    np.testing.assert_allclose(told["gap_0"], s * across, atol=1e-6)
    np.testing.assert_allclose(told["gap_1"], c * across, atol=1e-6)
    room = np.array([half[0], half[0], half[1]]) - 0.15 - task.settings.drone[0, 1]
    np.testing.assert_allclose(told["clearance_0"], [*room, 0.5], atol=1e-6)
    np.testing.assert_allclose(told["gap_distance_0"], x - [-0.75, -0.75, 0.75, 0.75], atol=1e-6)


def test_a_formation_drawn_in_passes_level():
    flown = run_episodes(load_config("gate"), partial(make_scripted, "formation_narrow"), 16, seed=3)
    assert flown["success_rate"].all()
    assert flown["payload_position_error_m"].max() < 0.01 and flown["payload_attitude_error_deg"].max() < 0.5
    vec = make("hover", num_envs=1)
    assert "formation_narrow" not in fitting_scripts(vec)
    assert "formation_narrow is for gaps" in refusal(make_scripted, "formation_narrow", vec)


@pytest.mark.parametrize("times", [(8.0, 5.0), (5.0, 5.0), (12.0, 11.0)])
def test_a_target_that_arrives_before_it_leaves_is_refused(times):
    given = dict(zip(("task_options.set_off", "task_options.arrival"), times, strict=True))
    assert "must be later than set_off" in refusal(make, "gate", **given)


def test_no_team_starts_in_a_wall():
    """Starts that would are drawn again, as others that fail."""
    vec = make("gate", 64, **{"task_options.start_radius": 3.0})
    vec.reset(seed=0)
    for _ in range(3):
        *_, info = vec.step(zeros(vec))
    assert not (info["failure_cause"] == vec.failure_causes.index("wall")).any()
