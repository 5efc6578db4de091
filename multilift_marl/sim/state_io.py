"""MuJoCo's generalised coordinates and the physical state: reading one from the other, and writing it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from mujoco.batch import Batch

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import mat, mat_to_quat, matrow, put, putmat, quat_to_mat, row, vec


class Layout(NamedTuple):
    """Where the bodies are in MuJoCo's arrays: the payload first, then the drones, each a free joint.

    A point payload has three slide joints in place of its free joint. Chains are no part of the model.
    """

    payload_nq: int
    """Coordinates of the payload: 7, or 3 for a point."""
    payload_nv: int
    """Velocities of the payload: 6, or 3 for a point."""
    payload_body: int
    """Index of the payload among bodies."""
    drone_bodies: tuple[int, ...]
    """Indices of the drones among bodies."""


class Rows(NamedTuple):
    """Rows of `batch.state`, one for each environment of a shard, and where fields start in them."""

    state: np.ndarray
    """(environments, fields)."""
    first: int
    """The first environment."""
    qpos: int
    qvel: int
    force: int
    """Applied forces `qfrc_applied`."""
    payload_nq: int
    payload_nv: int


def make_rows(layout: Layout, batch: Batch, first: int) -> Rows:
    """Return the rows of a batch whose first environment is `first`."""
    # All fields of a row lie in one buffer: where they begin is the difference of addresses, in numbers of 8 bytes.
    start = batch.state.__array_interface__["data"][0]

    def offset(field: str) -> int:
        place: int = batch.bind(field).__array_interface__["data"][0]
        return (place - start) // batch.state.itemsize

    fields = offset("qpos"), offset("qvel"), offset("qfrc_applied")
    return Rows(batch.state, first, *fields, layout.payload_nq, layout.payload_nv)


@kernel
def body_dof(b, rows):
    """Return where body b's velocities and forces are among those of all bodies; body 0 is the payload."""
    return 0 if b == 0 else rows.payload_nv + 6 * (b - 1)


@kernel
def read_payload(e, line, state, rows):
    """Read the payload's state out of a row of `batch.state`."""
    at = rows.qpos
    v = rows.qvel
    for j in range(3):
        state.payload_position[e, j] = line[at + j]
        state.payload_velocity[e, j] = line[v + j]
    if rows.payload_nv == 6:
        putmat(state.payload_rotation[e], quat_to_mat(line[at + 3], line[at + 4], line[at + 5], line[at + 6]))
        for j in range(3):
            state.payload_body_rates[e, j] = line[v + 3 + j]


@kernel
def write_bodies(e, line, state, rows):
    """Write the state of payload and drones into a row of `batch.state`."""
    # The payload, of which a point has no attitude.
    at = rows.qpos
    v = rows.qvel
    put(line[at : at + 3], row(state.payload_position, e))
    put(line[v : v + 3], row(state.payload_velocity, e))
    if rows.payload_nv == 6:
        # MuJoCo's quaternions have the real part first, as ours do; of q and -q either will do.
        line[at + 3], line[at + 4], line[at + 5], line[at + 6] = mat_to_quat(matrow(state.payload_rotation, e))
        put(line[v + 3 : v + 6], row(state.payload_body_rates, e))

    # The drones.
    at += rows.payload_nq
    v += rows.payload_nv
    for n in range(state.drone_position.shape[1]):
        put(line[at : at + 3], vec(state.drone_position, e, n))
        line[at + 3], line[at + 4], line[at + 5], line[at + 6] = mat_to_quat(mat(state.drone_rotation, e, n))
        put(line[v : v + 3], vec(state.drone_velocity, e, n))
        put(line[v + 3 : v + 6], vec(state.drone_body_rates, e, n))
        at += 7
        v += 6


@kernel
def find_warnings(lo, warning, diverged):
    """Mark environments from `lo` on for which MuJoCo has counted a warning as diverged.

    Args:
        lo: the first of the environments.
        warning: of each, what MuJoCo warned of last and how often it has (environments, kinds, 2).
        diverged: (E,) bool, written.
    """
    for i in range(warning.shape[0]):
        for kind in range(warning.shape[1]):
            if warning[i, kind, 1] != 0:
                diverged[lo + i] = True
