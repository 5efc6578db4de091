"""Formulas of bodies, rotors and air, each worked out again with NumPy: every sign, index and constant counts."""

from __future__ import annotations

from math import exp, pi, sqrt

import numpy as np
import pytest
from conftest import make_system
from plain_kernels import plain, record, turned

from multilift_marl.rig.constants import make_rig, make_rotors
from multilift_marl.rig.presets import PRESETS
from multilift_marl.sim import air, dynamics, gusts, state_io
from multilift_marl.sim.cables import common
from multilift_marl.sim.state import Air, EpisodeStats, HiddenLoads, SystemState

G = 9.81
NUMBERS = {  # of the sources that rig/vehicles.py names: mass, inertia, arm, b, κ, lags, speed and thrust limits, drag
    "falcon": (0.6168, (1.64e-3, 1.84e-3, 3.0e-3), 0.106, 1.562522e-6, 0.02199969, 0.033, 0.033, 150.0, 5.0, 0.0635),
    "crazyflie": (
        0.034, (16.571710e-6, 16.655602e-6, 29.261652e-6), 0.046, 1.28192e-8, 0.006, 0.0375, 0.0375, 0.0, 0.14,
        0.0231348,
    ),
    "crazyflie_id": (
        0.0319, (16.8e-6, 16.8e-6, 29.8e-6), 0.0460044, 1.982941e-8, 0.00735086, 0.145207, 0.145207, 803.98, 0.12,
        0.0231348,
    ),
    "hummingbird": (0.716, (0.007, 0.007, 0.012), 0.17, 8.54858e-6, 0.016, 0.0125, 0.025, 0.0, 6.003189, 0.1),
    "iris": (1.545, (0.029125, 0.029125, 0.055225), 0.2469818, 5.84e-6, 0.06, 0.0125, 0.025, 0.0, 7.0664, 0.128),
    "x500": (
        2.0643077, (0.0238380, 0.0238380, 0.0438940), 0.2460732, 8.54858e-6, 0.016, 0.0125, 0.025, 0.0, 8.54858,
        0.1396154,
    ),
}  # fmt: skip
FIELDS = (
    "mass", "inertia", "arm", "thrust_coefficient", "torque_ratio", "rotor_time_constant_up",
    "rotor_time_constant_down", "rotor_speed_min", "rotor_thrust_max", "rotor_radius",
)  # fmt: skip
DRAG = {  # Faessler's per mass; RotorS' per rotor speed, at hover
    "falcon": (0.54 * 0.6168, 0.39 * 0.6168, 0.0), "crazyflie": (0.0, 0.0, 0.0),
    "crazyflie_id": (0.01471782, 0.01471782, 0.01277641), "hummingbird": (4 * 453.2 * 8.06428e-5,) * 2 + (0.0,),
    "iris": (4 * 805.5 * 1.75e-4,) * 2 + (0.0,), "x500": (4 * 769.6 * 8.06428e-5,) * 2 + (0.0,),
}  # fmt: skip
ROTOR_INERTIA = {
    "falcon": 9.3575e-6, "crazyflie": 26.97e-9, "crazyflie_id": 34.52e-9, "hummingbird": 0.009 * 0.040225 / 12,
    "iris": 2.74004e-5, "x500": 0.016076923 * (0.27923077**2 + 0.016923077**2) / 12,
}  # fmt: skip


@pytest.mark.parametrize("name", PRESETS)
def test_presets_have_the_numbers_of_their_sources(name):
    vehicle = PRESETS[name]
    for field, number in zip(FIELDS, NUMBERS[name], strict=True):
        np.testing.assert_allclose(getattr(vehicle, field), number, rtol=1e-5, err_msg=field)
    np.testing.assert_allclose(vehicle.drag, DRAG[name], rtol=1e-3)
    assert vehicle.rotor_inertia == pytest.approx(ROTOR_INERTIA[name], rel=1e-5)
    assert vehicle.rolling_moment == 0.0


def test_the_x500s_inertia_is_that_of_a_body_and_four_points():
    rotors = np.array([[x, y, 0.06] for x in (-0.174, 0.174) for y in (-0.174, 0.174)])
    masses = np.full(4, 0.016076923076923075)
    total = 2.0 + masses.sum()
    center = (masses[:, None] * rotors).sum(axis=0) / total
    places, weights = np.concatenate([[[0, 0, 0]], rotors]) - center, np.concatenate([[2.0], masses])
    about = sum(m * ((p @ p) * np.eye(3) - np.outer(p, p)) for m, p in zip(weights, places, strict=True))
    expected = np.diag(about) + [0.02166666666666667, 0.02166666666666667, 0.04000000000000001]
    np.testing.assert_allclose(PRESETS["x500"].inertia, expected, rtol=1e-9)


# State and MuJoCo's coordinates


def moving_state(num_drones: int = 2) -> SystemState:
    """Return a state of which no two numbers are alike."""
    state, rng = SystemState.zeros(1, num_drones), np.random.default_rng(5)
    for array in state:
        if array.dtype == float:
            array[:] = rng.uniform(0.5, 2.0, array.shape) * rng.choice([-1, 1], array.shape)
    for rotation in (state.payload_rotation[0], *state.drone_rotation[0]):
        rotation[:] = turned(rng.normal(size=3), rng.uniform(0.3, 2.5))
    state.rotor_speed[:] = rng.uniform(400, 1200, state.rotor_speed.shape)
    return state


def quaternion(line: np.ndarray) -> np.ndarray:
    """Return the rotation of four numbers w, x, y, z."""
    w, axis = line[0], line[1:]
    return turned(axis, 2 * np.arctan2(np.linalg.norm(axis), w))


@pytest.mark.parametrize("point", [False, True])
def test_a_row_holds_payload_and_drones_and_nothing_else_is_touched(point):
    state, back = moving_state(), SystemState.zeros(1, 2)
    nq, nv = (3, 3) if point else (7, 6)
    rows = record(state=np.full((1, 60), 77.0), first=0, qpos=4, qvel=30, force=50, payload_nq=nq, payload_nv=nv)
    line = rows.state[0]
    plain(state_io.write_bodies)(0, line, state, rows)
    np.testing.assert_array_equal(line[4:7], state.payload_position[0])
    np.testing.assert_array_equal(line[30:33], state.payload_velocity[0])
    if not point:
        np.testing.assert_allclose(quaternion(line[7:11]), state.payload_rotation[0], atol=1e-12)
        np.testing.assert_array_equal(line[33:36], state.payload_body_rates[0])
    for n in range(2):
        at, v = 4 + nq + 7 * n, 30 + nv + 6 * n
        np.testing.assert_array_equal(line[at : at + 3], state.drone_position[0, n])
        np.testing.assert_allclose(quaternion(line[at + 3 : at + 7]), state.drone_rotation[0, n], atol=1e-12)
        np.testing.assert_array_equal(line[v : v + 6], [*state.drone_velocity[0, n], *state.drone_body_rates[0, n]])
    assert (line[:4] == 77).all() and (line[4 + nq + 14 : 30] == 77).all() and (line[30 + nv + 12 :] == 77).all()
    plain(state_io.read_payload)(0, line, back, rows)
    np.testing.assert_allclose(back.payload_position, state.payload_position)
    np.testing.assert_allclose(back.payload_velocity, state.payload_velocity)
    if not point:
        np.testing.assert_allclose(back.payload_rotation, state.payload_rotation, atol=1e-12)
        np.testing.assert_allclose(back.payload_body_rates, state.payload_body_rates)
    assert [plain(state_io.body_dof)(b, rows) for b in range(3)] == [0, nv, nv + 6]


# Loads of a step


def varied_rotors(state) -> record:
    """Return a variation of which every number counts."""
    rng = np.random.default_rng(8)
    return record(
        lag=rng.uniform(0.2, 0.9, (1, 2, 2, 3)), thrust=np.array([[0.9, 1.1]]), drag=np.array([[0.7, 1.3]]),
        center_varies=True, payload_center_of_mass=np.array([[0.02, -0.05, 0.03]]), payload_drag=np.array([1.4]),
        rotor=rng.uniform(0.8, 1.2, (1, 2, 4)),
    )  # fmt: skip


@pytest.mark.parametrize("varies", [False, True])
@pytest.mark.parametrize("blows", [False, True])
def test_a_steps_loads_are_those_of_rotors_drag_gyroscopes_and_air(varies, blows):
    system = make_system(2, **{"wind.gust": [1.0, -2.0, 0.5], "wind.ground_effect": True, "wind.roll_moment": 0.02,
                               "vehicle.rolling_moment": 2e-6, "vehicle.drag": (0.3, 0.2, 0.1)})  # fmt: skip
    state, h = moving_state(), system.timestep
    state.drone_position[0, :, 2] = [0.2, 3.0]
    constants, model = make_rotors(system), air.make_air(system)
    loads = HiddenLoads(
        np.array([1.4]), np.array([[0.4, -0.3, 0.2]]), np.array([[2.0, 1.0, -0.5]]), np.zeros((1, 2), bool)
    )
    loads.motors_off[0, 1] = True
    stats, blown = EpisodeStats.zeros(1), Air.zeros(1, 2)
    blown.steps[0] = round((model.gust_start + model.gust_rise / 3) / h)
    blown.downwash[:] = np.random.default_rng(2).normal(size=(1, 3, 3))
    thrust = np.random.default_rng(3).uniform(0.5, 4.0, (1, 2, 4))
    thrust[0, 0, 3] = 90.0  # more than there is
    rows = record(state=np.zeros((1, 40)), first=0, force=10, payload_nq=7, payload_nv=6)
    before, variation = state.rotor_speed.copy(), varied_rotors(state) if varies else None
    share = (1 - np.cos(pi * (blown.steps[0] * h - model.gust_start) / model.gust_rise)) / 2
    data = record(state=state, stats=stats)
    plain(dynamics.apply_loads)(rows, thrust, loads, data, constants, (blown, model) if blows else None, variation)

    line, power = rows.state[0], 0.0
    wind = np.array([2.0, 1.0, -0.5]) + (share * np.array([1.0, -2.0, 0.5]) if blows else 0)
    for n in range(2):
        vehicle = system.vehicles[n]
        asked = np.sqrt(thrust[0, n] / vehicle.thrust_coefficient)
        target = np.clip(asked, vehicle.rotor_speed_min, vehicle.rotor_speed_max) if n == 0 else np.zeros(4)
        gap = before[0, n] - target
        lag = np.where(gap > 0, vehicle.rotor_time_constant_down, vehicle.rotor_time_constant_up)
        decay, first = np.exp(-h / lag), lag / h * (1 - np.exp(-h / lag))  # means of e^(-t/τ) and e^(-2t/τ)
        second = lag / (2 * h) * (1 - np.exp(-2 * h / lag))
        if varies:
            decay, first, second = variation.lag[0, n][(gap > 0).astype(int)].T
        after, mean = target + gap * decay, target + gap * first
        np.testing.assert_allclose(state.rotor_speed[0, n], after, rtol=1e-12)
        f = vehicle.thrust_coefficient * (target**2 + 2 * target * gap * first + gap**2 * second)
        f *= variation.thrust[0, n] * variation.rotor[0, n] if varies else 1.0
        moment = (np.cross(vehicle.rotor_positions, f[:, None] * [0, 0, 1])).sum(axis=0)
        spin = np.array(vehicle.rotor_spin)
        moment[2] = vehicle.torque_ratio * (spin * f).sum()
        power += (vehicle.torque_ratio * f * (before[0, n] + after) / 2).sum()
        rotation, own_wind, lift = state.drone_rotation[0, n], wind.copy(), f.sum()
        if blows:
            own_wind += blown.downwash[0, n]
            gain = plain(air.ground_gain)(state.drone_position[0, n, 2], n, model)
            assert (gain > 1.005) == (n == 0)
            lift, moment[:2] = gain * lift, gain * moment[:2]
        through = rotation.T @ (state.drone_velocity[0, n] - own_wind)
        if blows:
            blades = 2e-6 * (spin * after).sum()
            moment[:2] += blades * through[:2] + [0.02 * through[1], 0.0]
        if varies:
            through *= variation.drag[0, n]
        force = rotation @ ([0, 0, lift] - np.array([0.3, 0.2, 0.1]) * through)
        axis = np.array([0, 0, -vehicle.rotor_inertia * (spin * mean).sum()])  # angular momentum of the rotors
        moment += -np.cross(state.drone_body_rates[0, n], axis)
        moment[2] += vehicle.rotor_inertia * (spin * (after - before[0, n])).sum() / h
        np.testing.assert_allclose(line[16 + 6 * n : 19 + 6 * n], force, rtol=1e-10)
        np.testing.assert_allclose(line[19 + 6 * n : 22 + 6 * n], moment, rtol=1e-9, atol=1e-12)
    assert stats.energy[0] == pytest.approx(h * power, rel=1e-12)
    center = variation.payload_center_of_mass[0] if varies else np.zeros(3)
    rotation = state.payload_rotation[0]
    velocity = state.payload_velocity[0] + rotation @ np.cross(state.payload_body_rates[0], center)
    through = velocity - wind - (blown.downwash[0, 2] if blows else 0)
    drag = -0.5 * 1.225 * system.payload_drag_area * np.linalg.norm(through) * through * (1.4 if varies else 1.0)
    force = drag + [0.4, -0.3, 0.2]
    np.testing.assert_allclose(line[10:13], force, rtol=1e-10)
    np.testing.assert_allclose(line[13:16], np.cross(center, rotation.T @ force), atol=1e-12)


# Air


def test_a_jet_has_the_momentum_of_its_four_rotors_wherever_it_is_met():
    system = make_system(2, **{"wind.wash": True})
    model, vehicle, attitude = air.make_air(system), system.vehicles[0], turned([1, 2, 3], 0.5)
    speed = (700.0, 800.0, 900.0, 1000.0)
    f = vehicle.thrust_coefficient * np.square(speed)
    growth = 0.094 / sqrt(2 * np.log(2))
    for x, y, z, breadth in ((0.05, -0.1, -0.3, 0.0), (0.2, 0.1, -1.5, 0.1), (-0.1, 0.02, -0.05, 0.3)):
        square = max(vehicle.rotor_radius / sqrt(2), -growth * z) ** 2 + breadth**2
        apart = ((np.array([x, y]) - vehicle.rotor_positions[:, :2]) ** 2).sum(axis=1)
        expected = (f * np.exp(-apart / square)).sum() / (1.225 * pi * square)
        away = tuple(attitude @ [x, y, z])
        found = plain(air.jet_flux)(0, away, breadth, tuple(attitude.ravel()), speed, model)
        assert found == pytest.approx(expected, rel=1e-10)
        assert plain(air.jet_flux)(0, tuple(attitude @ [x, y, -z]), breadth, tuple(attitude.ravel()), speed, model) == 0


def test_downwash_is_along_the_root_of_the_summed_momentum():
    system = make_system(3, **{"wind.wash": True})
    model, state, blown = air.make_air(system), moving_state(3), Air.zeros(1, 3)
    for n, tilt in enumerate((0.1, -0.2, 0.3)):
        state.drone_rotation[0, n] = turned([1.0, n - 1.0, 0.3], tilt)
    state.drone_position[0] = [[0.0, 0.0, 2.0], [0.05, 0.1, 1.4], [-0.1, 0.05, 2.5]]
    state.payload_position[0] = [0.02, 0.03, 0.8]
    plain(air.update_downwash)(0, state, blown, model)
    radius = sqrt(system.payload_drag_area / pi)
    places = [*state.drone_position[0], state.payload_position[0]]
    for i, place in enumerate(places):
        total, at_point = np.zeros(3), np.zeros(3)
        for n in range(3):
            frame, speed = tuple(state.drone_rotation[0, n].ravel()), tuple(state.rotor_speed[0, n])
            away = tuple(place - state.drone_position[0, n])
            down = -state.drone_rotation[0, n][:, 2]
            breadth = system.vehicles[i].arm if i < 3 else radius
            if n != i:
                total += plain(air.jet_flux)(n, away, breadth, frame, speed, model) * down
            at_point += plain(air.jet_flux)(n, away, 0.07, frame, speed, model) * down
        expected = total / sqrt(np.linalg.norm(total)) if total.any() else total
        np.testing.assert_allclose(blown.downwash[0, i], expected, rtol=1e-10)
        found = plain(air.wash_at)(0, tuple(place), 0.07, state, model)
        np.testing.assert_allclose(
            found, at_point / sqrt(np.linalg.norm(at_point)) if at_point.any() else 0, rtol=1e-10
        )
    assert (np.linalg.norm(blown.downwash[0], axis=1) > 0).tolist() == [True, True, False, True]


@pytest.mark.parametrize("height", [0.01, 0.0635 / 2, 0.1, 0.4])
def test_the_grounds_effect_is_that_of_sixteen_images(height):
    system = make_system(1, **{"wind.ground_effect": True})
    vehicle, model = system.vehicle, air.make_air(system)
    z, total = max(height, vehicle.rotor_radius / 2), 0.0
    for first in vehicle.rotor_positions:
        for second in vehicle.rotor_positions:  # one rotor above its own image: 1/(1 - (R/4z)²)
            total += vehicle.rotor_radius**2 * z / (2 * (((first - second) ** 2).sum() + 4 * z**2) ** 1.5)
    found = plain(air.ground_gain)(height, 0, model)
    assert found == pytest.approx(1 / (1 - total / 4), rel=1e-9)


def test_turbulence_filters_keep_the_stationary_covariance_in_any_step():
    for h in (0.01, 0.7, 3.0):
        a = np.exp(-h) * np.array([[1.0, 0.0], [h, 1.0]])
        columns = [plain(gusts._step_pair)(*unit, h, 0.0, 0.0) for unit in ((1.0, 0.0), (0.0, 1.0))]
        np.testing.assert_allclose(np.transpose(columns), a, rtol=1e-12)
        b = np.transpose([plain(gusts._step_pair)(0.0, 0.0, h, *unit) for unit in ((1.0, 0.0), (0.0, 1.0))])
        stationary = np.array([[1.0, 0.5], [0.5, 0.5]])
        np.testing.assert_allclose(a @ stationary @ a.T + b @ b.T, stationary, atol=1e-12)
        assert b[0, 1] == 0.0


def test_a_cables_law_and_the_statistics_of_its_tensions():
    law = plain(common.cable_tension)
    assert law(200.0, 30.0, 0.05, -0.2) == pytest.approx(4.0) and law(200.0, 30.0, 0.01, -0.2) == 0.0
    stats, state = EpisodeStats.zeros(2), SystemState.zeros(2, 2)
    for e in range(2):
        plain(common.clear_stats)(e, stats)
    cables = record(
        breaking_load=np.array([9.0, 50.0]), stiffness=np.array([[100.0, 200.0]] * 2), length=np.array([[0.5, 2.0]] * 2)
    )
    rows, data = record(first=0, state=np.zeros((2, 1))), record(state=state, stats=stats)
    mask = np.array([True, False])
    for tensions in ([8.0, 3.0], [9.5, 1.0], [2.0, 30.0]):
        state.cable_tension[:] = tensions
        plain(common.update_tension_stats)(rows, mask, True, data, cables)
    assert (stats.tension_min[0], stats.tension_max[0], stats.tension_peak[0]) == (1.0, 30.0, 30.0)
    assert stats.stretch_max[0] == pytest.approx(9.5 / 50.0)
    assert state.cable_broken.tolist() == [[True, False], [False, False]]
    assert stats.tension_min[1] > 1e6 and stats.tension_max[1] == 0.0


def test_constants_of_a_rotor_are_exact_means_over_a_step():
    system = make_system(1, **{"vehicle.preset": "hummingbird", "payload.mass": 0.3})
    constants, h = make_rotors(system), system.timestep
    for k, lag in enumerate((0.0125, 0.025)):
        mean = lag / h * (1 - exp(-h / lag))
        square = lag / (2 * h) * (1 - exp(-2 * h / lag))
        np.testing.assert_allclose(constants.lag[0, k], [exp(-h / lag), mean, square], rtol=1e-12)
    assert constants.payload_drag == pytest.approx(0.5 * 1.225 * system.payload_drag_area)
    np.testing.assert_allclose(constants.rotor_speed[0], [0.0, 838.0], rtol=1e-9)
    allocation = np.linalg.inv(system.vehicle.allocation)
    np.testing.assert_allclose(make_rig(system).allocation[0], allocation, atol=1e-9)
