"""Action interfaces: what their numbers mean, that zero hovers, and that everything follows their size."""

from __future__ import annotations

import typing

import numpy as np
import pytest
from conftest import GRAVITY, bold_actions, make, make_trainer, refusal, same, zeros

import multilift_marl as ml
from multilift_marl.control.actions import ACTIONS
from multilift_marl.math3d import heading
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.schema.control import ControlConfig

OTHERS = [name for name in ACTIONS if name != "reference"]
CALM = {
    "randomization.payload_mass": 0.0, "randomization.payload_force": 0.0,
    **{f"task_options.start_{name}": 0.0 for name in ("radius", "speed", "tilt")},
}  # fmt: skip


def check_drones(action: str, num_drones: int) -> None:
    """Skip what no planner can fly."""
    if action == "planner_weights" and num_drones == 1:
        pytest.skip("a body on one cable, which planners refuse")


def flying(action: str, num_envs: int = 2, num_drones: int = 4, **overrides):
    """Return teams at rest in formation, with the action interface `action`."""
    vec = make(num_envs=num_envs, num_drones=num_drones, **CALM | {"control.action": action} | overrides)
    vec.reset(seed=0)
    return vec


def step(vec, *numbers):
    """Let every drone act by these numbers for one step."""
    return vec.step(np.broadcast_to(np.array(numbers, float), (vec.num_envs, vec.num_drones, len(numbers))))


def outward(vec) -> np.ndarray:
    """Return the unit vectors (E, N, 3) that point outward from the payload."""
    flat = vec.task.goal.slot_frame
    return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)


def test_the_table_is_what_can_be_configured():
    assert tuple(ACTIONS) == typing.get_args(ControlConfig.model_fields["action"].annotation)


@pytest.mark.parametrize("action", ACTIONS)
def test_sizes_and_names_follow_the_interface(action, num_drones):
    check_drones(action, num_drones)
    vec = flying(action, num_drones=num_drones)
    observation, _ = vec.current()
    assert vec.action_size == len(vec.action_names) == len(set(vec.action_names))
    assert observation.shape[-1] == len(vec.observation_names) == vec.observation_size
    assert sum(name.startswith("previous_action") for name in vec.observation_names) == vec.action_size
    observation, *_ = vec.step(np.full((2, num_drones, vec.action_size), 0.125))
    np.testing.assert_array_equal(observation[..., -vec.action_size :], 0.125)
    per_drone = vec.state().reshape(2, -1)[:, 26:].reshape(2, num_drones, -1)
    np.testing.assert_array_equal(per_drone[..., -vec.action_size :], 0.125)


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("num_drones", [1, 2, 4])
def test_zero_keeps_a_team_at_rest_at_rest(action, num_drones):
    check_drones(action, num_drones)
    vec = flying(action, num_drones=num_drones)
    start = vec.world.state.drone_position.copy()
    for _ in range(50):
        *_, terminated, _, _ = vec.step(zeros(vec))
        assert not terminated.any()
    assert np.linalg.norm(vec.world.state.drone_position - start, axis=-1).max() < 1e-3
    assert vec.world.state.drone_body_rates.max() < 1e-3


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("num_drones", [1, 2, 4])
def test_zero_keeps_a_team_up_for_a_second_whatever_is_hidden(action, num_drones):
    check_drones(action, num_drones)
    vec = make(num_envs=16, num_drones=num_drones, **{"control.action": action})
    vec.reset(seed=0)
    start = vec.world.state.drone_position.copy()
    for _ in range(50):
        *_, terminated, _, _ = vec.step(zeros(vec))
        assert not terminated.any()
    moved = np.linalg.norm(vec.world.state.drone_position - start, axis=-1).max()
    assert moved < {"reference": 0.55, "velocity": 0.35}.get(action, 0.8)


def test_velocity_moves_a_team_at_the_velocity_asked_for():
    vec = flying("velocity")
    for _ in range(100):
        step(vec, 0, 0, 0.5, 0.4)
    state = vec.world.state
    np.testing.assert_allclose(state.drone_velocity, np.broadcast_to([0, 0, 0.5], (2, 4, 3)), atol=0.02)
    np.testing.assert_allclose(state.drone_body_rates[..., 2], 0.4 * 1.5, atol=0.02)


def test_velocity_is_told_in_the_slot_frame():
    vec = flying("velocity", **{"control.max_velocity": 0.6})
    for _ in range(150):
        step(vec, 0.5, 0, 0, 0)
    np.testing.assert_allclose(vec.reference.velocity, 0.3 * outward(vec), atol=1e-3)
    for _ in range(150):
        step(vec, 0, -1, 0, 0)
    np.testing.assert_allclose(vec.reference.velocity, -0.6 * np.cross([0, 0, 1], outward(vec)), atol=1e-3)


@pytest.mark.parametrize("action", ["acceleration", "acc_rates"])
def test_acceleration_lifts_a_team_as_asked(action):
    vec = flying(action)
    for _ in range(50):
        step(vec, 0, 0, 0.1, *[0] * (vec.action_size - 3))
    np.testing.assert_allclose(vec.world.state.drone_velocity[..., 2], 0.3, atol=0.02)
    step(vec, 1, 0, 0, *[0] * (vec.action_size - 3))
    np.testing.assert_allclose(vec.reference.acceleration, 3 * outward(vec), atol=1e-12)


def test_acceleration_turns_at_its_yaw_rate_and_acc_rates_to_the_targets_yaw():
    vec = flying("acceleration")
    before = vec.reference.yaw.copy()
    for _ in range(25):
        step(vec, 0, 0, 0, -0.4)
    np.testing.assert_allclose(vec.reference.yaw - before, -0.4 * 1.5 * 0.5, atol=1e-9)
    vec = flying("acc_rates")
    vec.reference.yaw[:] += 0.3
    for _ in range(100):
        step(vec, 0, 0, 0, 0, 0)
    yaw = [heading(tuple(float(x) for x in r.ravel())) for r in vec.world.state.drone_rotation.reshape(-1, 3, 3)]
    np.testing.assert_allclose(np.reshape(yaw, (2, 4)), np.repeat(vec.task.goal.yaw[:, None], 4, axis=1), atol=0.01)


def test_full_state_flies_a_motion_as_it_is_asked_for():
    """A team that goes up and down by a sine, 10 cm at 4 rad/s, lags by its motors alone, by less than 1 cm."""
    scales = np.array([0.2, 1.0, 3.0, 10.0])
    keys = ("max_offset", "max_velocity", "max_acceleration", "max_jerk")
    vec = flying("full_state", **{f"control.{key}": full for key, full in zip(keys, scales, strict=True)})
    start, w, off = vec.world.state.drone_position.copy(), 4.0, []
    for k in range(150):
        t = k * vec.task.dt
        motion = 1 - np.cos(w * t), w * np.sin(w * t), w**2 * np.cos(w * t), -(w**3) * np.sin(w * t)
        action = np.zeros(16)
        action[[2, 5, 8, 11]] = 0.1 * np.array(motion) / scales
        step(vec, *action)
        expected = 0.1 * (1 - np.cos(w * (t + vec.task.dt)))
        off.append(np.abs(vec.world.state.drone_position[..., 2] - start[..., 2] - expected).max())
    assert max(off[50:]) < 0.01


def test_full_state_tilts_for_a_force_on_its_cable():
    vec = flying("full_state", num_drones=2, **{"control.max_cable_force": 0.4})
    nominal, mass = vec.task.goal.cable_force.copy(), vec.world.system.vehicle.mass
    action = np.zeros(16)
    action[12] = 0.5
    for _ in range(10):
        step(vec, *action)
    more = nominal + 0.2 * np.linalg.norm(nominal, axis=-1, keepdims=True) * outward(vec)
    np.testing.assert_allclose(vec.controller._setpoint.cable_force, more, atol=1e-12)
    axes = [force + [0, 0, mass * GRAVITY] for force in (nominal, more)]
    rest, asked = ((axis / np.linalg.norm(axis, axis=-1, keepdims=True) * outward(vec)).sum(-1) for axis in axes)
    leans = (vec.world.state.drone_rotation[..., 2] * outward(vec)).sum(-1)
    assert (leans > 0.5 * (rest + asked)).all() and (asked > rest + 0.03).all()


@pytest.mark.parametrize("axis, full", [(0, 4.0), (1, 4.0), (2, 1.5)])
def test_ctbr_turns_at_the_rates_asked_for_about_the_axes_of_the_slot(axis, full):
    vec = flying("ctbr", num_drones=3)
    action = [0.0, 0.0, 0.0, 0.0]
    action[1 + axis] = 0.1
    for _ in range(25):
        step(vec, *action)
    outwards = outward(vec)[0]
    axes = [outwards, np.cross([0, 0, 1], outwards), np.broadcast_to([0.0, 0.0, 1.0], (3, 3))]
    rates = np.einsum("nij,nj->ni", vec.world.state.drone_rotation[0], vec.world.state.drone_body_rates[0])
    np.testing.assert_allclose(rates, 0.1 * full * axes[axis], atol=0.25 * 0.1 * full)  # they lean by now
    seen = vec.current()[0][0][:, [vec.observation_names.index(f"turned_rates_{i}") for i in range(3)]]
    expected = np.zeros(3)
    expected[axis] = 0.1 * full
    np.testing.assert_allclose(seen, np.broadcast_to(expected, (3, 3)), atol=0.1 * 0.1 * full)


@pytest.mark.parametrize("action", ["acc_rates", "ctbr"])
def test_the_same_numbers_move_a_team_alike_whatever_the_azimuths(action):
    """What all drones do alike moves those alike that face each other: so a network can be shared."""
    vec = flying(action, num_drones=4)
    rng = np.random.default_rng(0)
    for _ in range(60):
        one = 0.1 * rng.standard_normal(vec.action_size)
        step(vec, *one)
    seen, _ = vec.current()
    own = [i for i, name in enumerate(vec.observation_names) if name.startswith(("turned", "velocity", "slot_error"))]
    np.testing.assert_allclose(seen[0][:2, own], seen[0][2:, own], atol=2e-5)
    assert np.abs(seen[0][0, own]).max() > 0.05


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("hook", [[0, 0, 0], [0.02, 0.0, -0.01]])
def test_ctbm_gives_the_moments_asked_for_about_the_axes_of_the_slot(axis, hook):
    vec = flying("ctbm", num_drones=3, **{"cable.hook": hook})
    vehicle, state = vec.world.system.vehicle, vec.world.state
    attitude = state.drone_rotation.copy()
    step(vec, 0, 0, 0, 0)
    at_rest = vec.world.thrust @ vehicle.allocation.T
    vec.reset(seed=0)
    step(vec, 0, *(0.05 * np.eye(3)[axis]))
    wrench = vec.world.thrust @ vehicle.allocation.T - at_rest
    np.testing.assert_allclose(wrench[..., 0], 0.0, atol=1e-9)
    turn = np.arctan2(*vec.task.goal.slot_frame[..., ::-1].transpose(2, 0, 1)) - np.arctan2(
        -attitude[..., 0, 1], attitude[..., 1, 1]
    )
    c, s = np.cos(turn), np.sin(turn)
    frame = np.stack(
        [np.stack([c, s, 0 * c], -1), np.stack([-s, c, 0 * c], -1), np.broadcast_to([0, 0, 1], (*c.shape, 3))], -2
    )
    expected = 0.05 * 200.0 * np.asarray(vehicle.inertia) * frame[..., axis, :]
    np.testing.assert_allclose(wrench[..., 1:], expected, atol=1e-9)


@pytest.mark.parametrize("action", ["ctbr", "ctbm", "rotor"])
def test_thrust_goes_from_limit_to_limit_by_the_hover_thrust(action):
    vec = flying(action)
    vehicle = vec.world.system.vehicle
    low, high = vehicle.thrust_coefficient * vehicle.rotor_speed_min**2, vehicle.rotor_thrust_max
    hover = np.linalg.norm(vec.task.goal.cable_force + [0, 0, vehicle.mass * GRAVITY], axis=-1, keepdims=True) / 4
    for share, expected in [(-1, low), (0, hover), (1, high), (0.5, (hover + high) / 2), (-0.5, (hover + low) / 2)]:
        vec.reset(seed=0)
        step(vec, *([share] * 4 if action == "rotor" else [share, 0, 0, 0]))
        mean = vec.world.thrust.mean(axis=-1, keepdims=True)
        np.testing.assert_allclose(mean, np.broadcast_to(expected, mean.shape), rtol=1e-9)


def test_rotor_thrusts_are_each_rotors_own():
    vec = flying("rotor", num_drones=2)
    step(vec, 0.2, -0.3, 1.0, -1.0)
    order = np.argsort(vec.world.thrust, axis=-1)
    np.testing.assert_array_equal(order, np.broadcast_to([3, 1, 0, 2], order.shape))


@pytest.mark.parametrize("action", OTHERS)
def test_whatever_is_asked_rotors_stay_within_their_limits(action):
    vec = flying(action, num_envs=8)
    vehicle = vec.world.system.vehicle
    low = vehicle.thrust_coefficient * vehicle.rotor_speed_min**2
    for k in range(20):
        *_, terminated, truncated, _ = vec.step(bold_actions(vec, k, hold=3))
        assert (vec.world.thrust >= low - 1e-12).all() and (vec.world.thrust <= vehicle.rotor_thrust_max).all()
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)


@pytest.mark.parametrize("action", OTHERS)
def test_an_environment_replays_alone_and_continues_from_its_saved_state(action):
    share = 0.02 if action == "ctbm" else 0.2  # nothing holds the attitude

    def fly(vec, steps, first_env=0):
        seen = []
        for k in steps:
            observation, reward, terminated, truncated, _ = vec.step(share * bold_actions(vec, k, first_env, hold=2))
            seen.append((observation, reward))
            assert not (terminated | truncated).any()
        return seen

    disturbance = {"control.disturbance": "indi"} if "indi" in ACTIONS[action].supports else {}
    options = {"control.action": action} | disturbance
    many, alone = make(num_envs=5, num_threads=2, **options), make(num_envs=1, first_env=3, **options)
    many.reset(seed=1), alone.reset(seed=1)
    both = zip(fly(many, range(6)), fly(alone, range(6), first_env=3), strict=True)
    assert all(same([part[3:4] for part in one], list(two)) for one, two in both)
    again = make(num_envs=5, **options)
    again.load_state_dict(many.state_dict())
    assert same(fly(many, range(6, 12)), fly(again, range(6, 12)))


@pytest.mark.parametrize("action", OTHERS)
def test_scripts_refuse_what_they_cannot_fly(action):
    message = refusal(make_scripted, "formation", flying(action))
    assert f"'formation' acts by control.action=reference and cannot fly control.action={action}" in message


def test_an_unknown_interface_is_refused():
    assert "control.action" in refusal(ml.make_vec, "hover", num_envs=1, **{"control.action": "motors"})


@pytest.mark.slow
@pytest.mark.parametrize("action", ["acc_rates", "ctbr", "ctbm"])
def test_a_team_trains_with_the_interface(tmp_path, action):
    trainer = make_trainer(tmp_path, **{"control.action": action, "train.frames": 256})
    before = trainer.learner.actor.team.net[0].weight.detach().clone()
    assert trainer.run()
    assert trainer.iteration == 2
    assert not (trainer.learner.actor.base != 0).any()
    after = trainer.learner.actor.team.net[0].weight
    assert (after != before).any() and bool(after.isfinite().all())


def test_training_on_a_script_with_another_interface_is_refused(tmp_path):
    message = refusal(make_trainer, tmp_path, **{"control.action": "ctbr", "train.residual": "formation_integral"})
    assert "train.residual=formation" in message


def test_the_yaw_of_a_reference_is_each_drones_own():
    vec = make("hover", num_envs=2, num_drones=3)
    vec.reset(seed=0)
    action = zeros(vec)
    action[1, 2, 3] = 0.5
    vec.step(action)
    commanded = vec.reference.command_yaw - vec.task.goal.drone_yaw[:, None]
    np.testing.assert_allclose(commanded, 0.5 * vec.config.control.max_yaw * (action[..., 3] > 0), atol=1e-12)
