"""Failures common to all tasks, each a named cause."""

from __future__ import annotations

from math import cos, radians, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.config.system import MIN_SEPARATION, System
from multilift_marl.math3d import add, column, dot, mat, matrow, mul, norm, row, segment_distance, sub, unit, vec
from multilift_marl.sim.scene import drone_half_size

CAUSES = (
    "none",
    "ground",  # a drone or the payload touches it
    "drone_collision",  # two drones closer than the separation limit
    "cable_crossing",  # two cables closer than 0.1 m
    "cable_angle",  # over 90° from the drone's down axis or 135° from the payload's up axis
    "below_payload",  # a drone lower than the payload
    "tilt",  # a drone tilted over 80°
    "cable_broken",  # its tension has exceeded cable.breaking_load
    "out_of_range",  # payload over 3 m from its target, whatever the vehicle
    "diverged",  # the simulation has failed, not the team
)
_GROUND, _COLLISION, _CROSSING, _CABLE, _BELOW, _TILT, _BROKEN, _RANGE, DIVERGED = range(1, len(CAUSES))

MAX_DISTANCE = 3.0  # [m]
_CABLE_DISTANCE = 0.1  # [m] for the span of a falcon
_TOUCH = 0.005  # [m]
_MIN_UP = cos(radians(80.0))
_MIN_CABLE_PAYLOAD = cos(radians(135.0))


class Limits(NamedTuple):
    """Lengths of the failures, scaled to the vehicle."""

    separation: float
    """Between drones [m]."""
    cables: np.ndarray
    """(N, N) between cables [m]: 0.1 m for a falcon, at most half their distance at rest."""
    anchors: np.ndarray
    """(N, 3) [m]."""
    payload_half: np.ndarray
    """(3,) half edges of the payload [m]."""
    payload_center: tuple[float, float, float]
    """Its geometric centre from its centre of mass, in its frame [m]."""
    payload_round: bool
    """Whether it is a cylinder."""
    drone_half: np.ndarray
    """(3,) half edges of a drone [m]."""


def make_limits(system: System) -> Limits:
    """Return the limits of `system`."""
    n, anchors, slots = system.num_drones, system.anchors, system.slots
    cables = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            if i != j:
                rest = segment_distance(tuple(anchors[i]), tuple(slots[i]), tuple(anchors[j]), tuple(slots[j]))
                cables[i, j] = min(_CABLE_DISTANCE * system.min_separation / MIN_SEPARATION, 0.5 * rest)
    return Limits(
        separation=system.min_separation,
        cables=cables,
        anchors=np.ascontiguousarray(anchors),
        payload_half=system.payload_size / 2,
        payload_center=tuple(float(x) for x in system.payload_center),
        payload_round=system.payload_shape == "cylinder",
        drone_half=drone_half_size(system.vehicle),
    )


@kernel
def find_failures(lo, hi, state, errors, limits, cause, min_separation):
    """Write the first failure cause (0: none) of environments lo to hi; update the least separation (E,) [m]."""
    for e in range(lo, hi):
        cause[e] = _cause(e, state, errors, limits, min_separation)


@kernel
def _cause(e, state, errors, limits, min_separation):
    payload, attitude = row(state.payload_position, e), matrow(state.payload_rotation, e)
    up = column(attitude, 2)
    count = state.drone_position.shape[1]
    if not errors.distance[e] <= MAX_DISTANCE:
        return _RANGE
    half, center = limits.payload_half, add(payload, mul(attitude, limits.payload_center))
    below = _round_extent(attitude, half) if limits.payload_round else _extent(attitude, half)
    if center[2] - below < _TOUCH:
        return _GROUND
    for n in range(count):
        drone, frame = vec(state.drone_position, e, n), mat(state.drone_rotation, e, n)
        anchor = add(payload, mul(attitude, (limits.anchors[n, 0], limits.anchors[n, 1], limits.anchors[n, 2])))
        cable = unit(sub(drone, anchor))
        if drone[2] - _extent(frame, limits.drone_half) < _TOUCH:
            return _GROUND
        if state.cable_broken[e, n]:
            return _BROKEN
        if frame[8] < _MIN_UP:
            return _TILT
        if drone[2] < payload[2]:
            return _BELOW
        if dot(cable, column(frame, 2)) < 0.0 or dot(cable, up) < _MIN_CABLE_PAYLOAD:
            return _CABLE
        for m in range(n):
            other = vec(state.drone_position, e, m)
            apart = norm(sub(drone, other))
            min_separation[e] = min(min_separation[e], apart)
            if apart < limits.separation:
                return _COLLISION
            foot = add(payload, mul(attitude, (limits.anchors[m, 0], limits.anchors[m, 1], limits.anchors[m, 2])))
            if segment_distance(anchor, drone, foot, other) < limits.cables[n, m]:
                return _CROSSING
    return 0


@kernel
def _round_extent(attitude, half):
    """Return how far an upright cylinder reaches below its centre [m]."""
    return sqrt(max(1.0 - attitude[8] * attitude[8], 0.0)) * half[0] + abs(attitude[8]) * half[2]


@kernel
def _extent(attitude, half):
    """Return how far a box reaches below its centre [m]."""
    return abs(attitude[6]) * half[0] + abs(attitude[7]) * half[1] + abs(attitude[8]) * half[2]
