"""Chains: cables of masses, springs and dampers (report eqs 14-16), as the world sees them.

A chain of n links has n - 1 nodes between payload and drone, in world coordinates. Payload and drones are free bodies
in MuJoCo, as with massless cables. `chain_dynamics` advances nodes and bodies together; MuJoCo then adds contact:

1. `apply_loads` writes the loads of the physics step into `batch.state`.
2. `advance_chains` moves the nodes, and copies of the bodies, through the step, and adds each cable's mean force.
3. MuJoCo steps, for contact.
4. `read_chains` takes the bodies from `advance_chains`, and where they touch something what contact changes.
"""

from __future__ import annotations

from math import isfinite

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
    put,
    putmat,
    row,
    scale,
    sub,
    vec,
)
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.catenary import hang
from multilift_marl.sim.chain_arrays import Chain, largest_substep
from multilift_marl.sim.chain_dynamics import turned
from multilift_marl.sim.inertia import Inertias
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.scene import Layout
from multilift_marl.sim.state_io import (
    MAX_RATE,
    MAX_SPEED,
    MAX_STRETCH,
    clear_record,
    field_offset,
    note_tensions,
    read_payload,
    write_state,
)

_UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def make_chain(system: System, layout: Layout, parameters: Parameters, inertias: Inertias, batch: Batch) -> Chain:
    """Return the chains of `system`, those of each environment by `parameters`, which `update_chain` follows."""
    n, (e, count) = system.cable_segments, parameters.cable_length.shape
    force = field_offset(batch, "qfrc_applied")
    chain = Chain(
        segments=n,
        length=np.zeros((e, count)),
        stiffness=np.zeros((e, count)),
        damping=n * system.cable_damping,
        node_mass=np.zeros((e, count)),
        bending_stiffness=system.bending_stiffness,
        bending_damping=system.bending_damping,
        anchors=np.ascontiguousarray(system.anchors),
        hooks=np.ascontiguousarray(system.hooks),
        mass=inertias.mass,
        inertia=inertias.inertia,
        inverse_inertia=inertias.inverse,
        center=inertias.center,
        breaking_load=system.breaking_load,
        loads=force + np.append(0, layout.payload_nv + 6 * np.arange(count)),
        timestep=system.timestep,
        largest=largest_substep(system),
        bends=bool(system.bending_stiffness.any() or system.bending_damping.any()),
    )
    update_chain(chain, system, parameters)
    return chain


def update_chain(chain: Chain, system: System, parameters: Parameters) -> None:
    """Write what depends on parameters."""
    n, length = chain.segments, parameters.cable_length
    chain.length[:] = length / n
    chain.stiffness[:] = n * parameters.cable_stiffness
    chain.node_mass[:] = system.cable_mass * (length / system.cable_length) / (n - 1)


@kernel
def read_chains(rows, lo, hi, constraint, state, stats, diverged, c, chain, nodes, motion):
    """Read the physical state after MuJoCo's step, and write the bodies' into `batch.state`.

    Args:
        rows: `batch.state` of environments lo to hi, written.
        lo, hi: the environments.
        constraint: `qfrc_constraint` of the step (hi - lo, nv), which is contact alone.
        state, record: written.
        diverged: (E,) bool, set, never cleared.
        c, chain: Places, Chain.
        nodes: Nodes; their contact is written.
        motion: Motion of the shard, as `advance_chains` left it.
    """
    for e in range(lo, hi):
        if diverged[e]:
            continue
        i = e - lo
        _add_contact(e, i, rows[i], constraint[i], c, chain, nodes, motion)
        if not _sound(e, i, state.cable_broken[e], chain, nodes, motion):
            diverged[e] = True
            continue
        _write_bodies(i, rows[i], c, motion)
        read_payload(e, rows[i], state, c)
        for n in range(chain.segments.shape[0]):
            for j in range(3):
                state.drone_position[e, n, j] = motion.position[i, 1 + n, j]
                state.drone_velocity[e, n, j] = motion.velocity[i, 1 + n, j]
                state.drone_body_rates[e, n, j] = motion.rates[i, 1 + n, j]
                for k in range(3):
                    state.drone_rotation[e, n, j, k] = motion.rotation[i, 1 + n, j, k]
        slack = False
        for n in range(chain.segments.shape[0]):
            tension = motion.tension[i, n]
            state.cable_tension[e, n] = tension
            stats.tension_peak[e] = max(stats.tension_peak[e], motion.peak[i, n])
            slack = slack or tension <= GRAVITY * chain.node_mass[e, n] * (chain.segments[n] - 1)  # its own weight
        if slack:
            stats.slack_time[e] += c.timestep
    note_tensions(lo, hi, diverged, False, state, stats, c)


@kernel
def _add_contact(e, i, line, constraint, c, chain, nodes, motion):
    """Bring the bodies of environment e from their centres of mass to their frames' origins, and let contact act.

    MuJoCo stepped with the same loads and the cables' mean forces. Where it found contact, velocities are its own, and
    what they differ by from those without counts for the place at the end of the step, too.
    """
    h, v = chain.timestep, c.qvel
    for b in range(chain.mass.shape[1]):
        turns = b > 0 or c.payload_nv == 6
        attitude, center = matrow(motion.rotation[i], b), row(chain.center[e], b)
        position, velocity, rates = row(motion.position[i], b), row(motion.velocity[i], b), row(motion.rates[i], b)
        position = sub(position, mul(attitude, center))
        velocity = sub(velocity, mul(attitude, cross(rates, center)))
        touched = False
        for j in range(6 if turns else 3):
            nodes.contact[e, b, 1, j] = nodes.contact[e, b, 0, j]
            nodes.contact[e, b, 0, j] = constraint[v - c.qvel + j]
            touched = touched or constraint[v - c.qvel + j] != 0.0
        if touched:
            changed = (line[v], line[v + 1], line[v + 2])
            position, velocity = add(position, scale(h, sub(changed, velocity))), changed
            if turns:
                changed = (line[v + 3], line[v + 4], line[v + 5])
                attitude, rates = turned(attitude, scale(h, sub(changed, rates))), changed
        put(motion.position[i, b], position)
        put(motion.velocity[i, b], velocity)
        put(motion.rates[i, b], rates)
        putmat(motion.rotation[i, b], attitude)
        v += 6 if turns else 3


@kernel
def _sound(e, i, broken, chain, nodes, motion):
    """Return whether a simulation's numbers are finite and within physical bounds."""
    for b in range(chain.mass.shape[1]):
        for j in range(3):
            if not abs(motion.velocity[i, b, j]) < MAX_SPEED or not abs(motion.rates[i, b, j]) < MAX_RATE:
                return False
            if not isfinite(motion.position[i, b, j]):
                return False
    for n in range(chain.segments.shape[0]):
        stretch = 0.0
        for j in range(chain.segments[n] - 1):
            if not isfinite(dot(vec(nodes.position[e], n, j), vec(nodes.velocity[e], n, j))):
                return False
        for j in range(chain.segments[n] - (1 if broken[n] else 0)):
            stretch = max(stretch, motion.stretch[i, n, j])
        if not stretch < MAX_STRETCH * chain.length[e, n]:
            return False
    return True


@kernel
def _write_bodies(i, line, c, motion):
    """Write the bodies' motion into a row of `batch.state`."""
    at, v = c.qpos, c.qvel
    for b in range(motion.position.shape[1]):
        turns = b > 0 or c.payload_nv == 6
        put(line[at : at + 3], row(motion.position[i], b))
        put(line[v : v + 3], row(motion.velocity[i], b))
        if turns:
            line[at + 3], line[at + 4], line[at + 5], line[at + 6] = mat_to_quat(matrow(motion.rotation[i], b))
            put(line[v + 3 : v + 6], row(motion.rates[i], b))
        at += 7 if turns else 3
        v += 6 if turns else 3


@kernel
def write_chains(rows, lo, hi, mask, state, stats, c, chain, nodes):
    """Write the state of the environments in `mask` into `batch.state` and the nodes.

    A cable hangs between payload and drone as it would at rest, a slack one in an arc; its nodes move as if it were
    stretched evenly, those of an arc without stretch: its dampers would pull.
    """
    write_state(rows, lo, hi, mask, state, stats, c)
    links = np.zeros((chain.segments.max(), 7))
    for e in range(lo, hi):
        if not mask[e]:
            continue
        nodes.contact[e] = 0.0
        attitude, spin = matrow(state.payload_rotation, e), row(state.payload_body_rates, e)
        if c.payload_nv == 3:
            attitude, spin = _UPRIGHT, (0.0, 0.0, 0.0)
        for i in range(chain.segments.shape[0]):
            n, anchor = chain.segments[i], row(chain.anchors, i)
            drone, hook = mat(state.drone_rotation, e, i), row(chain.hooks, i)
            place = add(row(state.payload_position, e), mul(attitude, anchor))
            velocity = add(row(state.payload_velocity, e), mul(attitude, cross(spin, anchor)))
            end = add(vec(state.drone_velocity, e, i), mul(drone, cross(vec(state.drone_body_rates, e, i), hook)))
            chord = sub(add(vec(state.drone_position, e, i), mul(drone, hook)), place)
            weight = GRAVITY * chain.node_mass[e, i]
            hang(chord, sub(end, velocity), chain.length[e, i], chain.stiffness[e, i], weight, links[:n])
            for j in range(n - 1):
                place = add(place, scale(chain.length[e, i] + links[j, 3], row(links, j)))
                velocity = add(velocity, row(links[:, 4:], j))
                put(nodes.position[e, i, j], place)
                put(nodes.velocity[e, i, j], velocity)
            opening = dot(row(links, n - 1), row(links[:, 4:], n - 1))
            tension = chain.stiffness[e, i] * links[n - 1, 3] + chain.damping[i] * opening
            state.cable_tension[e, i] = max(0.0, tension)
        clear_record(e, stats)
    note_tensions(lo, hi, mask, True, state, stats, c)
