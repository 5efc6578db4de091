"""Targets of the payload, tilted ones too, drawn where the team can hold it at rest."""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.control.cable_forces import is_stable, place_balanced
from multilift_marl.control.formation import goal_hook, wrap
from multilift_marl.control.gains import make_gains
from multilift_marl.kernels.jit import drawing, kernel
from multilift_marl.math3d import add, matrow, mul, norm, put, putmat, row, scale, segment_distance, sub, turn, vec
from multilift_marl.mdp.failures import MAX_DISTANCE, Limits
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.trajectory import attitude_of
from multilift_marl.rig.system import System
from multilift_marl.schema.control import ControlConfig
from multilift_marl.schema.sections import RandomizationConfig

MAX_LEAP = MAX_DISTANCE - 0.25  # [m] from a target to the next one: nearer than what counts as failure
CLEARANCE = 0.1  # [m] of the payload from the ground at a target
ABOVE = 0.15  # of a cable's length, by which every drone is to be above the payload there
MARGIN = 1.2  # of distances between drones and cables at rest over those that count as failures
SOFT = 0.5  # of the stiffness with which drones hold their places, at which the payload is still to settle
MAX_REDRAWS = 1000


class Bounds(NamedTuple):
    """What a team can hold at rest."""

    tilts: bool
    """Whether it can hold a tilted payload at all: it takes three anchors that are not in line."""
    thrust: np.ndarray
    """(N,) of each drone with its weakest rotors [N]."""
    load: float
    """Heaviest payload over the nominal one."""
    drone: float
    """Heaviest drone over the nominal one."""
    separation: np.ndarray
    """(N, N) of drones [m]."""
    cables: np.ndarray
    """(N, N) distance between cables [m]."""
    half: np.ndarray
    """(3,) half edges of the payload [m]."""
    center: tuple[float, float, float]
    """Its geometric centre from its centre of mass, in its frame [m]."""
    stiffness: np.ndarray
    """(N,) with which drones hold their places [N/m]."""


def make_bounds(system: System, control: ControlConfig, limits: Limits, ranges: RandomizationConfig) -> Bounds:
    """Return the bounds of a team with what may be drawn in `ranges`, some margin left."""
    spread, gains = system.anchors - system.anchors.mean(axis=0), make_gains(control, system)
    return Bounds(
        tilts=bool(np.linalg.matrix_rank(spread, tol=1e-6) >= 2),
        thrust=np.array([0.9 * 4 * vehicle.rotor_thrust_max for vehicle in system.vehicles]) * ranges.weakest_rotor,
        load=1 + ranges.payload_mass,
        drone=1 + ranges.vehicle_mass,
        separation=MARGIN * limits.separation,
        cables=MARGIN * limits.cables,
        half=limits.payload_half,
        center=limits.payload_center,
        stiffness=SOFT * gains.mass * gains.k_p,
    )


@drawing
def draw_plan(e, rng, v, ranges):
    """Draw the poses of environment e, each anew until the team can hold it; return how many were drawn in vain, or -1.

    Args:
        e: the environment.
        rng: generator of the episode.
        v: View of task `pose`; its plan is written, its goal overwritten.
        ranges: of x and y [m], lowest and highest z [m], of yaw [rad], of roll and pitch [rad], where the
            start is level; the least and the largest share of the way from the last pose at which a target lies.
    """
    plan, goal, rig, bounds = v.own.plan, v.goal, v.rig, v.settings.holdable
    xy, low, high, yaw, tilt, nearest, farthest = ranges
    vain, k = 0, 0
    while k < plan.pose.shape[1]:
        lean = tilt if k > 0 and bounds.tilts else 0.0
        pose = plan.pose[e, k]
        pose[0], pose[1], pose[2] = rng.uniform(-xy, xy), rng.uniform(-xy, xy), rng.uniform(low, high)
        pose[3], pose[4], pose[5] = rng.uniform(-yaw, yaw), rng.uniform(-lean, lean), rng.uniform(-lean, lean)
        last = plan.pose[e, max(k - 1, 0)]
        if k > 0 and nearest < 1.0:  # each component goes as far; the heading turns the shorter way
            share = rng.uniform(nearest, farthest)
            # The same heading, written as the nearer one to the last: a share of the way is then not the long way
            # round.
            pose[3] = last[3] + wrap(pose[3] - last[3])
            for i in range(6):
                pose[i] = last[i] + share * (pose[i] - last[i])
            pose[3] = wrap(pose[3])
        put(goal.position[e], (pose[0], pose[1], pose[2]))
        putmat(goal.rotation[e], attitude_of(pose[3], pose[4], pose[5]))
        leap = norm((pose[0] - last[0], pose[1] - last[1], pose[2] - last[2]))
        held = place_balanced(e, goal, rig)
        if leap > MAX_LEAP or not (held and _within(e, goal, rig, bounds)):
            vain += 1
            if vain > MAX_REDRAWS:
                return -1
            continue
        # what the cables exert on the payload there, without their own weight, in the frame of the heading
        c, s = cos(pose[3]), -sin(pose[3])
        for n in range(rig.slots.shape[0]):
            cable_force = sub(vec(goal.cable_force, e, n), (0.0, 0.0, rig.cable_weight[n]))
            put(plan.cable_force[e, k, n], turn(c, s, cable_force))
        k += 1
    return vain


@kernel
def _within(e, goal, rig, bounds):
    """Return whether the team is within `bounds` at its goal."""
    target, position = matrow(goal.rotation, e), row(goal.position, e)
    half = bounds.half
    below = abs(target[6]) * half[0] + abs(target[7]) * half[1] + abs(target[8]) * half[2]
    if position[2] + mul(target, bounds.center)[2] - below < CLEARANCE:
        return False
    for n in range(rig.slots.shape[0]):
        slot, cable_weight = vec(goal.slots, e, n), (0.0, 0.0, rig.cable_weight[n])
        cable_force = sub(vec(goal.cable_force, e, n), cable_weight)
        carried = add(
            scale(bounds.load, cable_force), add(cable_weight, (0.0, 0.0, bounds.drone * rig.mass[n] * GRAVITY))
        )
        if norm(carried) > bounds.thrust[n]:
            return False
        if slot[2] - position[2] < ABOVE * rig.cable_length[n]:
            return False
        anchor = add(position, mul(target, (rig.anchors[n, 0], rig.anchors[n, 1], rig.anchors[n, 2])))
        for m in range(n):
            other = vec(goal.slots, e, m)
            foot = add(position, mul(target, (rig.anchors[m, 0], rig.anchors[m, 1], rig.anchors[m, 2])))
            if norm(sub(slot, other)) < bounds.separation[n, m]:
                return False
            end, beside = goal_hook(e, n, goal, rig), goal_hook(e, m, goal, rig)
            if segment_distance(anchor, end, foot, beside) < bounds.cables[n, m]:
                return False
    return target[8] > 1.0 - 1e-12 or is_stable(e, goal, rig, bounds.stiffness)
