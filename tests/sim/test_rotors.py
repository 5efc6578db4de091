"""Rotors against closed forms: speed, thrust, torque and energy."""

from __future__ import annotations

from math import cos, exp, pi, sqrt

import numpy as np
import pytest
from conftest import (
    GRAVITY,
    TIMESTEPS,
    free_world,
    hover_thrust,
    load,
    make_system,
    steady,
    turned_from_rest,
    weightless,
)

from multilift_marl.sim import World


@pytest.mark.parametrize("timestep", TIMESTEPS)
@pytest.mark.parametrize("start, thrust", [(1000.0, 3.0), (1500.0, 0.5)], ids=["faster", "slower"])
def test_rotor_speed_follows_its_command_exponentially(start, thrust, timestep):
    world = free_world(**{"sim.timestep": timestep})
    vehicle, steps = world.system.vehicle, round(0.04 / timestep)
    world.state.rotor_speed[:] = start
    world.step(np.full((1, 1, 4), thrust), steps)
    target = sqrt(thrust / vehicle.thrust_coefficient)
    expected = start + (target - start) * (1 - exp(-steps * timestep / vehicle.rotor_time_constant))
    np.testing.assert_allclose(world.state.rotor_speed, expected, rtol=1e-12)


@pytest.mark.parametrize("timestep", TIMESTEPS)
def test_impulse_of_the_thrust_is_exact_while_rotors_change_speed(timestep):
    world = free_world(**{"sim.timestep": timestep})
    vehicle, t, start, thrust = world.system.vehicle, 0.04, 1000.0, 3.0
    world.state.rotor_speed[:] = start
    world.step(np.full((1, 1, 4), thrust), round(t / timestep))
    target, tau = sqrt(thrust / vehicle.thrust_coefficient), vehicle.rotor_time_constant
    gap = start - target
    square = target**2 * t + 2 * target * gap * tau * (1 - exp(-t / tau)) + gap**2 * tau / 2 * (1 - exp(-2 * t / tau))
    expected = 4 * vehicle.thrust_coefficient * square / vehicle.mass - GRAVITY * t
    assert world.state.drone_velocity[0, 0, 2] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("command, limit", [(1e6, "max"), (5.001, "max"), (0.0, "min"), (-3.0, "min")])
def test_rotors_keep_their_limits(command, limit):
    world = free_world()
    vehicle = world.system.vehicle
    world.step(np.full((1, 1, 4), command), 250)
    np.testing.assert_allclose(world.state.rotor_speed, getattr(vehicle, f"rotor_speed_{limit}"), rtol=1e-9)


def test_rotor_speed_limit_is_that_of_the_largest_thrust():
    vehicle = make_system(1).vehicle
    assert vehicle.thrust_coefficient * vehicle.rotor_speed_max**2 == pytest.approx(vehicle.rotor_thrust_max)


@pytest.mark.parametrize("rotor_speed", [500.0, 983.9, 1500.0])
def test_thrust_is_b_times_speed_squared_along_body_z(rotor_speed):
    world, tilt = free_world(), 0.4
    vehicle = world.system.vehicle
    world.state.drone_rotation[:] = [[cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, cos(tilt)]]
    load(world)
    world.step(steady(world, vehicle.thrust_coefficient * rotor_speed**2), 10)
    thrust = 4 * vehicle.thrust_coefficient * rotor_speed**2
    expected = 0.04 * (thrust / vehicle.mass * np.array([np.sin(tilt), 0, cos(tilt)]) - [0, 0, GRAVITY])
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], expected, atol=1e-12)


def test_hover_speed_of_the_falcon_is_the_published_one():
    vehicle = make_system(1).vehicle
    assert sqrt(vehicle.mass * GRAVITY / 4 / vehicle.thrust_coefficient) == pytest.approx(983.9, abs=0.1)


PLUS = (0.0, pi / 2, pi, 3 * pi / 2)


@pytest.mark.parametrize(
    "rotor, torque",
    [(0, (0, -1, 1)), (1, (1, 0, -1)), (2, (0, 1, 1)), (3, (-1, 0, -1))],
)
def test_a_faster_rotor_turns_a_plus_quadrotor_as_equation_8_says(rotor, torque):
    world = free_world(vehicle={"rotor_azimuth": PLUS})
    vehicle, more = world.system.vehicle, 0.01
    thrust = weightless(world)[0, 0]
    thrust[rotor] += more
    world.step(steady(world, thrust))
    expected = turned_from_rest(
        more * np.array(torque) * [vehicle.arm, vehicle.arm, vehicle.torque_ratio], np.array(vehicle.inertia), 0.004
    )
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("rotor, torque", [(0, (1, -1, 1)), (1, (1, 1, -1)), (2, (-1, 1, 1)), (3, (-1, -1, -1))])
def test_a_faster_rotor_turns_an_x_quadrotor_about_its_diagonal(rotor, torque):
    world = free_world()
    vehicle, more = world.system.vehicle, 0.01
    thrust = weightless(world)[0, 0]
    thrust[rotor] += more
    world.step(steady(world, thrust))
    lever = vehicle.arm / sqrt(2)
    expected = turned_from_rest(
        more * np.array(torque) * [lever, lever, vehicle.torque_ratio], np.array(vehicle.inertia), 0.004
    )
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], expected, rtol=1e-8, atol=1e-12)


def test_energy_is_the_integral_of_rotor_torque_times_speed():
    world = World(make_system(4), 1, 1)
    vehicle, speed = world.system.vehicle, world.state.rotor_speed.copy()
    world.step(hover_thrust(world), 100)
    power = (vehicle.torque_ratio * vehicle.thrust_coefficient * speed**3).sum()
    assert world.stats.energy[0] == pytest.approx(0.4 * power, rel=1e-9)


# The rotors' own inertia

OWN_INERTIA = {"vehicle.rotor_inertia": 2e-5}


def spinning(vehicle, rotor_speed: np.ndarray) -> float:
    """Return the rotors' angular momentum about body z [kg m²/s]: each turns against its reaction torque."""
    return -vehicle.rotor_inertia * float(np.dot(vehicle.rotor_spin, rotor_speed))


@pytest.mark.parametrize("timestep", TIMESTEPS)
@pytest.mark.parametrize("torque_ratio", [1e-12, 0.022], ids=["no drag of the blades", "drag of the blades"])
def test_rotors_that_speed_up_turn_the_drone_the_other_way(torque_ratio, timestep):
    world = free_world(**OWN_INERTIA, **{"vehicle.torque_ratio": torque_ratio, "sim.timestep": timestep})
    vehicle, rotors = world.system.vehicle, world.state.rotor_speed[0, 0]
    rotors[:] = 800.0
    before = spinning(vehicle, rotors)
    rising = np.array(vehicle.rotor_spin) > 0
    world.step(np.where(rising, 3.0, 1.0)[None, None], round(0.1 / timestep))
    yaw = vehicle.inertia[2] * world.state.drone_body_rates[0, 0, 2]
    assert rotors[rising].min() > 1300 and rotors[~rising].max() < 850
    gained = yaw + spinning(vehicle, rotors) - before
    # what the air gives to the whole is κ times the impulse of the thrusts
    t, tau, b, impulse = 0.1, vehicle.rotor_time_constant, vehicle.thrust_coefficient, 0.0
    for spin, thrust in ((1, 3.0), (-1, 1.0)):
        target = sqrt(thrust / b)
        gap = 800.0 - target
        square = target**2 * t + 2 * target * gap * tau * (1 - exp(-t / tau))
        impulse += 2 * spin * torque_ratio * b * (square + gap**2 * tau / 2 * (1 - exp(-2 * t / tau)))
    assert gained == pytest.approx(impulse, rel=1e-6, abs=1e-9)
    assert yaw > 0.01 * torque_ratio / 0.022


def test_a_turning_drone_feels_the_precession_of_unbalanced_rotors():
    world = free_world(**OWN_INERTIA)
    vehicle = world.system.vehicle
    speeds = np.where(np.array(vehicle.rotor_spin) > 0, 1200.0, 700.0)
    world.state.rotor_speed[:] = speeds
    rates = np.array([0.3, 0.5, 0.0])
    world.state.drone_body_rates[:] = rates
    load(world)
    world.step((vehicle.thrust_coefficient * speeds**2)[None, None])
    momentum = np.array([0, 0, spinning(vehicle, speeds)])
    assert momentum[2] == pytest.approx(-2e-5 * 1000)
    inertia = np.array(vehicle.inertia)
    torque = -np.cross(rates, inertia * rates + momentum)
    torque[2] += vehicle.torque_ratio * vehicle.thrust_coefficient * np.dot(vehicle.rotor_spin, speeds**2)
    gained = world.state.drone_body_rates[0, 0] - rates
    np.testing.assert_allclose(gained, world.system.timestep * torque / inertia, rtol=1e-2, atol=1e-6)


def test_a_spinning_top_precesses_at_the_rate_of_its_gyroscope():
    """The transverse rates of a free drone turn at h / I where its inertia is the same about x and y."""
    overrides = {"vehicle.inertia": (2e-3, 2e-3, 3e-3), "vehicle.torque_ratio": 1e-12, "sim.timestep": 5e-4}
    world = free_world(**OWN_INERTIA, **overrides)
    vehicle = world.system.vehicle
    speeds = np.where(np.array(vehicle.rotor_spin) > 0, 1400.0, 400.0)
    world.state.rotor_speed[:] = speeds
    world.state.drone_body_rates[:] = [0.5, 0.0, 0.0]
    load(world)
    world.step((vehicle.thrust_coefficient * speeds**2)[None, None], 400)
    angle = -spinning(vehicle, speeds) / 2e-3 * 0.2  # dΩ/dt = -h e3 × ... / I: clockwise for rotors with h > 0
    expected = 0.5 * np.array([cos(angle), -np.sin(angle)])
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0, :2], expected, atol=0.01)


def test_rotors_without_inertia_exert_neither():
    world = free_world(**{"vehicle.rotor_inertia": 0.0, "vehicle.torque_ratio": 1e-12})
    world.state.drone_body_rates[:] = [0.0, 1.0, 0.0]
    load(world)
    world.step(np.where(np.array(world.system.vehicle.rotor_spin) > 0, 3.0, 1.0)[None, None], 25)
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], [0.0, 1.0, 0.0], atol=1e-9)
