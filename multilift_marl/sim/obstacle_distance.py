"""How far obstacles are: from points, along rays, from drones, cables and the payload.

Obstacle m of environment e is given by its row of `Obstacles`. Rows of kind NONE are infinitely far.
"""

from __future__ import annotations

from math import hypot, inf, sqrt
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    add,
    column,
    dot,
    from_columns,
    mat,
    matrow,
    mul,
    norm,
    row,
    scale,
    sub,
    tmul,
    unit,
    vec,
)
from multilift_marl.rig.constants import RigArrays
from multilift_marl.sim.gjk import nearest_within, separation
from multilift_marl.sim.obstacles import BOX, CYLINDER, HULL, NONE, SPHERE
from multilift_marl.sim.state import SystemState

_GRAZE = 1e-6  # [m] from a hull, where a ray has met it
_ADVANCES = 64  # of a ray towards a hull
_NOTHING = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # half edges of a point


class TeamBodies(NamedTuple):
    """The bodies of E teams: where they are, how large, and which of them count."""

    state: SystemState
    rig: RigArrays
    limits: Any
    """`mdp.failures.Limits`, the bodies' half edges."""
    lost: np.ndarray
    """(E, N) bool, drones that count no more, nor do their cables."""


@kernel
def point_distance(e, m, point, obstacles):
    """Return the signed distance of a point from an obstacle and the nearest point of its surface, world frame [m].

    Inside it is negative, to the nearest face; inside a HULL it is zero, and the nearest point is the point itself.
    """
    kind = obstacles.kind[e, m]
    if kind == NONE:
        return inf, point
    middle, attitude, half = vec(obstacles.position, e, m), mat(obstacles.rotation, e, m), vec(obstacles.size, e, m)
    if kind == HULL:
        hull = HULL, middle, attitude, obstacles.hull[e, m]
        offset = separation((BOX, point, _NOTHING, 0), hull, obstacles.vertices, inf)
        return norm(offset), sub(point, offset)
    local = tmul(attitude, sub(point, middle))
    distance, normal = local_distance(kind, half, local)
    return distance, sub(point, mul(attitude, scale(distance, normal)))


@kernel
def nearest_point(e, point, most, obstacles):
    """Return the point of an obstacle's surface that is nearest to a point; `most` [m] above it if none is nearer."""
    found, least = add(point, (0.0, 0.0, most)), most
    for m in range(obstacles.kind.shape[1]):
        distance, nearest = point_distance(e, m, point, obstacles)
        if distance < least:
            found, least = nearest, distance
    return found


@kernel
def local_distance(kind, size, p):
    """Return the signed distance of a point from a solid [m] and the outward normal there, in the solid's frame.

    Args:
        kind: BOX, CYLINDER or SPHERE; of a HULL that of the box about it.
        size: half edges of the box about it (3,) [m].
        p: the point (3,) [m].
    """
    if kind == SPHERE:
        return norm(p) - size[0], unit(p)
    if kind == CYLINDER:
        across = hypot(p[0], p[1])
        out = (p[0] / across, p[1] / across, 0.0) if across > 1e-12 else (1.0, 0.0, 0.0)
        side, above = across - size[0], abs(p[2]) - size[2]
        up = (0.0, 0.0, 1.0 if p[2] >= 0.0 else -1.0)
        if side > 0.0 and above > 0.0:
            far = hypot(side, above)
            return far, add(scale(side / far, out), scale(above / far, up))
        return (side, out) if side >= above else (above, up)
    x, y, z = abs(p[0]) - size[0], abs(p[1]) - size[1], abs(p[2]) - size[2]
    sx, sy, sz = 1.0 if p[0] >= 0.0 else -1.0, 1.0 if p[1] >= 0.0 else -1.0, 1.0 if p[2] >= 0.0 else -1.0
    if x > 0.0 or y > 0.0 or z > 0.0:
        out = (max(x, 0.0), max(y, 0.0), max(z, 0.0))
        far = norm(out)
        return far, (sx * out[0] / far, sy * out[1] / far, sz * out[2] / far)
    if x >= y and x >= z:
        return x, (sx, 0.0, 0.0)
    if y >= z:
        return y, (0.0, sy, 0.0)
    return z, (0.0, 0.0, sz)


@kernel
def ray_distance(e, m, origin, direction, obstacles):
    """Return how far a ray along a unit vector is from an obstacle [m]: inf where it misses, 0 from inside."""
    kind = obstacles.kind[e, m]
    if kind == NONE:
        return inf
    attitude, half = mat(obstacles.rotation, e, m), vec(obstacles.size, e, m)
    local, along = tmul(attitude, sub(origin, vec(obstacles.position, e, m))), tmul(attitude, direction)
    if kind == HULL:
        return _ray_to_hull(e, m, origin, direction, obstacles)
    if kind == SPHERE:
        begin, end = _between(1.0, dot(local, along), dot(local, local) - half[0] * half[0])
    else:
        begin, end = _slab(local[2], along[2], half[2])
        if kind == CYLINDER:
            square = along[0] * along[0] + along[1] * along[1]
            share = local[0] * along[0] + local[1] * along[1]
            rest = local[0] * local[0] + local[1] * local[1] - half[0] * half[0]
            first, last = _between(square, share, rest)
            begin, end = max(begin, first), min(end, last)
        else:
            for i in range(2):
                first, last = _slab(local[i], along[i], half[i])
                begin, end = max(begin, first), min(end, last)
    return max(begin, 0.0) if begin <= end and end >= 0.0 else inf


@kernel
def _slab(x, slope, half):
    """Return between which lengths a ray is within ± half in one coordinate."""
    if abs(slope) < 1e-15:
        return (-inf, inf) if abs(x) <= half else (inf, -inf)
    one, other = (-half - x) / slope, (half - x) / slope
    return min(one, other), max(one, other)


@kernel
def _between(a, b, c):
    """Return between which t a t² + 2 b t + c is not positive; a is not negative."""
    if a < 1e-15:
        return (-inf, inf) if c <= 0.0 else (inf, -inf)
    root = b * b - a * c
    if root < 0.0:
        return inf, -inf
    return (-b - sqrt(root)) / a, (-b + sqrt(root)) / a


@kernel
def _ray_to_hull(e, m, origin, direction, obstacles):
    """Return how far a ray is from a HULL: from plane to plane that separates it from what is left of the ray."""
    length = 0.0
    for _ in range(_ADVANCES):
        point = add(origin, scale(length, direction))
        distance, nearest = point_distance(e, m, point, obstacles)
        if distance <= _GRAZE:
            return length
        offset = sub(nearest, point)
        closing = dot(offset, direction)
        if closing <= 1e-12 * distance:
            return inf
        # The hull is behind the plane through its nearest point across the offset.
        length += distance * distance / closing
    return length


@kernel
def segment_distance_to(e, m, a, b, obstacles):
    """Return the distance of the segment a b, a cable, from an obstacle [m]; 0 if they touch."""
    middle, axes = _segment(a, b)
    return body_distance_to(e, m, (BOX, middle, axes, 0), obstacles, inf)


@kernel
def _segment(a, b):
    """Return middle and half edges of a segment."""
    none, along = (0.0, 0.0, 0.0), scale(0.5, sub(b, a))
    return scale(0.5, add(a, b)), from_columns(along, none, none)


@kernel
def box_distance_to(e, m, center, frame, half, obstacles):
    """Return the distance of a box, a drone, from an obstacle [m]; 0 if they touch.

    Args:
        e, m: environment and obstacle.
        center: of the box, world frame [m].
        frame: its attitude, 9 numbers.
        half: its half edges [m].
        obstacles: Obstacles.
    """
    return body_distance_to(e, m, (BOX, center, _stretch(frame, half), 0), obstacles, inf)


@kernel
def cylinder_distance_to(e, m, center, frame, half, obstacles):
    """Do as `box_distance_to` for an upright cylinder of radius `half[0]` and half height `half[2]` [m]."""
    return body_distance_to(e, m, (CYLINDER, center, _stretch(frame, half), 0), obstacles, inf)


@kernel
def _stretch(frame, half):
    """Return the columns of a frame, as long as half edges."""
    return (
        frame[0] * half[0], frame[1] * half[1], frame[2] * half[2],
        frame[3] * half[0], frame[4] * half[1], frame[5] * half[2],
        frame[6] * half[0], frame[7] * half[1], frame[8] * half[2],
    )  # fmt: skip


@kernel
def body_distance_to(e, m, body, obstacles, beyond):
    """Return the distance of a BOX, CYLINDER or HULL from an obstacle [m], 0 if they touch; see `gjk.separation`."""
    other = obstacles.kind[e, m]
    if other == NONE:
        return inf
    place, attitude, half = vec(obstacles.position, e, m), mat(obstacles.rotation, e, m), vec(obstacles.size, e, m)
    kind, middle, axes, _ = body
    if other == SPHERE and kind == HULL:
        offset = separation(body, (BOX, place, _NOTHING, 0), obstacles.vertices, beyond + half[0])
        return max(norm(offset) - half[0], 0.0)
    if other == SPHERE:
        offset = sub(place, middle)
        return max(norm(sub(offset, nearest_within(kind, axes, offset))) - half[0], 0.0)
    if other != HULL:
        attitude = _stretch(attitude, half)
    return norm(separation(body, (other, place, attitude, obstacles.hull[e, m]), obstacles.vertices, beyond))


@kernel
def least_clearance(e, team, nodes, obstacles, within):
    """Return the least distance of drones, cables and payload from obstacles [m]: 0 if any touch, at most `within`.

    Broken cables are left out, of chains their link at the drone.

    Args:
        e: the environment.
        team: TeamBodies.
        nodes: of chains (`World.nodes`), or None: an argument, so that Numba leaves their branch out then.
        obstacles: Obstacles.
        within: beyond it distances are not sought, which is quick [m]; inf: any.
    """
    state, rig, limits, lost = team
    least = within
    payload, attitude = row(state.payload_position, e), matrow(state.payload_rotation, e)
    # The payload, whose middle is off its centre of mass.
    half = limits.payload_half
    middle, axes = add(payload, mul(attitude, limits.payload_center)), _stretch(attitude, half)
    kind, hull = (CYLINDER if limits.payload_round else BOX), 0
    if limits.payload_hull >= 0:
        kind, axes, hull = HULL, attitude, limits.payload_hull
    if limits.payload_ball > 0.0:
        far = _clearance(e, (BOX, middle, _NOTHING, 0), 0.0, obstacles, least + limits.payload_ball)
        least = max(far - limits.payload_ball, 0.0)
    else:
        least = _clearance(e, (kind, middle, axes, hull), norm(half), obstacles, least)
    for n in range(state.drone_position.shape[1]):
        if lost[e, n]:
            continue
        drone, frame = vec(state.drone_position, e, n), mat(state.drone_rotation, e, n)
        box = row(limits.drone_half, n)
        least = _clearance(e, (BOX, drone, _stretch(frame, box), 0), norm(box), obstacles, least)
        # Its cable, from anchor to hook; of a chain link by link.
        begin, end = add(payload, mul(attitude, row(rig.anchors, n))), add(drone, mul(frame, row(rig.hooks, n)))
        if nodes is not None:
            for k in range(rig.cable_segments[n] - 1):
                node = vec(nodes.position[e], n, k)
                least = _cable_clearance(e, begin, node, obstacles, least)
                begin = node
        if not state.cable_broken[e, n]:
            least = _cable_clearance(e, begin, end, obstacles, least)
    return least


@kernel
def _cable_clearance(e, a, b, obstacles, least):
    """Return the distance of the segment a b from the nearest obstacle, if it is less than `least` [m]."""
    middle, axes = _segment(a, b)
    return _clearance(e, (BOX, middle, axes, 0), norm(column(axes, 0)), obstacles, least)


@kernel
def _clearance(e, body, radius, obstacles, least):
    """Return the distance of a body within `radius` [m] from the nearest obstacle, if it is less than `least` [m]."""
    _, middle, _, _ = body
    for m in range(obstacles.kind.shape[1]):
        if least <= 0.0:
            break
        if obstacles.kind[e, m] == NONE:
            continue
        # Spheres first, then the body's sphere and the obstacle's box: only what is left is worth an exact distance.
        offset, half = sub(middle, vec(obstacles.position, e, m)), vec(obstacles.size, e, m)
        apart = dot(offset, offset)
        reach = least + radius
        if apart > 2.0 * (reach * reach + dot(half, half)):
            continue
        local = tmul(mat(obstacles.rotation, e, m), offset)
        x, y, z = (
            max(abs(local[0]) - half[0], 0.0),
            max(abs(local[1]) - half[1], 0.0),
            max(abs(local[2]) - half[2], 0.0),
        )
        if x * x + y * y + z * z >= reach * reach:
            continue
        least = min(least, body_distance_to(e, m, body, obstacles, least))
    return least
