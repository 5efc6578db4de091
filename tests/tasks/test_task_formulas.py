"""Formulas of tasks: rewards, starts, paths and planned motions against closed forms and differences in time."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from conftest import make_system
from plain_kernels import plain, record, turned

from multilift_marl.control.formation import Goal
from multilift_marl.math3d import ease
from multilift_marl.mdp import ground, rewards
from multilift_marl.mdp import initial_states as starts
from multilift_marl.mdp import rig_features as rig_numbers
from multilift_marl.planning import paths, spline, trajectory
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.state import SystemState
from multilift_marl.tasks import gate

G = 9.81

# Rewards


def view(seed: int = 0):
    """Return a view of two environments of three drones, of which no two numbers are alike."""
    rng = np.random.default_rng(seed)
    state, goal = SystemState.zeros(2, 3), Goal.zeros(2, 3)
    for array in (*state, *goal):
        if array.dtype == float:
            array[:] = rng.normal(size=array.shape)
    state.cable_tension[:] = rng.uniform(1, 9, (2, 3))
    errors = record(distance=rng.uniform(0.1, 2, 2), angle=rng.uniform(0.1, 2, 2))
    mask = record(lost=np.array([[False, False, False], [False, True, False]]))
    limits = record(separation=np.full((3, 3), 0.3))
    own = record(pull_fraction=np.array([0.3, 0.8]))
    return record(
        state=state, goal=goal, errors=errors, mask=mask, limits=limits, own=own, action=rng.normal(size=(2, 3, 4)),
        previous=rng.normal(size=(2, 3, 4)), resting_tension=np.array([2.0, 3.0, 4.0]), cause=np.array([0, 4]),
    )  # fmt: skip


def half(value, margin):
    """Return what halves at the margin: 1/(1 + (value/margin)²)."""
    return margin**2 / (margin**2 + value**2)


@pytest.mark.parametrize("e", [0, 1])
def test_rewards_of_the_payload_halve_at_their_margins(e):
    v = view()
    speed, rate = (np.linalg.norm(each[e]) for each in (v.state.payload_velocity, v.state.payload_body_rates))
    slip = np.linalg.norm(v.state.payload_velocity[e] - v.goal.velocity[e])
    for found, expected in (
        (plain(rewards.distance)(e, v, 0.4), half(v.errors.distance[e], 0.4)),
        (plain(rewards.attitude)(e, v, 0.5), half(v.errors.angle[e], 0.5)),
        (plain(rewards.velocity)(e, v, 0.6), half(slip, 0.6)),
        (plain(rewards.body_rate)(e, v, 0.7), half(rate, 0.7)),
        (plain(rewards.stillness)(e, v, 0.6, 0.7), half(speed, 0.6) * half(rate, 0.7)),
        (plain(rewards.steadiness)(e, v, 0.6, 0.7), half(slip, 0.6) * half(rate, 0.7)),
        (plain(rewards.failure)(e, v), float(e == 1)),
        (plain(rewards.spin)(e, v, 0.2), (rate / 0.2 - 1) ** 2),
        (plain(rewards.spin)(e, v, 100.0), 0.0),
        (plain(rewards.action_rate)(e, v), ((v.action - v.previous)[e] ** 2).mean()),
    ):
        assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("e", [0, 1])
def test_rewards_of_the_formation_are_of_the_drones_that_are_left(e):
    v = view()
    left = [n for n in range(3) if not v.mask.lost[e, n]]
    places, slots = v.state.drone_position[e], v.goal.slots[e]
    off = [half(np.linalg.norm(places[n] - slots[n]), 0.9) for n in left]
    assert plain(rewards.formation)(e, v, 0.9) == pytest.approx(np.mean(off), rel=1e-12)
    low = sum(max(0.0, 1 - (places[n][2] - v.state.payload_position[e, 2]) / 1.5) ** 2 for n in left)
    near = sum(
        max(0.0, 1 - (np.linalg.norm(places[n] - places[m]) - 0.3) / 4.0) ** 2 for n in left for m in left if m < n
    )
    assert near > 0 and plain(rewards.closeness)(e, v, 4.0, 1.5) == pytest.approx(low + near, rel=1e-12)
    peak = np.zeros(2)
    plain(rewards.update_peak_tension)(e, v, peak)
    assert peak[e] == pytest.approx(max(v.state.cable_tension[e, n] / v.resting_tension[n] for n in left))


def test_a_payload_is_at_rest_within_all_four_bounds():
    v = view()
    speed, rate = (np.linalg.norm(each[0]) for each in (v.state.payload_velocity, v.state.payload_body_rates))
    exact = np.array([v.errors.distance[0], v.errors.angle[0], speed, rate])
    assert plain(rewards.is_at_rest)(0, v, rewards.RestBounds(*(1.0001 * exact)))
    for i in range(4):
        bounds = 1.0001 * exact
        bounds[i] = 0.9999 * exact[i]
        assert not plain(rewards.is_at_rest)(0, v, rewards.RestBounds(*bounds))


@pytest.mark.parametrize("e, fraction", [(0, 0.3), (1, 0.8)])
def test_a_payload_on_the_ground_counts_as_it_is_carried(e, fraction):
    v = view()
    share = fraction * half(v.errors.distance[e], 0.5)
    for found, expected in (
        (plain(ground.carried)(e, v), share),
        (plain(ground.position)(e, v, 0.4), share * half(v.errors.distance[e], 0.4)),
        (plain(ground.attitude)(e, v, 0.4), share * half(v.errors.angle[e], 0.4)),
        (plain(ground.steadiness)(e, v, 0.6, 0.7), share * plain(rewards.steadiness)(e, v, 0.6, 0.7)),
        (plain(ground.readiness)(e, v, 0.9), (1 - fraction) * plain(rewards.formation)(e, v, 0.9)),
        (plain(ground.pull_fraction)(e, 0, v), fraction),
    ):
        assert found == pytest.approx(expected, rel=1e-12)


# On the ground

RIG = record(
    anchors=np.array([[0.3, 0.1, 0.08], [-0.25, 0.15, 0.05], [0.1, -0.3, 0.02]]), azimuth=np.array([0.3, 2.5, -1.2]),
    heading=np.array([0.1, -0.4, 0.7]), force=np.array([[1.0, 0.5, 3.4], [-0.9, 0.4, 3.2], [0.1, -0.8, 3.0]]),
    hooked=False,
)  # fmt: skip


def test_slack_cables_leave_half_their_weight_to_the_drone_and_no_inertia_of_the_load():
    v, weight = view(), np.array([0.2, 0.3, 0.4])
    v.rig = RIG
    for e, n, fraction in ((0, 0, 0.25), (1, 2, 0.6)):
        before = v.goal.cable_force[e, n].copy()
        plain(ground.scale_cable_force)(e, n, v, fraction, weight)
        expected = fraction * before - RIG.force[n, 2] / G * v.goal.slot_acceleration[e, n]
        expected[2] += 0.5 * (1 - fraction) * weight[n]
        np.testing.assert_allclose(v.goal.cable_force[e, n], expected, rtol=1e-12)


def test_goals_move_along_paths_that_add_up():
    v = view()
    goal, before = (
        v.goal,
        [array.copy() for array in (v.goal.position, v.goal.velocity, v.goal.acceleration, v.goal.jerk)],
    )
    path, eased = (0.3, -0.5, 0.9), (0.2, 0.4, -0.6, 0.8)
    plain(ground.move_goal)(1, goal, path, eased)
    for old, new, factor in zip(
        before, (goal.position, goal.velocity, goal.acceleration, goal.jerk), eased, strict=True
    ):
        np.testing.assert_allclose(new[1], old[1] + factor * np.array(path), rtol=1e-12)
        np.testing.assert_array_equal(new[0], old[0])
    plain(ground.set_resting_goal)(1, goal, (1.0, 2.0, 3.0))
    assert goal.position[1].tolist() == [1, 2, 3]
    assert not (goal.velocity[1].any() or goal.acceleration[1].any() or goal.jerk[1].any())
    v.rig = RIG
    chord = goal.slots[1, 2] - goal.position[1] - goal.rotation[1] @ RIG.anchors[2]
    np.testing.assert_allclose(plain(ground.cable_chord)(1, 2, goal, RIG), chord, atol=1e-12)
    rise = (
        v.state.drone_position[1, 2, 2]
        - (v.state.payload_position[1] + v.state.payload_rotation[1] @ RIG.anchors[2])[2]
    )
    assert plain(ground.cable_rise)(1, 2, v.state, RIG) == pytest.approx(rise)


def test_a_team_stands_about_its_payload_each_drone_within_its_disc():
    v, own = view(), record(drone=np.array([0.05, 0.06, 0.07]), idle=np.array([100.0, 150.0, 200.0]))
    v.rig, distance, spread = RIG, np.array([1.0, 1.2, 1.4]), 0.2
    v.goal.yaw[:] = [0.5, -0.8]
    rng, moved = np.random.default_rng(3), []
    for _ in range(400):
        plain(ground.place_on_ground)(1, rng, v, own, distance, spread)
        angle = -0.8 + RIG.azimuth
        middle = v.goal.position[1, :2] + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        moved.append(v.state.drone_position[1, :, :2] - middle)
    far = np.linalg.norm(moved, axis=-1)
    assert far.max() <= spread and (far**2).mean() == pytest.approx(spread**2 / 2, rel=0.06)  # uniform in a disc
    assert np.abs(np.mean(moved, axis=(0, 1))).max() < 0.01
    np.testing.assert_array_equal(v.state.drone_position[1, :, 2], own.drone)
    np.testing.assert_array_equal(v.state.payload_position[1], v.goal.position[1])
    np.testing.assert_array_equal(v.state.payload_rotation[1], v.goal.rotation[1])
    for n in range(3):
        np.testing.assert_allclose(v.state.drone_rotation[1, n], turned([0, 0, 1], -0.8 + RIG.heading[n]), atol=1e-12)
        assert (v.state.rotor_speed[1, n] == own.idle[n]).all()
    for still in (
        v.state.payload_velocity,
        v.state.payload_body_rates,
        v.state.drone_velocity,
        v.state.drone_body_rates,
    ):
        assert not still[1].any() and still[0].any()


def test_the_ground_in_numbers_is_that_of_boxes_that_stand_on_it():
    system = make_system(
        3, **{"payload.center_of_mass": (0.02, -0.03, 0.01), "cable.model": "chain", "cable.segments": 3}
    )
    own = ground.make_ground(system)
    assert own.payload == pytest.approx(system.payload_size[2] / 2 + 0.01)
    np.testing.assert_allclose(own.drone, drone_half_size(system.vehicle)[2])
    np.testing.assert_allclose(own.cable_weight, system.cable_mass * G)
    assert own.size == pytest.approx(1.0)  # falcons
    away = ground.resting_distance(system, 0.1)
    level = np.hypot(*system.slots[:, :2].T)
    least = np.hypot(*(system.payload_size[:2] / 2 + [0.02, 0.03])) + 1.5 * system.vehicle.arm + 0.1
    np.testing.assert_allclose(away, np.maximum(level, least), rtol=1e-12)


# Starts


def test_starts_are_uniform_in_a_ball():
    rng = np.random.default_rng(0)
    points = np.array([plain(starts.in_ball)(rng, 2.0) for _ in range(4000)])
    radius = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(np.quantile(radius / 2, [0.1, 0.5, 0.9]) ** 3, [0.1, 0.5, 0.9], atol=0.03)
    assert radius.max() <= 2.0
    np.testing.assert_allclose((points**2).mean(axis=0), 4 / 5, rtol=0.06)
    assert np.abs(np.corrcoef(points.T) - np.eye(3)).max() < 0.05


# Paths


def path_of(kind: str):
    path = paths.Path.zeros(1)
    path.kind[0] = paths.PATHS.index(kind)
    path.centre[0], path.heading[0], path.size[0], path.rate[0], path.climb[0] = [1, 2, 3], 0.7, 0.9, 1.3, 0.4
    return path


@pytest.mark.parametrize("kind", ["circle", "figure8", "lemniscate", "helix", "random"])
def test_the_motion_along_a_path_is_the_derivative_of_its_places(kind):
    path, rng = path_of(kind), np.random.default_rng(1)
    path.curve[0] = paths.draw_curve(rng, np.array([1.0, 0.8, 0.5]))
    place = plain(paths.place)
    for t in (0.7, 1.9, 2.6, 4.3):
        found = plain(paths.motion)(0, t, path, spline.NO_FILE)
        near = np.array([place(0, t + k * 0.004, path, spline.NO_FILE) for k in range(-4, 5)])
        fit = np.polynomial.polynomial.polyfit(np.arange(-4, 5) * 0.004, near, 6)
        for order, (value, scale) in enumerate(zip(found, (1, 1, 2, 6), strict=True)):
            np.testing.assert_allclose(value, scale * fit[order], rtol=2e-3, atol=(1e-9, 1e-5, 1e-3, 0.3)[order])


def test_five_places_give_the_derivatives_of_a_quartic():
    c = np.array([[0.3, -0.2, 0.5], [1.0, 2.0, -1.0], [0.7, 0.4, 0.2], [-0.5, 0.9, 1.1], [0.8, -0.6, 0.4]])
    t = 0.01 * np.arange(-2, 3)
    places = [tuple(sum(c[k] * s**k for k in range(5))) for s in t]
    found = plain(paths.differences)(*places)
    for value, expected, tolerance in zip(
        found, (c[0], c[1], 2 * c[2], 6 * c[3]), (1e-12, 1e-9, 1e-7, 1e-5), strict=True
    ):
        np.testing.assert_allclose(value, expected, atol=tolerance)


def test_the_time_of_a_path_starts_from_rest_smoothly_and_loses_half_the_ramp():
    own = plain(paths.own_time)
    assert own(0.0) == own(-1.0) == 0.0 and own(5.0) - own(4.0) == pytest.approx(1.0)
    assert own(paths.RAMP) == pytest.approx(paths.RAMP / 2) and paths.RAMP == 2.0
    t = np.linspace(-0.5, 3.0, 3501)
    rate = np.gradient([own(each) for each in t], t)
    s = np.clip(t / 2.0, 0.0, 1.0)
    np.testing.assert_allclose(rate, s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3), atol=2e-4)


def test_random_paths_are_natural_between_their_way_points_and_clamped_at_their_ends():
    curve = paths.draw_curve(np.random.default_rng(4), np.array([1.0, 0.8, 0.5]))
    value = plain(paths._spline)
    last, h = len(curve) - 1, 1e-4
    for i in range(last + 1):
        np.testing.assert_allclose(value(curve, float(i)), curve[i, 0], atol=1e-12)
    for i in range(1, last):
        near = [np.array(value(curve, i + k * h)) for k in (-2, -1, 0, 1, 2)]
        left, right = (3 * near[2] - 4 * near[1] + near[0]) / (2 * h), (-3 * near[2] + 4 * near[3] - near[4]) / (2 * h)
        np.testing.assert_allclose(left, right, atol=1e-5)  # the first derivative is continuous, and the second
        np.testing.assert_allclose(near[0] - 2 * near[1] + near[2], h**2 * curve[i, 1], atol=5e-11)
        np.testing.assert_allclose(near[4] - 2 * near[3] + near[2], h**2 * curve[i, 1], atol=5e-11)
    start, end = (
        np.subtract(value(curve, h), value(curve, 0.0)),
        np.subtract(value(curve, last), value(curve, last - h)),
    )
    assert max(np.abs(start).max(), np.abs(end).max()) < 1e-6  # at rest
    u = np.linspace(0, last, 11 * 400 + 1)
    places = np.array([value(curve, each) for each in u])
    speed = np.linalg.norm(np.gradient(places, u, axis=0), axis=1).max()
    bend = np.linalg.norm(np.diff(places, 2, axis=0), axis=1).max() / (u[1] - u[0]) ** 2
    found = paths.largest_rates(curve)
    assert found[0] == pytest.approx(speed, rel=2e-3) and found[1] == pytest.approx(bend, rel=2e-2)


def test_a_spline_through_rows_is_smooth_to_the_fourth_derivative_and_rests_at_its_ends():
    rows = np.array([[0.0, 0, 1, 2, 0.1], [0.7, 1, 0, 2.5, 0.3], [1.1, 1.5, -1, 2, 0.2], [2.3, 0.5, 0.4, 1, -0.4]])
    table = spline.fit_spline(rows)
    np.testing.assert_allclose(table[[0, -1], 5:], 0.0, atol=1e-12)
    pieces = []
    for first, last in zip(table[:-1], table[1:], strict=True):
        h = last[0] - first[0]
        powers = np.array([[1, s, s**2, s**3, s**4, s**5] for s in (0.0, h)])
        rates = np.array([[0, 1, 2 * s, 3 * s**2, 4 * s**3, 5 * s**4] for s in (0.0, h)])
        bends = np.array([[0, 0, 2, 6 * s, 12 * s**2, 20 * s**3] for s in (0.0, h)])
        known = np.stack([first[1:5], last[1:5], first[5:9], last[5:9], first[9:], last[9:]])
        pieces.append(np.linalg.solve(np.concatenate([powers, rates, bends]), known))
    for i, piece in enumerate(pieces):
        h = table[i + 1, 0] - table[i, 0]
        if i + 1 < len(pieces):
            third = 6 * piece[3] + 24 * piece[4] * h + 60 * piece[5] * h**2
            fourth = 24 * piece[4] + 120 * piece[5] * h
            np.testing.assert_allclose(third, 6 * pieces[i + 1][3], atol=1e-8)
            np.testing.assert_allclose(fourth, 24 * pieces[i + 1][4], atol=1e-7)
        times = table[i, 0] + h * np.array([0.1, 0.5, 0.9])
        found = spline.sample_spline(table, times)
        for j, s in enumerate(h * np.array([0.1, 0.5, 0.9])):
            exact = [
                sum(piece[k] * s**k for k in range(6)), sum(k * piece[k] * s ** (k - 1) for k in range(1, 6)),
                sum(k * (k - 1) * piece[k] * s ** (k - 2) for k in range(2, 6)),
                sum(k * (k - 1) * (k - 2) * piece[k] * s ** (k - 3) for k in range(3, 6)),
            ]  # fmt: skip
            np.testing.assert_allclose(found[:, j], exact, atol=1e-9)
            place = plain(spline.spline_place)(table, times[j])
            np.testing.assert_allclose(place, exact[0][:3], atol=1e-12)
            assert plain(spline.spline_yaw)(table, times[j])[0] == pytest.approx(exact[0][3])
    assert plain(spline.spline_place)(table, -1.0) == pytest.approx(rows[0, 1:4])
    assert plain(spline.spline_place)(table, 9.0) == pytest.approx(rows[-1, 1:4])


def test_an_eased_way_has_the_derivatives_that_it_states():
    for t in (0.3, 0.8, 1.6, 2.2):
        found, h = plain(ease)(t, 0.1, 2.5), 1e-4
        near = [plain(ease)(t + k * h, 0.1, 2.5) for k in (-1, 1)]
        s = (t - 0.1) / 2.5
        assert found[0] == pytest.approx(35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7)
        for order in range(3):
            slope = (near[1][order] - near[0][order]) / (2 * h)
            assert found[order + 1] == pytest.approx(slope, rel=1e-5, abs=1e-6)


# Planned motions


def test_a_planned_attitude_turns_at_the_rates_that_it_states():
    yaw, roll, pitch, turn_rate, roll_rate, pitch_rate, h = 0.6, 0.3, -0.4, 1.2, -0.7, 0.9, 1e-5

    def attitude(t):
        flat = plain(trajectory.attitude_of)(yaw + t * turn_rate, roll + t * roll_rate, pitch + t * pitch_rate)
        return np.reshape(flat, (3, 3))

    expected = turned([0, 0, 1], yaw) @ turned([1, 0, 0], roll) @ turned([0, 1, 0], pitch)
    np.testing.assert_allclose(attitude(0.0), expected, atol=1e-12)
    rates = []
    for t in (-h, 0.0, h):
        skew = (attitude(t + h) - attitude(t - h)) / (2 * h) @ attitude(t).T
        rates.append(np.array([skew[2, 1], skew[0, 2], skew[1, 0]]))
    spin, swing = plain(trajectory._spin)(yaw, roll, turn_rate, roll_rate, pitch_rate)
    np.testing.assert_allclose(spin, rates[1], atol=1e-6)
    np.testing.assert_allclose(swing, (rates[2] - rates[0]) / (2 * h), atol=1e-3)


@pytest.mark.parametrize("share", [0.1, 0.35, 0.5, 0.8])
def test_a_dipped_angle_has_the_derivatives_that_it_states(share):
    dipped, h = plain(trajectory._dipped), 1e-4
    angle, first, second = dipped(0.4, -0.7, share, 0.75)
    straight = 0.4 - 1.1 * share
    assert angle == pytest.approx(straight * (1 - 0.75 * 16 * share**2 * (1 - share) ** 2))
    low, high = dipped(0.4, -0.7, share - h, 0.75), dipped(0.4, -0.7, share + h, 0.75)
    assert first == pytest.approx((high[0] - low[0]) / (2 * h), abs=1e-6)
    assert second == pytest.approx((high[1] - low[1]) / (2 * h), abs=1e-6)
    assert dipped(0.4, -0.7, 0.5, 1.0)[0] == pytest.approx(0.0)  # all of it is taken away half-way


@pytest.mark.parametrize("candidate", range(len(trajectory.CANDIDATES)))
@pytest.mark.parametrize("start, end", [(0.4, 2.0), (-3.0, 2.9), (1.0, -1.5)])
def test_a_course_turns_the_shorter_way_or_the_longer(candidate, start, end):
    plan = trajectory.Plan.zeros(1, 1, 2)
    plan.pose[0, :, 3] = start, end
    plain(trajectory._set_course)(0, 0, plan, candidate)
    turned_by, *shares = plan.course[0, 0]
    longer, *wanted = trajectory.CANDIDATES[candidate]
    assert np.exp(1j * turned_by) == pytest.approx(np.exp(1j * (end - start)))
    assert (abs(turned_by) > pi) == longer and abs(turned_by) < 2 * pi and shares == wanted


def test_a_drone_observes_the_numbers_of_its_own_rig_in_their_order():
    numbers = np.arange(16.0).reshape(2, 8)
    assert plain(rig_numbers.rig_numbers)(0, 1, record(rig_numbers=numbers)) == tuple(range(8, 16))


@pytest.mark.parametrize("cause", range(3))
def test_a_failure_in_the_gate_is_one_whatever_its_cause(cause):
    far = record(cause=np.array([cause]))
    failure = plain(gate.failure)
    failure.__globals__["least_room"] = lambda e, v: 0.1
    assert failure(0, far) == (cause != 0)
    failure.__globals__["least_room"] = lambda e, v: -0.1
    assert failure(0, far) == 1.0
