"""The formation, what actions make of it, and the scripts that fly it."""

from __future__ import annotations

from functools import partial
from math import cos, radians

import numpy as np
import pytest
from conftest import GRAVITY, make, make_system, refusal, slow

from multilift_marl.config.load import load_config
from multilift_marl.control.formation import Goal, place_formation
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.math3d import axis_angle, rot_z
from multilift_marl.policies.baselines import LINEAR, fitting_scripts, make_scripted
from multilift_marl.policies.formation import INTEGRAL_GAIN, LEAD_GAIN
from multilift_marl.rig.constants import make_rig

# The formation


def placed(system, yaw=0.0, tilt=None, position=(0.3, -0.2, 1.5)) -> Goal:
    goal = Goal.zeros(1, system.num_drones)
    rotation = np.reshape(rot_z(yaw), (3, 3))
    goal.position[0], goal.rotation[0] = position, rotation if tilt is None else tilt @ rotation
    place_formation(0, goal, make_rig(system))
    return goal


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
@pytest.mark.parametrize("num_drones", [2, 3, 4, 6])
def test_pulls_balance_the_payloads_weight_and_moments(num_drones, yaw):
    system = make_system(num_drones)
    goal = placed(system, yaw)
    anchors = system.anchors @ goal.rotation[0].T
    np.testing.assert_allclose(goal.cable_force[0].sum(axis=0), [0, 0, system.payload_mass * GRAVITY], atol=1e-12)
    np.testing.assert_allclose(np.cross(anchors, goal.cable_force[0]).sum(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_slots_are_at_the_end_of_the_stretched_cables_along_the_pulls(num_drones, yaw):
    system = make_system(num_drones)
    goal = placed(system, yaw)
    cables = goal.slots[0] - goal.position[0] - system.anchors @ goal.rotation[0].T
    tension = np.linalg.norm(goal.cable_force[0], axis=-1, keepdims=True)
    length = system.cable_length[:, None] + tension / system.cable_stiffness[:, None]
    np.testing.assert_allclose(cables, length * goal.cable_force[0] / tension, atol=1e-12)


def test_cables_keep_their_directions_over_a_tilted_target():
    system, tilt = make_system(4), np.reshape(axis_angle((0.6, 0.8, 0.0), 0.5), (3, 3))
    goal, level = placed(system), placed(system)
    tilted = placed(system, tilt=tilt)
    turn = np.reshape(rot_z(float(tilted.yaw[0])), (3, 3))
    anchors = system.anchors @ tilted.rotation[0].T
    cables = goal.slots[0] - goal.position[0] - system.anchors
    np.testing.assert_allclose(tilted.slots[0] - tilted.position[0] - anchors, cables @ turn.T, atol=1e-12)
    np.testing.assert_allclose(tilted.cable_force[0], level.cable_force[0] @ turn.T, atol=1e-12)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_slot_frames_point_outward(num_drones, yaw):
    goal = placed(make_system(num_drones), yaw)
    outward = (goal.slots[0] - goal.position[0])[:, :2]
    along = (outward * goal.slot_frame[0]).sum(axis=-1)
    np.testing.assert_allclose(along, np.linalg.norm(outward, axis=-1), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(goal.slot_frame[0], axis=-1), 1.0)


@pytest.fixture
def commanded(num_drones):
    """Return what a team's references are commanded for one action of every drone, relative to its slots."""

    def commanded(action):
        vec = make(num_envs=2, num_drones=num_drones)
        vec.reset(seed=0)
        vec.step(np.broadcast_to(np.asarray(action, float), (2, num_drones, 4)).copy())
        goal, reference = vec.task.goal, vec.reference
        return goal, reference.command - goal.slots, reference.command_yaw - goal.yaw[:, None]

    return commanded


def test_zero_action_commands_the_slots(commanded, num_drones):
    _, offset, yaw = commanded([0, 0, 0, 0])
    assert (offset == 0).all() and (yaw == 0).all()


@pytest.mark.parametrize("share", [-1.0, 0.3, 1.0])
def test_an_action_moves_the_slot_outward_sideways_and_up_and_turns_it(commanded, num_drones, share):
    goal, offset, _ = commanded([share, 0, 0, 0])
    outward = np.concatenate([goal.slot_frame, np.zeros((2, num_drones, 1))], axis=-1)
    np.testing.assert_allclose(offset, 0.5 * share * outward, atol=1e-12)
    _, offset, _ = commanded([0, share, 0, 0])
    np.testing.assert_allclose(offset, 0.5 * share * np.cross([0, 0, 1], outward), atol=1e-12)
    _, offset, _ = commanded([0, 0, share, 0])
    np.testing.assert_allclose(offset, np.broadcast_to([0, 0, 0.5 * share], offset.shape), atol=1e-12)
    _, offset, yaw = commanded([0, 0, 0, share])
    np.testing.assert_allclose(offset, 0, atol=1e-12)
    np.testing.assert_allclose(yaw, 0.5 * share, atol=1e-12)


# Scripts

COMPILED = "formation_redistributed", "hold_full_state", "hold_ctbr"  # for these tests alone


def observed(vec, spread=1.0, **values) -> np.ndarray:
    """Return random observations (5, N, D) of this deviation with some numbers, by name, set."""
    shape = (5, vec.num_drones, vec.observation_size)
    observation = np.random.default_rng(0).normal(scale=spread, size=shape).astype(np.float32)
    for name, value in values.items():
        observation[..., vec.observation_names.index(name)] = value
    return observation


@pytest.mark.parametrize("name", [slow(name) if name in COMPILED else name for name in LINEAR])
def test_scripts_act_on_any_batch_within_the_limits(name):
    task = {"formation_narrow": "gate", "formation_redistributed": "loss"}.get(name, "track")
    vec = make(task, num_envs=1, **{"control.action": LINEAR[name].INTERFACE, "control.heading": "outward"})
    policy, observation = make_scripted(name, vec), 10 * observed(vec)
    assert policy.act(observation).shape == (5, 4, vec.action_size)
    assert policy.act(observation[0]).shape == (4, vec.action_size)
    assert np.abs(policy.act(observation)).max() <= 1
    np.testing.assert_array_equal(policy.act(observation)[3], policy.act(observation[3]))


def test_the_formation_script_asks_for_the_slots():
    vec = make(num_envs=1)
    assert (make_scripted("formation", vec).act(observed(vec)) == 0).all()


def test_the_integral_script_moves_the_slots_against_the_integral():
    vec = make(num_envs=1, **{"control.max_offset": 0.4})
    integral = {f"payload_error_integral_{axis}": value for axis, value in enumerate((0.1, -0.2, 5.0))}
    action = make_scripted("formation_integral", vec).act(observed(vec, **integral))
    expected = [-INTEGRAL_GAIN * 0.1 / 0.4, INTEGRAL_GAIN * 0.2 / 0.4, -1.0, 0.0]
    np.testing.assert_allclose(action, np.broadcast_to(expected, action.shape), rtol=1e-6)


@pytest.mark.parametrize("name", ["formation_feedback", "formation_gusts"])
def test_feedback_scripts_move_the_slots_against_what_they_observe(name):
    vec = make(num_envs=1, **{"control.max_offset": 0.4})
    script, gains = make_scripted(name, vec), LINEAR[name].GAINS
    for told in {gain[:2] for gain in gains}:
        expected = [0.0] * 4
        for *observation, moved, gain in gains:
            if tuple(observation) == told:
                expected[moved] = gain * 0.1 / 0.4
        action = script.act(observed(vec, 0.0, **{"{}_{}".format(*told): 0.1}))
        np.testing.assert_allclose(action, np.broadcast_to(expected, action.shape), rtol=1e-6)


@pytest.mark.parametrize(
    ("task", "along"),
    [
        (
            "pose",
            {"payload_error_0": 0.3, "planned_position_0": 0.3, "payload_velocity_1": 0.2, "planned_velocity_1": 0.2},
        ),
        ("pose", {"payload_rotation_error_1": 0.2, "planned_rotation_1": 0.2}),
        ("track", {"payload_velocity_0": 1.0, "target_velocity_0": 1.0}),
    ],
)
def test_the_feedback_script_lets_the_payload_go_where_it_is_meant_to(task, along):
    vec = make(task, num_envs=1)
    script = make_scripted("formation_feedback", vec)
    np.testing.assert_allclose(script.act(observed(vec, 0.0, **along)), 0, atol=1e-6)
    assert all(np.abs(script.act(observed(vec, 0.0, **{name: 0.2}))).max() > 0.03 for name in along)


@pytest.mark.slow
def test_the_feedback_script_holds_a_payload_in_turbulence_that_the_integral_does_not():
    config = load_config("hover_wind")
    success = {
        name: run_episodes(config, partial(make_scripted, name), 12, seed=1000)["success_rate"].mean()
        for name in ("formation_integral", "formation_feedback")
    }
    assert success["formation_feedback"] > 0.8 > 0.4 > success["formation_integral"]


@pytest.mark.slow
def test_the_script_for_gusts_holds_poses_in_turbulence_that_the_feedback_script_does_not():
    config = load_config("pose_wind")
    success = {
        name: run_episodes(config, partial(make_scripted, name), 24, seed=1000)["success_rate"].mean()
        for name in ("formation_feedback", "formation_gusts")
    }
    assert success["formation_gusts"] > 0.75 > success["formation_feedback"]


def test_the_leading_script_stands_ahead_by_what_the_acceleration_asks():
    vec = make("track", num_envs=1, **{"control.max_offset": 0.6})
    v, a, height = 1.3, 2.0, cos(radians(30))
    ways = {f"target_ahead_{t}ms_{axis}": sign * (v * t / 1e3 + 0.5 * a * (t / 1e3) ** 2)
            for t in (100, 200, 400, 800) for axis, sign in ((0, 1), (1, -1))}  # fmt: skip
    action = make_scripted("formation_lead", vec).act(observed(vec, **ways))
    lead = LEAD_GAIN * height * a / 9.81 / 0.6
    np.testing.assert_allclose(action, np.broadcast_to([lead, -lead, 0, 0], action.shape), atol=1e-4)


def test_the_leading_script_needs_to_know_the_way():
    assert "formation_lead" in fitting_scripts(make("track", num_envs=1))
    assert "formation_lead" not in fitting_scripts(make("hover", num_envs=1))
    assert fitting_scripts(make("track", num_envs=1, **{"control.action": "rotor"})) == []
    message = refusal(make_scripted, "formation_lead", make("hover", num_envs=1))
    assert message.startswith("formation_lead needs to observe where the target will go, and task hover has no such")


def test_unknown_script_names_the_nearest():
    with pytest.raises(ConfigError, match="unknown baseline 'formatoin'; did you mean 'formation'"):
        make_scripted("formatoin", make(num_envs=1))
