"""MuJoCo's generalised coordinates and the physical state: reading one from the other, and writing it."""

from __future__ import annotations

from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np
from mujoco.batch import Batch

from multilift_marl._jit import kernel
from multilift_marl.math3d import (
    add,
    cross,
    dot,
    mat,
    mat_to_quat,
    matrow,
    mul,
    norm,
    put,
    putmat,
    quat_to_mat,
    row,
    scale,
    sub,
    vec,
)
from multilift_marl.rig.system import System
from multilift_marl.sim.hover import hook_position
from multilift_marl.sim.inertia import Inertias, mobility, point_motion
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.scene import Layout
from multilift_marl.sim.snatch import snatch_peak

MAX_SPEED = 100.0  # [m/s] beyond this a simulation has diverged
MAX_RATE = 500.0  # [rad/s]
MAX_STRETCH = 0.2  # [-] of a cable's length


class StateLayout(NamedTuple):
    """Where things are, for reading and writing states."""

    timestep: float
    anchors: np.ndarray
    """(N, 3) [m]."""
    hooks: np.ndarray
    """(N, 3) [m]."""
    cable_length: np.ndarray
    """(E, N) [m]."""
    cable_stiffness: np.ndarray
    """(E, N) [N/m]."""
    cable_damping: np.ndarray
    """(N,) [N s/m]."""
    breaking_load: np.ndarray
    """(N,) [N]."""
    inertias: Inertias
    qpos: int
    """Offset of qpos in a row of `batch.state`; likewise the next one."""
    qvel: int
    payload_nq: int
    payload_nv: int


def make_state_layout(
    system: System, layout: Layout, parameters: Parameters, inertias: Inertias, batch: Batch
) -> StateLayout:
    """Return the places of `system` with live `parameters` in the rows of a batch."""
    return StateLayout(
        timestep=system.timestep,
        anchors=np.ascontiguousarray(system.anchors),
        hooks=np.ascontiguousarray(system.hooks),
        cable_length=parameters.cable_length,
        cable_stiffness=parameters.cable_stiffness,
        cable_damping=np.ascontiguousarray(system.cable_damping),
        breaking_load=system.breaking_load,
        inertias=inertias,
        qpos=field_offset(batch, "qpos"),
        qvel=field_offset(batch, "qvel"),
        payload_nq=layout.payload_nq,
        payload_nv=layout.payload_nv,
    )


def field_offset(batch: Batch, name: str) -> int:
    """Return where a state field starts in a row of `batch.state`."""
    view = batch.bind(name)
    start = view.__array_interface__["data"][0] - batch.state.__array_interface__["data"][0]
    return start // batch.state.itemsize


@kernel
def read_state(rows, lo, hi, tension, state, stats, diverged, c):
    """Read the physical state out of `batch.state` and mark environments that have diverged.

    A diverged environment keeps its last sound state.

    Args:
        rows: `batch.state` of environments lo to hi.
        lo, hi: the environments.
        tension: cable tensions of the last physics step (hi - lo, N) [N].
        state, record: written.
        diverged: (E,) bool, set, never cleared.
        c: Places.
    """
    for e in range(lo, hi):
        line = rows[e - lo]
        if diverged[e] or not _sound(e, line, tension[e - lo], c):
            diverged[e] = True
            continue
        at, v = c.qpos + c.payload_nq, c.qvel + c.payload_nv
        slack = False
        for n in range(tension.shape[1]):
            if tension[e - lo, n] > 0.0 and state.cable_tension[e, n] == 0.0:
                peak = _find_peak(e, n, line, tension[e - lo, n], state, c)
                stats.tension_peak[e] = max(stats.tension_peak[e], peak)
                state.cable_broken[e, n] = state.cable_broken[e, n] or peak > c.breaking_load[n]
            for j in range(3):
                state.drone_position[e, n, j] = line[at + j]
                state.drone_velocity[e, n, j] = line[v + j]
                state.drone_body_rates[e, n, j] = line[v + 3 + j]
            putmat(state.drone_rotation[e, n], quat_to_mat(line[at + 3], line[at + 4], line[at + 5], line[at + 6]))
            at += 7
            v += 6
            state.cable_tension[e, n] = tension[e - lo, n]
            slack = slack or tension[e - lo, n] <= 0.0
        read_payload(e, line, state, c)
        if slack:
            stats.slack_time[e] += c.timestep
    note_tensions(lo, hi, diverged, False, state, stats, c)


@kernel
def _find_peak(e, n, line, tension, state, c):
    """Return the peak of the snatch of cable n, which went taut before the step that has just been made [N].

    The state is that before the step, `line` that after it. The ends parted freely until the cable was taut.
    """
    anchor, hook = row(c.anchors, n), row(c.hooks, n)
    payload, drone = matrow(state.payload_rotation, e), mat(state.drone_rotation, e, n)
    if c.payload_nv == 3:
        payload = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    rates = row(state.payload_body_rates, e)
    low, low_velocity = point_motion(
        row(state.payload_position, e), payload, row(state.payload_velocity, e), rates, anchor
    )
    rates = vec(state.drone_body_rates, e, n)
    high, high_velocity = point_motion(
        vec(state.drone_position, e, n), drone, vec(state.drone_velocity, e, n), rates, hook
    )
    cable = sub(high, low)
    length = norm(cable)
    direction = scale(1.0 / length, cable)
    speed, stretch = dot(direction, sub(high_velocity, low_velocity)), length - c.cable_length[e, n]

    # What else pulls the ends apart follows from the velocities after the step.
    v = c.qvel
    after = (line[v], line[v + 1], line[v + 2])
    rates = (line[v + 3], line[v + 4], line[v + 5]) if c.payload_nv == 6 else (0.0, 0.0, 0.0)
    after = add(after, mul(payload, cross(rates, anchor)))
    v += c.payload_nv + 6 * n
    ending = add((line[v], line[v + 1], line[v + 2]), mul(drone, cross((line[v + 3], line[v + 4], line[v + 5]), hook)))
    gives = mobility(e, 0, payload, anchor, direction, c.inertias)
    gives += mobility(e, 1 + n, drone, hook, direction, c.inertias)
    acceleration = (dot(direction, sub(ending, after)) - speed) / c.timestep + gives * tension
    speed = sqrt(max(speed * speed - 2.0 * acceleration * max(stretch, 0.0), 0.0)) if speed > 0.0 else 0.0
    if speed == 0.0:
        return 0.0
    return snatch_peak(speed, acceleration, 1.0 / gives, c.cable_stiffness[e, n], c.cable_damping[n])


@kernel
def read_payload(e, line, state, c):
    """Read the payload's state out of a row of `batch.state`."""
    at, v = c.qpos, c.qvel
    for j in range(3):
        state.payload_position[e, j] = line[at + j]
        state.payload_velocity[e, j] = line[v + j]
    if c.payload_nv == 6:
        putmat(state.payload_rotation[e], quat_to_mat(line[at + 3], line[at + 4], line[at + 5], line[at + 6]))
        for j in range(3):
            state.payload_body_rates[e, j] = line[v + 3 + j]


@kernel
def note_tensions(lo, hi, chosen, which, state, stats, c):
    """Note in record how large the tensions in state are, and which cables break, where `chosen` (E,) is `which`.

    One call for all: handing over a named tuple costs two atomic operations for each of its arrays.
    """
    for e in range(lo, hi):
        if chosen[e] != which:
            continue
        for n in range(c.breaking_load.shape[0]):
            tension = state.cable_tension[e, n]
            if tension > c.breaking_load[n]:
                state.cable_broken[e, n] = True
            stats.tension_min[e] = min(stats.tension_min[e], tension)
            stats.tension_max[e] = max(stats.tension_max[e], tension)
            stats.tension_peak[e] = max(stats.tension_peak[e], tension)
            stats.stretch_max[e] = max(stats.stretch_max[e], tension / (c.cable_stiffness[e, n] * c.cable_length[e, n]))


@kernel
def _sound(e, line, tension, c):
    """Return whether a simulation's numbers are finite and within physical bounds."""
    v = c.qvel
    for j in range(c.payload_nv):
        bound = MAX_SPEED if j < 3 else MAX_RATE
        if not abs(line[v + j]) < bound:
            return False
    v += c.payload_nv
    for n in range(tension.shape[0]):
        for j in range(6):
            if not abs(line[v + 6 * n + j]) < (MAX_SPEED if j < 3 else MAX_RATE):
                return False
        if not tension[n] < MAX_STRETCH * c.cable_stiffness[e, n] * c.cable_length[e, n]:
            return False
    for j in range(c.payload_nq + 7 * tension.shape[0]):
        if not isfinite(line[c.qpos + j]):
            return False
    return True


@kernel
def write_state(rows, lo, hi, mask, state, stats, c):
    """Write the state of the environments in `mask` into `batch.state`; tensions follow from the stretch."""
    for e in range(lo, hi):
        if not mask[e]:
            continue
        line = rows[e - lo]
        clear_record(e, stats)
        write_payload(e, line, state, c)
        attitude = matrow(state.payload_rotation, e)
        at, v = c.qpos + c.payload_nq, c.qvel + c.payload_nv
        for n in range(state.drone_position.shape[1]):
            put(line[at : at + 3], vec(state.drone_position, e, n))
            q = mat_to_quat(mat(state.drone_rotation, e, n))
            line[at + 3], line[at + 4], line[at + 5], line[at + 6] = q
            put(line[v : v + 3], vec(state.drone_velocity, e, n))
            put(line[v + 3 : v + 6], vec(state.drone_body_rates, e, n))
            at += 7
            v += 6
            anchor = (c.anchors[n, 0], c.anchors[n, 1], c.anchors[n, 2])
            cable = sub(hook_position(e, n, state, c.hooks), add(row(state.payload_position, e), mul(attitude, anchor)))
            tension = c.cable_stiffness[e, n] * max(0.0, sqrt(dot(cable, cable)) - c.cable_length[e, n])
            state.cable_tension[e, n] = tension
    note_tensions(lo, hi, mask, True, state, stats, c)


@kernel
def write_payload(e, line, state, c):
    """Write the payload's state into a row of `batch.state`."""
    at, v = c.qpos, c.qvel
    put(line[at : at + 3], row(state.payload_position, e))
    put(line[v : v + 3], row(state.payload_velocity, e))
    if c.payload_nv == 6:
        q = mat_to_quat(matrow(state.payload_rotation, e))
        line[at + 3], line[at + 4], line[at + 5], line[at + 6] = q
        put(line[v + 3 : v + 6], row(state.payload_body_rates, e))


@kernel
def clear_record(e, stats):
    """Let the record of environment e start anew."""
    stats.energy[e], stats.slack_time[e] = 0.0, 0.0
    stats.tension_min[e], stats.tension_max[e], stats.tension_peak[e] = 1e9, 0.0, 0.0
    stats.stretch_max[e] = 0.0
