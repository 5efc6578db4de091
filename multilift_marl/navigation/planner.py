"""Whole routes among obstacles: a search on a lattice, a smooth curve through what it finds, and speeds along that."""

from __future__ import annotations

from dataclasses import dataclass
from time import thread_time
from typing import NamedTuple

import numpy as np

from multilift_marl.navigation.formation_shapes import FormationShapes, has_low, make_shape_limits, make_shapes
from multilift_marl.navigation.motion import RouteMotion, move_team
from multilift_marl.navigation.search import make_lattice, search_route, states_at
from multilift_marl.navigation.smoothing import Band, coordinate_scale, smooth_knots, space_knots
from multilift_marl.navigation.team_clearance import (
    Scene,
    TeamBody,
    hangs_over,
    make_body,
    make_scene,
    measure_clearance,
    team_clearance,
    team_reach,
    write_arms,
)
from multilift_marl.navigation.timing import SAMPLES, sample_curve, time_route
from multilift_marl.planning.route import NoRoute, Route, RouteReport
from multilift_marl.rig.system import System
from multilift_marl.sim.obstacles import Obstacles, half_extents

FINENESS = 1.0, 0.6, 0.45  # of the lattice, tried in turn, and ...
MOVING = 2  # ... of a moving team, which cannot wait, as many and a tenth of the states
STEP = 0.5  # [-] of the lattice, over the narrowest half width of payload and drone
TALL = 1.5  # [-] steps of height, over those, and ...
LOW = 0.5  # ... with low shapes
REPAIRS = 9  # of the curve, and as many of its speeds
CLOSER = 0.015  # [m] that a knot is to keep more, each time that it is too close
FADES = 1.0, 1.6, 2.2  # [s] in which a route comes to its curve from a moving start, tried in turn
FIRMER = 1.25  # of acceleration where a moving start leaves little room to brake
SLOWER = 0.75  # of speed and acceleration where they bring the team too close
TILTS = np.deg2rad([45.0, 60.0])  # of drones along a route from rest, and from a moving start
_SPARE = 0.005  # [m] of the shapes' limits, for the curve
_STILL = 0.05  # [m/s] below which a team is at rest
_AHEAD = 1.0  # [s] before and after a time, in which the team is slower then
_SLOWEST = 0.35  # of speed and acceleration in the open, where obstacles are closest


@dataclass(frozen=True)
class RouteSettings:
    """What a route is to keep.

    Attributes:
        clearance: that all bodies keep from obstacles where there is room [m].
        least_clearance: that they keep everywhere [m].
        comfort: clearance beyond which more is worth nothing [m].
        speed: of all bodies, at most [m/s].
        acceleration: of all bodies, at most [m/s²].
        low, high: space of the payload's position (3,) [m]; None: `room` around start, goal and obstacles.
        room: [m].
        ground: height of the payload's lowest point, at least [m].
        most: states to expand on each lattice.
    """

    clearance: float = 0.08
    least_clearance: float = 0.03
    comfort: float = 0.25
    speed: float = 1.5
    acceleration: float = 2.0
    low: tuple[float, float, float] | None = None
    high: tuple[float, float, float] | None = None
    room: float = 2.0
    ground: float = 0.3
    most: int = 1_000_000


def find_route(
    system: System,
    obstacles: Obstacles,
    env: int,
    start: np.ndarray,
    goal: np.ndarray,
    settings: RouteSettings = RouteSettings(),
    departure: np.ndarray | None = None,
) -> Route:
    """Return a route of a team to rest in the resting formation at a goal.

    Low shapes are tried where things hang over the way and no route is found without them.

    Args:
        system: the team.
        obstacles, env: those of one environment, where they are now.
        start, goal: (4,) x, y, z [m] and yaw [rad] of the level payload.
        settings: what it is to keep.
        departure: (4, 4 + J) pose and shape of the team at the start and three orders of rates, such as
            `route.sample(time)[:, 0]` of another route; `start` is not used then. None: at rest in the resting
            formation.

    Raises:
        NoRoute: start or goal is too close to an obstacle or too low, or no way is found.
        ConfigError: the space is too large for a search.
    """
    begun = thread_time()
    start = np.array(start if departure is None else departure[0, :4], dtype=float)
    goal = np.array(goal, dtype=float)
    scene = make_scene(obstacles, env)
    tries = [make_shapes(system)]
    if departure is not None and departure.shape[1] > 4 + len(tries[0].modes):  # that of a route in low shapes
        tries = [make_shapes(system, low=True)]
    elif hangs_over(scene, settings.ground) and has_low((shapes := make_shapes(system, low=True)).modes, system):
        tries.append(shapes)
    shapes = tries[0]
    body = make_body(system, shapes.rest, shapes.modes)
    space = _space(start, goal, scene, body, settings)
    if departure is not None:  # a curve may leave it a little
        space = np.array([np.minimum(space[0], start[:3]), np.maximum(space[1], start[:3])])
    still = np.zeros(len(shapes.modes))
    shape = still if departure is None else departure[0, 4:]
    for name, pose, own in (("start", start, shape), ("goal", goal, still)):
        _check_pose(name, pose, own, space, body, scene, settings)

    request = _Request(system, scene, start, goal, space, settings, departure)
    expanded = 0
    for fineness in FINENESS[: None if departure is None else MOVING]:
        for shapes in tries:
            route, count = _find_with(shapes, fineness, request)
            expanded += count
            if route is not None:
                report = route.report._replace(expanded=expanded, planning_time=thread_time() - begun)
                return route._replace(report=report)
    raise NoRoute(
        f"no route that keeps {settings.least_clearance:g} m from all obstacles was found, with any of "
        f"{len(shapes.choices)} shapes of the formation: widen a gap, lower least_clearance, or raise most"
    )


class _Request(NamedTuple):
    """What `find_route` is asked for."""

    system: System
    scene: Scene
    start: np.ndarray
    goal: np.ndarray
    space: np.ndarray
    """(2, 3) lowest and highest position of the payload [m]."""
    settings: RouteSettings
    departure: np.ndarray | None


def _find_with(shapes: FormationShapes, fineness: float, request: _Request) -> tuple[Route | None, int]:
    """Return a route by some shapes and one lattice, None if none is found, and how many states were expanded."""
    system, settings, departure, goal = request.system, request.settings, request.departure, request.goal
    body = make_body(system, shapes.rest, shapes.modes)
    shape, most = np.zeros(len(shapes.modes)), settings.most
    if departure is not None:
        departure = np.pad(departure, ((0, 0), (0, 4 + len(shapes.modes) - departure.shape[1])))
        shape, most = departure[0, 4:], settings.most // 10
    nearest = int(np.abs(shapes.choices - shape).sum(axis=1).argmin())
    least = settings.least_clearance * fineness**2
    step = fineness * STEP * (system.payload_size[:2].min() / 2 + body.radius.max()) * np.ones(3)
    if has_low(shapes.modes, system):  # a slot may be between two heights of the lattice: the curve moves into it
        step[2] *= LOW
        least -= step[2] / 2
    else:
        step[2] *= TALL
    lattice = make_lattice(request.start, goal, request.space, step, body, shapes, (least, settings.comfort))
    way, expanded = search_route(lattice, request.start, nearest, body, request.scene, most)
    if not len(way):
        return None, expanded
    states = states_at(way, lattice, shapes)
    states[0, 4:] = shape
    turns = round((states[-1, 3] - goal[3]) / (2 * np.pi))
    states[-1, :4] = *goal[:3], goal[3] + 2 * np.pi * turns
    return _make_route(states, body, request._replace(departure=departure)), expanded


def measure_route(
    system: System, obstacles: Obstacles, env: int, route: Route, enough: float = RouteSettings.comfort
) -> RouteMotion:
    """Return a team's motion along a route and its distances from obstacles as they are now, such as new ones.

    Args:
        system: the team.
        obstacles, env: those of one environment.
        route: of the team.
        enough: distance beyond which it is not measured [m].
    """
    return move_team(route, system, make_body(system, route.rest, route.modes), make_scene(obstacles, env), enough)


def _space(start: np.ndarray, goal: np.ndarray, scene: Scene, body: TeamBody, settings: RouteSettings) -> np.ndarray:
    """Return the lowest and the highest position of the payload, (2, 3) [m]."""
    far = half_extents(scene.kind, scene.size, scene.rotation)
    points = np.vstack([start[:3], goal[:3], scene.position - far, scene.position + far])
    low, high = points.min(axis=0) - settings.room, points.max(axis=0) + settings.room
    low = low if settings.low is None else np.array(settings.low, dtype=float)
    high = high if settings.high is None else np.array(settings.high, dtype=float)
    low[2] = max(low[2], settings.ground + body.half[2] - body.center[2])
    return np.array([low, high])


def _check_pose(
    name: str, pose: np.ndarray, shape: np.ndarray, space: np.ndarray, body: TeamBody, scene: Scene,
    settings: RouteSettings,
) -> None:  # fmt: skip
    """Refuse a start or a goal where the team cannot be."""
    if pose[2] < space[0, 2] - 1e-9:
        raise NoRoute(
            f"the {name} is {pose[2]:.2f} m high, and the payload has to be at least {space[0, 2]:.2f} m high"
        )
    if (pose[:3] < space[0] - 1e-9).any() or (pose[:3] > space[1] + 1e-9).any():
        raise NoRoute(f"the {name} {_text(pose)} is outside the space from {_text(space[0])} to {_text(space[1])}")
    arms = np.zeros_like(body.rest)
    write_arms(shape, body, arms)
    left = team_clearance(tuple(pose), arms, body, scene, team_reach(arms, body), settings.comfort)
    if left < settings.least_clearance:
        where = "in an obstacle" if left <= 0 else f"{left:.3f} m from an obstacle"
        raise NoRoute(
            f"at the {name} {_text(pose)} the team is {where}, and has to keep {settings.least_clearance:g} m: move "
            f"the {name} or the obstacle"
        )


def _text(place: np.ndarray) -> str:
    return f"({place[0]:.2f}, {place[1]:.2f}, {place[2]:.2f}) m"


def _make_route(states: np.ndarray, body: TeamBody, request: _Request) -> Route | None:
    """Return the smooth route along states (S, 4 + J) of a lattice, None if it comes too close to obstacles."""
    system, scene, space, settings = request.system, request.scene, request.space, request.settings
    departure = request.departure
    weights = coordinate_scale(len(body.modes))
    knots, spacing = space_knots(states, weights)
    lead, pace = moving_start(departure, weights, spacing)
    limits = make_shape_limits(system)
    band = Band(
        body=body,
        scene=scene,
        limits=limits._replace(separation=limits.separation + _SPARE, cables=limits.cables + _SPARE),
        space=space,
        scale=weights,
        safe=np.full(len(knots), settings.clearance),
        comfort=settings.comfort,
        spacing=spacing,
        lead=lead,
    )
    best = knots, knots, np.array([-np.inf])
    for _ in range(REPAIRS):
        knots = smooth_knots(knots, band)
        u = np.arange(SAMPLES * (len(knots) - 1) + 1) / SAMPLES
        values = sample_curve(knots, u)
        clearance = _measure(values, body, scene, settings.comfort)
        close = u[clearance < settings.least_clearance + 0.01]
        if not len(close):
            break
        if clearance.min() > best[2].min():
            best = knots, values, clearance
        knot = np.arange(len(knots))
        band.safe[np.abs(knot[:, None] - close).min(axis=1) <= 2.0] += CLOSER
    if has_low(body.modes, system) and clearance.min() < best[2].min():  # where there is little room repairs may harm
        knots, values, clearance = best
    if clearance.min() < settings.least_clearance:
        return None

    # Speeds: lower where obstacles are close, and again where inertia swings drones towards them.
    points = team_points(values, system, body)
    care = np.clip(clearance / settings.comfort, _SLOWEST, 1.0)
    slow, firm = care, care
    tilt = TILTS[int(departure is not None)]
    for attempt in range(REPAIRS):
        fade = FADES[attempt % len(FADES)]
        table = time_route(knots, points, slow * settings.speed, firm * settings.acceleration, pace, departure, fade)
        report = RouteReport(0, _length(values), float(table[-1, 0]), 0.0, 0.0)
        route = Route(table[:, 0], table, body.rest, body.modes, report)
        motion = move_team(route, system, body, scene, settings.comfort)
        if motion.feasible(tilt) and motion.clearance.min() >= settings.least_clearance:
            least = float(motion.clearance.min())
            return route._replace(report=report._replace(clearance=least))
        if departure is not None and not motion.feasible(tilt, fade):
            firm = FIRMER * firm if attempt % len(FADES) == 2 else firm  # it brakes too late, too
            continue
        share = _slower(values, motion, motion.feasible(tilt), settings)
        slow, firm = share * slow, share * firm
    return None


def moving_start(
    departure: np.ndarray | None, weights: np.ndarray, spacing: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the lead (D,) of a band, see `Band`, and the pace of its samples, see `smooth_times`, at a start.

    Args:
        departure: see `find_route`.
        weights: length of a unit of each coordinate (D,) [m].
        spacing: of knots [m].
    """
    if departure is None or (fast := float(np.linalg.norm(weights * departure[1]))) <= _STILL:
        return np.zeros(len(weights)), (0.0, 0.0)
    gain = float((weights * departure[1]) @ (weights * departure[2])) / fast
    return departure[1] * spacing / fast, (fast / spacing * SAMPLES, gain / spacing * SAMPLES)


def _slower(values: np.ndarray, motion: RouteMotion, feasible: bool, settings: RouteSettings) -> np.ndarray:
    """Return shares of speed and acceleration (M,), lower about where the team comes too close, or is overtaxed."""
    close = motion.clearance < settings.least_clearance
    if not feasible or not close.any():
        return np.full(len(values), SLOWER)
    near = np.zeros(len(motion.times), bool)
    for time in motion.times[close]:
        near |= np.abs(motion.times - time) <= _AHEAD
    nearest = np.linalg.norm(values[:, None, :3] - motion.places[None, near, :3], axis=-1).min(axis=1)
    return np.where(nearest < 0.1, SLOWER, 1.0)


def _arms(values: np.ndarray, body: TeamBody) -> np.ndarray:
    """Return the cables (M, N, 3) [m] of poses and shapes (M, 4 + J), payload's frame."""
    force = body.rest + np.tensordot(values[:, 4:], body.modes, axes=1)
    return body.length[:, None] * force / np.linalg.norm(force, axis=-1, keepdims=True)


def _measure(values: np.ndarray, body: TeamBody, scene: Scene, enough: float) -> np.ndarray:
    clearance = np.empty(len(values))
    places = np.ascontiguousarray(values[:, :4])
    measure_clearance(places, _arms(values, body), body, scene, enough, clearance)
    return clearance


def team_points(values: np.ndarray, system: System, body: TeamBody) -> np.ndarray:
    """Return where payload and drones are (M, 1 + N, 3) [m]."""
    c, s = np.cos(values[:, 3]), np.sin(values[:, 3])
    out = system.anchors + _arms(values, body)
    turned = np.stack([c[:, None] * out[..., 0] - s[:, None] * out[..., 1],
                       s[:, None] * out[..., 0] + c[:, None] * out[..., 1], out[..., 2]], axis=-1)  # fmt: skip
    return np.concatenate([values[:, None, :3], values[:, None, :3] + turned], axis=1)


def _length(values: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(values[:, :3], axis=0), axis=1).sum())
