"""The smoothed reference, and how well drones and teams follow it."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from conftest import floats, make, make_system, refuse_system, with_vehicle

from multilift_marl.control.formation import Reference, Smoothing, smooth, start_reference, wrap
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.math3d import heading
from multilift_marl.schema.control import ControlConfig
from multilift_marl.sim import World

# The smoothed reference


def control_step(command, seconds, yaw=0.0, frequency=6.0, speed=1.0, dt=0.004) -> Reference:
    """Return a reference's history, one step for each environment, after it started at rest at the origin."""
    steps = round(seconds / dt)
    one, history = Reference.zeros(1, 1), Reference.zeros(steps, 1)
    one.command[:], one.command_yaw[:] = command, yaw
    for step in range(steps):
        smooth(0, 1, one, Smoothing(frequency, speed, dt))
        for kept, now in zip(history, one, strict=True):
            kept[step] = now[0]
    return history


def test_a_near_command_is_approached_like_a_critically_damped_third_order_step():
    dt, w = 1e-4, 6.0
    history = control_step([0.2, -0.1, 0.1], 1.5, dt=dt)
    t = dt * np.arange(1, len(history.position) + 1)[:, None]
    share = 1 - np.exp(-w * t) * (1 + w * t + (w * t) ** 2 / 2)
    np.testing.assert_allclose(history.position[:, 0], share * [0.2, -0.1, 0.1], atol=2e-4)
    speed = w * np.exp(-w * t) * (w * t) ** 2 / 2
    np.testing.assert_allclose(history.velocity[:, 0], speed * [0.2, -0.1, 0.1], atol=1e-3)


@pytest.mark.parametrize("distance", [0.1, 0.6, 4.0])
def test_no_command_is_overshot(distance):
    history = control_step([0, distance, 0], 10.0)
    assert history.position[:, 0, 1].max() <= distance + 1e-6
    assert history.position[-1, 0, 1] == pytest.approx(distance, abs=1e-6)


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_a_far_command_is_approached_at_the_speed_limit(speed):
    history = control_step([6.0, -6.0, 6.0], 5.0, speed=speed)
    norm = np.linalg.norm(history.velocity[:, 0], axis=-1)
    assert norm.max() <= 1.01 * speed
    assert norm[round(2 / 0.004)] == pytest.approx(speed, rel=0.01)


def test_velocity_acceleration_and_jerk_are_derivatives():
    history = control_step([2.0, 0.5, -0.3], 2.0, dt=1e-3)
    for lower, higher in [("position", "velocity"), ("velocity", "acceleration"), ("acceleration", "jerk")]:
        slope = np.diff(getattr(history, lower), axis=0) / 1e-3
        np.testing.assert_allclose(slope, getattr(history, higher)[1:], atol=1e-9)


def test_yaw_is_approached_like_a_critically_damped_second_order_step():
    history = control_step([0, 0, 0], 1.5, yaw=0.8, dt=1e-4)
    wt = 6.0 * 1e-4 * np.arange(1, len(history.yaw) + 1)
    np.testing.assert_allclose(history.yaw[:, 0], 0.8 * (1 - np.exp(-wt) * (1 + wt)), atol=1e-3)


@pytest.mark.parametrize(
    "command, expected", [(2.5, 2.5), (4.0, 4.0 - 2 * pi), (-3.5, 2 * pi - 3.5), (7.0, 7.0 - 2 * pi)]
)
def test_yaw_takes_the_short_way(command, expected):
    assert control_step([0, 0, 0], 6.0, yaw=command).yaw[-1, 0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "angle, expected", [(0.5, 0.5), (pi, pi), (-pi, pi), (3.5, 3.5 - 2 * pi), (-20.0, 6 * pi - 20)]
)
def test_wrap(angle, expected):
    assert wrap(angle) == pytest.approx(expected)


@pytest.mark.timeout(60, method="thread")  # of a loop that never ends
@pytest.mark.parametrize("angle", [1e18, -1e18, 1e300])
def test_wrap_of_any_angle_ends_within_pi(angle):
    assert abs(wrap(angle)) <= pi


def test_wrap_of_less_than_a_turn_too_much_is_exact():
    """Trained policies fly on: within ± 3π every bit is that of a full turn added once, or of the angle itself."""
    for angle in np.random.default_rng(0).uniform(-3 * pi, 3 * pi, 1000).tolist():
        once = angle - 2 * pi if angle > pi else angle + 2 * pi if angle <= -pi else angle
        assert wrap(angle) == once


@pytest.mark.parametrize("frequency", [62.5, 1e-2])
def test_the_fastest_and_the_slowest_filter_stay_smooth(frequency):
    """A quarter of the control rate is the fastest that the configuration takes; from 130 rad/s on it would diverge."""
    history = control_step([0.2, -0.1, 0.1], 2.0, yaw=0.8, frequency=frequency)
    assert np.abs(history.position[:, 0]).max() <= 0.2 * 1.02
    assert np.abs(history.yaw).max() <= 0.8 * 1.02


@pytest.mark.parametrize("rate", [50.0, 250.0])
def test_a_filter_too_fast_for_the_control_rate_is_refused(rate):
    rates = {"sim.control_hz": rate, "env.policy_hz": 50.0, "control.attitude_frequency": 10.0}
    make_system(1, **rates, **{"control.reference_frequency": rate / 4})
    message = refuse_system(1, **rates, **{"control.reference_frequency": 1.01 * rate / 4})
    assert message.startswith("control.reference_frequency=") and "raise sim.control_hz" in message


# Flight


def test_a_free_drone_follows_its_reference_to_the_centimetre():
    system = make_system(1, **{"cable.length": 20.0})
    system = with_vehicle(system, drag=(0.0, 0.0, 0.0))
    world, reference = World(system, 1, 1), Reference.zeros(1, 1)
    world.state.payload_position[:] = [0, 0, 0.075]
    world.state.drone_position[:] = [0, 0, 2.0]
    world.load(np.ones(1, bool))
    start_reference(0, world.state, reference)
    reference.command[:], reference.command_yaw[:] = [1.5, -1.0, 3.0], 1.0
    gains = make_gains(ControlConfig(), system)._replace(load_share=np.zeros(1))
    thrust, errors = np.zeros((1, 1, 4)), []
    for _ in range(1250):
        smooth(0, 1, reference, Smoothing(6.0, 1.0, 0.004))
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
