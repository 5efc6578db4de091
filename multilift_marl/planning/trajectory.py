"""The planned trajectory of a payload from pose to pose, from rest to rest, and of the formation that carries it.

Slots that merely moved to a target half a turn away would meet in the middle. Here the target itself moves and turns
smoothly. Its motion determines the force and the moment that the payload needs, these the cable forces, and these the
slots (differential flatness, Sreenath and Kumar, RSS 2013).
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.control.cable_forces import distribute_wrench, drone_offset, place_slots
from multilift_marl.control.formation import hook_arm, place_formation, turn_slot_frame, wrap
from multilift_marl.kernels.jit import inlined, kernel
from multilift_marl.math3d import (
    add,
    cross,
    ease,
    heading,
    mat,
    matmul,
    matrow,
    mul,
    norm,
    put,
    putmat,
    rot_z,
    row,
    scale,
    segment_distance,
    sub,
    transpose,
    turn,
    vec,
)
from multilift_marl.mdp.env_data import load_row
from multilift_marl.physical import GRAVITY

CANDIDATES = (  # the usual one first: whether to turn the longer way round, and two shares, see `Plan.course`
    (False, 0.5, 0.0),
    (False, 1.0, 0.3),
    (True, 0.25, 0.3),
    (False, 1.0, 0.0),
    (False, 0.0, 0.3),
    (True, 0.0, 0.6),
    (False, 0.75, -0.3),
)
ACCEPT_ACCELERATION = 5.0  # [m/s²] of a slot, about: the first candidate that asks for no more is taken
MIN_IMPROVEMENT = 0.95  # of the peak of the candidate before, at most, for another one to be taken
CONTACT_PENALTY = 30.0  # [m/s²] that drones or cables that touch count as; in proportion, those closer than allowed
_SAMPLES = 60  # of a trajectory, by which candidates are compared


class Plan(NamedTuple):
    """The poses of an episode: K targets, before them the start."""

    pose: np.ndarray
    """(E, K + 1, 6) x, y, z [m], yaw, roll, pitch [rad]; the attitude is Rz(yaw) Rx(roll) Ry(pitch)."""
    cable_force: np.ndarray
    """(E, K + 1, N, 3) of the cables on the payload at rest there, in the frame turned by the yaw alone [N]."""
    course: np.ndarray
    """(E, K, 3) of the trajectory to each target: by how much it turns [rad], which share of roll and pitch is taken
    away half-way (a payload that turns takes smaller forces the less it tilts), and which share the cable forces of the
    level start have there, where a negative one leads away from them."""
    stage: np.ndarray
    """(E,) int64, which target is the present one, from 0."""

    @classmethod
    def zeros(cls, num_envs: int, targets: int, num_drones: int) -> Plan:
        """Return empty plans."""
        e, k = num_envs, targets
        pose, cable_force = np.zeros((e, k + 1, 6)), np.zeros((e, k + 1, num_drones, 3))
        return cls(pose, cable_force, np.zeros((e, k, 3)), np.zeros(e, np.int64))


@kernel
def attitude_of(yaw, roll, pitch):
    """Return Rz(yaw) Rx(roll) Ry(pitch), whose heading is `yaw`."""
    return matmul(rot_z(yaw), _tilt(roll, pitch))


@kernel
def _tilt(roll, pitch):
    cr, sr, cp, sp = cos(roll), sin(roll), cos(pitch), sin(pitch)
    return (cp, 0.0, sp, sr * sp, cr, -sr * cp, -cr * sp, sr, cr * cp)


@kernel
def set_goal_from_plan(e, k, plan, goal, rig):
    """Let pose k of the plan be the goal of environment e: its slots and cable forces too."""
    pose = plan.pose[e, k]
    put(goal.position[e], (pose[0], pose[1], pose[2]))
    putmat(goal.rotation[e], attitude_of(pose[3], pose[4], pose[5]))
    place_formation(e, goal, rig)
    c, s = cos(pose[3]), sin(pose[3])
    for n in range(rig.slots.shape[0]):
        put(goal.cable_force[e, n], turn(c, s, mat_row(plan.cable_force, e, k, n)))
    place_slots(e, goal, rig)


@kernel
def mat_row(a, i, j, n):
    """Return row (i, j, n) of an array of four axes."""
    return (a[i, j, n, 0], a[i, j, n, 1], a[i, j, n, 2])


@kernel
def select_candidate(e, v):
    """Choose the course to each target of environment e: the first of `CANDIDATES` that is gentle, else the gentlest.

    The measure is the acceleration of a slot: a drone whose cable is nearly slack is swung about by little changes.

    Args:
        e: the environment.
        v: View of task `pose`; its courses are written, its time and plan overwritten.
    """
    plan = v.own.plan
    for k in range(plan.course.shape[1]):
        least, best = np.inf, 0
        for i in range(len(CANDIDATES)):
            _set_course(e, k, plan, i)
            # It overwrites the view's time, the plan's stage and the planned pose.
            peak = _peak_acceleration(e, k, v)
            if peak < MIN_IMPROVEMENT * least:
                least, best = peak, i
            if peak <= ACCEPT_ACCELERATION:
                break
        _set_course(e, k, plan, best)
    v.time[e] = 0.0


@kernel
def _set_course(e, k, plan, i):
    """Let the trajectory to target k have candidate i."""
    longer, dip, level = CANDIDATES[i]
    turned = wrap(plan.pose[e, k + 1, 3] - plan.pose[e, k, 3])
    put(plan.course[e, k], (turned - 2.0 * pi * np.sign(turned) if longer else turned, dip, level))


@inlined
def _peak_acceleration(e, k, v):
    """Return the largest acceleration of a slot on the way to target k [m/s²], more if drones or cables come close."""
    plan, planned, rig, bounds = v.own.plan, v.planned, v.rig, v.settings.holdable
    hold_plan_pose(e, k, plan, planned, rig)
    plan.stage[e] = k
    most, room, dt = 0.0, 1.0, v.settings.seconds / _SAMPLES
    for i in range(_SAMPLES):
        v.time[e] = k * v.settings.hold + (i + 1) * dt
        evaluate_plan(e, v, dt)
        position, attitude = row(planned.position, e), matrow(planned.rotation, e)
        for n in range(rig.slots.shape[0]):
            most = max(most, norm(add(row(planned.acceleration, e), vec(planned.slot_acceleration, e, n))))
            slot, foot = vec(planned.slots, e, n), add(position, mul(attitude, row(rig.anchors, n)))
            for m in range(n):
                other, beside = vec(planned.slots, e, m), add(position, mul(attitude, row(rig.anchors, m)))
                room = min(room, norm(sub(slot, other)) / bounds.separation[n, m])
                room = min(room, segment_distance(foot, slot, beside, other) / bounds.cables[n, m])
    return most if room >= 1.0 else max(most, ACCEPT_ACCELERATION) + CONTACT_PENALTY * (1.0 - room)


@kernel
def hold_plan_pose(e, k, plan, planned, rig):
    """Let the planned trajectory of environment e be at rest at pose k of the plan."""
    set_goal_from_plan(e, k, plan, planned, rig)
    for moving in (planned.velocity, planned.acceleration, planned.jerk, planned.angular_velocity):
        moving[e] = 0.0
    for moving in (planned.slot_velocity, planned.slot_acceleration, planned.slot_jerk):
        moving[e] = 0.0
    planned.drone_yaw_rate[e] = 0.0


@inlined
def advance_plan(e, v):
    """Move the planned pose of environment e on to its time, and its goal where a new target's time has come."""
    plan = v.own.plan
    # Time is a sum of steps, which round-off may leave short of `hold` or beyond it: half a step off, it is neither.
    stage = min(int((v.time[e] - 0.5 * v.control_dt) / v.settings.hold), plan.pose.shape[1] - 2)
    if stage != plan.stage[e]:
        plan.stage[e] = stage
        set_goal_from_plan(e, stage + 1, plan, v.goal, v.rig)
    if v.has_plan:
        evaluate_plan(e, v, v.control_dt)
    else:
        for n in range(v.rig.slots.shape[0]):
            turn_team(e, n, heading(mat(v.payload_estimate.rotation, e, load_row(n, v))), v)
    if v.rig.is_point:  # its attitude is that of the plan, or of the goal
        putmat(v.state.payload_rotation[e], matrow(v.planned.rotation, e))


@inlined
def turn_team(e, n, yaw, v):
    """Let the slot frame of drone n, and the cable force that it feeds forward, be those of a team of heading `yaw`.

    Without a plan the target may be half a turn away, and there its cable pulls the other way.
    """
    plan, c, s = v.own.plan, cos(yaw), sin(yaw)
    turn_slot_frame(e, n, yaw, v.goal, v.rig)
    cable_force = turn(c, s, mat_row(plan.cable_force, e, plan.stage[e] + 1, n))
    put(v.goal.cable_force[e, n], add(cable_force, (0.0, 0.0, v.rig.cable_weight[n])))


@inlined
def evaluate_plan(e, v, dt):
    """Write the planned pose of environment e at its time, `dt` [s] after the last one, and where the drones are then.

    Settings are `hold` and `seconds`, how long each target stays and the trajectory to it takes [s], `inertia` of the
    payload, 9 numbers [kg m²], and `distribution`, a WrenchDistribution over the anchors.
    """
    plan, planned, rig = v.own.plan, v.planned, v.rig
    count, k = rig.slots.shape[0], plan.stage[e]
    seconds = v.settings.seconds
    gone = v.time[e] - k * v.settings.hold
    if gone >= seconds + 4.5 * dt:  # a little later than the trajectory ends: the differences of the slots are zero
        return

    # pose, velocities and accelerations: position and angles go from rest to rest together
    s, ds, dds, ddds = ease(gone, 0.0, seconds)
    a, b = plan.pose[e, k], plan.pose[e, k + 1]
    before, start, step = row(planned.position, e), (a[0], a[1], a[2]), (b[0] - a[0], b[1] - a[1], b[2] - a[2])
    turned, dip, level = plan.course[e, k]
    yaw = a[3] + s * turned
    roll, rolled, rolling = _dipped(a[4], b[4], s, dip)
    pitch, pitched, pitching = _dipped(a[5], b[5], s, dip)
    attitude, position = attitude_of(yaw, roll, pitch), add(start, scale(s, step))
    spin, swing = _spin(yaw, roll, turned, rolled, pitched)
    # ω = ṡ spin(s), so that ω̇ = s̈ spin + ṡ² d(spin)/ds; d/ds is `swing` at steady rates and the second derivatives of
    # roll and pitch in place of the first.
    swing = add(swing, _spin(yaw, roll, 0.0, rolling, pitching)[0])
    acceleration, angular_acceleration = scale(dds, step), add(scale(dds, spin), scale(ds * ds, swing))
    rates, c, si = scale(ds, spin), cos(yaw), sin(yaw)
    put(planned.position[e], position)
    put(planned.velocity[e], scale(ds, step))
    put(planned.acceleration[e], acceleration)
    put(planned.jerk[e], scale(ddds, step))
    put(planned.angular_velocity[e], rates)
    putmat(planned.rotation[e], attitude)
    planned.yaw[e] = yaw
    planned.drone_yaw[e] = yaw
    planned.drone_yaw_rate[e] = ds * turned

    # the cable forces of the two poses, mixed, lack some of the force and the moment of this motion
    body = matmul(matmul(attitude, v.settings.inertia), transpose(attitude))
    # Euler's equation in the world frame, J = R J_b Rᵀ.
    moment = add(mul(body, angular_acceleration), cross(rates, mul(body, rates)))
    force = scale(rig.payload_mass, add(acceleration, (0.0, 0.0, GRAVITY)))
    share = level * 16.0 * s * s * (1.0 - s) * (1.0 - s)
    for n in range(count):
        old, new = mat_row(plan.cable_force, e, k, n), mat_row(plan.cable_force, e, k + 1, n)
        mixed = scale(1.0 - share, add(scale(1.0 - s, old), scale(s, new)))
        cable_force = turn(c, si, add(mixed, scale(share, mat_row(plan.cable_force, e, 0, n))))
        put(planned.cable_force[e, n], cable_force)
        force = sub(force, cable_force)
        moment = sub(moment, cross(mul(attitude, row(rig.anchors, n)), cable_force))
    linear, angular = distribute_wrench(force, moment, attitude, v.settings.distribution)

    # slots where the drones exert these forces, and their motion by differences
    moved = sub(position, before)
    for n in range(count):
        arm = mul(attitude, row(rig.anchors, n))
        cable_force = add(vec(planned.cable_force, e, n), add(linear, cross(angular, arm)))
        held = add(cable_force, (0.0, 0.0, rig.cable_weight[n]))
        hook = add(add(position, arm), drone_offset(n, cable_force, rig))
        slot = sub(hook, hook_arm(n, held, yaw, rig))
        velocity, past = vec(planned.slot_velocity, e, n), vec(planned.slot_acceleration, e, n)
        # Beside the payload's own motion, which the goal's velocity has already.
        gained = scale(1.0 / dt, sub(sub(slot, vec(planned.slots, e, n)), moved))
        change = scale(1.0 / dt, sub(gained, velocity))
        put(planned.slots[e, n], slot)
        put(planned.slot_velocity[e, n], gained)
        put(planned.slot_acceleration[e, n], change)
        put(planned.slot_jerk[e, n], scale(1.0 / dt, sub(change, past)))
        # the drones' controllers add the inertia of their share of the load, which these forces hold already
        load = rig.force[n, 2] / GRAVITY
        put(planned.cable_force[e, n], sub(held, scale(load, add(acceleration, change))))


@kernel
def preview_plan(times, plan, hold, seconds, position, rotation):
    """Write the planned places (E, M, 3) and attitudes (E, M, 3, 3) at times (E, M), see `evaluate_plan`."""
    for e in range(times.shape[0]):
        for m in range(times.shape[1]):
            k = min(max(int(times[e, m] / hold), 0), plan.pose.shape[1] - 2)
            s = ease(times[e, m] - k * hold, 0.0, seconds)[0]
            a, b = plan.pose[e, k], plan.pose[e, k + 1]
            turned, dip, _ = plan.course[e, k]
            put(position[e, m], (a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), a[2] + s * (b[2] - a[2])))
            roll, pitch = _dipped(a[4], b[4], s, dip)[0], _dipped(a[5], b[5], s, dip)[0]
            putmat(rotation[e, m], attitude_of(a[3] + s * turned, roll, pitch))


@kernel
def _dipped(start, end, s, by):
    """Return the angle at share s of the way from start to end, less half-way, and its two derivatives by s."""
    straight, change, u = start + s * (end - start), end - start, s * (1.0 - s)
    dip, first, second = 1.0 - by * 16.0 * u * u, -by * 32.0 * u * (1.0 - 2.0 * s), -by * 32.0 * (1.0 - 6.0 * u)
    return straight * dip, change * dip + straight * first, 2.0 * change * first + straight * second


@kernel
def _spin(yaw, roll, turned, rolled, pitched):
    """Return the angular velocity of an attitude whose angles change at these rates, and its change at steady rates."""
    c, s = cos(yaw), sin(yaw)
    leaning = turn(c, s, (rolled, cos(roll) * pitched, sin(roll) * pitched))
    bending = turn(c, s, (0.0, -sin(roll) * rolled * pitched, cos(roll) * rolled * pitched))
    # Angular velocity in the world frame: yaw about z; in the frame turned by the yaw roll about x, then pitch about
    # the y axis that roll has tilted.
    yawing = (0.0, 0.0, turned)
    return add(leaning, yawing), add(cross(yawing, leaning), bending)
