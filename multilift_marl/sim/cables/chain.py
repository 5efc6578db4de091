"""Chains: cables of masses, springs and dampers (report eqs 14-16).

A chain of n links has n - 1 nodes between payload and drone, in world coordinates. Payload and drones are free bodies
in MuJoCo, as with massless cables. `chain_dynamics` advances nodes and bodies together; MuJoCo then adds contact:

1. `apply_loads` writes the loads of the physics step into `batch.state`.
2. `advance_chains` moves the nodes, and copies of the bodies, through the step, and adds each cable's mean force.
3. MuJoCo steps, for contact.
4. `read_state` takes the bodies from `advance_chains`, and where they hit something it repeats that with the impact.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.math3d import (
    IDENTITY,
    add,
    cross,
    dot,
    mat,
    mat_to_quat,
    matrow,
    mul,
    put,
    row,
    scale,
    sub,
    vec,
)
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.system import System
from multilift_marl.sim.cables import catenary
from multilift_marl.sim.cables.catenary import hang
from multilift_marl.sim.cables.chain_arrays import Chain, Motion, Nodes, Workspace, largest_substep
from multilift_marl.sim.cables.chain_contact import add_contact
from multilift_marl.sim.cables.chain_dynamics import advance_chains
from multilift_marl.sim.cables.common import (
    MAX_RATE,
    MAX_SPEED,
    MAX_STRETCH,
    cable_tension,
    clear_stats,
    make_common,
    update_tension_stats,
)
from multilift_marl.sim.parameters import Inertias, Parameters
from multilift_marl.sim.state import SimData
from multilift_marl.sim.state_io import Rows, read_payload, write_bodies

SLACK = catenary.SLACK


def add_cable(spec: mujoco.MjSpec, system: System, index: int) -> None:
    """Do nothing: chains are no part of MuJoCo's model."""


def set_constants(model: mujoco.MjModel, system: System) -> None:
    """Do nothing: chains are no part of MuJoCo's model."""


def make_cables(system: System, parameters: Parameters, inertias: Inertias) -> Chain:
    """Return the chains of `system`, those of each environment by `parameters`, which `update_cables` follows."""
    e, n = parameters.cable_length.shape
    chain = Chain(
        cables=make_common(system, parameters),
        bodies=inertias,
        segments=system.cable_segments,
        length=np.zeros((e, n)),
        stiffness=np.zeros((e, n)),
        # Dampers and springs of links in series: n times those of the whole cable each.
        damping=system.cable_segments * system.cable_damping,
        node_mass=np.zeros((e, n)),
        bending_stiffness=system.bending_stiffness,
        bending_damping=system.bending_damping,
        bends=bool(system.bending_stiffness.any() or system.bending_damping.any()),
        largest=np.zeros(e, int),
        nodes=Nodes.zeros(e, system),
        links=np.zeros((e, int(system.cable_segments.max()), 7)),
        motion=Motion.zeros(e, system),
    )
    update_cables(chain, system, parameters)
    return chain


def update_cables(cables: Chain, system: System, parameters: Parameters) -> None:
    """Write what depends on parameters."""
    n = cables.segments
    cables.largest[:] = largest_substep(system, parameters.cable_length)
    cables.length[:] = parameters.cable_length / n
    cables.stiffness[:] = n * parameters.cable_stiffness
    # A cable that is drawn longer is heavier; all its mass is in the n - 1 nodes.
    cables.node_mass[:] = system.cable_mass * (parameters.cable_length / system.cable_length) / (n - 1)


def update_models(
    batch: Batch, system: System, parameters: Parameters, mask: np.ndarray, names: set[str], broken: np.ndarray
) -> None:
    """Do nothing: chains are no part of MuJoCo's models."""


def bind_steps(batch: Batch, rows: Rows, data: SimData, cables: Chain) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return what to call before and after MuJoCo's step of a batch."""
    work = Workspace.zeros(cables.segments)
    advance = bind(advance_chains, rows, data, cables, work)
    return advance, bind(read_state, rows, batch.bind("qfrc_constraint"), data, cables, work)


@kernel
def read_state(rows, contact, data, cables, work):
    """Read the physical state after MuJoCo's step, and write the bodies' into `batch.state`.

    Args:
        rows: Rows of the environments, written.
        contact: `qfrc_constraint` of the step (environments, nv), which is contact alone.
        data: SimData, written.
        cables: Chain with the motion that `advance_chains` left; its nodes' contact is written.
        work: Workspace.
    """
    state = data.state
    stats = data.stats
    motion = cables.motion
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        if data.diverged[e]:
            continue
        add_contact(e, rows.state[i], contact[i], state, cables, rows, work)
        if not _is_sound(e, state.cable_broken[e], cables):
            data.diverged[e] = True
            continue

        # Bodies: MuJoCo's row, from which the payload is read, and the drones.
        _write_motion(e, rows.state[i], motion, rows)
        read_payload(e, rows.state[i], state, rows)
        for n in range(cables.segments.shape[0]):
            for j in range(3):
                state.drone_position[e, n, j] = motion.position[e, 1 + n, j]
                state.drone_velocity[e, n, j] = motion.velocity[e, 1 + n, j]
                state.drone_body_rates[e, n, j] = motion.rates[e, 1 + n, j]
                for k in range(3):
                    state.drone_rotation[e, n, j, k] = motion.rotation[e, 1 + n, j, k]

        # Cables: slack is a tension no larger than the chain's own weight.
        slack = False
        for n in range(cables.segments.shape[0]):
            tension = motion.tension[e, n]
            state.cable_tension[e, n] = tension
            stats.tension_peak[e] = max(stats.tension_peak[e], motion.peak[e, n])
            slack = slack or tension <= GRAVITY * cables.node_mass[e, n] * (cables.segments[n] - 1)
        if slack:
            stats.slack_time[e] += cables.cables.timestep
    update_tension_stats(rows, data.diverged, False, data, cables.cables)


@kernel
def _is_sound(e, broken, chain):
    """Return whether a simulation's numbers are finite and within physical bounds."""
    motion = chain.motion
    nodes = chain.nodes
    for b in range(motion.position.shape[1]):
        for j in range(3):
            if not abs(motion.velocity[e, b, j]) < MAX_SPEED or not abs(motion.rates[e, b, j]) < MAX_RATE:
                return False
            if not isfinite(motion.position[e, b, j]):
                return False
    for n in range(chain.segments.shape[0]):
        stretch = 0.0
        for j in range(chain.segments[n] - 1):
            if not isfinite(dot(vec(nodes.position[e], n, j), vec(nodes.velocity[e], n, j))):
                return False
        for j in range(chain.segments[n] - (1 if broken[n] else 0)):
            stretch = max(stretch, motion.stretch[e, n, j])
        if not stretch < MAX_STRETCH * chain.length[e, n]:
            return False
    return True


@kernel
def _write_motion(e, line, motion, rows):
    """Write the bodies' motion into a row of `batch.state`."""
    at = rows.qpos
    v = rows.qvel
    for b in range(motion.position.shape[1]):
        turns = b > 0 or rows.payload_nv == 6
        put(line[at : at + 3], row(motion.position[e], b))
        put(line[v : v + 3], row(motion.velocity[e], b))
        if turns:
            line[at + 3], line[at + 4], line[at + 5], line[at + 6] = mat_to_quat(matrow(motion.rotation[e], b))
            put(line[v + 3 : v + 6], row(motion.rates[e], b))
        at += 7 if turns else 3
        v += 6 if turns else 3


@kernel
def write_state(rows, mask, data, cables):
    """Write the state of the environments in `mask` into `batch.state` and the nodes.

    A cable hangs between payload and drone as it would at rest, a slack one in an arc; its nodes move as if it were
    stretched evenly, those of an arc without stretch: its dampers would resist.
    """
    state = data.state
    nodes = cables.nodes
    common = cables.cables
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        if not mask[e]:
            continue
        clear_stats(e, data.stats)
        write_bodies(e, rows.state[i], state, rows)
        links = cables.links[e]
        nodes.contact[e] = 0.0
        attitude = matrow(state.payload_rotation, e)
        spin = row(state.payload_body_rates, e)
        if rows.payload_nv == 3:
            attitude = IDENTITY
            spin = (0.0, 0.0, 0.0)
        for n in range(cables.segments.shape[0]):
            # The ends and their velocities.
            count = cables.segments[n]
            anchor = row(common.anchors, n)
            hook = row(common.hooks, n)
            drone = mat(state.drone_rotation, e, n)
            place = add(row(state.payload_position, e), mul(attitude, anchor))
            velocity = add(row(state.payload_velocity, e), mul(attitude, cross(spin, anchor)))
            end = add(vec(state.drone_velocity, e, n), mul(drone, cross(vec(state.drone_body_rates, e, n), hook)))
            chord = sub(add(vec(state.drone_position, e, n), mul(drone, hook)), place)

            # The nodes between them.
            length = cables.length[e, n]
            stiffness = cables.stiffness[e, n]
            # `end` is the hook's velocity: less the anchor's, the rate of the chord.
            hang(chord, sub(end, velocity), length, stiffness, GRAVITY * cables.node_mass[e, n], links[:count])
            for j in range(count - 1):
                place = add(place, scale(length + links[j, 3], row(links, j)))
                velocity = add(velocity, row(links[:, 4:], j))
                put(nodes.position[e, n, j], place)
                put(nodes.velocity[e, n, j], velocity)

            # Tension of the link next to the drone.
            rate = dot(row(links, count - 1), row(links[:, 4:], count - 1))
            state.cable_tension[e, n] = cable_tension(stiffness, cables.damping[n], links[count - 1, 3], rate)
    update_tension_stats(rows, mask, True, data, common)
