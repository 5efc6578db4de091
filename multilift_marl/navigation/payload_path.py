"""Paths of a payload alone, a point that keeps a distance from obstacles: the shortest, and that of a potential field.

They know nothing of drones and cables; `time_path` gives them speeds that the whole team can fly.
"""

from __future__ import annotations

from time import thread_time

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, mul, norm, put, row, scale, sub
from multilift_marl.navigation.formation_shapes import FormationShapes, ShapeLimits
from multilift_marl.navigation.motion import move_team
from multilift_marl.navigation.planner import FADES, REPAIRS, SLOWER, TILTS, RouteSettings, moving_start, team_points
from multilift_marl.navigation.search import make_lattice, search_route, states_at
from multilift_marl.navigation.smoothing import Band, coordinate_scale, smooth_knots, space_knots
from multilift_marl.navigation.team_clearance import (
    Scene,
    TeamBody,
    local_point,
    make_body,
    measure_clearance,
    rotation_of,
)
from multilift_marl.navigation.timing import SAMPLES, sample_curve, time_route
from multilift_marl.planning.route import NoRoute, Route, RouteReport
from multilift_marl.rig.system import System
from multilift_marl.sim.obstacle_distance import local_distance

STEP = 0.15  # [m] of the grid
SHARES = 1.0, 0.8, 0.6, 0.4  # of the radius by which obstacles are inflated, tried in turn
STRIDE = 0.02  # [m] of a step through a potential field, at most
NEAR = 0.3  # [m] from the goal, within which its attraction falls
STUCK = 100  # steps in which a way through a field that has not moved on by ...
MOVED = 0.1  # ... this ends [m]
LONGEST = 2000  # steps
_TIGHT = 1e-3  # [m]
POINT = TeamBody(
    anchors=np.zeros((0, 3)),
    length=np.zeros(0),
    radius=np.zeros(0),
    half=np.zeros(3),
    center=np.zeros(3),
    rest=np.zeros((0, 3)),
    modes=np.zeros((0, 0, 3)),
)
"""A team of no drones whose payload is a point."""
_NO_SHAPES = FormationShapes(np.zeros((0, 3)), np.zeros((0, 0, 3)), np.zeros((1, 0)), np.zeros((1, 1), bool))
_NO_LIMITS = ShapeLimits(
    np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0)
)  # fmt: skip
_NO_SCENE = Scene(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))


def space_of(settings: RouteSettings, start: np.ndarray) -> np.ndarray:
    """Return the lowest and highest position of the payload (2, 3) [m], with a start (3,) that has left it a little."""
    if settings.low is None or settings.high is None:
        raise ValueError("paths of a payload need settings.low and settings.high")
    return np.array([np.minimum(settings.low, start[:3]), np.maximum(settings.high, start[:3])])


def shortest_path(
    start: np.ndarray, goal: np.ndarray, space: np.ndarray, scene: Scene, radius: float,
    departure: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the smoothed shortest path (K, 4) of a point that keeps away from obstacles, by A* on a grid.

    Args:
        start, goal: (4,) x, y, z [m] and yaw [rad].
        space: (2, 3) lowest and highest position [m].
        scene: the obstacles.
        radius: by which they are inflated [m]; less where start or goal is closer, or there is no way; see `SHARES`.
        departure: (4, 4) pose at the start and three orders of rates; None: at rest.

    Raises:
        NoRoute: there is none.
    """
    ends = np.empty(2)
    measure_clearance(np.array([start, goal]), np.zeros((2, 0, 3)), POINT, scene, radius, ends)
    radius = max(float(ends.min()) - _TIGHT, 0.0)
    for share in SHARES:
        inflated = share * radius
        clearance = inflated, inflated + _TIGHT
        lattice = make_lattice(start, goal, space, np.full(3, STEP), POINT, _NO_SHAPES, clearance)
        way, _ = search_route(lattice, start, 0, POINT, scene, RouteSettings.most)
        if len(way):
            break
    else:
        raise NoRoute(f"the payload alone finds no way {inflated:.2f} m from all obstacles: lower the radius")
    states = states_at(way, lattice, _NO_SHAPES)
    states[0], states[-1] = start, goal

    weights = coordinate_scale(0)
    knots, spacing = space_knots(states, weights)
    lead, _ = moving_start(departure, weights, spacing)
    safe = np.full(len(knots), inflated)
    return smooth_knots(knots, Band(POINT, scene, _NO_LIMITS, space, weights, safe, inflated, spacing, lead))


def field_path(
    start: np.ndarray, goal: np.ndarray, space: np.ndarray, scene: Scene, distance: float, gain: float
) -> np.ndarray:
    """Return the path (K, 4) down a potential field (Khatib 1986), to the goal or to where it leads no further.

    The goal attracts by a force of 1, each obstacle repels by gain (1/r - 1) / r² with r its distance over `distance`.

    Args:
        start, goal, space, scene: see `shortest_path`.
        distance: from an obstacle, within which it repels [m].
        gain: [-].
    """
    points = np.zeros((LONGEST, 3))
    count = descend(start[:3].copy(), goal[:3].copy(), space, scene, distance, gain, points)
    states = np.column_stack([points[:count], np.full(count, goal[3])])
    states[0] = start
    return space_knots(states, coordinate_scale(0))[0]


@kernel
def descend(start, goal, space, scene, distance, gain, points):
    """Write the points (M, 3) of the way down the field; return how many."""
    put(points[0], (start[0], start[1], start[2]))
    end = (goal[0], goal[1], goal[2])
    for k in range(1, points.shape[0]):
        here = row(points, k - 1)
        way = sub(end, here)
        far = norm(way)
        if far < STRIDE:
            put(points[k], end)
            return k + 1
        force = scale(1.0 / max(far, NEAR), way)
        for m in range(scene.kind.shape[0]):
            d, normal = local_distance(scene.kind[m], scene.size[m], local_point(scene, m, here))
            r = max(d, _TIGHT) / distance
            if r < 1.0:
                force = add(force, scale(gain * (1.0 / r - 1.0) / r**2, mul(rotation_of(scene, m), normal)))
        moved = add(here, scale(STRIDE / max(norm(force), 1.0), force))
        for i in range(3):
            points[k, i] = min(max(moved[i], space[0, i]), space[1, i])
        if k >= STUCK and norm(sub(row(points, k), row(points, k - STUCK))) < MOVED:
            return k + 1
    return points.shape[0]


def time_path(
    states: np.ndarray, system: System, modes: np.ndarray, settings: RouteSettings, departure: np.ndarray | None
) -> Route:
    """Return the route along states (S, 4 + J) with speeds that the team can fly, blind to obstacles.

    Args:
        states: x, y, z, yaw and shape, see `Route`.
        system: the team.
        modes: (J, N, 3) of the shape's coordinates [N].
        settings: `speed` and `acceleration` count.
        departure: see `find_route`.
    """
    begun = thread_time()
    body = make_body(system, system.formation_force, modes)
    weights = coordinate_scale(len(modes))
    knots, spacing = space_knots(states, weights)
    _, pace = moving_start(departure, weights, spacing)
    values = sample_curve(knots, np.arange(SAMPLES * (len(knots) - 1) + 1) / SAMPLES)
    points, share = team_points(values, system, body), np.ones(len(values))
    tilt = TILTS[int(departure is not None)]
    for attempt in range(REPAIRS):
        fade = FADES[attempt % len(FADES)]
        speeds = share * settings.speed, share * settings.acceleration
        table = time_route(knots, points, *speeds, pace, departure, fade)
        length = float(np.linalg.norm(np.diff(values[:, :3], axis=0), axis=1).sum())
        report = RouteReport(0, length, float(table[-1, 0]), float("nan"), thread_time() - begun)
        route = Route(table[:, 0], table, body.rest, modes, report)
        if move_team(route, system, body, _NO_SCENE, 0.0).feasible(tilt):
            break
        share = SLOWER * share if departure is None else share
    return route
