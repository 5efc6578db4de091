"""Landing: its starts, touch-down, what is forgiven, its success."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, make, zeros
from test_scripted_flights import fly_once

from multilift_marl.config.load import load_config
from multilift_marl.mdp.ground import CREEP
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.tasks import land
from multilift_marl.tasks.land import AIRBORNE, CRASHED, LANDED, LOWER, NEAR, RELEASE, SETTLE

CALM = {"randomization.payload_mass": 0.0}


def after(seconds: float, num_envs: int = 1, **overrides):
    """Return landings that the formation has flown for so long."""
    vec = make("land", num_envs=num_envs, **overrides)
    vec.reset(seed=0)
    for _ in range(round(seconds / vec.task.dt)):
        vec.step(zeros(vec))
    return vec


def judge(vec) -> str:
    """Return the cause of failure of the first environment at the end of a step in its present state."""
    for stage in ("check", "reward"):
        vec.task.stages[stage](0, 1)
    return vec.failure_causes[vec.task.cause[0]]


def touch_down(velocity, aside=(0.0, 0.0), height=0.004):
    """Return a landing whose payload has just come down with `velocity` [m/s], `aside` of its pad [m]."""
    vec = make("land", num_envs=1)
    vec.reset(seed=0)
    state, task = vec.world.state, vec.task
    moved = task.own.course[0, :2] + aside, state.payload_position[0, 2] - 0.075 - height
    for array in (state.payload_position[0], state.drone_position[0].T):
        array[0], array[1], array[2] = array[0] + moved[0][0], array[1] + moved[0][1], array[2] - moved[1]
    state.payload_velocity[0] = velocity
    return vec


# Starts


@pytest.mark.slow
def test_land_starts_are_as_documented():
    vec = make("land", num_envs=2000)
    vec.reset(seed=0)
    state, task, system = vec.world.state, vec.task, vec.world.system
    np.testing.assert_allclose(state.payload_position, np.broadcast_to([0, 0, 1.5], (2000, 3)))
    assert np.abs(task.own.course[:, :2]).max() <= 1 and np.ptp(task.own.course[:, :2], axis=0).min() > 1.99
    assert np.degrees(np.abs(task.goal.yaw).max()) <= 45 and np.degrees(np.ptp(task.goal.yaw)) > 89
    assert (state.payload_velocity == 0).all() and task.errors.angle.max() < 1e-7
    expected = system.resting_tension * (vec.world.hidden_loads.payload_mass / system.payload_mass)[:, None]
    np.testing.assert_allclose(state.cable_tension, expected, rtol=1e-6)


# Touch-down


@pytest.mark.parametrize(
    "velocity, aside, height, touch, cause",
    [
        ([0, 0, -0.29], (0, 0), 0.004, LANDED, "none"),
        ([0, 0, -0.31], (0, 0), 0.004, CRASHED, "ground"),
        ([0.22, 0, -0.22], (0, 0), 0.004, CRASHED, "ground"),
        ([0, 0, -0.1], (0.07, 0.07), 0.004, LANDED, "none"),
        ([0, 0, -0.1], (0.08, 0.08), 0.004, CRASHED, "ground"),
        ([0, 0, -0.5], (0, 0), 0.02, AIRBORNE, "none"),
    ],
    ids=["soft", "hard", "sideways", "on the pad", "off the pad", "not yet"],
)
def test_a_payload_comes_down_softly_on_its_pad_or_fails(velocity, aside, height, touch, cause):
    vec = touch_down(velocity, aside, height)
    vec.task.goal.position[0] = vec.world.state.payload_position[0]
    assert judge(vec) == cause
    assert vec.task.own.touch[0] == touch


def test_a_payload_that_has_bounced_after_a_hard_touch_down_has_still_failed():
    vec = touch_down([0, 0, -0.5])
    judge(vec)
    vec.world.state.payload_velocity[0] = 0
    assert judge(vec) == "ground"
    assert not vec.task.succeeded()[0]


def test_the_speed_a_control_step_before_the_touch_counts_too():
    vec = touch_down([0, 0, -0.1])
    vec.task.own.speed[0] = 0.31
    assert judge(vec) == "ground"


def test_drones_may_never_touch_the_ground():
    vec = after(LOWER[0])
    assert vec.task.own.touch[0] == LANDED and judge(vec) == "none"
    vec.world.state.drone_position[0, 2, 2] = 0.03
    assert judge(vec) == "ground"


# Success and reward


def test_the_team_lets_go_without_moving_the_payload():
    vec = after(RELEASE[0] + 0.2, 8, **CALM)
    assert (vec.task.own.touch == LANDED).all()
    before = vec.world.state.payload_position.copy()
    for _ in range(round(5.0 / 0.02)):
        vec.step(zeros(vec))
    after_all = vec.world.state.payload_position
    np.testing.assert_allclose(after_all[:, :2], before[:, :2], atol=2e-3)
    np.testing.assert_allclose(after_all[:, 2], 0.075, atol=1e-3)
    assert (vec.world.state.cable_tension == 0).all()


@pytest.mark.parametrize("spoil", ["nothing", "move", "pull", "near payload", "near ground", "slide", "lift"])
def test_success_is_at_rest_slack_and_clear_throughout_the_last_second(spoil):
    vec = after(11.0, **CALM)
    assert judge(vec) == "none"
    state, task = vec.world.state, vec.task
    task.good_time[0] = 1.0
    if spoil == "move":
        state.payload_velocity[0, 0] = 0.03
    if spoil == "pull":
        state.cable_tension[0, 1] = 0.01
    if spoil == "near payload":
        state.drone_position[0, 1, 2] = 0.15 + 0.3 + 0.05
        state.drone_position[0, 1, :2] = state.payload_position[0, :2]
    if spoil == "near ground":
        state.drone_position[0, 1, 2] = 0.35
    if spoil == "slide":
        state.payload_position[0, 0] += 0.12
    if spoil == "lift":
        state.payload_position[0, 2] += 0.006
    judge(vec)
    assert task.succeeded()[0] == (spoil == "nothing")
    assert (task.good_time[0] > 0) == (spoil == "nothing")


@pytest.mark.parametrize("above", [0.28, 0.32])
def test_clearance_is_from_the_payloads_surface_wherever_its_centre_of_mass_is(above):
    vec = after(11.0, **CALM, **{"payload.center_of_mass": [0.0, 0.0, 0.05]})
    state, system = vec.world.state, vec.world.system
    half = np.linalg.norm(drone_half_size(system.vehicle))
    top = state.payload_position[0, 2] + system.payload_center[2] + system.payload_size[2] / 2
    state.drone_position[0, 1] = [*state.payload_position[0, :2], top + half + above]
    vec.task.good_time[0] = 1.0
    judge(vec)
    assert (vec.task.good_time[0] > 0) == (above > 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("script", ["formation", "formation_integral"])
def test_scripts_land(script):
    vec = make("land", num_envs=64)
    _, success, failure = fly_once(vec, make_scripted(script, vec).act)
    assert success.mean() >= 0.9 and failure.mean() <= 0.1


@pytest.mark.slow
def test_in_return_motors_off_lose_to_staying_high_to_the_formation_to_its_integral():
    def score(script=None, **gains):
        vec = make("land", num_envs=32)
        vec.controller.gains = vec.controller.gains._replace(**gains)
        vec._bind()
        vec.reset(seed=0)
        high = zeros(vec)
        high[..., 2] = 1.0  # drones stay half a metre above the plan: the payload never comes down
        total, *_ = fly_once(vec, make_scripted(script, vec).act if script else lambda observation: high)
        return total.mean()

    off, high = score(thrust_min=np.zeros(4), thrust_max=np.zeros(4)), score()
    formation, integral = score("formation"), score("formation_integral")
    assert off < 0.2 * high
    assert high < 0.8 * formation
    assert formation < integral


def test_with_a_margin_the_payload_settles_more_slowly_and_the_rest_is_later():
    margin, more = 0.05, 0.05 / CREEP
    usual, wide = (make("land", num_envs=1, **{"task_options.margin": value}) for value in (0.0, margin))
    for vec in (usual, wide):
        vec.reset(seed=0)

    def at(vec, seconds: float):
        vec.task.time[0] = seconds
        land.advance(0, vec.task.view_for(land.advance))
        return vec.task.goal

    np.testing.assert_array_equal(at(wide, SETTLE[0]).position, at(usual, SETTLE[0]).position)
    for share in (0.25, 0.5, 0.75):
        slow, fast = (at(vec, SETTLE[0] + share * (SETTLE[1] + add)) for vec, add in ((wide, more), (usual, 0.0)))
        np.testing.assert_allclose(slow.position, fast.position, atol=1e-12)
        np.testing.assert_allclose(slow.velocity * (SETTLE[1] + more) / SETTLE[1], fast.velocity, atol=1e-12)
    for seconds in (RELEASE[0] + 1.0, LOWER[0] + 0.5, LOWER[0] + LOWER[1]):
        np.testing.assert_allclose(at(wide, seconds + more).slots, at(usual, seconds).slots, atol=1e-12)
        np.testing.assert_allclose(wide.task.goal.cable_force, usual.task.goal.cable_force, atol=1e-9)
    for vec, add in ((usual, 0.0), (wide, more)):
        at(vec, 1.0)
        left = land.time_to_touch(0, 0, vec.task.view_for(land.time_to_touch))
        assert left == pytest.approx(SETTLE[0] + SETTLE[1] + add - 1.0)


def test_the_slow_last_part_of_the_descent_scales_with_the_vehicle():
    vec = make(load_config("rigs/crazyflie2", {"task": "land"}), num_envs=1)
    vec.reset(seed=0)
    task, ground = vec.task, vec.task.settings.ground
    while task.time[0] < SETTLE[0] - 0.5 * task.control_dt:
        task.stages["plan"](0, 1)
    assert ground.size < 0.5
    assert task.goal.position[0, 2] - ground.payload == pytest.approx(NEAR * ground.size, rel=1e-6)


def test_cables_that_are_not_yet_slack_are_missed_by_what_they_pull_beyond_their_own_weight():
    vec = make("land", num_envs=2, **{"cable.model": "chain", "cable.density": 0.05})
    vec.reset(seed=0)
    weight = GRAVITY * 0.05 * vec.world.system.cable_length
    [criterion] = [each for each in vec.task.criteria() if each.name == "cable_force_n"]
    expected = (vec.world.state.cable_tension - weight).max(axis=1)
    assert (expected > 1).all()
    np.testing.assert_allclose(criterion.excess(), expected)
