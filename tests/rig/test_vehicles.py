"""Vehicles: the presets against their sources, one's own by configuration, rotors with two lags, and stability."""

from __future__ import annotations

import csv
import re
from dataclasses import asdict
from math import exp, pi, sqrt
from pathlib import Path

import numpy as np
import pytest
from conftest import GRAVITY, drone_gains, floats, free_world, load, make_system, refuse_system

import multilift_marl as ml
from multilift_marl.control.allocation import allocate
from multilift_marl.control.gains import DroneGains, make_gains
from multilift_marl.control.geometric import attitude_torque
from multilift_marl.math3d import axis_angle
from multilift_marl.rig.presets import PRESETS
from multilift_marl.rig.vehicles import resolve_vehicles
from multilift_marl.schema.control import ControlConfig
from multilift_marl.schema.sections import VehicleConfig

NAMES = sorted(PRESETS)
LEVEL = floats(np.eye(3))
STILL = (0.0, 0.0, 0.0)


def gains_of(preset: str, **control) -> DroneGains:
    return drone_gains(make_gains(ControlConfig(**control), make_system(1, **{"vehicle.preset": preset})), 0)


# Presets


def test_the_recorded_table_holds_every_number_of_every_preset():
    path = Path(__file__).parents[2] / "docs" / "data" / "vehicles.csv"
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["field"] for row in rows} == VehicleConfig.model_fields.keys() - {"preset"}
    for row in rows:
        assert row.keys() - {"field", "unit"} == PRESETS.keys()
        for name, vehicle in PRESETS.items():
            value = np.atleast_1d(getattr(vehicle, row["field"]))
            value = np.rad2deg(value) if row["unit"] == "deg" else value
            assert [float(number) for number in row[name].split()] == pytest.approx(value, rel=1e-5), row["field"]


@pytest.mark.parametrize("preset", NAMES)
def test_preset_passes_the_checks_of_ones_own_vehicle(preset):
    assert resolve_vehicles(VehicleConfig(preset=preset), 2) == (PRESETS[preset],) * 2


def test_a_rotor_hovers_on_the_momentum_that_its_disc_gives_to_the_air():
    """f = 2 ρ A v²: the air that passes the disc at v leaves at 2 v, with the momentum f per second."""
    vehicle, speed = PRESETS["falcon"], 5.0
    through = 1.225 * np.pi * vehicle.rotor_radius**2 * speed  # [kg/s]
    assert vehicle.disc_momentum * speed**2 == pytest.approx(through * 2 * speed, rel=1e-12)


@pytest.mark.parametrize(
    "preset, speed", [("falcon", 983.9), ("hummingbird", 453.2), ("iris", 805.5), ("crazyflie_id", 1986.3)]
)
def test_hover_speed(preset, speed):
    vehicle = PRESETS[preset]
    assert sqrt(vehicle.mass * GRAVITY / 4 / vehicle.thrust_coefficient) == pytest.approx(speed, abs=0.1)


@pytest.mark.parametrize("preset, ratio", [("hummingbird", 3.42), ("iris", 1.865), ("crazyflie", 1.679)])
def test_thrust_to_weight(preset, ratio):
    vehicle = PRESETS[preset]
    assert 4 * vehicle.rotor_thrust_max / (vehicle.mass * GRAVITY) == pytest.approx(ratio, abs=0.005)


@pytest.mark.parametrize("preset, speed", [("hummingbird", 838.0), ("iris", 1100.0)])
def test_thrust_limit_is_that_of_the_published_speed_limit(preset, speed):
    assert PRESETS[preset].rotor_speed_max == pytest.approx(speed)


def test_thrust_of_the_identified_crazyflie_at_hover_is_that_of_its_identified_curve():
    vehicle = PRESETS["crazyflie_id"]
    hover = vehicle.mass * GRAVITY / 4
    rpm = sqrt(hover / vehicle.thrust_coefficient) * 30 / pi
    assert 2.4582929831265485e-10 * rpm**2 - 5.382196214637237e-7 * rpm == pytest.approx(hover, rel=1e-4)


def test_rotors_of_the_identified_crazyflie_stand_where_its_length_per_axis_says():
    np.testing.assert_allclose(np.abs(PRESETS["crazyflie_id"].rotor_positions[:, :2]), 0.03253)


def test_rotors_of_the_iris_stand_at_the_mean_of_its_unequal_arms():
    np.testing.assert_allclose(PRESETS["iris"].rotor_positions[0], [0.13, 0.21, 0], atol=1e-12)


@pytest.mark.parametrize("preset", NAMES)
def test_standard_payload_takes_the_same_share_of_the_spare_lift(preset):
    system = make_system(1, **{"vehicle.preset": preset})
    share = system.payload_mass / system.vehicle.spare_lift
    assert share == pytest.approx(0.35 / PRESETS["falcon"].spare_lift)


# One's own


OWN = {
    "mass": 0.8,
    "inertia": (2e-3, 3e-3, 4e-3),
    "arm": 0.12,
    "rotor_azimuth": (0.0, 90.0, 180.0, 270.0),
    "rotor_spin": (-1.0, 1.0, -1.0, 1.0),
    "thrust_coefficient": 2e-6,
    "torque_ratio": 0.02,
    "rotor_time_constant_up": 0.01,
    "rotor_time_constant_down": 0.02,
    "rotor_speed_min": 100.0,
    "rotor_thrust_max": 6.0,
    "drag": (0.1, 0.2, 0.3),
    "rotor_radius": 0.05,
    "rotor_solidity": 0.12,
    "rolling_moment": 1e-6,
    "rotor_inertia": 1e-5,
}


@pytest.mark.parametrize("field", OWN)
def test_a_configured_field_stands_in_place_of_the_preset_s(field):
    vehicle = make_system(1, **{f"vehicle.{field}": OWN[field]}).vehicle
    expected = tuple(np.deg2rad(OWN[field])) if field == "rotor_azimuth" else OWN[field]
    assert asdict(vehicle) == asdict(PRESETS["falcon"]) | {field: expected}


def test_every_field_of_a_vehicle_can_be_configured():
    assert OWN.keys() == asdict(PRESETS["falcon"]).keys() - {"name"}
    assert VehicleConfig.model_fields.keys() == {"preset", *OWN}


@pytest.mark.parametrize(
    "overrides, complaint",
    [
        ({"preset": "falkon"}, r"unknown vehicle\.preset 'falkon'; did you mean 'falcon'\?"),
        ({"inertia": (1e-3, 1e-3, 3e-3)}, r"vehicle\.inertia .* is impossible: no moment may exceed the sum"),
        ({"rotor_spin": (1, 1, 1, 1)}, r"vehicle\.rotor_spin .* must hold 1 for two rotors and -1 for the other two"),
        ({"rotor_spin": (1, -1, 1, -0.5)}, r"vehicle\.rotor_spin .* must hold 1 for two rotors"),
        ({"rotor_spin": (1, 1, -1, -1)}, r"vehicle\.rotor_azimuth .* cannot turn the drone about each axis: let"),
        ({"rotor_azimuth": (0, 90, 180, 250)}, r"vehicle\.rotor_azimuth .* does not balance: equal thrusts"),
        ({"rotor_azimuth": (0, 180, 0, 180)}, r"vehicle\.rotor_azimuth .* cannot turn the drone about each axis"),
        ({"rotor_speed_min": 5000}, r"vehicle\.rotor_speed_min=5000 rad/s must be less than the 1788"),
        (
            {"mass": 3.0},
            r"vehicle 'falcon' of vehicle\.mass=3 kg cannot lift itself with 20 N; raise",
        ),
        ({"mass": -1.0}, r"vehicle\.mass must be greater than 0, but is -1"),
        ({"arm": 0}, r"vehicle\.arm must be greater than 0"),
        ({"rotor_time_constant_up": 0}, r"vehicle\.rotor_time_constant_up must be greater than 0"),
        ({"rotor_inertia": -1e-6}, r"vehicle\.rotor_inertia must be greater than or equal to 0"),
        ({"drag": (0.1, -0.1, 0)}, r"vehicle\.drag must be greater than or equal to 0"),
        ({"rotor_spin": (1, -1, 1)}, r"vehicle\.rotor_spin must be a list of 4 numbers"),
    ],
)
def test_an_impossible_vehicle_is_refused(overrides, complaint):
    message = refuse_system(1, **{f"vehicle__{key}": value for key, value in overrides.items()})
    assert re.match(complaint, message), message


# Rotors with two lags


@pytest.mark.parametrize("start, thrust, constant", [(300.0, 3.0, "up"), (700.0, 1.0, "down")])
@pytest.mark.parametrize("timestep", [1e-3, 4e-3])
def test_rising_and_falling_rotors_lag_each_by_its_own_constant(start, thrust, constant, timestep):
    world = free_world(**{"sim.timestep": timestep, "vehicle.preset": "hummingbird"})
    vehicle, t = world.system.vehicle, 0.04
    assert (vehicle.rotor_time_constant_up, vehicle.rotor_time_constant_down) == (0.0125, 0.025)
    tau = getattr(vehicle, f"rotor_time_constant_{constant}")
    world.state.rotor_speed[:] = start
    world.step(np.full((1, 1, 4), thrust), round(t / timestep))
    target = sqrt(thrust / vehicle.thrust_coefficient)
    gap = start - target
    np.testing.assert_allclose(world.state.rotor_speed, target + gap * exp(-t / tau), rtol=1e-12)
    square = target**2 * t + 2 * target * gap * tau * (1 - exp(-t / tau)) + gap**2 * tau / 2 * (1 - exp(-2 * t / tau))
    expected = 4 * vehicle.thrust_coefficient * square / vehicle.mass - GRAVITY * t
    assert world.state.drone_velocity[0, 0, 2] == pytest.approx(expected, rel=1e-9)


# Stability: a torque command passes a first-order lag τ, τ s³ + s² + k_w s + k_R = 0


def damping(eigenvalues: np.ndarray) -> float:
    """Return the least damping ratio; negative if unstable."""
    return float((-eigenvalues.real / np.abs(eigenvalues)).min())


@pytest.mark.parametrize("loop", ["attitude", "position", "yaw"])
def test_a_frequency_far_above_its_bound_is_accepted_as_any_above_it(caplog, loop):
    ml.make_vec("hover", num_envs=1, **{f"control.{loop}_frequency": 900.0})
    assert any(f"control.{loop}_frequency=900 is above" in each.getMessage() for each in caplog.records)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("preset", NAMES)
def test_attitude_loop_with_motor_lag_is_damped(preset, axis):
    gains, tau = gains_of(preset), PRESETS[preset].rotor_time_constant
    assert damping(np.roots([tau, 1, gains.k_w[axis], gains.k_R[axis]])) > 0.23


@pytest.mark.parametrize("preset", NAMES)
def test_position_loop_around_the_attitude_loop_is_damped(preset):
    gains, tau = gains_of(preset), PRESETS[preset].rotor_time_constant
    loop = np.diag(np.ones(4), 1)  # position, velocity, acceleration = g · tilt, and two derivatives of it
    loop[4] = -np.array([gains.k_R[0] * gains.k_p, gains.k_R[0] * gains.k_v, gains.k_R[0], gains.k_w[0], 1]) / tau
    assert damping(np.linalg.eigvals(loop)) > 0.23


def test_position_is_limited_relative_to_attitude_and_the_configured_frequency_is_the_upper_bound():
    assert gains_of("falcon").k_p == 16.0
    assert gains_of("falcon", position_frequency=3.0).k_p == 9.0
    assert sqrt(gains_of("crazyflie_id").k_p) == pytest.approx(0.7 * 6.8867 / 5, rel=1e-4)
    assert gains_of("falcon", attitude_frequency=10.0).k_v == pytest.approx(2 * 10 / 5)
    assert gains_of("falcon", attitude_frequency=30.0).k_R == gains_of("falcon", attitude_frequency=None).k_R


@pytest.mark.parametrize(
    ("asked", "warnings"),
    [
        ({"attitude_frequency": 31.0}, ["control.attitude_frequency=31 is above 0.7 / motor lag: 21.2 rad/s is used"]),
        ({"position_frequency": 6.5}, ["control.position_frequency=6.5 is above 1/5 of attitude's: 4 rad/s is used"]),
        (
            {"attitude_frequency": 5.5},
            [
                "control.position_frequency=4 is above 1/5 of attitude's: 1.1 rad/s is used",
                "control.yaw_frequency=8 is above attitude's: 5.5 rad/s is used",
            ],
        ),
        ({"attitude_frequency": None, "position_frequency": None}, []),
        ({"position_frequency": 3.5}, []),
        ({}, []),
    ],
)
def test_a_gain_that_is_limited_says_so_once(caplog, asked, warnings):
    for _ in range(2):
        gains_of("falcon", **asked)
    assert [stats.getMessage().partition(";")[0] for stats in caplog.records] == warnings


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("preset", NAMES)
def test_attitude_returns_from_20_degrees(preset, axis):
    world = free_world(**{"vehicle.preset": preset, "cable.length": 90.0})
    vehicle = world.system.vehicle
    gains = gains_of(preset)
    inverse = np.ascontiguousarray(np.linalg.inv(vehicle.allocation))
    tilt = np.deg2rad(20)
    world.state.drone_rotation[0, 0] = np.reshape(axis_angle(floats(np.eye(3)[axis]), tilt), (3, 3))
    load(world)
    angles = []
    for _ in range(round(12 / sqrt(gains.k_R[axis]) / world.system.timestep)):
        rotation, rates = floats(world.state.drone_rotation[0, 0]), floats(world.state.drone_body_rates[0, 0])
        torque = attitude_torque(rotation, rates, LEVEL, STILL, gains)
        thrust = allocate(vehicle.mass * GRAVITY, torque, inverse, gains.thrust_min, gains.thrust_max)
        world.step(np.array(thrust).reshape(1, 1, 4))
        angles.append(np.arccos(np.clip((np.trace(world.state.drone_rotation[0, 0]) - 1) / 2, -1, 1)))
    assert max(angles) <= 1.001 * tilt
    assert np.rad2deg(angles[-1]) < 1.0
    assert not world.diverged.any()
