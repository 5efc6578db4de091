"""Forces, filters and gusts: every constant and sign of their formulas against numbers worked out another way."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from plain_kernels import plain, record, turned
from test_estimator import riccati
from test_snatch import exact_peak

from multilift_marl.control import disturbance
from multilift_marl.control.disturbance import Disturbance, Rejection
from multilift_marl.sensing import estimator
from multilift_marl.sensing.suite import SensorSuite
from multilift_marl.sim.cables import massless
from multilift_marl.sim.cables.common import Cables
from multilift_marl.sim.gusts import gust_factor
from multilift_marl.sim.parameters import Inertias
from multilift_marl.sim.state import SystemState

G = 9.81
DT = 0.004
ATTITUDE = turned([0.3, -0.8, 0.5], 0.7)
VELOCITY = np.array([0.4, -1.1, 0.7])

# Estimator


def filters(delay: int = 0):
    """Return channels, readings, state and filter of one drone in motion."""
    state = SystemState.zeros(1, 1)
    state.drone_position[0, 0], state.drone_velocity[0, 0] = [1.0, 2.0, 3.0], VELOCITY
    state.drone_rotation[0, 0] = ATTITUDE
    values = np.zeros((1, 1, 16))
    readings = record(values=values, tick=np.array([7]), fresh=np.ones((1, 6), bool))
    field = np.array([[3.0, 21.0, -43.0]])
    channels = record(dt=DT, delay=np.full(6, delay), magnetic_field=field)
    bias = np.array([[[0.01, -0.02, 0.03]]])
    return channels, readings, state, estimator.Filter(bias, np.full((1, 1), 0.05), np.zeros((1, 1, delay + 1, 6)))


def test_a_filter_moves_by_half_the_acceleration_times_the_square_of_a_tick():
    channels, readings, state, filter = filters()
    rates = np.array([1.5, -2.5, 0.8])
    force = np.array([3.0, -4.0, 12.0])
    readings.values[0, 0, :6] = [*force, *(rates + filter.gyro_bias[0, 0])]
    channels.dt = 0.2  # long, so that the square counts
    plain(estimator._predict)(0, 0, readings, channels, state, filter)
    angle = 0.2 * np.linalg.norm(rates)
    acceleration = ATTITUDE @ turned(rates, 0.5 * angle) @ force - [0, 0, G + 0.05]
    np.testing.assert_allclose(state.drone_velocity[0, 0], VELOCITY + 0.2 * acceleration, rtol=1e-12)
    moved = 0.2 * VELOCITY + 0.5 * 0.2**2 * acceleration
    np.testing.assert_allclose(state.drone_position[0, 0], [1, 2, 3] + moved, rtol=1e-12)
    np.testing.assert_allclose(state.drone_rotation[0, 0], ATTITUDE @ turned(rates, angle), atol=1e-12)
    np.testing.assert_allclose(state.drone_body_rates[0, 0], rates, rtol=1e-12)
    np.testing.assert_array_equal(filter.past[0, 0, 0], [*state.drone_position[0, 0], *state.drone_velocity[0, 0]])


@pytest.mark.parametrize("tick", [7, 8, 9])
def test_a_fix_corrects_all_that_came_after_it_each_axis_by_its_own_gains(tick):
    channels, readings, state, filter = filters(delay=2)
    rng = np.random.default_rng(tick)
    gains = estimator.FilterGains(rng.normal(size=(3, 4, 2)), rng.normal(size=(3, 3, 2)), rng.normal(size=(2, 1)))
    filter.past[:] = rng.normal(size=filter.past.shape)
    readings.values[0, 0, 10:16] = rng.normal(size=6)
    readings.tick[0] = tick
    before = filter.past[0, 0].copy(), state.drone_position[0, 0].copy(), filter.gyro_bias[0, 0].copy()
    plain(estimator._correct_motion)(0, 0, readings, channels, state, filter, gains)

    off = readings.values[0, 0, 10:16] - before[0][(tick - 2) % 3]
    pairs = np.stack([off[:3], off[3:]])  # of position and velocity, along each axis
    for i in range(3):
        k = np.stack([gains.level[i, :2], gains.level[i, :2], gains.vertical[i, :2]])  # axis, what, of
        change = np.concatenate([[k[axis, what] @ pairs[:, axis] for axis in range(3)] for what in range(2)])
        at = (tick - 2 + i) % 3
        np.testing.assert_allclose(filter.past[0, 0, at], before[0][at] + change, rtol=1e-12)
    np.testing.assert_allclose(state.drone_position[0, 0], before[1] + change[:3], rtol=1e-12)
    np.testing.assert_allclose(state.drone_velocity[0, 0], VELOCITY + change[3:], rtol=1e-12)
    assert filter.lift_bias[0, 0] == pytest.approx(0.05 + gains.vertical[2, 2] @ pairs[:, 2])
    # A tilt about x speeds a drone up along -y by g, one about y along x.
    tilt, bias = (gains.level[2, row] @ pairs[:, :2] for row in (2, 3))
    rotation = np.array([-tilt[1], tilt[0], 0.0])
    expected = turned(rotation, np.linalg.norm(rotation)) @ ATTITUDE
    np.testing.assert_allclose(state.drone_rotation[0, 0], expected, atol=1e-12)
    np.testing.assert_allclose(filter.gyro_bias[0, 0], before[2] + ATTITUDE.T @ [-bias[1], bias[0], 0.0], rtol=1e-10)


@pytest.mark.parametrize("error", [0.3, -0.2])
def test_a_magnetometer_turns_the_heading_back_and_tells_the_bias_about_the_vertical(error):
    channels, readings, state, filter = filters()
    field = channels.magnetic_field[0]
    readings.values[0, 0, 6:9] = ATTITUDE.T @ field
    state.drone_rotation[0, 0] = turned([0, 0, 1], error) @ ATTITUDE  # what it thinks
    gains = estimator.FilterGains(np.zeros((1, 4, 2)), np.zeros((1, 3, 2)), np.array([[0.25], [-0.5]]))
    thought, bias = state.drone_rotation[0, 0].copy(), filter.gyro_bias[0, 0].copy()
    plain(estimator._correct_heading)(0, 0, readings, channels, state, filter, gains)
    expected = turned([0, 0, 1], -0.25 * error) @ thought
    np.testing.assert_allclose(state.drone_rotation[0, 0], expected, atol=1e-12)
    np.testing.assert_allclose(filter.gyro_bias[0, 0], bias + thought.T @ [0, 0, 0.5 * error], rtol=1e-10)


def test_a_filter_starts_at_the_first_fix_and_elsewhere_at_the_truth():
    _, readings, true, filter = filters(delay=2)
    readings.values[0, 0, 10:13] = [7.0, 8.0, 9.0]
    true.drone_body_rates[0, 0] = [0.1, 0.2, -0.3]
    state = SystemState.zeros(1, 1)
    plain(estimator.start_filter)(0, true, readings, state, filter)
    assert state.drone_position[0, 0].tolist() == [7.0, 8.0, 9.0]
    for name in ("drone_velocity", "drone_rotation", "drone_body_rates"):
        np.testing.assert_array_equal(getattr(state, name), getattr(true, name))
    assert not filter.gyro_bias.any() and not filter.lift_bias.any()
    np.testing.assert_array_equal(filter.past[0, 0], [[7.0, 8.0, 9.0, *VELOCITY]] * 3)


@pytest.mark.parametrize("level", ["mocap", "onboard"])
def test_gains_are_those_of_the_three_models_with_the_stated_noise(level):
    rate, suite = 250.0, estimator._make_suite(level, 250.0)
    gains, dt = estimator.make_gains(suite, 20.0), 1 / 250
    spread = np.sqrt(rate / 2)
    push = np.hypot(suite.accelerometer.noise, 9e-3 * spread) * dt
    turn = np.hypot(suite.gyroscope.noise, 1.8e-4 * spread) * dt
    walks = 3e-4 * np.sqrt(dt), 3e-3 * np.sqrt(dt)
    level_axis = np.array([[1, dt, 0, 0], [0, 1, G * dt, 0], [0, 0, 1, -dt], [0, 0, 0, 1]])
    vertical = np.array([[1, dt, 0], [0, 1, -dt], [0, 0, 1]])
    heading = np.array([[1, -dt], [0, 1]])
    noise = [np.broadcast_to(sensor.noise, 3) for sensor in (suite.position, suite.velocity)]
    fixes, fields = round(rate / suite.position.rate), round(rate / suite.magnetometer.rate)
    for found, a, deviations, r, steps in (
        (gains.level[0], level_axis, [0, push, turn, walks[0]], [each[0] for each in noise], fixes),
        (gains.vertical[0], vertical, [0, push, walks[1]], [each[2] for each in noise], fixes),
        (gains.heading, heading, [turn, walks[0]], [suite.magnetometer.noise / 20.0], fields),
    ):
        through, q, size = np.eye(len(a)), np.zeros_like(a), len(r)
        for _ in range(steps):
            through, q = a @ through, a @ q @ a.T + np.diag(np.square(deviations))
        c, cover = np.eye(size, len(a)), np.diag(np.square(r))
        p = riccati(through, c, q, cover)
        np.testing.assert_allclose(found, p @ c.T @ np.linalg.inv(c @ p @ c.T + cover), rtol=2e-3)
    for i in range(len(gains.level)):
        np.testing.assert_allclose(gains.level[i], np.linalg.matrix_power(level_axis, i) @ gains.level[0], rtol=1e-9)
        np.testing.assert_allclose(gains.vertical[i], np.linalg.matrix_power(vertical, i) @ gains.vertical[0])


def test_sensors_have_the_numbers_of_their_data_sheets():
    suite = SensorSuite()
    spread = np.sqrt(125.0)  # of one-sided densities at 250 Hz
    assert suite.accelerometer.noise == pytest.approx(70e-6 * G * spread)
    assert suite.gyroscope.noise == pytest.approx(np.radians(2.8e-3) * spread)
    magnetometer, barometer, position = suite.magnetometer, suite.barometer, suite.position
    assert magnetometer.noise == 0.015  # 15 nT
    assert (magnetometer.offset, magnetometer.drift, magnetometer.drift_time) == (0.2, 0.05, 100)
    assert (barometer.noise, barometer.drift, barometer.drift_time) == (1.2, 3.0, 300)  # 0.012 mbar
    assert (position.rate, position.delay, suite.velocity.noise) == (10.0, 0.1, 0.05)
    assert np.hypot(position.noise, position.drift) == pytest.approx([0.01, 0.01, 0.018], rel=0.06)
    cameras = estimator._make_suite("mocap", 250.0)
    assert cameras.magnetometer.noise == pytest.approx(np.radians(0.2) * 48.4)  # 0.2° of heading in a level field
    assert (cameras.position.rate, cameras.position.delay, cameras.position.noise) == (125.0, 0.008, 1e-3)


# Unknown forces


def rejection(largest: float = 3.0):
    """Return state, reference, numbers and memory of the rejection of one drone in motion."""
    state = SystemState.zeros(1, 1)
    state.drone_rotation[0, 0], state.drone_velocity[0, 0] = ATTITUDE, VELOCITY
    state.drone_position[0, 0] = [0.1, -0.2, 0.3]
    state.rotor_speed[0, 0] = [1000.0, 1100.0, 900.0, 1050.0]
    gains = record(
        thrust_min=np.array([0.2]), thrust_max=np.array([4.0]), mass=np.array([0.6]), load_share=np.array([0.35]),
        drag=np.array([[0.3, 0.2, 0.1]]),
    )  # fmt: skip
    own = Rejection(DT, np.array([0.1]), np.array([2.0]), np.array([largest]), np.array([1e-6]), gains)
    reference = record(
        position=np.zeros((1, 1, 3)), velocity=np.array([[[0.5, 0.2, -0.4]]]),
        acceleration=np.array([[[1.0, -0.7, 0.3]]]),
    )  # fmt: skip
    return state, reference, own, Disturbance.zeros(1, 1), np.array([[[0.2, -0.1, 3.4]]])


def test_the_integral_adds_the_error_times_its_gain_and_the_step():
    state, reference, own, memory, cable = rejection()
    memory.force[0, 0] = [0.3, 0.2, -0.1]
    plain(disturbance.integrate_error)(0, 1, state, reference, cable, memory, own)
    expected = np.array([0.3, 0.2, -0.1]) - 2.0 * DT * np.array([0.1, -0.2, 0.3])
    np.testing.assert_allclose(memory.force[0, 0], expected, rtol=1e-12)
    np.testing.assert_allclose(memory.cable_force[0, 0], cable[0, 0] + expected, rtol=1e-12)


@pytest.mark.parametrize("rotor", range(4))
@pytest.mark.parametrize(
    "thrust, free",
    [(4.0, False), (3.961, False), (3.959, True), (1.0, True), (0.241, True), (0.239, False), (0.2, False)],
)
def test_the_integral_may_not_grow_within_a_hundredth_of_either_limit_of_a_rotor(thrust, free, rotor):
    for growing in (True, False):
        state, reference, own, memory, cable = rejection()
        state.rotor_speed[0, 0, rotor] = np.sqrt(thrust / 1e-6)
        before = (-1.0 if growing else 1.0) * state.drone_position[0, 0]
        memory.force[0, 0] = before
        plain(disturbance.integrate_error)(0, 1, state, reference, cable, memory, own)
        changed = not np.array_equal(memory.force[0, 0], before)
        assert changed == (free or not growing)


@pytest.mark.parametrize("sign", [-1, 1])
def test_an_integral_at_its_limit_keeps_its_direction_and_comes_back(sign):
    state, reference, own, memory, cable = rejection(largest=0.5)
    away = sign * np.array([300.0, -200.0, 100.0])
    for _ in range(5):
        reference.position[0, 0] = state.drone_position[0, 0] + away
        plain(disturbance.integrate_error)(0, 1, state, reference, cable, memory, own)
    np.testing.assert_allclose(memory.force[0, 0], 0.5 * away / np.linalg.norm(away), rtol=1e-9)
    reference.position[0, 0] = state.drone_position[0, 0] - 1e-3 * away
    plain(disturbance.integrate_error)(0, 1, state, reference, cable, memory, own)
    back = (0.5 - 2.0 * DT * 1e-3 * np.linalg.norm(away)) * away / np.linalg.norm(away)
    np.testing.assert_allclose(memory.force[0, 0], back, rtol=1e-9)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_measured_force_at_its_limit_keeps_its_direction(sign):
    state, reference, own, memory, cable = rejection(largest=0.5)
    state.drone_velocity[:], away = 0.0, sign * np.array([300.0, -200.0, 100.0])
    cable[0, 0] = -1e6 * away
    for _ in range(5):
        plain(disturbance.estimate_force)(0, 1, state, reference, cable, memory, own)
    np.testing.assert_allclose(memory.force[0, 0], 0.5 * away / np.linalg.norm(away), atol=1e-6)


def test_the_measured_force_is_what_rotors_exert_beyond_motion_weight_and_what_is_fed_forward():
    state, reference, own, memory, cable = rejection(largest=1e9)
    memory.velocity[0, 0], memory.force[0, 0] = [0.39, -1.12, 0.705], [0.3, 0.2, -0.1]
    plain(disturbance.estimate_force)(0, 1, state, reference, cable, memory, own)
    rotors = 1e-6 * (state.rotor_speed[0, 0] ** 2).sum() * ATTITUDE[:, 2]
    drag = ATTITUDE @ (np.array([0.3, 0.2, 0.1]) * (ATTITUDE.T @ [0.5, 0.2, -0.4]))
    fed = np.array([0.2, -0.1, 3.4]) + drag + 0.35 * np.array([1.0, -0.7, 0.3])
    moved = 0.6 * (VELOCITY - [0.39, -1.12, 0.705]) / DT + [0, 0, 0.6 * G]
    old = np.array([0.3, 0.2, -0.1])
    np.testing.assert_allclose(memory.force[0, 0], old + 0.1 * (rotors - moved - fed - old), rtol=1e-9)
    np.testing.assert_allclose(memory.cable_force[0, 0], cable[0, 0] + memory.force[0, 0], rtol=1e-12)
    np.testing.assert_array_equal(memory.velocity[0, 0], VELOCITY)


# Snatches


@pytest.mark.parametrize("acceleration", [-40.0, -5.0, 0.0, 5.0, 60.0, 1000.0])
@pytest.mark.parametrize("ratio", [0.0, 0.05, 0.7, 0.99, 1.01, 1.5, 4.0, 30.0])
@pytest.mark.parametrize("speed", [0.002, 0.1, 3.0])
def test_a_snatch_has_its_peak_with_any_damping_and_any_other_force(speed, ratio, acceleration):
    mass, stiffness = 0.4, 2e4
    damping = 2 * ratio * np.sqrt(stiffness * mass)
    found = plain(massless.snatch_peak)(speed, acceleration, mass, stiffness, damping)
    # By the roots of s² + c/m s + k/m; a force that rises for ever ends at m a.
    roots = np.roots([1.0, damping / mass, stiffness / mass]).astype(complex)
    rest, pace = mass * acceleration / stiffness, np.sqrt(stiffness / mass)
    first, second = np.linalg.solve([[1.0, 1.0], roots], [-rest, speed])
    end = 10.0 / pace if ratio < 1 else -40.0 / roots.real.max()
    time = np.unique(np.concatenate([np.linspace(0, end, 40_001), np.geomspace(1e-7 * end, end, 40_001)]))
    parts = first * np.exp(roots[0] * time), second * np.exp(roots[1] * time)
    stretch, rate = rest + sum(parts).real, (roots[0] * parts[0] + roots[1] * parts[1]).real
    force = stiffness * stretch + damping * rate
    force[0] = damping * speed
    gone = np.flatnonzero(force < 0)
    expected = force[: gone[0] if gone.size else None].max()
    assert found == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("stretch", [0.004, 0.0, -0.003])
def test_a_snatch_is_met_at_the_speed_at_which_the_cable_was_at_its_natural_length(stretch, monkeypatch):
    timestep, drone_mass, load_mass, natural, acceleration = 1e-3, 0.7, 0.9, 1.0, 7.0
    state = SystemState.zeros(1, 1)
    state.payload_rotation[0], state.drone_rotation[0, 0] = turned([1, 2, 3], 0.5), ATTITUDE
    state.payload_velocity[0], state.payload_body_rates[0] = [0.3, -0.2, 0.5], [0.6, 0.4, -0.8]
    state.drone_body_rates[0, 0] = [-0.5, 0.9, 0.3]
    anchor, hook = np.array([0.2, -0.1, 0.05]), np.array([0.03, 0.02, -0.06])
    along = np.array([0.3, 0.5, 0.9]) / np.linalg.norm([0.3, 0.5, 0.9])
    low = state.payload_rotation[0] @ anchor
    low_velocity = state.payload_velocity[0] + state.payload_rotation[0] @ np.cross([0.6, 0.4, -0.8], anchor)
    state.drone_position[0, 0] = low + (natural + stretch) * along - ATTITUDE @ hook
    met = 1.3
    speed = np.sqrt(met**2 + 2 * acceleration * max(stretch, 0.0))
    spin = ATTITUDE @ np.cross([-0.5, 0.9, 0.3], hook)
    state.drone_velocity[0, 0] = low_velocity + speed * along + np.cross(along, [0.4, 0.1, 0.2]) - spin

    moments = np.array([[0.01, 0.02, 0.03], [0.004, 0.005, 0.006]])
    centers = np.array([[[0.01, 0.02, -0.01], [0.0, 0.0, 0.0]]])
    inverse = np.stack([np.diag(1 / moments[0]), np.diag(1 / moments[1])])[None]
    bodies = Inertias(np.array([[load_mass, drone_mass]]), np.zeros((1, 2, 3, 3)), inverse, centers)
    mobility = 0.0
    for mass, moment, arm, rotation in (
        (load_mass, moments[0], anchor - centers[0, 0], state.payload_rotation[0]),
        (drone_mass, moments[1], hook, ATTITUDE),
    ):
        lever = np.cross(arm, rotation.T @ along)
        mobility += 1 / mass + lever @ (lever / moment)
    found = plain(massless._mobility)(
        0, 0, tuple(state.payload_rotation[0].ravel()), tuple(anchor), tuple(along), bodies
    )
    lever = np.cross(anchor - centers[0, 0], state.payload_rotation[0].T @ along)
    assert found == pytest.approx(1 / load_mass + lever @ (lever / moments[0]), rel=1e-12)

    tension = 25.0  # its mean over the step has slowed what all else would have sped up
    line = np.zeros(30)
    line[10:13], line[13:16] = state.payload_velocity[0], state.payload_body_rates[0]
    change = (acceleration - mobility * tension) * timestep
    line[16:19], line[19:22] = state.drone_velocity[0, 0] + change * along, state.drone_body_rates[0, 0]
    cables = Cables(
        timestep, anchor[None], hook[None], np.array([[natural]]), np.array([[1e4]]), np.array([30.0]), None
    )
    rows = record(qvel=10, payload_nv=6)
    view = record(cables=cables, bodies=bodies)
    peak = plain(massless._step_peak)(0, 0, line, tension, state, view, rows)
    assert peak == pytest.approx(exact_peak(met, acceleration, 1 / mobility, 1e4, 30.0), rel=1e-5)


# Gusts


@pytest.mark.parametrize("start, rise, hold", [(1.0, 2.0, 0.7), (0.3, 0.5, 4.0), (0.0, 1.3, 0.0)])
def test_a_gust_falls_as_it_has_risen(start, rise, hold):
    factor = plain(gust_factor)
    for share in np.linspace(0.01, 0.99, 23):
        risen = (1 - np.cos(pi * share)) / 2
        assert factor(start + share * rise, start, rise, hold) == pytest.approx(risen, abs=1e-12)
        assert factor(start + rise + hold + (1 - share) * rise, start, rise, hold) == pytest.approx(risen, abs=1e-12)
        assert hold == 0 or factor(start + rise + share * hold, start, rise, hold) == 1.0
    assert factor(start + 2 * rise + hold + 1e-6, start, rise, hold) == factor(start - 1e-6, start, rise, hold) == 0.0
