"""Chains: cables of masses, springs and dampers (report eqs 14-16) in MuJoCo's generalised coordinates.

Payload, links and drones are one tree without loops: the payload is the root, every cable a branch of n links, and the
drone the leaf on a ball joint. A link is a ball joint and a slide along it, whose spring nk and damper nc are the
joint's, so that the integrator treats them implicitly. Its mass, density times length, is at its upper end, the last
one's at the drone. docs/cables.md compares this with other forms.
"""

from __future__ import annotations

from math import isfinite
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.config.system import System
from multilift_marl.config.vehicles import GRAVITY
from multilift_marl.math3d import (
    add,
    column,
    cross,
    dot,
    from_columns,
    mat,
    mat_to_quat,
    matmul,
    matrow,
    mul,
    put,
    putmat,
    quat_to_mat,
    row,
    scale,
    sub,
    tmul,
    transpose,
    unit,
    vec,
)
from multilift_marl.sim.hanging import hang
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.rows import (
    MAX_RATE,
    MAX_SPEED,
    MAX_STRETCH,
    clear_record,
    note_tensions,
    read_payload,
    write_payload,
)
from multilift_marl.sim.scene import link_frame

_SENSORS = 13  # numbers of each drone: position, quaternion, velocity, body rates
_UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Chain(NamedTuple):
    """Numbers of the chains."""

    segments: np.ndarray
    """(N,) links."""
    coordinates: np.ndarray
    """(N + 1,) where each cable's coordinates start, counted from the payload's."""
    velocities: np.ndarray
    """(N + 1,) likewise."""
    frames: np.ndarray
    """(N, 3, 3) frame of the first link in the payload's, in the resting formation."""
    length: np.ndarray
    """(E, N) of a segment [m]; likewise the next ones."""
    stiffness: np.ndarray
    weight: np.ndarray
    damping: np.ndarray
    """(N,) of a segment [N s/m]."""


def make_chain(system: System, parameters: Parameters) -> Chain:
    """Return the chains of `system`, those of each environment by `parameters`."""
    n, shape = system.cable_segments, parameters.cable_length.shape
    chain = Chain(
        segments=n,
        coordinates=np.cumsum(np.append(0, 5 * n + 4)),
        velocities=np.cumsum(np.append(0, 4 * n + 3)),
        frames=np.stack([link_frame(force) for force in system.formation_force]),
        length=np.zeros(shape),
        stiffness=np.zeros(shape),
        weight=np.zeros(shape),
        damping=n * system.cable_damping,
    )
    divide_chains(chain, system, parameters)
    return chain


def divide_chains(chain: Chain, system: System, parameters: Parameters) -> None:
    """Write segments that make up the cables of every environment."""
    n, length = chain.segments, parameters.cable_length
    chain.length[:] = length / n
    chain.stiffness[:] = n * parameters.cable_stiffness
    chain.weight[:] = GRAVITY * (system.cable_mass * (length / system.cable_length)) / n


@kernel
def read_chains(rows, lo, hi, sensors, state, record, diverged, c, chain):
    """Read the physical state of teams on chains, as `rows.read_rows` does; tensions too are current.

    Args:
        rows: `batch.state` of environments lo to hi.
        lo, hi: the environments.
        sensors: 13 numbers of each drone (hi - lo, 13 N).
        state, record: written.
        diverged: (E,) bool, set, never cleared.
        c, chain: Places, Chain.
    """
    for e in range(lo, hi):
        line, told = rows[e - lo], sensors[e - lo]
        if diverged[e] or not _sound(e, line, told, state.cable_broken[e], c, chain):
            diverged[e] = True
            continue
        read_payload(e, line, state, c)
        slack = False
        for n in range(chain.segments.shape[0]):
            at = _SENSORS * n
            for j in range(3):
                state.drone_position[e, n, j] = told[at + j]
                state.drone_velocity[e, n, j] = told[at + 7 + j]
                state.drone_body_rates[e, n, j] = told[at + 10 + j]
            putmat(state.drone_rotation[e, n], quat_to_mat(told[at + 3], told[at + 4], told[at + 5], told[at + 6]))
            pull = 0.0 if state.cable_broken[e, n] else _tension(e, n, line, c, chain)
            state.cable_tension[e, n] = pull
            slack = slack or pull <= chain.segments[n] * chain.weight[e, n]  # the drone holds the cable alone
        if slack:
            record.slack_time[e] += c.timestep
    note_tensions(lo, hi, diverged, False, state, record, c)


@kernel
def _tension(e, n, line, c, chain):
    """Return the tension of cable n in its segment next to the drone [N]; 0 where that is pushed together."""
    at = c.qpos + c.payload_nq + chain.coordinates[n] + 5 * chain.segments[n] - 1
    v = c.qvel + c.payload_nv + chain.velocities[n] + 4 * chain.segments[n] - 1
    return max(0.0, chain.stiffness[e, n] * line[at] + chain.damping[n] * line[v])


@kernel
def _sound(e, line, told, broken, c, chain):
    """Return whether a simulation's numbers are finite and within physical bounds."""
    for j in range(c.payload_nv):
        if not abs(line[c.qvel + j]) < (MAX_SPEED if j < 3 else MAX_RATE):
            return False
    count = chain.segments.shape[0]
    for n in range(count):
        for j in range(7, _SENSORS):
            if not abs(told[_SENSORS * n + j]) < (MAX_SPEED if j < 10 else MAX_RATE):
                return False
        if (
            not broken[n]
            and not _tension(e, n, line, c, chain) < MAX_STRETCH * c.cable_stiffness[e, n] * c.cable_length[e, n]
        ):
            return False
        for j in range(7):
            if not isfinite(told[_SENSORS * n + j]):
                return False
    for j in range(c.payload_nq + chain.coordinates[count]):
        if not isfinite(line[c.qpos + j]):
            return False
    return True


@kernel
def write_chains(rows, lo, hi, mask, state, record, c, chain):
    """Write the state of the environments in `mask` into `batch.state`, as `rows.write_rows` does.

    A cable hangs between payload and drone as it would at rest, a slack one in an arc; its nodes move as if it were
    stretched evenly, those of an arc without stretch: its dampers would pull.
    """
    links = np.zeros((chain.segments.max(), 7))
    for e in range(lo, hi):
        if not mask[e]:
            continue
        line = rows[e - lo]
        clear_record(e, record)
        write_payload(e, line, state, c)
        attitude, spin = matrow(state.payload_rotation, e), row(state.payload_body_rates, e)
        if c.payload_nv == 3:
            attitude, spin = _UPRIGHT, (0.0, 0.0, 0.0)
        spin = mul(attitude, spin)
        for i in range(chain.segments.shape[0]):
            n = chain.segments[i]
            at, v = c.qpos + c.payload_nq + chain.coordinates[i], c.qvel + c.payload_nv + chain.velocities[i]
            anchor = mul(attitude, (c.anchors[i, 0], c.anchors[i, 1], c.anchors[i, 2]))
            drone = mat(state.drone_rotation, e, i)
            arm = mul(drone, row(c.hooks, i))
            chord = sub(add(vec(state.drone_position, e, i), arm), add(row(state.payload_position, e), anchor))
            turning = mul(drone, vec(state.drone_body_rates, e, i))
            end = add(vec(state.drone_velocity, e, i), cross(turning, arm))
            opening = sub(end, add(row(state.payload_velocity, e), cross(spin, anchor)))
            hang(chord, opening, chain.length[e, i], chain.stiffness[e, i], chain.weight[e, i], links[:n])
            frame, rate = matmul(attitude, matrow(chain.frames, i)), spin
            for j in range(n):
                direction, stretch = row(links, j), links[j, 3]
                frame, rate = _put_link(
                    line, at + 5 * j, v + 4 * j, frame, rate, direction, chain.length[e, i], stretch,
                    row(links[:, 4:], j),
                )  # fmt: skip
            at, v = at + 5 * n, v + 4 * n
            q = mat_to_quat(matmul(transpose(frame), drone))
            line[at], line[at + 1], line[at + 2], line[at + 3] = q
            put(line[v : v + 3], sub(vec(state.drone_body_rates, e, i), tmul(drone, rate)))
            state.cable_tension[e, i] = _tension(e, i, line, c, chain)
    note_tensions(lo, hi, mask, True, state, record, c)


@kernel
def _put_link(line, at, v, frame, rate, direction, length, stretch, opening):
    """Write turn, stretch and their rates of one link; return its frame and angular velocity, world frame.

    Args:
        line: row of `batch.state`, written.
        at, v: where the link's coordinates and velocities are in it.
        frame, rate: of the link below, or of the payload.
        direction: of the link, world frame.
        length, stretch: [m].
        opening: velocity of its upper end relative to its lower one [m/s].
    """
    turned = matmul(_shortest_turn(column(frame, 2), direction), frame)
    across = scale(1.0 / (length + stretch), cross(direction, opening))
    turning = add(across, scale(dot(rate, direction), direction))  # the link does not spin on the one below
    q = mat_to_quat(matmul(transpose(frame), turned))
    line[at], line[at + 1], line[at + 2], line[at + 3] = q
    line[at + 4] = stretch
    put(line[v : v + 3], tmul(turned, sub(turning, rate)))
    line[v + 3] = dot(direction, opening)
    return turned, turning


@kernel
def _shortest_turn(start, end):
    """Return the rotation about start x end that takes one unit vector to the other, 1 + [s]x + [s]x²/(1 + c)."""
    if 1.0 + dot(start, end) < 1e-9:  # a half turn about any axis across
        x, y, z = unit(cross(start, (0.0, 1.0, 0.0) if abs(start[0]) > 0.5 else (1.0, 0.0, 0.0)))
        return from_columns(
            (2.0 * x * x - 1.0, 2.0 * x * y, 2.0 * x * z),
            (2.0 * x * y, 2.0 * y * y - 1.0, 2.0 * y * z),
            (2.0 * x * z, 2.0 * y * z, 2.0 * z * z - 1.0),
        )
    x, y, z = cross(start, end)
    k = 1.0 / (1.0 + dot(start, end))
    return (
        1.0 - k * (y * y + z * z), k * x * y - z, k * x * z + y,
        k * x * y + z, 1.0 - k * (x * x + z * z), k * y * z - x,
        k * x * z - y, k * y * z + x, 1.0 - k * (x * x + y * y),
    )  # fmt: skip
