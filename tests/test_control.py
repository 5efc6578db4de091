"""Control: thrust allocation, attitude on SO(3), the smoothed reference, the formation and its scripts."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from conftest import GRAVITY, make, make_system

from multilift_marl.config.schema import ControlConfig
from multilift_marl.config.vehicles import PRESETS, Vehicle
from multilift_marl.control.allocation import allocate, allocation_matrix
from multilift_marl.control.formation import Goal, Reference, Rig, place_formation, smooth, start_reference, wrap
from multilift_marl.control.geometric import attitude_torque, desired_rates, fly, make_gains
from multilift_marl.control.scripted import INTEGRAL_GAIN, SCRIPTED, make_scripted
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import axis_angle, heading, rot_z, thrust_frame
from multilift_marl.sim import World

FALCON = PRESETS["falcon"]
PLUS = replace(FALCON, rotor_azimuth=(0.0, pi / 2, pi, 3 * pi / 2))
SEEDS = range(5)


def floats(array) -> tuple[float, ...]:
    return tuple(float(x) for x in np.ravel(array))


def hat(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def vee(m):
    return np.array([m[2, 1], m[0, 2], m[1, 0]])


def random_rotation(rng, angle=2.5):
    axis = rng.normal(size=3)
    return np.reshape(axis_angle(floats(axis / np.linalg.norm(axis)), float(rng.uniform(0, angle))), (3, 3))


# Allocation


def test_allocation_of_a_plus_quadrotor_is_equation_11():
    arm, ratio = PLUS.arm, PLUS.torque_ratio
    expected = [[1, 1, 1, 1], [0, arm, 0, -arm], [-arm, 0, arm, 0], [ratio, -ratio, ratio, -ratio]]
    np.testing.assert_allclose(allocation_matrix(PLUS), expected, atol=1e-15)


def allocated(vehicle: Vehicle, thrust: float, torque, low: float = 0.0, high: float = 5.0) -> np.ndarray:
    inverse = np.ascontiguousarray(np.linalg.inv(allocation_matrix(vehicle)))
    return np.array(allocate(float(thrust), floats(torque), inverse, low, high))


@pytest.mark.parametrize("vehicle", [FALCON, PLUS], ids=["x", "+"])
@pytest.mark.parametrize("seed", SEEDS)
def test_allocation_inverts_the_matrix_within_the_limits(vehicle, seed):
    rotors = np.random.default_rng(seed).uniform(0.1, 4.9, 4)
    thrust, *torque = allocation_matrix(vehicle) @ rotors
    np.testing.assert_allclose(allocated(vehicle, thrust, torque), rotors, rtol=1e-9)


@pytest.mark.parametrize("vehicle", [FALCON, PLUS], ids=["x", "+"])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("seed", SEEDS)
def test_yaw_is_given_up_first_and_no_more_than_needed(vehicle, sign, seed):
    rotors = np.random.default_rng(seed).uniform(1.0, 4.0, 4)
    thrust, roll, pitch, _ = allocation_matrix(vehicle) @ rotors
    asked = sign * 10.0
    given = allocated(vehicle, thrust, (roll, pitch, asked))
    wrench = allocation_matrix(vehicle) @ given
    np.testing.assert_allclose(wrench[:3], [thrust, roll, pitch], rtol=1e-9, atol=1e-12)
    assert 0 <= wrench[3] / asked < 1
    assert np.isclose(given, 0.0).any() or np.isclose(given, 5.0).any()


@pytest.mark.parametrize("seed", SEEDS)
def test_rotors_stay_within_their_limits_whatever_is_asked(seed):
    rng = np.random.default_rng(seed)
    for _ in range(200):
        given = allocated(FALCON, rng.uniform(-10, 40), rng.normal(0, 1, 3), 0.03, 5.0)
        assert (given >= 0.03).all() and (given <= 5.0).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_the_plant_turns_as_the_allocation_means(seed):
    rng, world = np.random.default_rng(seed), World(make_system(1, **{"cable.length": 5.0}), 1, 1)
    vehicle, torque = world.system.vehicle, rng.uniform(-1, 1, 3) * [0.05, 0.05, 0.01]
    thrust = allocated(vehicle, 8.0, torque)[None, None]
    world.state.drone_position[..., 2] -= 1.0
    world.state.rotor_speed[:] = np.sqrt(thrust / vehicle.thrust_coefficient)
    world.load(np.ones(1, bool))
    world.step(thrust)
    expected = world.system.timestep * torque / vehicle.inertia
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], expected, rtol=1e-9)


# Attitude


@pytest.mark.parametrize("seed", SEEDS)
def test_desired_rates_are_those_of_the_turning_thrust_frame(seed):
    a, b, c, d = np.random.default_rng(seed).uniform(-2, 2, (4, 3))

    def force(t):
        return a * np.sin(t) + b * t**2 + c * np.cos(2 * t) + [0, 0, 9]

    def force_rate(t):
        return a * np.cos(t) + 2 * b * t - 2 * c * np.sin(2 * t)

    def frame(t):
        return np.reshape(thrust_frame(floats(force(t)), float(d[0] + d[1] * t)), (3, 3))

    for t in (0.0, 0.4, 1.1):
        turning = (frame(t + 1e-6) - frame(t - 1e-6)) / 2e-6
        yaw = float(d[0] + d[1] * t)
        rates = desired_rates(floats(frame(t)), floats(force(t)), floats(force_rate(t)), yaw, float(d[1]))
        np.testing.assert_allclose(rates, vee(frame(t).T @ turning), atol=1e-7)


@pytest.fixture(scope="module")
def gains():
    return make_gains(ControlConfig(), make_system(4))


def torque(rotation, rates, desired, desired_rate, gains) -> np.ndarray:
    return np.array(attitude_torque(floats(rotation), floats(rates), floats(desired), floats(desired_rate), gains))


def test_no_torque_at_equilibrium(gains):
    rotation = random_rotation(np.random.default_rng(0))
    np.testing.assert_allclose(torque(rotation, np.zeros(3), rotation, np.zeros(3), gains), 0, atol=1e-15)


@pytest.mark.parametrize("seed", SEEDS)
def test_on_the_reference_only_the_gyroscopic_torque_is_left(gains, seed):
    rng = np.random.default_rng(seed)
    rotation, rates = random_rotation(rng), rng.normal(size=3)
    expected = np.cross(rates, gains.inertia * rates)
    assert np.abs(expected).max() > 1e-5
    np.testing.assert_allclose(torque(rotation, rates, rotation, rates, gains), expected, atol=1e-15)


@pytest.mark.parametrize("seed", SEEDS)
def test_attitude_torque_is_equations_31_and_32(gains, seed):
    rng = np.random.default_rng(seed)
    R, R_d, rates, rates_d = random_rotation(rng), random_rotation(rng), rng.normal(size=3), rng.normal(size=3)
    J = np.diag(gains.inertia)
    e_R = 0.5 * vee(R_d.T @ R - R.T @ R_d)
    e_rates = rates - R.T @ R_d @ rates_d
    expected = -J @ (gains.k_R * e_R) - J @ (gains.k_w * e_rates) + np.cross(rates, J @ rates)
    expected -= J @ hat(rates) @ R.T @ R_d @ rates_d
    np.testing.assert_allclose(torque(R, rates, R_d, rates_d, gains), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_attitude_torque_descends_the_error_function(gains, seed):
    rng = np.random.default_rng(seed)
    R, R_d = random_rotation(rng), random_rotation(rng)

    def error(rotation):
        return 0.5 * np.trace(np.eye(3) - R_d.T @ rotation)

    def turned(axis, angle):
        return R @ np.reshape(axis_angle(floats(np.eye(3)[axis]), angle), (3, 3))

    gradient = [(error(turned(axis, 1e-6)) - error(turned(axis, -1e-6))) / 2e-6 for axis in range(3)]
    stiffness = np.array(gains.inertia) * gains.k_R
    np.testing.assert_allclose(torque(R, np.zeros(3), R_d, np.zeros(3), gains), -stiffness * gradient, atol=1e-8)


@pytest.mark.parametrize("tau, expected", [(0.01, 20.0), (0.033, 20.0), (0.07, 10.0)])
def test_attitude_is_no_faster_than_the_motors_allow(tau, expected):
    system = make_system(4)
    system = replace(system, vehicle=replace(system.vehicle, rotor_time_constant=tau))
    gains = make_gains(ControlConfig(attitude_frequency=20.0, attitude_damping=0.8), system)
    np.testing.assert_allclose(gains.k_R[:2], expected**2)
    np.testing.assert_allclose(gains.k_w[:2], 2 * 0.8 * expected)


def test_position_gains_are_those_of_the_natural_frequency(gains):
    assert (gains.k_p, gains.k_v) == (16.0, 8.0)


# The smoothed reference


def follow(command, seconds, yaw=0.0, frequency=6.0, speed=1.0, dt=0.004) -> Reference:
    """Return a reference's history, one step for each environment, after it started at rest at the origin."""
    steps = round(seconds / dt)
    one, history = Reference.zeros(1, 1), Reference.zeros(steps, 1)
    one.command[:], one.command_yaw[:] = command, yaw
    for step in range(steps):
        smooth(0, 1, one, frequency, speed, dt)
        for kept, now in zip(history, one, strict=True):
            kept[step] = now[0]
    return history


def test_a_near_command_is_approached_like_a_critically_damped_third_order_step():
    dt, w = 1e-4, 6.0
    history = follow([0.2, -0.1, 0.1], 1.5, dt=dt)
    t = dt * np.arange(1, len(history.position) + 1)[:, None]
    share = 1 - np.exp(-w * t) * (1 + w * t + (w * t) ** 2 / 2)
    np.testing.assert_allclose(history.position[:, 0], share * [0.2, -0.1, 0.1], atol=2e-4)
    speed = w * np.exp(-w * t) * (w * t) ** 2 / 2
    np.testing.assert_allclose(history.velocity[:, 0], speed * [0.2, -0.1, 0.1], atol=1e-3)


@pytest.mark.parametrize("distance", [0.1, 0.6, 4.0])
def test_no_command_is_overshot(distance):
    history = follow([0, distance, 0], 10.0)
    assert history.position[:, 0, 1].max() <= distance + 1e-6
    assert history.position[-1, 0, 1] == pytest.approx(distance, abs=1e-6)


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_a_far_command_is_approached_at_the_speed_limit(speed):
    history = follow([6.0, -6.0, 6.0], 5.0, speed=speed)
    norm = np.linalg.norm(history.velocity[:, 0], axis=-1)
    assert norm.max() <= 1.01 * speed
    assert norm[round(2 / 0.004)] == pytest.approx(speed, rel=0.01)


def test_velocity_acceleration_and_jerk_are_derivatives():
    history = follow([2.0, 0.5, -0.3], 2.0, dt=1e-3)
    for lower, higher in [("position", "velocity"), ("velocity", "acceleration"), ("acceleration", "jerk")]:
        slope = np.diff(getattr(history, lower), axis=0) / 1e-3
        np.testing.assert_allclose(slope, getattr(history, higher)[1:], atol=1e-9)


def test_yaw_is_approached_like_a_critically_damped_second_order_step():
    history = follow([0, 0, 0], 1.5, yaw=0.8, dt=1e-4)
    wt = 6.0 * 1e-4 * np.arange(1, len(history.yaw) + 1)
    np.testing.assert_allclose(history.yaw[:, 0], 0.8 * (1 - np.exp(-wt) * (1 + wt)), atol=1e-3)


@pytest.mark.parametrize(
    "command, expected", [(2.5, 2.5), (4.0, 4.0 - 2 * pi), (-3.5, 2 * pi - 3.5), (7.0, 7.0 - 2 * pi)]
)
def test_yaw_takes_the_short_way(command, expected):
    assert follow([0, 0, 0], 6.0, yaw=command).yaw[-1, 0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "angle, expected", [(0.5, 0.5), (pi, pi), (-pi, pi), (3.5, 3.5 - 2 * pi), (-20.0, 6 * pi - 20)]
)
def test_wrap(angle, expected):
    assert wrap(angle) == pytest.approx(expected)


# Flight


def test_a_free_drone_follows_its_reference_to_the_centimetre():
    system = make_system(1, **{"cable.length": 20.0})
    system = replace(system, vehicle=replace(system.vehicle, drag=(0.0, 0.0, 0.0)))
    world, reference = World(system, 1, 1), Reference.zeros(1, 1)
    world.state.payload_position[:] = [0, 0, 0.075]
    world.state.drone_position[:] = [0, 0, 2.0]
    world.load(np.ones(1, bool))
    start_reference(0, world.state, reference)
    reference.command[:], reference.command_yaw[:] = [1.5, -1.0, 3.0], 1.0
    gains = make_gains(ControlConfig(), system)._replace(load_share=np.zeros(1))
    thrust, errors = np.zeros((1, 1, 4)), []
    for _ in range(1250):
        smooth(0, 1, reference, 6.0, 1.0, 0.004)
        fly(0, 1, world.state, reference, np.zeros((1, 1, 3)), thrust, gains)
        world.step(thrust)
        errors.append(np.linalg.norm(world.state.drone_position - reference.position))
    assert (world.state.cable_tension == 0).all()
    assert max(errors) < 0.02
    np.testing.assert_allclose(world.state.drone_position[0, 0], [1.5, -1.0, 3.0], atol=1e-3)
    assert heading(floats(world.state.drone_rotation[0, 0])) == pytest.approx(1.0, abs=1e-3)


CALM = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}


@pytest.mark.parametrize("num_drones", [2, 3, 4, 6])
def test_a_team_moves_as_one_along_its_references(num_drones):
    at_rest = {f"task_options.start_{name}": 0 for name in ("radius", "speed", "tilt")}
    vec = make(num_envs=2, num_drones=num_drones, **CALM, **at_rest)
    vec.reset(seed=0)
    outward_x, outward_y = np.moveaxis(vec.task.goal.slot_frame, -1, 0)
    aside = np.stack([0.5 * outward_x, -0.5 * outward_y, 0.2 + 0 * outward_x, 0 * outward_x], axis=-1)
    for _ in range(250):
        vec.step(aside)
        errors = np.linalg.norm(vec.world.state.drone_position - vec.reference.position, axis=-1)
        assert errors.max() < 0.05
    assert errors.max() < 0.02
    moved = vec.world.state.drone_position - vec.task.goal.slots
    np.testing.assert_allclose(moved, np.broadcast_to([0.25, 0, 0.1], moved.shape), atol=0.02)


@pytest.mark.parametrize("num_drones", [3, 4, 6])
def test_the_formation_carries_a_known_payload_to_its_target(num_drones):
    vec = make(num_envs=8, num_drones=num_drones, **CALM)
    vec.reset(seed=0)
    for _ in range(399):
        vec.step(np.zeros((8, num_drones, 4)))
    assert vec.task.errors.distance.max() < 2e-3
    assert np.degrees(vec.task.errors.angle.max()) < 1.5


# The formation


def placed(system, yaw=0.0, tilt=None, position=(0.3, -0.2, 1.5)) -> Goal:
    goal = Goal.zeros(1, system.num_drones)
    rotation = np.reshape(rot_z(yaw), (3, 3))
    goal.position[0], goal.rotation[0] = position, rotation if tilt is None else tilt @ rotation
    place_formation(0, goal, Rig(system.anchors, system.slots, system.slot_azimuth, system.formation_force))
    return goal


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
@pytest.mark.parametrize("num_drones", [2, 3, 4, 6])
def test_pulls_balance_the_payloads_weight_and_moments(num_drones, yaw):
    system = make_system(num_drones)
    goal = placed(system, yaw)
    anchors = system.anchors @ goal.rotation[0].T
    np.testing.assert_allclose(goal.pull[0].sum(axis=0), [0, 0, system.payload_mass * GRAVITY], atol=1e-12)
    np.testing.assert_allclose(np.cross(anchors, goal.pull[0]).sum(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_slots_are_at_the_end_of_the_stretched_cables_along_the_pulls(num_drones, yaw):
    system = make_system(num_drones)
    goal = placed(system, yaw)
    cables = goal.slots[0] - goal.position[0] - system.anchors @ goal.rotation[0].T
    tension = np.linalg.norm(goal.pull[0], axis=-1, keepdims=True)
    length = system.cable_length[:, None] + tension / system.cable_stiffness[:, None]
    np.testing.assert_allclose(cables, length * goal.pull[0] / tension, atol=1e-12)


def test_cables_keep_their_directions_over_a_tilted_target():
    system, tilt = make_system(4), np.reshape(axis_angle((0.6, 0.8, 0.0), 0.5), (3, 3))
    goal, level = placed(system), placed(system)
    tilted = placed(system, tilt=tilt)
    turn = np.reshape(rot_z(float(tilted.yaw[0])), (3, 3))
    anchors = system.anchors @ tilted.rotation[0].T
    cables = goal.slots[0] - goal.position[0] - system.anchors
    np.testing.assert_allclose(tilted.slots[0] - tilted.position[0] - anchors, cables @ turn.T, atol=1e-12)
    np.testing.assert_allclose(tilted.pull[0], level.pull[0] @ turn.T, atol=1e-12)


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


def observed(vec, **values) -> np.ndarray:
    """Return random observations (5, N, D) with some numbers, by name, set."""
    observation = np.random.default_rng(0).normal(size=(5, vec.num_drones, vec.observation_size)).astype(np.float32)
    for name, value in values.items():
        observation[..., vec.observation_names.index(name)] = value
    return observation


@pytest.mark.parametrize("name", SCRIPTED)
def test_scripts_act_on_any_batch_within_the_limits(name):
    vec = make(num_envs=1)
    policy, observation = make_scripted(name, vec), 10 * observed(vec)
    assert policy.act(observation).shape == (5, 4, 4)
    assert policy.act(observation[0]).shape == (4, 4)
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


def test_unknown_script_names_the_nearest():
    with pytest.raises(ConfigError, match="unknown scripted policy 'formatoin'; did you mean 'formation'"):
        make_scripted("formatoin", make(num_envs=1))
