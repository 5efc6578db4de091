"""Take-off: its starts on the ground, its plan, what is forgiven there, its success."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make, refusal, zeros
from test_scripted_flights import fly_once

import multilift_marl as ml
from multilift_marl.errors import warn_once
from multilift_marl.math3d import axis_angle
from multilift_marl.mdp.ground import CREEP, resting_distance
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.tasks import land, takeoff
from multilift_marl.tasks.takeoff import FLYING, LIFT, LIFTED, PULL, RESTING, SLACK, TAUT, TIGHTEN

ARRIVED = LIFT[0] + LIFT[1]  # [s]
CALM = {"randomization.payload_mass": 0.0}


def after(seconds: float, num_envs: int = 1, **overrides):
    """Return take-offs that the formation has flown for so long."""
    vec = make("takeoff", num_envs=num_envs, **overrides)
    vec.reset(seed=0)
    for _ in range(round(seconds / vec.task.dt)):
        vec.step(zeros(vec))
    return vec


# Starts


def test_takeoff_starts_are_as_documented():
    vec = make("takeoff", num_envs=4000)
    vec.reset(seed=0)
    goal, state, system = vec.task.goal, vec.world.state, vec.world.system
    assert np.abs(goal.position[:, :2]).max() <= 1 and np.ptp(goal.position[:, :2], axis=0).min() > 1.99
    assert np.degrees(np.abs(goal.yaw).max()) <= 45 and np.degrees(np.ptp(goal.yaw)) > 89
    np.testing.assert_allclose(state.payload_position[:, 2], system.payload_size[2] / 2)
    np.testing.assert_array_equal(state.payload_position, goal.position)
    assert vec.task.errors.angle.max() < 1e-7
    np.testing.assert_allclose(state.drone_position[..., 2], 0.3 * system.vehicle.arm)
    assert (state.cable_tension == 0).all() and (state.drone_velocity == 0).all()
    np.testing.assert_allclose(goal.slots, state.drone_position, atol=1e-12)
    away = np.linalg.norm((state.drone_position - state.payload_position[:, None])[..., :2], axis=-1)
    middle = np.hypot(*system.slots[0, :2])
    assert middle - 0.1 <= away.min() < middle - 0.09 and middle + 0.09 < away.max() <= middle + 0.1


@pytest.mark.parametrize("model", ["massless", "chain"])
def test_a_team_that_stands_does_not_drift(model, num_drones):
    vec = make("takeoff", num_envs=2, num_drones=num_drones, **{"cable.model": model})
    vec.reset(seed=0)
    world, state = vec.world, vec.world.state
    before = [array.copy() for array in (state.payload_position, state.drone_position)]
    world.step(np.zeros((2, num_drones, 4)), nstep=500)
    for now, was in zip((state.payload_position, state.drone_position), before, strict=True):
        np.testing.assert_allclose(now, was, atol=1.5e-3 if model == "chain" else 2e-4)  # in two seconds
    assert not world.diverged.any()


def test_drones_beside_a_payload_too_wide_for_their_cables_are_refused():
    wide = {"payload.size": [3.0, 3.0, 0.1], "payload.anchors": [[0.3, 0, 0.05], [-0.3, 0.3, 0.05], [-0.3, -0.3, 0.05]]}
    message = refusal(ml.make_vec, "takeoff", num_envs=1, num_drones=3, **wide)
    assert "cable 0 is too short" in message and "cable.length" in message and "start_spread" in message


# The plan


@pytest.mark.parametrize(("task", "advance"), [("takeoff", takeoff.advance), ("land", land.advance)])
def test_accelerations_of_slots_are_the_slopes_of_their_velocities(task, advance):
    vec, step, fastest = make(task, num_envs=1), 1e-4, 0.0
    vec.reset(seed=0)
    goal = vec.task.goal
    for time in np.arange(0.13, 11.0, 0.16):
        velocity = []
        for at in (time - step, time + step, time):
            vec.task.time[0] = at
            advance(0, vec.task.view_for(advance))
            velocity.append(goal.slot_velocity[0].copy())
        slope = (velocity[1] - velocity[0]) / (2 * step)
        np.testing.assert_allclose(goal.slot_acceleration[0], slope, atol=1e-4)
        fastest = max(fastest, np.abs(slope).max())
    assert fastest > 0.3


def test_the_velocities_of_the_plan_are_those_of_target_and_slots():
    vec = make("takeoff", num_envs=1, **{"env.policy_hz": 250})
    vec.reset(seed=0)
    goal, rows = vec.task.goal, []
    for _ in range(round(ARRIVED * 250)):
        vec.step(zeros(vec))
        rows.append([x[0].copy() for x in (goal.position, goal.velocity, goal.slots, goal.slot_velocity)])
    target, target_velocity, slots, slot_velocity = (np.array(x) for x in zip(*rows, strict=True))
    np.testing.assert_allclose(np.gradient(target, 0.004, axis=0)[1:-1], target_velocity[1:-1], atol=1e-3)
    own = np.gradient(slots - target[:, None], 0.004, axis=0)
    np.testing.assert_allclose(own[1:-1], slot_velocity[1:-1], atol=0.02)  # the closing of the cables is not told
    assert np.abs(slot_velocity).max() > 0.5
    assert target[-1, 2] == pytest.approx(vec.task.options.target_height, abs=1e-6)


@pytest.mark.parametrize(
    ("task", "advance", "until", "bound"),
    [("takeoff", takeoff.advance, takeoff.time_to_lift, -4.0), ("land", land.advance, land.time_to_touch, -np.inf)],
)
def test_at_half_the_pace_the_plan_takes_twice_the_time(task, advance, until, bound):
    usual, slow = (make(task, num_envs=1, **{"task_options.pace": pace}) for pace in (1.0, 0.5))
    fastest = 0.0
    for vec in (usual, slow):
        vec.reset(seed=0)
    for seconds in (0.5, 2.0, 3.4, 4.5, 5.6, 7.0, 9.3):
        for vec, time in ((usual, seconds), (slow, 2 * seconds)):
            vec.task.time[0] = time
            advance(0, vec.task.view_for(advance))
        goal, other = usual.task.goal, slow.task.goal
        np.testing.assert_allclose(other.position, goal.position, atol=1e-9)
        np.testing.assert_allclose(2 * other.velocity, goal.velocity, atol=1e-9)
        np.testing.assert_allclose(2 * other.slot_velocity, goal.slot_velocity, atol=1e-9)
        fastest = max(fastest, np.abs(goal.velocity).max(), np.abs(goal.slot_velocity).max())
        left = [until(0, 0, vec.task.view_for(until)) for vec in (usual, slow)]
        assert left[1] == pytest.approx(max(2 * left[0], bound)) or left[0] == bound
    assert fastest > 0.2


def at(vec, seconds: float):
    """Return the goal of a plan at a time."""
    vec.task.time[0] = seconds
    takeoff.advance(0, vec.task.view_for(takeoff.advance))
    return vec.task.goal


def test_a_margin_is_gone_through_slowly_and_the_rest_of_the_plan_is_later():
    margin, more = 0.05, 2 * 0.05 / CREEP
    usual, wide = (make("takeoff", num_envs=1, **{"task_options.margin": value}) for value in (0.0, margin))
    for vec in (usual, wide):
        vec.reset(seed=0)
    near, far = (at(vec, TIGHTEN[0]).slots.copy() for vec in (usual, wide))
    np.testing.assert_allclose(np.linalg.norm(near - far, axis=-1), margin, rtol=0.01)  # short of taut
    slots = np.array([at(wide, TIGHTEN[0] + share * more).slots[0].copy() for share in (0.2, 0.4, 0.6, 0.8)])
    rates = np.linalg.norm(np.diff(slots, axis=0), axis=-1) / (0.2 * more)
    assert (rates < 1.1 * CREEP).all() and (rates > 0.9 * CREEP).all()
    near, far = (at(vec, PULL[0] + later).slots.copy() for vec, later in ((usual, 0.0), (wide, more)))
    np.testing.assert_allclose(np.linalg.norm(near - far, axis=-1), margin, rtol=0.01)  # beyond taut
    for seconds in (PULL[0] + PULL[1], LIFT[0] + 1.0, ARRIVED):
        np.testing.assert_allclose(at(wide, seconds + more).slots, at(usual, seconds).slots, atol=1e-12)
        np.testing.assert_allclose(wide.task.goal.cable_force, usual.task.goal.cable_force, atol=1e-9)


def test_with_a_margin_drones_that_miss_their_places_snatch_less():
    peaks = []
    for margin in (0.0, 0.05):
        slow = {"task_options.pace": 0.5, "task_options.margin": margin, "env.episode_seconds": 32.0}
        vec = make("takeoff", num_envs=1, **CALM, **slow)
        vec.reset(seed=0)
        actions = zeros(vec)
        actions[0, :, 2] = np.array([0.04, -0.04, 0.04, -0.04]) / vec.config.control.max_offset
        for _ in range(vec.max_steps - 1):
            vec.step(actions)
        assert vec.task.own.stage[0] == LIFTED
        peaks.append(float(vec.world.stats.tension_peak[0]))
    assert peaks[0] > 3 * peaks[1] and peaks[1] < 2 * vec.world.system.resting_tension.max()


@pytest.mark.parametrize("hook", [[0.0, 0.0, -0.1], [0.02, 0.01, -0.06]])
def test_hooks_of_level_drones_are_short_of_taut_by_as_much(hook):
    """Drones lean as much as they pull, and their hooks are to stay where the cables end."""
    vec = make("takeoff", num_envs=1, **{"cable.hook": hook}, **CALM)
    vec.reset(seed=0)
    system, state = vec.world.system, vec.world.state
    for seconds, share in ((TIGHTEN[0], -SLACK), (PULL[0], TAUT)):
        goal = at(vec, seconds)
        turned = axis_angle((0.0, 0.0, 1.0), float(goal.yaw[0]))
        level = np.array(turned).reshape(3, 3)  # payload and drones, whose headings are the payload's
        hooks = goal.slots[0] + hook @ level.T
        anchors = state.payload_position[0] + system.anchors @ level.T
        np.testing.assert_allclose(np.linalg.norm(hooks - anchors, axis=1), 1.0 + share, atol=2e-4)
    goal = at(vec, ARRIVED)
    expected = goal.position[0] + system.slots @ level.T
    np.testing.assert_allclose(goal.slots[0], expected, atol=1e-9)  # leaning as they do in flight


@pytest.mark.parametrize("task", ["takeoff", "land"])
@pytest.mark.parametrize("rig", [{"cable.hook": [0.02, 0, -0.08]}, {"cable.length": 3.0, "env.episode_seconds": 18.0}])
def test_hooks_and_long_cables_leave_the_ground_and_come_to_it_gently(task, rig):
    vec = make(task, num_envs=8, **rig)
    _, success, failure = fly_once(vec, make_scripted("formation_integral", vec).act)
    assert success.all() and not failure.any()


@pytest.mark.parametrize("task", ["takeoff", "land"])
def test_episodes_too_short_for_a_slow_plan_are_warned_of(task, caplog):
    warn_once.cache_clear()
    make(task, num_envs=1, **{"env.episode_seconds": 3.0})  # the usual plan, cut on purpose
    assert not caplog.records
    make(task, num_envs=1, **{"cable.length": 3.0})
    [record] = caplog.records
    assert f"task {task} can succeed from" in record.message and "env.episode_seconds=" in record.message


@pytest.mark.parametrize("task", ["takeoff", "land"])
def test_margins_beyond_a_fifth_of_a_cable_are_refused(task):
    message = refusal(ml.make_vec, task, num_envs=1, **{"task_options.margin": 0.21, "cable.length": 1.0})
    assert "task_options.margin=0.21 m is 0.21 of a cable's length" in message and "cable.length" in message


def test_cables_are_slack_until_the_drones_close_them_and_taut_when_they_pull():
    assert (after(TIGHTEN[0], 8).world.stats.tension_max == 0).all()
    vec = after(PULL[0] + 0.6 * PULL[1], 8)
    assert (vec.world.state.cable_tension > 0.2 * vec.world.system.resting_tension).all()
    assert (vec.task.own.stage == FLYING).all()


def test_the_team_of_a_known_payload_lifts_it_with_no_jerk_at_its_cables():
    vec = after(ARRIVED + 1.0, 4, **CALM)
    assert (vec.task.own.stage == LIFTED).all()
    assert vec.task.errors.distance.max() < 0.01
    assert (vec.world.stats.tension_max < 1.3 * vec.world.system.resting_tension.max()).all()


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_the_pull_suits_lighter_and_heavier_payloads(factor):
    vec = make("takeoff", num_envs=4, **CALM, **{"task_options.success_distance": 0.1})
    vec.reset(seed=0)
    vec.world.set_parameters(np.ones(4, bool), payload_mass=np.full(4, factor * vec.world.system.payload_mass))
    for _ in range(vec.max_steps):
        *_, info = vec.step(zeros(vec))
    assert info["success"].all()
    assert (vec.world.stats.tension_max < 1.5 * factor * vec.world.system.resting_tension.max()).all()


# What is forgiven


def cause(vec) -> str:
    vec.task.cause[:] = 0
    vec.task.stages["measure"](0, 1)
    return vec.failure_causes[vec.task.cause[0]]


def test_tensions_are_compared_with_those_at_rest_of_the_true_payload():
    vec = make("takeoff", num_envs=3, **{"payload.mass": 0.8, "randomization.payload_mass": 0.2})
    vec.reset(seed=0)
    true = vec.world.hidden_loads.payload_mass
    expected = vec.world.system.resting_tension.max() * true / 0.8
    assert np.ptp(true) > 0.01
    np.testing.assert_allclose(vec.task._resting_tension(), expected)


def test_drones_may_touch_the_ground_until_they_fly():
    vec = after(0.2)
    assert vec.task.own.stage[0] == RESTING and cause(vec) == "none"
    vec = after(TIGHTEN[0])
    assert vec.task.own.stage[0] == FLYING and cause(vec) == "none"
    vec.world.state.drone_position[0, 1, 2] = 0.03
    assert cause(vec) == "ground"


def test_the_payload_may_touch_the_ground_until_it_is_lifted():
    vec = after(PULL[0])
    assert cause(vec) == "none"
    vec = after(LIFT[0] + 0.8 * LIFT[1])
    assert vec.task.own.stage[0] == LIFTED and cause(vec) == "none"
    sunk = vec.world.state.payload_position[0, 2] - 0.078
    vec.world.state.payload_position[0, 2] -= sunk
    vec.world.state.drone_position[0, :, 2] -= sunk
    assert cause(vec) == "ground"


@pytest.mark.parametrize("seconds", [0.2, TIGHTEN[0], ARRIVED])
def test_collisions_and_tumbling_are_never_forgiven(seconds):
    vec = after(seconds)
    state = vec.world.state
    kept = state.drone_position[0, 1].copy()
    state.drone_position[0, 1] = state.drone_position[0, 0] + [0.0, -0.3, 0.05]
    assert cause(vec) == "drone_collision"
    state.drone_position[0, 1] = kept
    state.drone_rotation[0, 0] = np.reshape(axis_angle((1.0, 0.0, 0.0), 1.45), (3, 3))
    assert cause(vec) == "tilt"


# Success and reward


def test_success_is_at_the_final_target_with_never_more_than_twice_the_resting_tension():
    vec = after(9.9, 8, **{"task_options.success_distance": 0.1})
    assert vec.task.succeeded().all()
    static = (
        vec.world.system.resting_tension.max() * vec.world.hidden_loads.payload_mass / vec.world.system.payload_mass
    )
    vec.world.stats.tension_max[:4] = 2.01 * static[:4]
    assert vec.task.succeeded().tolist() == [False] * 4 + [True] * 4
    vec.task.good_time[:] = 1.9
    assert not vec.task.succeeded().any()


def test_errors_on_the_way_do_not_count_as_success():
    vec = after(ARRIVED - 0.1, 4, **CALM)
    assert (vec.task.good_time == 0).all() and vec.task.errors.distance.max() < 0.05


@pytest.mark.slow
def test_the_integral_formation_takes_off():
    vec = make("takeoff", num_envs=64)
    _, success, failure = fly_once(vec, make_scripted("formation_integral", vec).act)
    assert not failure.any() and success.mean() >= 0.9


@pytest.mark.slow
def test_in_return_motors_off_lose_to_standing_by_to_the_formation_to_its_integral():
    def score(script=None, raised=0.0, **gains):
        vec = make("takeoff", num_envs=32, **{"control.max_offset": 0.5})
        vec.controller.gains = vec.controller.gains._replace(**gains)
        vec._bind()
        vec.reset(seed=0)
        action = zeros(vec)
        action[..., 2] = raised
        total, *_ = fly_once(vec, make_scripted(script, vec).act if script else lambda observation: action)
        return total.mean()

    off, low = score(thrust_min=np.zeros(4), thrust_max=np.zeros(4)), score(raised=-0.5)
    formation, integral = score("formation"), score("formation_integral")
    assert off < 0.35 * formation
    assert off < low < 0.8 * formation
    assert formation < 0.97 * integral


def test_drones_rest_at_their_slots_distance_or_clear_of_the_payload():
    narrow = make("takeoff").world.system
    np.testing.assert_allclose(resting_distance(narrow, 0.0), np.hypot(narrow.slots[:, 0], narrow.slots[:, 1]))
    wide = make("takeoff", **{"payload.size": [1.6, 1.2, 0.1], "cable.length": 3.0, "cable.angle": 0.0}).world.system
    clear = 1.0 + 1.5 * wide.vehicle.arm + 0.2  # half the diagonal, the drone's reach, the spread
    np.testing.assert_allclose(resting_distance(wide, 0.2), clear)
    level = clear - np.hypot(*wide.anchors[0, :2]) + 0.2
    said = refusal(make, "takeoff", **{"payload.size": [1.6, 1.2, 0.1], "cable.length": 0.6, "cable.angle": 0.0,
                                      "task_options.start_spread": 0.2 / 0.6})  # fmt: skip
    height = 0.05 + 0.05 - drone_half_size(wide.vehicle)[2]
    assert f"takes {np.hypot(level, height) / 0.6:.2f} of its length" in said


def test_drones_start_within_a_share_of_their_shortest_cable():
    """`start_spread` is in lengths of the shortest cable."""
    for length in (0.5, 2.0):
        task = ml.make_vec("takeoff", **{"env.num_envs": 1, "env.num_drones": 3, "cable.length": length}).task
        assert task._spread == pytest.approx(length * task.options.start_spread)


@pytest.mark.parametrize("task", ["takeoff", "land"])
def test_a_team_may_begin_anywhere(task):
    """Beside another origin the same episodes succeed, and drones observe the same."""
    flown = []
    for origin in ([0.0, 0.0], [30.0, -20.0]):
        vec = make(task, num_envs=4, **{"task_options.origin": origin})
        observation, _ = vec.reset(seed=5)
        policy, seen = make_scripted("formation_integral", vec), [observation.copy()]
        for _ in range(vec.max_steps - 1):
            observation, *_ = vec.step(policy.act(observation))
            seen.append(observation.copy())
        state = vec.world.state
        level = [each.excess() for each in vec.task.criteria()]
        flown.append((np.array(seen), state.payload_position - [*origin, 0.0], vec.task.succeeded(), level))
    here, there = flown
    np.testing.assert_allclose(there[0], here[0], atol=2e-5)
    np.testing.assert_allclose(there[1], here[1], atol=1e-6)
    assert here[2].all() and there[2].all()
    np.testing.assert_allclose(np.array(there[3]), np.array(here[3]), atol=1e-5)
