"""The formation about the payload's target pose, and the smoothed references to it."""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    add,
    clip,
    heading,
    limit,
    matrow,
    mul,
    norm,
    put,
    row,
    scale,
    sub,
    thrust_frame,
    turn,
    vec,
)
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.constants import RigArrays

LEAP_SPEED = 20.0  # [m/s] of a slot from one control step to the next: what is faster was put elsewhere ...
LEAP_RATE = 50.0  # [rad/s] ... or turned at once


class Goal(NamedTuple):
    """The payload's target and the formation about it."""

    position: np.ndarray
    """(E, 3) target of the payload's centre of mass [m]."""
    rotation: np.ndarray
    """(E, 3, 3) target attitude."""
    yaw: np.ndarray
    """(E,) heading of the target [rad]."""
    slots: np.ndarray
    """(E, N, 3) place of each drone with the payload at rest at the target, world frame [m]."""
    slot_frame: np.ndarray
    """(E, N, 2) cosine and sine of the slot frame's heading: x points outward from the payload, z up."""
    cable_force: np.ndarray
    """(E, N, 3) nominal force of each drone on its cable there [N]."""
    drone_yaw: np.ndarray
    """(E,) heading of the team, the target's where a task does not say otherwise; a drone's own is `RigArrays.heading`
    from there [rad]."""
    velocity: np.ndarray
    """(E, 3) of a target that moves, and of its slots [m/s]; zero otherwise, like the next ones."""
    acceleration: np.ndarray
    """(E, 3) [m/s²]."""
    jerk: np.ndarray
    """(E, 3) [m/s³]."""
    drone_yaw_rate: np.ndarray
    """(E,) [rad/s]."""
    angular_velocity: np.ndarray
    """(E, 3) of a target that turns, world frame [rad/s]."""
    slot_velocity: np.ndarray
    """(E, N, 3) of each slot beside the target's, where the formation turns or changes [m/s]."""
    slot_acceleration: np.ndarray
    """(E, N, 3) of the same [m/s²]."""
    slot_jerk: np.ndarray
    """(E, N, 3) of the same [m/s³]."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> Goal:
        """Return empty goals."""
        e, n = num_envs, num_drones
        placed = ((e, 3), (e, 3, 3), (e,), (e, n, 3), (e, n, 2), (e, n, 3), (e,))
        moving = ((e, 3), (e, 3), (e, 3), (e,), (e, 3), (e, n, 3), (e, n, 3), (e, n, 3))
        return cls(*(np.zeros(shape) for shape in (*placed, *moving)))


class Reference(NamedTuple):
    """What the drones follow: a command, smoothed."""

    command: np.ndarray
    """(E, N, 3) commanded position [m]."""
    command_yaw: np.ndarray
    """(E, N) [rad]."""
    position: np.ndarray
    """(E, N, 3) [m]."""
    velocity: np.ndarray
    """(E, N, 3) [m/s]."""
    acceleration: np.ndarray
    """(E, N, 3) [m/s²]."""
    jerk: np.ndarray
    """(E, N, 3) [m/s³]."""
    yaw: np.ndarray
    """(E, N) [rad]."""
    yaw_rate: np.ndarray
    """(E, N) [rad/s]."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> Reference:
        """Return references at the origin."""
        e, n = num_envs, num_drones
        shapes = ((e, n, 3), (e, n), (e, n, 3), (e, n, 3), (e, n, 3), (e, n, 3), (e, n), (e, n))
        return cls(*(np.zeros(shape) for shape in shapes))


@kernel
def place_formation(e: int, goal: Goal, rig: RigArrays) -> None:
    """Write slots, slot frames and cable forces of environment e for its target pose."""
    target, position = matrow(goal.rotation, e), row(goal.position, e)
    yaw = heading(target)
    goal.yaw[e] = yaw
    goal.drone_yaw[e] = yaw
    c, s = cos(yaw), sin(yaw)
    for n in range(rig.slots.shape[0]):
        anchor = (rig.anchors[n, 0], rig.anchors[n, 1], rig.anchors[n, 2])
        cable = sub((rig.slots[n, 0], rig.slots[n, 1], rig.slots[n, 2]), anchor)
        # Anchors tilt with the target, cables and slots turn with its heading alone: drones stay above a tilted
        # payload.
        put(goal.slots[e, n], add(add(position, mul(target, anchor)), turn(c, s, cable)))
        put(goal.cable_force[e, n], turn(c, s, (rig.force[n, 0], rig.force[n, 1], rig.force[n, 2])))
        turn_slot_frame(e, n, yaw, goal, rig)


@kernel
def turn_slot_frame(e, n, yaw, goal, rig):
    """Let the slot frame of drone n be that of a team of heading `yaw` [rad]."""
    goal.slot_frame[e, n, 0] = cos(yaw + rig.azimuth[n])
    goal.slot_frame[e, n, 1] = sin(yaw + rig.azimuth[n])


@kernel
def goal_arm(e, n, goal, rig, yaw):
    """Return the hook of drone n from its centre, at rest in a team of heading `yaw` at the target, world frame [m]."""
    return hook_arm(n, vec(goal.cable_force, e, n), yaw, rig)


@kernel
def hook_arm(n, cable_force, yaw, rig):
    """Return the hook of drone n from its centre, at rest with a cable force [N] in a team of heading `yaw` [m]."""
    if not rig.hooked:
        return (0.0, 0.0, 0.0)
    force = add(cable_force, (0.0, 0.0, rig.mass[n] * GRAVITY))
    return mul(thrust_frame(force, yaw + rig.heading[n]), row(rig.hooks, n))


@kernel
def goal_hook(e, n, goal, rig):
    """Return where the hook of drone n is at the target, world frame [m]."""
    return add(vec(goal.slots, e, n), goal_arm(e, n, goal, rig, goal.drone_yaw[e]))


@kernel
def set_heading(e, yaw, goal, rig):
    """Give the team of environment e another heading than the target's; its hooks stay where they are."""
    if rig.hooked:
        for n in range(rig.slots.shape[0]):
            turned = sub(goal_arm(e, n, goal, rig, goal.drone_yaw[e]), goal_arm(e, n, goal, rig, yaw))
            put(goal.slots[e, n], add(vec(goal.slots, e, n), turned))
    goal.drone_yaw[e] = yaw


@kernel
def start_reference(e, state, reference):
    """Let the references of environment e start where its drones are, at their velocities and headings."""
    for n in range(reference.yaw.shape[1]):
        put(reference.position[e, n], vec(state.drone_position, e, n))
        put(reference.velocity[e, n], vec(state.drone_velocity, e, n))
        reference.acceleration[e, n] = 0.0
        reference.jerk[e, n] = 0.0
        reference.yaw[e, n] = heading(matrow(state.drone_rotation[e], n))
        reference.yaw_rate[e, n] = 0.0


class Smoothing(NamedTuple):
    """How references follow their commands."""

    frequency: float
    """ω of the filters [rad/s]."""
    speed: float
    """Largest steady speed [m/s]."""
    dt: float
    """Control step [s]."""


@kernel
def smooth(lo, hi, reference, smoothing):
    """Move the references of environments lo to hi one control step towards their commands.

    Position: a critically damped third-order filter, (s/ω + 1)³, whose input is limited so that far commands are
    approached at the smoothing's speed; yaw: a second-order one.
    """
    w, dt = smoothing.frequency, smoothing.dt
    # In steady motion the filter's jerk and acceleration are 0: ω³ gap = 3 ω² v, so a gap of 3 v/ω gives the speed v.
    reach = 3.0 * smoothing.speed / w
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            p, v, a = vec(reference.position, e, n), vec(reference.velocity, e, n), vec(reference.acceleration, e, n)
            gap = limit(sub(vec(reference.command, e, n), p), reach)
            jerk = sub(scale(w * w * w, gap), add(scale(3.0 * w * w, v), scale(3.0 * w, a)))
            # Semi-implicit Euler: each derivative moves on by the new one above it.
            a = add(a, scale(dt, jerk))
            v = add(v, scale(dt, a))
            put(reference.position[e, n], add(p, scale(dt, v)))
            put(reference.velocity[e, n], v)
            put(reference.acceleration[e, n], a)
            put(reference.jerk[e, n], jerk)
            smooth_yaw(e, n, reference, w, dt)


@kernel
def to_goal_frame(lo, hi, reference, goal, before):
    """Make the references of environments lo to hi relative to the slots and motion of their goals, which then move on.

    `smooth_moving` makes them absolute again. In between, references ride along: only commands are smoothed, so a
    moving target is followed without lag. `before` (Reference) keeps them as they were, its commands the slots.
    """
    for e in range(lo, hi):
        velocity, acceleration = row(goal.velocity, e), row(goal.acceleration, e)
        for n in range(reference.yaw.shape[1]):
            # Keep slot and reference.
            put(before.command[e, n], vec(goal.slots, e, n))
            put(before.position[e, n], vec(reference.position, e, n))
            put(before.velocity[e, n], vec(reference.velocity, e, n))
            put(before.acceleration[e, n], vec(reference.acceleration, e, n))
            before.command_yaw[e, n] = goal.drone_yaw[e]
            before.yaw[e, n] = reference.yaw[e, n]
            before.yaw_rate[e, n] = reference.yaw_rate[e, n]

            # Make the reference relative.
            put(reference.position[e, n], sub(vec(reference.position, e, n), vec(goal.slots, e, n)))
            own_velocity = add(velocity, vec(goal.slot_velocity, e, n))
            own_acceleration = add(acceleration, vec(goal.slot_acceleration, e, n))
            put(reference.velocity[e, n], sub(vec(reference.velocity, e, n), own_velocity))
            put(reference.acceleration[e, n], sub(vec(reference.acceleration, e, n), own_acceleration))
            reference.yaw[e, n] -= goal.drone_yaw[e]
            reference.yaw_rate[e, n] -= goal.drone_yaw_rate[e]


@kernel
def smooth_moving(lo, hi, reference, goal, before, smoothing):
    """Do as `smooth`, about goals that move; see `to_goal_frame`.

    References of slots that leap stay where they were and are smoothed from there.
    """
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            if _has_leapt(e, n, goal, before, smoothing.dt):
                _stay(e, n, reference, goal, before)
            else:
                put(reference.position[e, n], add(vec(reference.position, e, n), vec(goal.slots, e, n)))
                reference.yaw[e, n] += goal.drone_yaw[e]
    smooth(lo, hi, reference, smoothing)
    for e in range(lo, hi):
        velocity, acceleration, jerk = row(goal.velocity, e), row(goal.acceleration, e), row(goal.jerk, e)
        for n in range(reference.yaw.shape[1]):
            own_velocity = add(velocity, vec(goal.slot_velocity, e, n))
            own_acceleration = add(acceleration, vec(goal.slot_acceleration, e, n))
            put(reference.velocity[e, n], add(vec(reference.velocity, e, n), own_velocity))
            put(reference.acceleration[e, n], add(vec(reference.acceleration, e, n), own_acceleration))
            put(reference.jerk[e, n], add(vec(reference.jerk, e, n), add(jerk, vec(goal.slot_jerk, e, n))))
            reference.yaw_rate[e, n] += goal.drone_yaw_rate[e]


@kernel
def _has_leapt(e, n, goal, before, dt):
    """Return whether slot or heading of a drone has moved farther in a control step `dt` [s] than a vehicle can."""
    moved = norm(sub(vec(goal.slots, e, n), vec(before.command, e, n)))
    turned = abs(wrap(goal.drone_yaw[e] - before.command_yaw[e, n]))
    return moved > LEAP_SPEED * dt or turned > LEAP_RATE * dt


@kernel
def _stay(e, n, reference, goal, before):
    """Put a reference back to where it was, its motion relative to that of its slot."""
    own_velocity = add(row(goal.velocity, e), vec(goal.slot_velocity, e, n))
    own_acceleration = add(row(goal.acceleration, e), vec(goal.slot_acceleration, e, n))
    put(reference.position[e, n], vec(before.position, e, n))
    put(reference.velocity[e, n], sub(vec(before.velocity, e, n), own_velocity))
    put(reference.acceleration[e, n], sub(vec(before.acceleration, e, n), own_acceleration))
    reference.yaw[e, n] = before.yaw[e, n]
    reference.yaw_rate[e, n] = before.yaw_rate[e, n] - goal.drone_yaw_rate[e]


@kernel
def smooth_yaw(e, n, reference, frequency, dt):
    """Move the yaw of one drone's reference one control step towards its command, the short way."""
    w = frequency
    gap = wrap(reference.command_yaw[e, n] - reference.yaw[e, n])
    rate = reference.yaw_rate[e, n]
    # A gap beyond 1 rad counts as 1: half a turn then takes no more rate than the filter's ω/2.
    rate += dt * (w * w * clip(gap, -1.0, 1.0) - 2.0 * w * rate)
    reference.yaw_rate[e, n] = rate
    reference.yaw[e, n] += dt * rate


@kernel
def wrap(angle):
    """Return the angle in (-π, π]."""
    angle = np.fmod(angle, 2.0 * pi)
    if angle > pi:
        return angle - 2.0 * pi
    return angle + 2.0 * pi if angle <= -pi else angle
