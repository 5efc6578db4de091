"""Set-points below the position: each level of the controller against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, drone_gains, floats, free_world, load, make_system

from multilift_marl.control.allocation import allocate
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import Gains, make_gains
from multilift_marl.control.geometric import attitude_torque, fly, fly_rates, rate_torque
from multilift_marl.control.setpoints import Setpoint, smooth_velocity, track_own_state
from multilift_marl.math3d import axis_angle
from multilift_marl.schema.control import ControlConfig
from multilift_marl.sim import World

DT = 1e-3
QUICK = {"rotor_time_constant_up": 1e-4, "rotor_time_constant_down": 1e-4, "rotor_inertia": 0.0}
NO_CABLE = np.zeros((1, 1, 3))
SEEDS = range(3)


def quick_drone(**vehicle) -> tuple[World, Gains]:
    """Return a free falcon whose motors hardly lag, without drag, and its gains, the load's inertia left out."""
    world = free_world(vehicle=QUICK | vehicle, **{"sim.timestep": DT})
    gains = make_gains(ControlConfig(), world.system)
    return world, gains._replace(load_share=np.zeros(1))


def fly_for(world: World, seconds: float, step, read) -> np.ndarray:
    """Return what `read` returned after every physics step; `step` writes `world.thrust` before each."""
    seen = []
    for _ in range(round(seconds / DT)):
        step()
        world.step(world.thrust)
        seen.append(read())
    return np.array(seen)


# Body rates


@pytest.mark.parametrize("seed", SEEDS)
def test_at_the_desired_rates_only_the_gyroscopic_torque_is_left(seed):
    rates, gains = (
        np.random.default_rng(seed).normal(size=3),
        drone_gains(make_gains(ControlConfig(), make_system(1)), 0),
    )
    expected = np.cross(rates, gains.inertia * rates)
    assert np.abs(expected).max() > 1e-5
    np.testing.assert_allclose(rate_torque(floats(rates), floats(rates), gains), expected, atol=1e-15)


@pytest.mark.parametrize("axis", range(3))
def test_a_step_of_the_body_rate_is_first_order(axis):
    world, gains = quick_drone()
    setpoint = Setpoint.zeros(1, 1)
    setpoint.thrust[:] = gains.mass * GRAVITY
    setpoint.rates[0, 0, axis] = 0.1
    seen = fly_for(
        world, 0.3, lambda: fly_rates(0, 1, world.state, setpoint, NO_CABLE, world.thrust, gains),
        lambda: world.state.drone_body_rates[0, 0].copy(),
    )  # fmt: skip
    t = DT * np.arange(1, len(seen) + 1)
    np.testing.assert_allclose(seen[:, axis], 0.1 * (1 - np.exp(-gains.k_w[0, axis] * t)), atol=0.03 * 0.1)
    assert np.abs(np.delete(seen, axis, axis=1)).max() < 1e-4


def test_a_step_of_the_body_rate_with_motor_lag_is_second_order():
    tau = 0.033
    world, gains = quick_drone(rotor_time_constant_up=tau, rotor_time_constant_down=tau)
    k = gains.k_w[0, 0]
    setpoint = Setpoint.zeros(1, 1)
    setpoint.thrust[:] = gains.mass * GRAVITY
    setpoint.rates[0, 0, 0] = 0.05
    seen = fly_for(
        world, 0.4, lambda: fly_rates(0, 1, world.state, setpoint, NO_CABLE, world.thrust, gains),
        lambda: world.state.drone_body_rates[0, 0, 0],
    )  # fmt: skip
    t, decay = DT * np.arange(1, len(seen) + 1), 0.5 / tau
    w = np.sqrt(k / tau - decay**2)  # τ ω̈ + ω̇ + k (ω - ω_d) = 0
    expected = 0.05 * (1 - np.exp(-decay * t) * (np.cos(w * t) + decay / w * np.sin(w * t)))
    np.testing.assert_allclose(seen, expected, atol=0.04 * 0.05)


def test_rates_and_thrust_give_up_yaw_first():
    world, gains = quick_drone()
    setpoint = Setpoint.zeros(1, 1)
    setpoint.thrust[:] = gains.mass * GRAVITY
    setpoint.rates[:] = [1.0, -0.5, 30.0]
    fly_rates(0, 1, world.state, setpoint, NO_CABLE, world.thrust, gains)
    given = world.system.vehicle.allocation @ world.thrust[0, 0]
    wanted = np.array(rate_torque((0.0, 0.0, 0.0), floats(setpoint.rates), drone_gains(gains, 0)))
    np.testing.assert_allclose(given[:3], [setpoint.thrust[0, 0], *wanted[:2]], rtol=1e-9)
    assert 0 < given[3] < 0.9 * wanted[2]
    assert np.isclose(world.thrust, gains.thrust_max).any() or np.isclose(world.thrust, gains.thrust_min).any()


# Attitude


def turn_to(
    world: World, gains: Gains, desired: np.ndarray, rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> None:
    """Write the thrusts that turn the drone to an attitude (3, 3), which turns at body rates, at the hover thrust."""
    state, g = world.state, drone_gains(gains, 0)
    torque = attitude_torque(floats(state.drone_rotation), floats(state.drone_body_rates), floats(desired), rates, g)
    world.thrust[0, 0] = allocate(g.mass * GRAVITY, torque, g.allocation, g.thrust_min, g.thrust_max)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("damping", [0.5, 0.8])
def test_a_step_of_the_attitude_is_second_order_with_the_configured_frequency_and_damping(axis, damping):
    world, _ = quick_drone()
    gains = make_gains(ControlConfig(attitude_damping=damping), world.system)
    frequency = (20.0, 20.0, 8.0)[axis]
    desired = np.array(axis_angle(floats(np.eye(3)[axis]), 0.02))

    def angle():
        r = world.state.drone_rotation[0, 0]
        return 0.5 * (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])[axis]

    seen = fly_for(world, 8 / frequency, lambda: turn_to(world, gains, desired), angle)
    t, decay = DT * np.arange(1, len(seen) + 1), damping * frequency
    w = frequency * np.sqrt(1 - damping**2)
    expected = 0.02 * (1 - np.exp(-decay * t) * (np.cos(w * t) + decay / w * np.sin(w * t)))
    np.testing.assert_allclose(seen, expected, atol=0.03 * 0.02)


def test_a_turning_attitude_is_followed_without_lag():
    world, gains = quick_drone()
    world.state.drone_body_rates[0, 0, 2] = 0.4
    load(world)
    time = [0.0]

    def step():
        turn_to(world, gains, np.array(axis_angle((0.0, 0.0, 1.0), 0.4 * time[0])), (0.0, 0.0, 0.4))
        time[0] += DT

    turned = fly_for(world, 1.0, step, lambda: world.state.drone_rotation[0, 0].copy())
    assert np.arctan2(turned[-1, 1, 0], turned[-1, 0, 0]) == pytest.approx(0.4, abs=1e-3)


# Acceleration


def follow_acceleration(world: World, reference: Reference, gains: Gains, tilt_rates: np.ndarray | None = None) -> None:
    """Write the thrusts for the reference's acceleration alone."""
    track_own_state(0, 1, world.state, reference, 0.0)
    fly(0, 1, world.state, reference, NO_CABLE, world.thrust, gains, tilt_rates)


@pytest.mark.parametrize("acceleration", [(0.0, 0.0, 2.0), (1.5, 0.0, 0.0), (0.5, -1.0, 1.0)])
def test_a_steady_acceleration_is_that_commanded(acceleration):
    world, gains = quick_drone()
    reference = Reference.zeros(1, 1)
    reference.acceleration[:] = acceleration
    seen = fly_for(
        world, 1.0, lambda: follow_acceleration(world, reference, gains),
        lambda: world.state.drone_velocity[0, 0].copy(),
    )  # fmt: skip
    np.testing.assert_allclose((seen[-1] - seen[-101]) / 0.1, acceleration, atol=0.01)


def lag_of_a_changing_acceleration(with_rates: bool) -> float:
    """Return the largest error of a sinusoidal acceleration [m/s²], with or without the rates of its attitude."""
    world, gains = quick_drone()
    reference, rates, w, wanted = Reference.zeros(1, 1), np.zeros((1, 1, 3)), 4.0, []

    def step():
        t = len(wanted) * DT
        acceleration, jerk = 2.0 * np.sin(w * t), 2.0 * w * np.cos(w * t)
        reference.acceleration[0, 0] = [acceleration, 0, 0]
        rates[0, 0, 1] = with_rates * jerk * GRAVITY / (GRAVITY**2 + acceleration**2)  # of atan(a/g)
        follow_acceleration(world, reference, gains, rates)
        wanted.append(acceleration)

    speed = fly_for(world, 1.5, step, lambda: world.state.drone_velocity[0, 0, 0])
    return np.abs(np.gradient(speed, DT) - wanted)[500:].max()


def test_rates_beside_the_acceleration_take_the_lag_out_of_a_changing_one():
    assert lag_of_a_changing_acceleration(with_rates=True) < 0.2
    assert lag_of_a_changing_acceleration(with_rates=True) < 0.3 * lag_of_a_changing_acceleration(with_rates=False)


# Velocity


def follow_velocity(world: World, reference: Reference, gains: Gains) -> None:
    """Write the thrusts for the reference's velocity alone."""
    reference.position[:] = world.state.drone_position
    fly(0, 1, world.state, reference, NO_CABLE, world.thrust, gains)


def test_a_velocity_error_falls_exponentially():
    world, gains = quick_drone()
    reference = Reference.zeros(1, 1)
    reference.velocity[0, 0, 2] = 0.5
    seen = fly_for(
        world, 1.0, lambda: follow_velocity(world, reference, gains),
        lambda: world.state.drone_velocity[0, 0, 2],
    )  # fmt: skip
    t = DT * np.arange(1, len(seen) + 1)
    np.testing.assert_allclose(seen, 0.5 * (1 - np.exp(-gains.k_v * t)), atol=0.01 * 0.5)


def test_a_sideways_velocity_is_reached_and_kept():
    world, gains = quick_drone()
    reference = Reference.zeros(1, 1)
    reference.velocity[0, 0] = [0.6, -0.3, 0.1]
    seen = fly_for(
        world, 1.8, lambda: follow_velocity(world, reference, gains),
        lambda: world.state.drone_velocity[0, 0].copy(),
    )  # fmt: skip
    np.testing.assert_allclose(seen[-1], [0.6, -0.3, 0.1], atol=2e-3)


def test_a_smoothed_velocity_is_a_critically_damped_second_order_step():
    world, _ = quick_drone()
    reference, setpoint, w, dt = Reference.zeros(1, 1), Setpoint.zeros(1, 1), 6.0, 1e-4
    setpoint.velocity[0, 0], reference.yaw_rate[0, 0] = [1.0, -0.5, 0.2], 0.7
    history = []
    for _ in range(10000):
        smooth_velocity(0, 1, world.state, reference, setpoint, w, dt)
        history.append([field[0, 0].copy() for field in (reference.velocity, reference.acceleration, reference.jerk)])
    velocity, acceleration, jerk = np.array(history).swapaxes(0, 1)
    t = dt * np.arange(1, 10001)[:, None]
    np.testing.assert_allclose(velocity, (1 - np.exp(-w * t) * (1 + w * t)) * [1.0, -0.5, 0.2], atol=1e-3)
    np.testing.assert_allclose(np.diff(velocity, axis=0) / dt, acceleration[1:], atol=1e-9)
    np.testing.assert_allclose(np.diff(acceleration, axis=0) / dt, jerk[1:], atol=1e-9)
    assert reference.yaw[0, 0] == pytest.approx(0.7)
    np.testing.assert_array_equal(reference.position, world.state.drone_position)


def test_below_the_position_references_go_with_the_drone():
    world, _ = quick_drone()
    world.state.drone_velocity[0, 0] = [1, 2, 3]
    reference = Reference.zeros(1, 1)
    reference.yaw_rate[0, 0] = 0.5
    track_own_state(0, 1, world.state, reference, 0.1)
    np.testing.assert_array_equal(reference.position, world.state.drone_position)
    np.testing.assert_array_equal(reference.velocity, world.state.drone_velocity)
    assert reference.yaw[0, 0] == pytest.approx(0.05)
