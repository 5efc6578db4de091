"""Failures common to all tasks, each a named cause."""

from __future__ import annotations

from math import cos, radians, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import inlined
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
from multilift_marl.sim.obstacle_distance import TeamBodies, least_clearance
from multilift_marl.sim.obstacles import count_hulls

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
    "obstacle_collision",  # a drone, a cable or the payload touches an obstacle
    "out_of_range",  # payload over 3 m from its target, whatever the vehicle; of navigate: outside its map
    "diverged",  # the simulation has failed, not the team
)
FIRST_OWN = len(CAUSES)  # the cause that a task's first own failure has, see `Task.FAILURES`
GROUND, COLLISION, CROSSING, CABLE, BELOW, TILT, BROKEN, WALL, OBSTACLE, RANGE, DIVERGED = range(1, len(CAUSES))
LOAD_GROUND = 0  # the payload's contact with the ground, to be ignored apart from the drones'

MAX_DISTANCE = 3.0  # [m]
_CABLE_DISTANCE = 0.1  # [m] for the span of a falcon
TOUCH = 0.005  # [m] what is no higher touches the ground, no farther an obstacle
SIGHT = 2.0  # [m] beyond which clearances are not computed
MAX_TILT = 80.0  # [deg] of a drone
_MIN_UP = cos(radians(MAX_TILT))
_MIN_CABLE_PAYLOAD = cos(radians(135.0))


class FailureMask(NamedTuple):
    """What does not count as a failure for now; all zero unless a task says otherwise."""

    ignored: np.ndarray
    """(E,) int64, a bit for every cause, see `ignore`."""
    lost: np.ndarray
    """(E, N) bool, drones that count no more."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> FailureMask:
        """Return a mask that ignores nothing."""
        return cls(np.zeros(num_envs, np.int64), np.zeros((num_envs, num_drones), bool))


class Limits(NamedTuple):
    """Lengths of the failures, scaled to the vehicles."""

    separation: np.ndarray
    """(N, N) between drones [m]."""
    cables: np.ndarray
    """(N, N) between cables [m]: 0.1 m for a falcon, at most half their distance at rest."""
    payload_half: np.ndarray
    """(3,) half edges of the payload [m]."""
    payload_center: tuple[float, float, float]
    """Its geometric centre from its centre of mass, in its frame [m]."""
    payload_round: bool
    """Whether it is a cylinder."""
    payload_ball: float
    """Radius of what stands for a point, else 0 [m]."""
    payload_hull: int
    """Row of `Obstacles.vertices` with the vertices of a mesh's hull from its geometric centre, else -1."""
    drone_half: np.ndarray
    """(N, 3) half edges of a drone [m]."""
    distance: float
    """Of the payload from its target [m]."""


def make_limits(system: System, distance: float = MAX_DISTANCE) -> Limits:
    """Return the limits of `system`, whose payload may be `distance` [m] from its target."""
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
        payload_half=system.payload_size / 2,
        payload_center=triple(system.payload_center),
        payload_round=system.payload_shape == "cylinder",
        payload_ball=system.payload_size[0] / 2 if system.payload_shape == "point" else 0.0,
        payload_hull=-1 if system.payload_mesh is None else count_hulls(system.scenery),
        drone_half=np.array([drone_half_size(vehicle) for vehicle in system.vehicles]),
        distance=distance,
    )


def least_height(system: System) -> float:
    """Return how high a payload that hangs level must be at least, so as not to touch the ground [m]."""
    return float(TOUCH + system.payload_size[2] / 2 - system.payload_center[2])


def ignore(*causes: int) -> int:
    """Return the value of `FailureMask.ignored` that lets `causes` pass."""
    return sum(1 << cause for cause in causes)


@inlined
def _counts(cause, ignored):
    """Return whether a cause is a failure."""
    return (ignored >> cause) & 1 == 0


@inlined
def find_cause(e, v):
    """Return the first failure cause of environment e (0: none); update its least separation [m].

    Args:
        e: the environment.
        v: View.
    """
    state, limits, mask, rig = v.state, v.limits, v.mask, v.rig
    ignored = mask.ignored[e]
    payload, attitude = row(state.payload_position, e), matrow(state.payload_rotation, e)
    up = column(attitude, 2)
    # `not a <= b` catches NaN, too. It cannot be ignored: beyond that nothing else means anything.
    if not v.errors.distance[e] <= limits.distance:
        return RANGE
    if payload_height(payload, attitude, limits) < TOUCH and _counts(LOAD_GROUND, ignored):
        return GROUND
    for n in range(state.drone_position.shape[1]):
        if mask.lost[e, n]:
            continue
        drone, frame = vec(state.drone_position, e, n), mat(state.drone_rotation, e, n)
        anchor = add(payload, mul(attitude, row(rig.anchors, n)))
        end = add(drone, mul(frame, row(rig.hooks, n)))
        cable = unit(sub(end, anchor))
        # each drone alone: ground, its cable, its tilt, its height
        if drone[2] - _extent(frame, limits.drone_half[n]) < TOUCH and _counts(GROUND, ignored):
            return GROUND
        broken = state.cable_broken[e, n]  # of a drone that is detached, too
        if broken and _counts(BROKEN, ignored):
            return BROKEN
        if frame[8] < _MIN_UP and _counts(TILT, ignored):
            return TILT
        if drone[2] < payload[2] and _counts(BELOW, ignored):
            return BELOW
        if not broken and _counts(CABLE, ignored):
            if dot(cable, column(frame, 2)) < 0.0 or dot(cable, up) < _MIN_CABLE_PAYLOAD:
                return CABLE
        # against those before it: drones, then cables
        for m in range(n):
            if mask.lost[e, m]:
                continue
            separation = norm(sub(drone, vec(state.drone_position, e, m)))
            v.min_separation[e] = min(v.min_separation[e], separation)
            if separation < limits.separation[n, m] and _counts(COLLISION, ignored):
                return COLLISION
            if broken or state.cable_broken[e, m]:
                continue
            foot = add(payload, mul(attitude, row(rig.anchors, m)))
            other = add(vec(state.drone_position, e, m), mul(mat(state.drone_rotation, e, m), row(rig.hooks, m)))
            if segment_distance(anchor, end, foot, other) < limits.cables[n, m] and _counts(CROSSING, ignored):
                return CROSSING
    return 0


@inlined
def find_obstacle(e, v):
    """Return OBSTACLE if anything of environment e touches an obstacle, else 0; update the clearance [m]."""
    team = TeamBodies(v.state, v.rig, v.limits, v.mask.lost)
    clearance = least_clearance(e, team, v.nodes, v.obstacles, SIGHT)
    v.clearance[e] = clearance
    v.min_clearance[e] = min(v.min_clearance[e], clearance)
    return OBSTACLE if clearance < TOUCH and _counts(OBSTACLE, v.mask.ignored[e]) else 0


@inlined
def payload_height(payload, attitude, limits):
    """Return the height of the lowest point of a payload [m] at `payload` [m] with `attitude`, 9 numbers."""
    half, center = limits.payload_half, add(payload, mul(attitude, limits.payload_center))
    return center[2] - (_round_extent(attitude, half) if limits.payload_round else _extent(attitude, half))


@inlined
def _round_extent(attitude, half):
    """Return how far an upright cylinder reaches below its centre [m]."""
    # sin θ r + |cos θ| h/2, with cos θ = R33.
    return sqrt(max(1.0 - attitude[8] * attitude[8], 0.0)) * half[0] + abs(attitude[8]) * half[2]


@inlined
def _extent(attitude, half):
    """Return how far a box reaches below its centre [m]."""
    # Support function of a box along -z: the third row of R holds the axes' heights.
    return abs(attitude[6]) * half[0] + abs(attitude[7]) * half[1] + abs(attitude[8]) * half[2]
