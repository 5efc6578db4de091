"""Failures common to all tasks, each a named cause."""

from __future__ import annotations

from math import cos, radians, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.math3d import (
    add,
    column,
    dot,
    mat,
    matrow,
    mul,
    norm,
    row,
    segment_distance,
    sub,
    triple,
    unit,
    vec,
)
from multilift_marl.rig.resolve import MIN_SEPARATION
from multilift_marl.rig.system import System
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.state import hook_position

CAUSES = (
    "none",
    "ground",  # a drone or the payload touches it
    "drone_collision",  # two drones closer than the separation limit
    "cable_crossing",  # two cables closer than 0.1 m
    "cable_angle",  # over 90° from the drone's down axis or 135° from the payload's up axis
    "below_payload",  # a drone lower than the payload
    "tilt",  # a drone tilted over 80°
    "cable_broken",  # its tension has exceeded cable.breaking_load
    "wall",  # anything touches a wall (task gate)
    "out_of_range",  # payload over 3 m from its target, whatever the vehicle
    "diverged",  # the simulation has failed, not the team
)
GROUND, COLLISION, CROSSING, CABLE, BELOW, TILT, BROKEN, WALL, RANGE, DIVERGED = range(1, len(CAUSES))
LOAD_GROUND = 0  # the payload's contact with the ground, to be forgiven apart from the drones'

MAX_DISTANCE = 3.0  # [m]
_CABLE_DISTANCE = 0.1  # [m] for the span of a falcon
TOUCH = 0.005  # [m] what is no higher touches the ground
_MIN_UP = cos(radians(80.0))
_MIN_CABLE_PAYLOAD = cos(radians(135.0))


class FailureMask(NamedTuple):
    """What does not count as a failure for now; all zero unless a task says otherwise."""

    ignored: np.ndarray
    """(E,) int64, a bit for every cause, see `forgive`."""
    lost: np.ndarray
    """(E, N) bool, drones that count no more."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> FailureMask:
        """Return a watch that forgives nothing."""
        return cls(np.zeros(num_envs, np.int64), np.zeros((num_envs, num_drones), bool))


class Limits(NamedTuple):
    """Lengths of the failures, scaled to the vehicles."""

    separation: np.ndarray
    """(N, N) between drones [m]."""
    cables: np.ndarray
    """(N, N) between cables [m]: 0.1 m for a falcon, at most half their distance at rest."""
    anchors: np.ndarray
    """(N, 3) [m]."""
    hooks: np.ndarray
    """(N, 3) [m]."""
    payload_half: np.ndarray
    """(3,) half edges of the payload [m]."""
    payload_center: tuple[float, float, float]
    """Its geometric centre from its centre of mass, in its frame [m]."""
    payload_round: bool
    """Whether it is a cylinder."""
    drone_half: np.ndarray
    """(N, 3) half edges of a drone [m]."""


def make_limits(system: System) -> Limits:
    """Return the limits of `system`."""
    n, anchors, ends = system.num_drones, system.anchors, system.cable_ends
    cables = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            if i != j:
                rest = segment_distance(tuple(anchors[i]), tuple(ends[i]), tuple(anchors[j]), tuple(ends[j]))
                cables[i, j] = min(_CABLE_DISTANCE * system.min_separation[i, j] / MIN_SEPARATION, 0.5 * rest)
    return Limits(
        separation=system.min_separation,
        cables=cables,
        anchors=np.ascontiguousarray(anchors),
        hooks=np.ascontiguousarray(system.hooks),
        payload_half=system.payload_size / 2,
        payload_center=triple(system.payload_center),
        payload_round=system.payload_shape == "cylinder",
        drone_half=np.array([drone_half_size(vehicle) for vehicle in system.vehicles]),
    )


@kernel
def find_failures(lo, hi, state, errors, limits, watch, cause, min_separation):
    """Write the first failure cause (0: none) of environments lo to hi; update the least separation (E,) [m]."""
    for e in range(lo, hi):
        cause[e] = _cause(e, state, errors, limits, watch, min_separation)


def ignore(*causes: int) -> int:
    """Return the value of `Watch.forgiven` that lets pass `causes`."""
    return sum(1 << cause for cause in causes)


@kernel
def _counts(cause, ignored):
    """Return whether a cause is a failure."""
    return (ignored >> cause) & 1 == 0


@kernel
def _cause(e, state, errors, limits, watch, min_separation):
    ignored = watch.ignored[e]
    payload, attitude = row(state.payload_position, e), matrow(state.payload_rotation, e)
    up = column(attitude, 2)
    count = state.drone_position.shape[1]
    if not errors.distance[e] <= MAX_DISTANCE:
        return RANGE
    if payload_height(payload, attitude, limits) < TOUCH and _counts(LOAD_GROUND, ignored):
        return GROUND
    for n in range(count):
        if watch.lost[e, n]:
            continue
        drone, frame = vec(state.drone_position, e, n), mat(state.drone_rotation, e, n)
        anchor = add(payload, mul(attitude, (limits.anchors[n, 0], limits.anchors[n, 1], limits.anchors[n, 2])))
        end = hook_position(e, n, state, limits.hooks)
        cable = unit(sub(end, anchor))
        if drone[2] - _extent(frame, limits.drone_half[n]) < TOUCH and _counts(GROUND, ignored):
            return GROUND
        if state.cable_broken[e, n] and _counts(BROKEN, ignored):
            return BROKEN
        if frame[8] < _MIN_UP and _counts(TILT, ignored):
            return TILT
        if drone[2] < payload[2] and _counts(BELOW, ignored):
            return BELOW
        if dot(cable, column(frame, 2)) < 0.0 or dot(cable, up) < _MIN_CABLE_PAYLOAD:
            if _counts(CABLE, ignored):
                return CABLE
        for m in range(n):
            if watch.lost[e, m]:
                continue
            apart = norm(sub(drone, vec(state.drone_position, e, m)))
            min_separation[e] = min(min_separation[e], apart)
            if apart < limits.separation[n, m] and _counts(COLLISION, ignored):
                return COLLISION
            foot = add(payload, mul(attitude, (limits.anchors[m, 0], limits.anchors[m, 1], limits.anchors[m, 2])))
            other = hook_position(e, m, state, limits.hooks)
            if segment_distance(anchor, end, foot, other) < limits.cables[n, m] and _counts(CROSSING, ignored):
                return CROSSING
    return 0


@kernel
def payload_height(payload, attitude, limits):
    """Return the height of the lowest point of a payload [m] at `payload` [m] with `attitude`, 9 numbers."""
    half, center = limits.payload_half, add(payload, mul(attitude, limits.payload_center))
    return center[2] - (_round_extent(attitude, half) if limits.payload_round else _extent(attitude, half))


@kernel
def _round_extent(attitude, half):
    """Return how far an upright cylinder reaches below its centre [m]."""
    return sqrt(max(1.0 - attitude[8] * attitude[8], 0.0)) * half[0] + abs(attitude[8]) * half[2]


@kernel
def _extent(attitude, half):
    """Return how far a box reaches below its centre [m]."""
    return abs(attitude[6]) * half[0] + abs(attitude[7]) * half[1] + abs(attitude[8]) * half[2]
