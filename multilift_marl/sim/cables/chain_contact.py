"""Contact of bodies on chains: what MuJoCo finds of it, and how chains move with it.

Chains advance before MuJoCo finds the contact of the step, with no more of it than the last two steps had in common.
The rest of it, an impact, comes too late for them: a body that it stopped would have left the links beside it stretched
or pushed together, with hundreds of joules that do not exist. So the step is repeated with the impact at its start.
"""

from __future__ import annotations

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, cross, matrow, mul, norm, put, putmat, row, scale, sub, tmul
from multilift_marl.sim.cables.chain_dynamics import add_cables, common_force, gather_bodies, take_substeps, turned
from multilift_marl.sim.state_io import body_dof

_UNFELT = 1e-5  # [m] by which contact may move a body within a step without a repetition: 5e-5 J in a link of 1 MN/m
_ARM = 0.1  # [m] at which a rotation counts


@kernel
def add_contact(e, line, contact, state, chain, rows, work):
    """Let contact act on nodes and bodies of environment e, and bring bodies from centres of mass to frames' origins.

    Args:
        e: environment.
        line: row of `batch.state` after MuJoCo's step, which had the same loads and the cables' mean forces.
        contact: `qfrc_constraint` of that step (nv,), which is contact alone.
        state: SystemState at the start of the step; `cable_broken` is written.
        chain: Chain; nodes and motion are written.
        rows: Rows.
        work: Workspace.
    """
    touched = False
    for j in range(contact.shape[0]):
        touched = touched or contact[j] != 0.0
    hit = touched and _is_hit(e, contact, chain, rows)
    if hit:
        _repeat(e, line, contact, state, chain, rows, work)
    for b in range(chain.motion.position.shape[1]):
        _leave_center(e, b, chain)
        # A gentle contact needs no repetition: MuJoCo's velocities stand in for the chains' own.
        if touched and not hit:
            _take_velocity(e, b, line, contact, chain, rows)
        first = body_dof(b, rows)
        for j in range(6 if b > 0 or rows.payload_nv == 6 else 3):
            chain.nodes.contact[e, b, 1, j] = chain.nodes.contact[e, b, 0, j]
            chain.nodes.contact[e, b, 0, j] = contact[first + j]


@kernel
def _impact(e, b, first, contact, chain, rows):
    """Return what chains have not felt yet of the contact of body b: force (first = 0) or torque (first = 3)."""
    at = body_dof(b, rows) + first
    touch = chain.nodes.contact[e, b]
    felt = (common_force(touch, first), common_force(touch, first + 1), common_force(touch, first + 2))
    return sub((contact[at], contact[at + 1], contact[at + 2]), felt)


@kernel
def _is_hit(e, contact, chain, rows):
    """Return whether the impact of any body would move it noticeably within the step."""
    bodies = chain.bodies
    h = chain.cables.timestep
    for b in range(chain.motion.position.shape[1]):
        shift = norm(_impact(e, b, 0, contact, chain, rows)) / bodies.mass[e, b]
        if b > 0 or rows.payload_nv == 6:
            turning = mul(matrow(bodies.inverse[e], b), _impact(e, b, 3, contact, chain, rows))
            shift = max(shift, _ARM * norm(turning))
        if h * h * shift > _UNFELT:
            return True
    return False


@kernel
def _repeat(e, line, contact, state, chain, rows, work):
    """Advance nodes and bodies again from the start of the step, where the impact changes the bodies' velocities."""
    bodies = chain.bodies
    motion = chain.motion
    h = chain.cables.timestep
    for n in range(chain.segments.shape[0]):
        state.cable_broken[e, n] = motion.first_broken[e, n]
        for j in range(chain.segments[n] - 1):
            put(chain.nodes.position[e, n, j], row(motion.first_position[e, n], j))
            put(chain.nodes.velocity[e, n, j], row(motion.first_velocity[e, n], j))
    add_cables(e, line, -1.0, chain, rows)
    gather_bodies(e, line, state, chain, rows, work)
    for b in range(motion.position.shape[1]):
        at = body_dof(b, rows)
        touch = chain.nodes.contact[e, b]
        felt = (common_force(touch, 0), common_force(touch, 1), common_force(touch, 2))
        # All of the contact comes as an impulse h F at the start of the step. The lasting part, which `gather_bodies`
        # has taken for a force again, would count twice.
        put(work.force[b], sub(row(work.force, b), felt))
        force = (contact[at], contact[at + 1], contact[at + 2])
        put(motion.velocity[e, b], add(row(motion.velocity[e], b), scale(h / bodies.mass[e, b], force)))
        if b == 0 and rows.payload_nv < 6:
            continue
        attitude = matrow(motion.rotation[e], b)
        center = row(bodies.center[e], b)
        felt_torque = (common_force(touch, 3), common_force(touch, 4), common_force(touch, 5))
        # Generalised torques are about the frame's origin, the momentum is about the centre of mass.
        felt_torque = sub(felt_torque, cross(center, tmul(attitude, felt)))
        put(work.torque[b], sub(row(work.torque, b), felt_torque))
        torque = sub((contact[at + 3], contact[at + 4], contact[at + 5]), cross(center, tmul(attitude, force)))
        put(work.momentum[b], add(row(work.momentum, b), scale(h, mul(attitude, torque))))
        put(motion.rates[e, b], mul(matrow(bodies.inverse[e], b), tmul(attitude, row(work.momentum, b))))
    take_substeps(e, state, chain, work)
    add_cables(e, line, 1.0, chain, rows)


@kernel
def _leave_center(e, b, chain):
    """Bring body b from its centre of mass to the origin of its frame."""
    motion = chain.motion
    attitude = matrow(motion.rotation[e], b)
    center = row(chain.bodies.center[e], b)
    put(motion.position[e, b], sub(row(motion.position[e], b), mul(attitude, center)))
    turning = mul(attitude, cross(row(motion.rates[e], b), center))
    put(motion.velocity[e, b], sub(row(motion.velocity[e], b), turning))


@kernel
def _take_velocity(e, b, line, contact, chain, rows):
    """Give body b MuJoCo's velocities where it touches something; they also change its place at the end of the step."""
    motion = chain.motion
    h = chain.cables.timestep
    turns = b > 0 or rows.payload_nv == 6
    first = body_dof(b, rows)
    touched = False
    for j in range(6 if turns else 3):
        touched = touched or contact[first + j] != 0.0
    if not touched:
        return
    v = rows.qvel + first
    changed = (line[v], line[v + 1], line[v + 2])
    velocity = row(motion.velocity[e], b)
    # MuJoCo steps places by the new velocity: what it changes of that changes the place by h times as much.
    put(motion.position[e, b], add(row(motion.position[e], b), scale(h, sub(changed, velocity))))
    put(motion.velocity[e, b], changed)
    if turns:
        changed = (line[v + 3], line[v + 4], line[v + 5])
        rates = row(motion.rates[e], b)
        putmat(motion.rotation[e, b], turned(matrow(motion.rotation[e], b), scale(h, sub(changed, rates))))
        put(motion.rates[e, b], changed)
