"""Limits of failures and walls: each quantity by its closed form, on both sides of its limit."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import make_system
from plain_kernels import plain, record, turned

from multilift_marl.mdp import failures
from multilift_marl.mdp.failures import CAUSES, FailureMask, Limits, find_cause, ignore, make_limits, payload_height
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.state import SystemState
from multilift_marl.tasks import gate

HOOKS = np.array([[0.03, -0.05, -0.07], [-0.04, 0.02, -0.06]])
ANCHORS = np.array([[0.3, 0.1, 0.08], [-0.25, 0.15, 0.05]])
HALF = np.array([0.3, 0.2, 0.1])
DRONE = np.array([[0.2, 0.15, 0.06], [0.1, 0.12, 0.05]])
CENTER = (0.02, -0.03, 0.04)


def team(anchors=ANCHORS, hooks=HOOKS, **limits):
    """Return the view of two drones in flight whose attitudes differ, far from every limit."""
    state = SystemState.zeros(1, 2)
    state.payload_position[0] = [0.4, -0.3, 2.0]
    state.payload_rotation[0] = turned([0.3, -0.5, 0.8], 0.3)
    state.drone_position[0] = [[1.1, 0.2, 3.0], [-0.4, -0.1, 3.1]]
    state.drone_rotation[0] = turned([1.0, -2.0, 0.5], 0.4), turned([-0.4, 0.7, 2.0], -0.6)
    values = {
        "separation": np.full((2, 2), 0.3), "cables": np.full((2, 2), 0.01), "payload_half": HALF,
        "payload_center": CENTER, "payload_round": False, "payload_ball": 0.0, "payload_hull": -1, "drone_half": DRONE,
        "distance": 3.0,
    }  # fmt: skip
    return record(
        state=state, limits=Limits(**(values | limits)), mask=FailureMask.zeros(1, 2), min_separation=np.full(1, 9.0),
        errors=record(distance=np.zeros(1)), rig=record(anchors=anchors, hooks=hooks),
    )  # fmt: skip


def cause(view) -> str:
    return CAUSES[plain(find_cause)(0, view)]


def line_distance(view) -> float:
    """Return the distance of the two cables, whose nearest points are inside, as that of skew lines."""
    state = view.state
    low = state.payload_position[0] + ANCHORS @ state.payload_rotation[0].T
    high = state.drone_position[0] + np.einsum("nij,nj->ni", state.drone_rotation[0], HOOKS)
    along = high - low
    normal = np.cross(*along)
    share = np.linalg.solve(np.stack([along[0], -along[1], normal], axis=1), low[1] - low[0])
    assert 0.05 < share[0] < 0.95 and 0.05 < share[1] < 0.95
    return abs((low[1] - low[0]) @ normal) / np.linalg.norm(normal)


def test_nothing_fails_within_all_limits():
    assert cause(team()) == "none"


def test_cables_are_from_each_anchor_to_each_drones_own_hook():
    view = team(separation=np.zeros((2, 2)))
    view.state.drone_position[0] = [[-0.6, -0.25, 3.0], [1.2, -0.35, 3.1]]  # each above the other's anchor
    found = line_distance(view)
    assert 0.02 < found < 0.5
    for factor, expected in ((0.999, "none"), (1.001, "cable_crossing")):
        view.limits.cables[:] = factor * found
        assert cause(view) == expected


def test_separation_is_between_centres_and_its_least_is_kept():
    view = team()
    found = np.linalg.norm(np.subtract(*view.state.drone_position[0]))
    for factor, expected in ((0.999, "none"), (1.001, "drone_collision")):
        view.limits.separation[:] = factor * found
        assert cause(view) == expected
    assert view.min_separation[0] == pytest.approx(found, rel=1e-14)


def lowest_corner(center, rotation, half) -> float:
    """Return the height of the lowest of the eight corners of a box."""
    return min((center + rotation @ (half * signs))[2] for signs in product((-1, 1), repeat=3))


@pytest.mark.parametrize("n", [0, 1])
def test_a_drone_touches_the_ground_by_its_lowest_corner(n):
    for height, expected in ((0.0051, "none"), (0.0049, "ground")):
        view = team(payload_half=np.full(3, 1e-3))
        state = view.state
        state.payload_position[0] = state.drone_position[0, n] - [0.1, 0.1, 0.01]
        state.payload_rotation[0] = state.drone_rotation[0, n]
        low = lowest_corner(state.drone_position[0, n], state.drone_rotation[0, n], DRONE[n])
        state.payload_position[0, 2] -= low - height
        state.drone_position[0, :, 2] -= low - height
        state.drone_position[0, 1 - n, 2] += 1.0
        view.mask.ignored[0] = ignore(failures.LOAD_GROUND, failures.CABLE, failures.BELOW)
        assert cause(view) == expected


def test_a_box_reaches_down_to_its_lowest_corner_and_a_cylinder_to_its_rim():
    view = team()
    position, rotation = view.state.payload_position[0], view.state.payload_rotation[0]
    middle = position + rotation @ CENTER
    found = plain(payload_height)(tuple(position), tuple(rotation.ravel()), view.limits)
    assert found == pytest.approx(lowest_corner(middle, rotation, HALF), abs=1e-14)
    around = np.linspace(0, 2 * np.pi, 100_001)
    rims = np.stack([HALF[0] * np.cos(around), HALF[0] * np.sin(around), np.full_like(around, -HALF[2])], axis=1)
    found = plain(payload_height)(tuple(position), tuple(rotation.ravel()), view.limits._replace(payload_round=True))
    assert found == pytest.approx((middle + rims @ rotation.T)[:, 2].min(), abs=1e-9)
    for height, expected in ((0.0051, "none"), (0.0049, "ground")):
        moved = team()
        moved.state.payload_position[0, 2] += height - lowest_corner(middle, rotation, HALF)
        assert cause(moved) == expected


@pytest.mark.parametrize("angle, expected", [(79.99, "none"), (80.01, "tilt")])
def test_a_drone_may_tilt_80_degrees(angle, expected):
    view = team()
    view.mask.ignored[0] = ignore(failures.CABLE)
    view.state.drone_rotation[0, 1] = turned([0.6, -0.8, 0.0], np.radians(angle))
    assert cause(view) == expected


@pytest.mark.parametrize("angle, expected", [(89.99, "none"), (90.01, "cable_angle")])
def test_a_cable_stays_below_its_drone(angle, expected):
    view = team(hooks=np.zeros((2, 3)))
    view.mask.ignored[0] = ignore(failures.TILT)
    state = view.state
    low = state.payload_position[0] + state.payload_rotation[0] @ ANCHORS[1]
    cable = state.drone_position[0, 1] - low
    cable /= np.linalg.norm(cable)
    up = np.cross(cable, [0.3, 0.5, -0.2])
    up = np.cos(np.radians(angle)) * cable + np.sin(np.radians(angle)) * up / np.linalg.norm(up)
    side = np.cross(up, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    state.drone_rotation[0, 1] = np.stack([np.cross(side, up), side, up], axis=1)
    assert cause(view) == expected


@pytest.mark.parametrize("angle, expected", [(134.99, "none"), (135.01, "cable_angle")])
def test_a_cable_stays_within_135_degrees_of_the_payloads_axis(angle, expected):
    view = team(hooks=np.zeros((2, 3)), anchors=np.zeros((2, 3)))
    state, tilt = view.state, np.radians(angle)
    state.payload_rotation[0] = np.eye(3)
    state.drone_position[0, 0] = state.payload_position[0] + [1.0, 0.5, 1.5]
    state.drone_position[0, 1] = state.payload_position[0] + 2.0 * np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    state.drone_rotation[0, 1] = turned([0.0, -1.0, 0.0], np.radians(70.0))
    view.mask.ignored[0] = ignore(failures.BELOW, failures.CROSSING)
    assert cause(view) == expected


@pytest.mark.parametrize("height, expected", [(1e-6, "none"), (-1e-6, "below_payload")])
def test_a_drone_stays_above_the_payloads_origin(height, expected):
    view = team()
    view.state.drone_position[0, 0, 2] = view.state.payload_position[0, 2] + height
    view.mask.ignored[0] = ignore(failures.CABLE, failures.CROSSING)
    assert cause(view) == expected


@pytest.mark.parametrize("distance, expected", [(3.0, "none"), (3.0001, "out_of_range"), (np.nan, "out_of_range")])
def test_the_payload_stays_within_three_metres(distance, expected):
    view = team()
    view.errors.distance[0] = distance
    assert cause(view) == expected


def test_what_is_ignored_passes_and_nothing_beside_it():
    view = team()
    view.state.cable_broken[0, 1] = True
    assert cause(view) == "cable_broken"
    for index in range(len(CAUSES)):
        view.mask.ignored[0] = ignore(index)
        assert cause(view) == ("none" if index == failures.BROKEN else "cable_broken")
    view.mask.ignored[0], view.mask.lost[0, 1] = 0, True
    assert cause(view) == "none"


@pytest.mark.parametrize("who", [0, 1])
def test_where_there_is_no_cable_none_crosses_or_points_the_wrong_way(who):
    """Drones that are detached, of task regroup, collide and tilt like the others."""
    crossing = team(separation=np.zeros((2, 2)), cables=np.full((2, 2), 5.0))
    inverted = team()
    inverted.state.drone_rotation[0, who] = turned([1.0, 0.0, 0.0], np.radians(175.0))
    inverted.mask.ignored[0] = ignore(failures.TILT)
    close = team(separation=np.full((2, 2), 5.0))
    for view, expected in ((crossing, "cable_crossing"), (inverted, "cable_angle"), (close, "drone_collision")):
        assert cause(view) == expected
        view.mask.ignored[0] |= ignore(failures.BROKEN)
        view.state.cable_broken[0, who] = True
        assert cause(view) == ("none" if expected.startswith("cable") else expected)


def test_a_lost_drone_is_no_partner():
    view = team(separation=np.full((2, 2), 5.0))
    assert cause(view) == "drone_collision"
    for n in range(2):
        view.mask.lost[:] = [[n == 0, n == 1]]
        assert cause(view) == "none"


def test_cables_keep_a_tenth_of_a_metre_scaled_by_spans_at_most_half_their_distance_at_rest():
    limits = make_limits(make_system(4))
    assert limits.cables[0, 1] == pytest.approx(0.1, rel=1e-12)  # falcons
    assert (np.diag(limits.cables) == 0).all()
    small = make_system(3, **{"vehicle.preset": "crazyflie", "payload.mass": 0.02, "randomization.payload_force": 0.0})
    limits, least = make_limits(small), small.min_separation[0, 1]
    apart = np.linalg.norm(small.anchors[0] - small.anchors[1])  # cables that spread are nearest at their anchors
    assert limits.cables[0, 1] == pytest.approx(min(0.1 * least / 0.35, 0.5 * apart), rel=1e-9)
    np.testing.assert_allclose(limits.payload_half, small.payload_size / 2)
    np.testing.assert_allclose(limits.drone_half[1], drone_half_size(small.vehicle))


def test_a_drones_box_is_seven_tenths_of_its_arm_wide_and_three_high():
    vehicle = make_system(1).vehicle
    np.testing.assert_allclose(drone_half_size(vehicle), [0.7 * vehicle.arm, 0.7 * vehicle.arm, 0.3 * vehicle.arm])


# Walls


def gates(x=(0.4,), y=(0.15,), half=(0.5,), height=3.0):
    """Return the view of walls with gaps."""
    settings = record(
        x=np.array(x), gap_height=height, reach=2.0, begin=1.0, duration=10.0, level=1.3, clear=np.array([0.3, 0.35]),
        passed=0.9, drone=DRONE, payload=HALF, center=CENTER,
    )  # fmt: skip
    return record(settings=settings, own=record(gap_y=np.array([y]), half_width=np.array([half])))


# ends of a cable: it nears one edge of the gap, or its top, towards either face, in either direction of x
CABLES = [
    ((-0.5, 0.0, 1.0), (0.9, 0.5, 2.0)),
    ((0.9, 0.5, 2.0), (-0.5, 0.0, 1.0)),
    ((-0.5, 0.4, 1.0), (0.9, 0.0, 2.0)),
    ((-0.5, 0.3, 1.0), (0.9, -0.4, 2.0)),
    ((-0.5, 0.1, 2.0), (0.9, 0.2, 2.9)),
    ((-0.5, 0.1, 2.9), (0.9, 0.2, 2.5)),
    ((0.38, 0.0, 1.0), (0.42, 0.6, 2.0)),  # within the wall
    ((0.4, 0.0, 1.0), (0.4, 0.6, 2.0)),  # along it
    ((0.3, 0.0, 1.0), (0.41, 0.6, 2.0)),  # ends inside
]


@pytest.mark.parametrize("low, high", CABLES)
def test_a_cable_has_the_room_of_its_nearest_point_inside_the_wall(low, high):
    view = gates()
    share = np.linspace(0, 1, 2_000_001)[:, None]
    points = np.array(low) + share * (np.array(high) - np.array(low))
    inside = points[np.abs(points[:, 0] - 0.4) <= 0.05 + 1e-12]
    expected = min((0.5 - np.abs(inside[:, 1] - 0.15)).min(), (3.0 - inside[:, 2]).min())
    found = plain(gate._cable_room)(0, 0, low, high, view)
    if low[0] == high[0]:  # along the wall only its lower end is looked at: the drone's own box is at the other
        expected = 0.5 - abs(low[1] - 0.15)
    assert found == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_wall_is_a_tenth_of_a_metre_thick(side):
    view = gates()
    for past, expected in ((0.0499, True), (0.0501, False)):
        x = 0.4 + side * past
        far = x + side * 0.5
        room = plain(gate._cable_room)(0, 0, (x, 2.0, 1.0), (far, 2.0, 2.0), view)
        assert (room < 0) == expected
        rotation = turned([0.3, -0.7, 0.5], 0.8)
        reach = max((rotation @ (HALF * signs))[0] for signs in product((-1, 1), repeat=3))
        center = (0.4 + side * (past + reach), 2.0, 1.0)
        room = plain(gate._room)(0, 0, center, tuple(rotation.ravel()), HALF, view)
        assert (room < 0) == expected


@pytest.mark.parametrize("y, z", [(0.2, 1.0), (-0.1, 1.0), (0.15, 2.7)])
def test_a_box_in_a_wall_has_the_room_of_its_corners(y, z):
    view, rotation = gates(), turned([0.3, -0.7, 0.5], 0.8)
    corners = np.array([[0.41, y, z] + rotation @ (HALF * signs) for signs in product((-1, 1), repeat=3)])
    expected = min((0.5 - np.abs(corners[:, 1] - 0.15)).min(), (3.0 - corners[:, 2]).min())
    found = plain(gate._room)(0, 0, (0.41, y, z), tuple(rotation.ravel()), HALF, view)
    assert found == pytest.approx(expected, abs=1e-12)


def test_the_next_gap_is_the_first_that_is_not_yet_cleared():
    view, state = gates((-0.75, 0.75), (0.1, -0.2), (0.5, 0.6)), SystemState.zeros(1, 2)
    for n, clear in enumerate((0.3, 0.35)):
        for x, expected in ((-0.75 + clear, (0, 1)), (0.75 + clear, (1, 2))):
            found = []
            for at in (x - 1e-6, x + 1e-6):
                state.drone_position[0, n, 0] = at
                found.append(plain(gate.own_gap)(0, n, state, view))
            assert tuple(found) == expected


def test_the_target_eases_through_the_middle_of_its_way_at_the_middle_of_its_time():
    view = gates((0.0,), (0.2,), (0.5,))
    place = plain(gate.target_position)
    assert place(0, 6.0, view) == pytest.approx((0.0, 0.2, 1.3))
    assert place(0, 0.5, view) == pytest.approx((-2.0, 0.0, 1.3)) == place(0, 1.0, view)
    assert place(0, 11.0, view) == pytest.approx((2.0, 0.0, 1.3)) == place(0, 12.0, view)
    s = 0.25
    eased = 35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7
    x, y, _ = place(0, 3.5, view)
    assert x == pytest.approx(2.0 * (2.0 * eased - 1.0), rel=1e-12)
    u = (x + 2.0) / 1.75  # to 0.25 m before the wall
    assert y == pytest.approx(0.2 * (35 * u**4 - 84 * u**5 + 70 * u**6 - 20 * u**7), rel=1e-12)
