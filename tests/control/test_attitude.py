"""Thrust allocation, and attitude control on SO(3)."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from conftest import drone_gains, floats, make_system, turned_from_rest, with_vehicle

from multilift_marl.control.allocation import allocate
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import attitude_torque, desired_rates
from multilift_marl.math3d import axis_angle, thrust_frame
from multilift_marl.rig.presets import PRESETS
from multilift_marl.rig.vehicle import Vehicle
from multilift_marl.schema.control import ControlConfig
from multilift_marl.sim import World

FALCON = PRESETS["falcon"]
PLUS = replace(FALCON, rotor_azimuth=(0.0, pi / 2, pi, 3 * pi / 2))
SEEDS = range(5)


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
    np.testing.assert_allclose(PLUS.allocation, expected, atol=1e-15)


def allocated(vehicle: Vehicle, thrust: float, torque, low: float = 0.0, high: float = 5.0) -> np.ndarray:
    inverse = np.ascontiguousarray(np.linalg.inv(vehicle.allocation))
    return np.array(allocate(float(thrust), floats(torque), inverse, low, high))


@pytest.mark.parametrize("vehicle", [FALCON, PLUS], ids=["x", "+"])
@pytest.mark.parametrize("seed", SEEDS)
def test_allocation_inverts_the_matrix_within_the_limits(vehicle, seed):
    rotors = np.random.default_rng(seed).uniform(0.1, 4.9, 4)
    thrust, *torque = vehicle.allocation @ rotors
    np.testing.assert_allclose(allocated(vehicle, thrust, torque), rotors, rtol=1e-9)


@pytest.mark.parametrize("vehicle", [FALCON, PLUS], ids=["x", "+"])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("seed", SEEDS)
def test_yaw_is_given_up_first_and_no_more_than_needed(vehicle, sign, seed):
    rotors = np.random.default_rng(seed).uniform(1.0, 4.0, 4)
    thrust, roll, pitch, _ = vehicle.allocation @ rotors
    asked = sign * 10.0
    given = allocated(vehicle, thrust, (roll, pitch, asked))
    wrench = vehicle.allocation @ given
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
    expected = turned_from_rest(torque, np.array(vehicle.inertia), world.system.timestep)
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], expected, rtol=1e-8)


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
    return drone_gains(make_gains(ControlConfig(), make_system(4)), 0)


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
    system = with_vehicle(system, rotor_time_constant_up=tau, rotor_time_constant_down=tau)
    gains = drone_gains(make_gains(ControlConfig(attitude_frequency=20.0, attitude_damping=0.8), system), 3)
    np.testing.assert_allclose(gains.k_R[:2], expected**2)
    np.testing.assert_allclose(gains.k_w[:2], 2 * 0.8 * expected)


def test_position_gains_are_those_of_the_natural_frequency(gains):
    assert (gains.k_p, gains.k_v) == (16.0, 8.0)
