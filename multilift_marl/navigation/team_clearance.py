"""How far a team is from obstacles: its payload's box, its cables as segments, its drones as spheres about them.

The signed distance d(p) from a convex obstacle is convex, and n = ∇d is its normal there. So d(x) + n · (z - x) bounds
d(z) from below, in all of a box or a segment; where that bound meets the distance of one of its points, it is exact.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import inlined, kernel
from multilift_marl.math3d import add, dot, matmul, mul, norm, put, row, scale, sub, tmul, transpose, turn, unit
from multilift_marl.rig.system import System
from multilift_marl.sim.obstacle_distance import local_distance
from multilift_marl.sim.obstacles import HULL, NONE, SPHERE, Obstacles, half_extents

TOLERANCE = 1e-3  # [m] of distances, which are too small rather than too large
_ITERATIONS = 16
FAR = 1e3  # [m] the distance where there is no obstacle


class TeamBody(NamedTuple):
    """The geometry of a team."""

    anchors: np.ndarray
    """(N, 3) in the payload's frame [m]."""
    length: np.ndarray
    """(N,) of the cables [m]."""
    radius: np.ndarray
    """(N,) of spheres about the drones [m]."""
    half: np.ndarray
    """(3,) half edges of the payload's box [m]."""
    center: np.ndarray
    """(3,) of that box, in the payload's frame [m]."""
    rest: np.ndarray
    """(N, 3) cable forces at rest, and ... [N]"""
    modes: np.ndarray
    """(J, N, 3) those of the modes, see `FormationShapes`."""


class Scene(NamedTuple):
    """The obstacles of one environment, as they are."""

    kind: np.ndarray
    """(M,) without free rows."""
    size: np.ndarray
    """(M, 3) [m]."""
    rotation: np.ndarray
    """(M, 3, 3)."""
    position: np.ndarray
    """(M, 3) [m]."""


def make_body(system: System, rest: np.ndarray, modes: np.ndarray) -> TeamBody:
    """Return the geometry of a team and the modes of its shapes."""
    radius = np.array([np.linalg.norm(vehicle.half_size) for vehicle in system.vehicles])
    return TeamBody(
        anchors=system.anchors.copy(),
        length=system.cable_length.copy(),
        radius=radius + np.linalg.norm(system.hooks, axis=1),
        half=system.payload_size / 2,
        center=np.array(system.payload_center, dtype=float),
        rest=rest,
        modes=modes,
    )


def make_scene(obstacles: Obstacles, env: int) -> Scene:
    """Return the obstacles of one environment as they are now; of a HULL the box that encloses it."""
    used = obstacles.kind[env] != NONE
    parts = obstacles.kind, obstacles.size, obstacles.rotation, obstacles.position
    return Scene(*(np.ascontiguousarray(part[env][used]) for part in parts))


def hangs_over(scene: Scene, height: float) -> bool:
    """Return whether there is room beneath an obstacle: it is wholly above a height [m], or slanted, or a mesh."""
    upwards = np.abs(scene.rotation[:, 2])
    half = half_extents(scene.kind, scene.size, scene.rotation)[:, 2]
    slanted = (scene.kind != SPHERE) & (upwards.max(axis=1) < 1.0 - 1e-6)
    return bool(((scene.position[:, 2] - half > height) | slanted | (scene.kind == HULL)).any())


def rest_clearance(system: System, obstacles: Obstacles, env: int, place: tuple[float, float, float, float]) -> float:
    """Return how far the resting formation is from obstacles [m], `FAR` at most.

    Args:
        system: the team.
        obstacles, env: those of one environment.
        place: x, y, z [m] and yaw [rad] of the level payload.
    """
    rest = system.formation_force
    body, arms = make_body(system, rest, np.zeros((0, *rest.shape))), np.zeros_like(rest)
    write_arms(np.zeros(0), body, arms)
    return float(team_clearance(place, arms, body, make_scene(obstacles, env), team_reach(arms, body), FAR))


@kernel
def segment_clearance(kind, size, a, b, enough):
    """Return distance, normal and share of the point of a segment that is nearest to an obstacle, in its frame.

    Of two points of the segment between which the least distance is, the two tangents of the convex distance meet at
    the next one, and below it.

    Args:
        kind, size: the obstacle.
        a, b: ends of the segment [m].
        enough: distance beyond which a bound of it will do [m].
    """
    along = sub(b, a)
    left, here = local_distance(kind, size, a)
    down = dot(here, along)
    # The distance is convex along the segment: where it does not fall at the first end, nothing is nearer; where its
    # tangent is still far at the other end, all is.
    if down >= 0.0 or left + down >= enough:
        return (left, here, 0.0) if down >= 0.0 else (left + down, here, 0.0)
    right, there = local_distance(kind, size, b)
    up = dot(there, along)
    if up <= 0.0:
        return right, there, 1.0
    low, high = 0.0, 1.0
    for _ in range(_ITERATIONS):
        # Where the two tangents meet: left + down (s - low) = right + up (s - high).
        share = (left - right + up * high - down * low) / (up - down)
        share = min(max(share, low), high)
        bound = left + down * (share - low)
        if bound >= enough or min(left, right) - bound < TOLERANCE:
            return (bound, here, low) if left < right else (bound, there, high)
        value, normal = local_distance(kind, size, add(a, scale(share, along)))
        slope = dot(normal, along)
        # The least distance stays between a point where it falls and one where it rises.
        if slope < 0.0:
            left, down, low, here = value, slope, share, normal
        else:
            right, up, high, there = value, slope, share, normal
    return (left, here, low) if left < right else (right, there, high)


@kernel
def box_clearance(kind, size, middle, axes, half, enough):
    """Return distance, normal and point of a box that is nearest to an obstacle, in the obstacle's frame.

    Projections onto the obstacle and the box take turns; the tangent plane of each gives a bound of the distance.

    Args:
        kind, size: the obstacle.
        middle: of the box [m].
        axes: its axes as columns of 9 numbers.
        half: its half edges [m].
        enough: distance beyond which a bound of it will do [m].
    """
    x, best = middle, -FAR
    normal, point = (0.0, 0.0, 1.0), middle
    for _ in range(_ITERATIONS):
        far, n = local_distance(kind, size, x)
        local = tmul(axes, n)
        # d(z) ≥ d(x) + n · (z - x) for all z of the box; the box reaches `reach` beyond its middle towards -n.
        reach = abs(local[0]) * half[0] + abs(local[1]) * half[1] + abs(local[2]) * half[2]
        bound = far + dot(n, sub(middle, x)) - reach
        if bound > best:
            best, normal, point = bound, n, x
        if best >= enough or far - best < TOLERANCE or far <= 0.0:
            break
        # The obstacle's nearest point to x, and the box's nearest point to that.
        back = tmul(axes, sub(sub(x, scale(far, n)), middle))
        inside = (
            min(max(back[0], -half[0]), half[0]),
            min(max(back[1], -half[1]), half[1]),
            min(max(back[2], -half[2]), half[2]),
        )
        x = add(middle, mul(axes, inside))
    return best, normal, point


@inlined
def local_point(scene, m, p):
    """Return a point of the world in the frame of obstacle m."""
    d = (p[0] - scene.position[m, 0], p[1] - scene.position[m, 1], p[2] - scene.position[m, 2])
    r = scene.rotation
    return (
        r[m, 0, 0] * d[0] + r[m, 1, 0] * d[1] + r[m, 2, 0] * d[2],
        r[m, 0, 1] * d[0] + r[m, 1, 1] * d[1] + r[m, 2, 1] * d[2],
        r[m, 0, 2] * d[0] + r[m, 1, 2] * d[1] + r[m, 2, 2] * d[2],
    )


@inlined
def rotation_of(scene, m):
    """Return the rotation of obstacle m, 9 numbers."""
    r = scene.rotation
    return (
        r[m, 0, 0], r[m, 0, 1], r[m, 0, 2], r[m, 1, 0], r[m, 1, 1], r[m, 1, 2], r[m, 2, 0], r[m, 2, 1], r[m, 2, 2],
    )  # fmt: skip


@kernel
def write_arms(coordinates, body, arms):
    """Write each cable from its anchor to its drone (N, 3) [m], payload's heading frame, of a shape (J,)."""
    for n in range(body.rest.shape[0]):
        f = row(body.rest, n)
        for j in range(coordinates.shape[0]):
            mode = (body.modes[j, n, 0], body.modes[j, n, 1], body.modes[j, n, 2])
            f = add(f, scale(coordinates[j], mode))
        put(arms[n], scale(body.length[n], unit(f)))


@kernel
def team_reach(arms, body):
    """Return the radius of a sphere about the payload's position that holds the team [m]."""
    reach = 0.0
    for i in range(3):
        reach += (abs(body.center[i]) + body.half[i]) ** 2
    reach = sqrt(reach)
    for n in range(arms.shape[0]):
        reach = max(reach, norm(add(row(body.anchors, n), row(arms, n))) + body.radius[n])
    return reach


@kernel
def payload_clearance(scene, m, here, c, s, body, enough):
    """Return distance, normal and point (world) of the payload that is nearest to obstacle m.

    Args:
        scene, m: the obstacle.
        here: position of the payload [m].
        c, s: cosine and sine of its yaw.
        body: TeamBody.
        enough: see `box_clearance`.
    """
    middle = add(here, turn(c, s, (body.center[0], body.center[1], body.center[2])))
    frame = rotation_of(scene, m)
    axes = matmul(transpose(frame), (c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0))
    half = (body.half[0], body.half[1], body.half[2])
    far, normal, point = box_clearance(scene.kind[m], scene.size[m], local_point(scene, m, middle), axes, half, enough)
    spot = mul(frame, point)
    spot = (spot[0] + scene.position[m, 0], spot[1] + scene.position[m, 1], spot[2] + scene.position[m, 2])
    return far, mul(frame, normal), spot


@kernel
def cable_clearance(scene, m, a, b, radius, enough):
    """Return the distances from obstacle m of a cable and of the drone at its end, and their normals.

    Args:
        scene, m: the obstacle.
        a, b: anchor and drone, world frame [m].
        radius: of the sphere about the drone [m].
        enough: see `segment_clearance`.

    Returns:
        Distance of the cable, its normal, the share of its length where that is; distance of the drone, its normal.
    """
    start, end = local_point(scene, m, a), local_point(scene, m, b)
    kind, size, frame = scene.kind[m], scene.size[m], rotation_of(scene, m)
    drone, outward = local_distance(kind, size, end)
    cable, normal, share = segment_clearance(kind, size, start, end, enough)
    return cable, mul(frame, normal), share, drone - radius, mul(frame, outward)


@kernel
def team_clearance(place, arms, body, scene, reach, enough):
    """Return the distance of a team from the nearest obstacle, or `enough` where it is more [m].

    Args:
        place: x, y, z [m] and yaw [rad] of the level payload.
        arms: (N, 3), see `write_arms`.
        body, scene: the team and the obstacles.
        reach: see `team_reach`.
        enough: [m].
    """
    here, c, s = (place[0], place[1], place[2]), cos(place[3]), sin(place[3])
    least = enough
    for m in range(scene.kind.shape[0]):
        # Most obstacles are farther than the team's own sphere reaches.
        far = local_distance(scene.kind[m], scene.size[m], local_point(scene, m, here))[0]
        if far > reach + least:
            continue
        least = min(least, payload_clearance(scene, m, here, c, s, body, least)[0])
        for n in range(arms.shape[0]):
            a = add(here, turn(c, s, row(body.anchors, n)))
            b = add(a, turn(c, s, row(arms, n)))
            found = cable_clearance(scene, m, a, b, body.radius[n], least)
            least = min(least, min(found[0], found[3]))
        if least <= 0.0:
            return least
    return least


@kernel
def measure_clearance(places, arms, body, scene, enough, clearance):
    """Write the clearance (T,) of places (T, 4) with arms (T, N, 3), at most `enough` [m]."""
    for t in range(places.shape[0]):
        reach = team_reach(arms[t], body)
        clearance[t] = team_clearance(places[t], arms[t], body, scene, reach, enough)
