"""Whole routes among obstacles: clear of them by another measure, smooth, the same each time; what has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_system
from test_team_clearance import exact_clearance

from multilift_marl.errors import ConfigError
from multilift_marl.navigation import planner
from multilift_marl.navigation.formation_shapes import drone_places, find_breach
from multilift_marl.navigation.planner import RouteSettings, find_route, measure_route
from multilift_marl.navigation.team_clearance import hangs_over, make_scene
from multilift_marl.planning.maps import draw_map, place_map
from multilift_marl.planning.route import NoRoute
from multilift_marl.sim.obstacles import BOX, CYLINDER, HULL, SPHERE, Obstacles, place_obstacle

START, GOAL = np.array([-3.0, 0.0, 1.5, 0.0]), np.array([3.0, 0.0, 1.5, 0.0])
ROOM = RouteSettings(low=(-4.5, -3.0, 0.5), high=(4.5, 3.0, 3.2))
PILLARS = [
    (CYLINDER, (0.3, 0.3, 2.0), (-1.0, 0.2, 2.0), 0.0),
    (BOX, (0.2, 0.2, 2.0), (0.3, -1.2, 2.0), 0.6),
    (SPHERE, (0.3, 0.3, 0.3), (1.2, 0.5, 2.0), 0.0),
]
WALL = [(BOX, (0.1, 2.0, 4.0), (0.0, side * 2.4, 4.0), 0.0) for side in (-1.0, 1.0)]  # a gap of 0.8 m
WINDOW = [
    *[(BOX, (0.1, 2.0, 2.0), (0.0, side * 2.6, 2.0), 0.0) for side in (-1.0, 1.0)],
    (BOX, (0.1, 0.7, 0.55), (0.0, 0.0, 0.55), 0.0),
    (BOX, (0.1, 0.7, 0.7), (0.0, 0.0, 3.6), 0.0),
]


def placed(rows):
    obstacles = Obstacles.zeros(1, max(len(rows), 1))
    for row, each in enumerate(rows):
        place_obstacle(0, row, obstacles, *each)
    return obstacles


def least_clearance(route, system, rows, count=120):
    """Return the distance of the shape at rest from obstacles, by points of all bodies [m]."""
    times = np.linspace(0, route.times[-1], count)
    positions, rotations, forces = route.evaluate(times)
    found = []
    for position, rotation, force in zip(positions, rotations, forces, strict=True):
        place = np.append(position, np.arctan2(rotation[1, 0], rotation[0, 0]))
        found.append(exact_clearance(system, place, drone_places(system, force) - system.anchors, rows))
    return min(found)


@pytest.mark.parametrize("rows", [PILLARS, WALL, WINDOW], ids=["pillars", "gap", "window"])
def test_a_route_keeps_away_from_obstacles_and_within_the_limits_of_shapes(rows):
    system = make_system(4)
    route = find_route(system, placed(rows), 0, START, GOAL, ROOM)
    assert least_clearance(route, system, rows) >= ROOM.least_clearance
    straight = np.linspace(START, GOAL, 50)
    arms = drone_places(system, system.formation_force) - system.anchors
    assert min(exact_clearance(system, place, arms, rows) for place in straight) <= 0.0
    _, _, forces = route.evaluate(np.linspace(0, route.times[-1], 200))
    for force in forces:
        assert force.sum(axis=0) == pytest.approx(system.formation_force.sum(axis=0))
        assert find_breach(force, system) is None
    assert route.report.expanded > 0 and 6.0 <= route.report.length < 8.0


SLOT = [  # 2 m long, 1.05 m high: the resting formation is as high, and has to keep its distance
    (BOX, (1.0, 4.0, 0.65), (0.0, 0.0, 0.65), 0.0),
    (BOX, (1.0, 4.0, 1.0), (0.0, 0.0, 3.35), 0.0),
]


def test_cables_lean_outwards_where_the_way_is_low(monkeypatch):
    system, room = make_system(4), replace(ROOM, low=(-4.5, -3.0, 0.8), high=(4.5, 3.0, 1.8))
    route = find_route(system, placed(SLOT), 0, START, GOAL, room)
    assert least_clearance(route, system, SLOT) >= room.least_clearance
    _, _, forces = route.evaluate(np.linspace(0, route.times[-1], 200))
    assert all(find_breach(force, system) in (None, "the lean of a cable") for force in forces)
    assert np.degrees(np.arctan2(np.hypot(forces[..., 0], forces[..., 1]), forces[..., 2])).max() < 50.5
    heights = drone_places(system, forces)[..., 2].max(axis=1)
    assert heights[[0, -1]] == pytest.approx(np.full(2, system.slots[:, 2].max()), abs=1e-3)
    assert heights.min() < heights[0] - 0.2
    # On from the middle of the slot, in its shape; and from a route without low shapes that meets it.
    departure = route.sample(np.array([0.5 * route.times[-1]]))[:, 0]
    onward = find_route(system, placed(SLOT), 0, START, GOAL, room, departure)
    assert onward.sample(np.zeros(1))[:3, 0] == pytest.approx(departure[:3], abs=1e-9)
    assert least_clearance(onward, system, SLOT, 60) >= room.least_clearance
    free = find_route(system, placed([]), 0, START, GOAL, room)
    departure = free.sample(np.array([0.8]))[:, 0]
    onward = find_route(system, placed(SLOT), 0, START, GOAL, room, departure)
    assert onward.sample(np.zeros(1))[:3, 0, :-1] == pytest.approx(departure[:3], abs=1e-9)
    assert least_clearance(onward, system, SLOT, 60) >= room.least_clearance

    monkeypatch.setattr(planner, "hangs_over", lambda *_: False)
    with pytest.raises(NoRoute):
        find_route(system, placed(SLOT), 0, START, GOAL, replace(room, most=200_000))


def test_things_hang_over_the_way_that_are_above_a_height_or_slanted():
    def hangs(kind, height, turn=((1, 0, 0), (0, 1, 0), (0, 0, 1))):
        size = (0.2, 0.2, 0.2) if kind == SPHERE else (0.5, 0.4, 0.2)
        obstacles = placed([(kind, size, (0.0, 0.0, height), 0.0)])
        obstacles.rotation[0, 0] = turn @ obstacles.rotation[0, 0]
        return hangs_over(make_scene(obstacles, 0), 0.3)

    c, s = np.cos(0.1), np.sin(0.1)
    lying, leaning = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    for height in (0.5 + 1e-6, 0.5 - 1e-6):
        assert hangs(BOX, height) == hangs(SPHERE, height) == (height > 0.5)
        assert hangs(SPHERE, height, leaning) == (height > 0.5)
        assert not hangs(BOX, height - 0.1, lying) and not hangs(BOX, height - 0.3, lying)
        assert hangs(BOX, height, leaning) and hangs(CYLINDER, height - 1.0, leaning) and hangs(HULL, height)
    assert not hangs_over(make_scene(placed([]), 0), 0.3)


def test_a_team_passes_below_a_plank_that_leans_to_the_ground():
    system, plank = make_system(4), placed([(BOX, (0.15, 15.0, 0.05), (0.0, 0.0, 1.6), 0.0)])
    c, s = np.cos(np.deg2rad(8)), np.sin(np.deg2rad(8))
    plank.rotation[0, 0] = [[1, 0, 0], [0, c, -s], [0, s, c]]
    room = RouteSettings(low=(-4.9, -0.9, 0.7), high=(4.9, 0.9, 1.2))
    route = find_route(system, plank, 0, np.array([-4.0, 0, 1, 0]), np.array([4.0, 0, 1, 0]), room)
    assert route.report.clearance >= room.least_clearance and len(route.modes) == 3


@pytest.mark.parametrize("num_drones", [1, 2, 3, pytest.param(6, marks=pytest.mark.slow), 8])
def test_teams_of_every_size_pass_the_gaps_of_a_narrow_map(num_drones):
    system = make_system(num_drones)
    scale = make_system(4) if num_drones == 1 else system  # the payload of one drone is wider than the gaps of its maps
    drawn = draw_map("narrow", 2, scale)
    obstacles = Obstacles.zeros(1, 16)
    place_map(0, drawn, obstacles)
    settings = RouteSettings(low=tuple(drawn.low), high=tuple(drawn.high))
    route = find_route(system, obstacles, 0, np.append(drawn.start, 0), np.append(drawn.goal, 0.3), settings)
    rows = [(each.kind, each.size, each.position, each.yaw) for each in drawn.obstacles]
    assert least_clearance(route, system, rows, 60) >= settings.least_clearance
    place, rotation, force = route.evaluate(np.array([0.0, route.times[-1], 1e3]))
    assert place == pytest.approx(np.stack([drawn.start, drawn.goal, drawn.goal]), abs=1e-9)
    assert np.arctan2(rotation[1:, 1, 0], rotation[1:, 0, 0]) == pytest.approx(0.3)
    assert force == pytest.approx(np.tile(system.formation_force, (3, 1, 1)), abs=1e-9)


@pytest.fixture(scope="module")
def route():
    return find_route(make_system(4), placed(WALL), 0, START, GOAL, ROOM)


def test_pose_and_shape_are_smooth_and_begin_and_end_at_rest(route):
    """Differences to both sides of each knot agree up to the third derivative, so that all are continuous there."""
    step = 1e-4
    for order in range(3):
        left, right = route.sample(route.times[1:-1] - step), route.sample(route.times[1:-1] + step)
        higher = route.sample(route.times[1:-1])[order + 1]
        slope = (right[order] - left[order]) / (2 * step)
        np.testing.assert_allclose(slope, higher, atol=2e-3 * max(1.0, np.abs(higher).max()))
    ends = route.sample(route.times[[0, -1]])
    assert ends[1:3] == pytest.approx(np.zeros_like(ends[1:3]), abs=1e-9)


def test_speed_and_acceleration_are_within_their_limits(route):
    _, velocity, acceleration, _ = route.sample(np.linspace(0, route.times[-1], 500))
    assert 0.5 < np.linalg.norm(velocity[:, :3], axis=1).max() <= ROOM.speed + 1e-6
    assert np.linalg.norm(acceleration[:, :3], axis=1).max() <= ROOM.acceleration + 1e-6


def test_the_same_map_has_the_same_route_bit_for_bit(route):
    again = find_route(make_system(4), placed(WALL), 0, START, GOAL, ROOM)
    assert (again.table == route.table).all() and (again.modes == route.modes).all()


def test_a_route_goes_on_with_the_motion_of_another(route):
    for share in (0.15, 0.3, 0.5):
        departure = route.sample(np.array([share * route.times[-1]]))[:, 0]
        onward = find_route(make_system(4), placed(WALL), 0, START, GOAL, ROOM, departure)
        begun = onward.sample(np.zeros(1))[:, 0]
        assert begun[:3] == pytest.approx(departure[:3], abs=1e-9)
        assert begun[3] == pytest.approx(departure[3], abs=0.3)  # drones leap where it does
        assert least_clearance(onward, make_system(4), WALL, 60) >= ROOM.least_clearance
        assert onward.times[-1] < 1.1 * (1 - share) * route.times[-1] + 0.2


def test_a_new_obstacle_shows_where_a_route_is_no_longer_clear(route):
    system = make_system(4)
    motion = measure_route(system, placed(WALL), 0, route)
    assert motion.clearance.min() == pytest.approx(route.report.clearance)
    assert motion.tension.min() > 0.5 and motion.thrust.max() < 0.9
    blocked = measure_route(system, placed([*WALL, (SPHERE, (0.2, 0.2, 0.2), (2.0, 0.0, 1.5), 0.0)]), 0, route)
    at = blocked.places[blocked.clearance <= 0.0, 0]
    assert len(at) and 1.4 < at.min() and at.max() < 2.6


CLOSED = [(BOX, (0.1, 4.0, 4.0), (0.0, 0.0, 2.0), 0.0)]
TIGHT = [(BOX, (0.1, 2.0, 4.0), (0.0, side * 2.23, 4.0), 0.0) for side in (-1.0, 1.0)]  # the payload fits by 1 cm
SHELF = [  # which the payload could pass below, and the drones above
    (BOX, (0.1, 4.0, 0.5), (0.0, 0.0, 0.5), 0.0),
    (BOX, (1.2, 4.0, 0.1), (0.0, 0.0, 1.85), 0.0),
    (BOX, (1.2, 4.0, 1.0), (0.0, 0.0, 3.9), 0.0),
]
IN_A_PILLAR = [(CYLINDER, (0.3, 0.3, 2.0), (-3.0, 0.4, 2.0), 0.0)]
AT_THE_GOAL = [(CYLINDER, (0.3, 0.3, 2.0), (3.0, -0.54, 2.0), 0.0)]


@pytest.mark.parametrize(
    "rows, goal, words",
    [
        (CLOSED, GOAL, "no route that keeps 0.03 m from all obstacles"),
        (TIGHT, GOAL, "no route that keeps 0.03 m from all obstacles"),
        (SHELF, GOAL, "no route that keeps 0.03 m from all obstacles"),
        (IN_A_PILLAR, GOAL, r"at the start \(-3.00, 0.00, 1.50\) m the team is in an obstacle"),
        (AT_THE_GOAL, GOAL, r"at the goal .* m from an obstacle, and has to keep 0.03 m"),
        ([], [3.0, 0.0, 0.1, 0.0], "the goal is 0.10 m high, and the payload has to be at least 0.50 m high"),
        ([], [9.0, 0.0, 1.5, 0.0], r"the goal \(9.00, 0.00, 1.50\) m is outside the space"),
    ],
)
def test_what_has_no_route_is_refused_in_a_sentence(rows, goal, words):
    with pytest.raises(NoRoute, match=words) as refused:
        find_route(make_system(4), placed(rows), 0, START, np.array(goal), replace(ROOM, most=20_000))
    assert isinstance(refused.value, ConfigError) and "\n" not in str(refused.value)


def test_long_walls_widen_the_space_along_themselves_alone():
    walls = placed([(BOX, (50.0, 0.05, 1.5), (0.0, side * 2.0, 1.5), 0.0) for side in (-1.0, 1.0)])
    settings = RouteSettings()
    body = planner.make_body(make_system(4), *planner.make_shapes(make_system(4))[:2])
    low, high = planner._space(START, GOAL, make_scene(walls, 0), body, settings)
    assert low[:2] == pytest.approx([-52.0, -4.05]) and high == pytest.approx([52.0, 4.05, 5.0])


def test_a_space_that_is_too_large_for_a_search_is_refused_with_its_cure():
    far = placed([(SPHERE, (0.3, 0.3, 0.3), (300.0, 300.0, 30.0), 0.0)])
    with pytest.raises(ConfigError, match=r"states of a search for a route, more than 2e\+08; bound it") as refused:
        find_route(make_system(4), far, 0, START, GOAL)
    assert not isinstance(refused.value, NoRoute)
