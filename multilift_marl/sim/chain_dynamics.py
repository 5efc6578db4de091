"""How chains move, with the bodies that they tie together: substeps that conserve momentum.

In a substep h, link j pulls along its direction d_j at the start of the substep, with the tension

    T_j = k s_j' + c (s_j' - s_j)/h

of its stretch s_j before and s_j' after it: springs and dampers are implicit along the links, and forces on nodes and
bodies are equal, opposite and in one line. Every place then advances with its new velocity. For stiff links this is
SHAKE (Ryckaert, Ciccotti and Berendsen 1977), a symplectic method: linear and angular momentum of payload, nodes and
drones change by loads alone, to round-off, and energy does not drift.

With the velocities u, w of the ends of a link after the substep, s_j' = s_j + h d_j · (u - w) + h r_j, where r_j is
what the link's turning adds. Without r_j the tensions solve a linear system: one tridiagonal matrix a cable, eliminated
from the drone down to its first link, and one dense matrix (N, N) of the first links, which meet at the payload. A few
passes with the same factors bring r_j in.

What a tension does across its link is explicit, and stable while T h² < m l. The substep is halved until that holds
with a margin, so a cable may snatch at any speed.
"""

from __future__ import annotations

from math import sqrt

from multilift_marl._jit import kernel
from multilift_marl.math3d import (
    add,
    axis_angle,
    cross,
    dot,
    matmul,
    matrow,
    mul,
    norm,
    put,
    putmat,
    row,
    scale,
    sub,
    tmul,
    unit,
)
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.chain_arrays import UNITS
from multilift_marl.sim.chain_bending import find_bending

_PASSES = 2  # at most, over what the links' turning adds
_SETTLED = 1e-6  # [m/s] change of that which needs no further pass
_MARGIN = 0.3  # [-] T h²/(m l) of a substep that may be taken


@kernel
def advance_chains(rows, lo, hi, state, diverged, chain, nodes, motion):
    """Advance nodes and bodies of environments lo to hi by one physics step, and load MuJoCo's bodies with the cables.

    Args:
        rows: `batch.state`, with the loads of the step; the cables' mean forces are added to them.
        lo, hi: the environments.
        state: SystemState at the start of the step; `cable_broken` is written.
        diverged: (E,) bool, environments that are left as they are.
        chain: Chain.
        nodes: Nodes, written.
        motion: Motion of these environments, written.
    """
    for e in range(lo, hi):
        if diverged[e]:
            continue
        i, line = e - lo, rows[e - lo]
        _gather_bodies(e, i, line, state, chain, nodes, motion)
        motion.dissipated[i] = 0.0
        for n in range(chain.segments.shape[0]):
            motion.peak[i, n] = 0.0
        left, size = UNITS, chain.largest
        while left > 0:
            size = min(size, left)
            if chain.bends:
                find_bending(e, i, state, chain, nodes, motion)
            while True:
                h = size * chain.timestep / UNITS
                _find_links(e, i, h, state, chain, nodes, motion)
                _factorize(e, state, chain, motion)
                _solve_tensions(e, h, state, chain, motion)
                if size == 1 or _steepness(e, h, state, chain, motion) <= _MARGIN:
                    break
                size //= 2
            _add_turning(e, i, h, state, chain, nodes, motion)
            _move(e, i, h, state, chain, nodes, motion)
            left -= size
            if size < chain.largest and _steepness(e, 2.0 * h, state, chain, motion) < _MARGIN:
                size *= 2
        for b in range(chain.mass.shape[1]):
            dofs = 6 if chain.inverse_inertia[e, b, 0, 0] > 0.0 else 3
            for j in range(dofs):
                line[chain.loads[b] + j] += motion.impulse[b, j] / chain.timestep


@kernel
def _gather_bodies(e, i, line, state, chain, nodes, motion):
    """Take the bodies at the start of a physics step and what acts on them: gravity, loads, lasting contact.

    Contact is there so that cables do not have to hold for a moment what stands on the ground: as much of it as the
    last two steps had in common, since the impulse of an impact is over.
    """
    for b in range(chain.mass.shape[1]):
        if b == 0:
            position, velocity = row(state.payload_position, e), row(state.payload_velocity, e)
            attitude, rates = matrow(state.payload_rotation, e), row(state.payload_body_rates, e)
            if chain.inverse_inertia[e, 0, 0, 0] == 0.0:
                attitude, rates = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
        else:
            position, velocity = row(state.drone_position[e], b - 1), row(state.drone_velocity[e], b - 1)
            attitude, rates = matrow(state.drone_rotation[e], b - 1), row(state.drone_body_rates[e], b - 1)
        center = row(chain.center[e], b)
        put(motion.position[i, b], add(position, mul(attitude, center)))
        put(motion.velocity[i, b], add(velocity, mul(attitude, cross(rates, center))))
        put(motion.rates[i, b], rates)
        putmat(motion.rotation[i, b], attitude)
        put(motion.momentum[b], mul(attitude, mul(matrow(chain.inertia[e], b), rates)))
        at, mass, touch = chain.loads[b], chain.mass[e, b], nodes.contact[e, b]
        force = (line[at], line[at + 1], line[at + 2])
        force = add(force, (_common(touch, 0), _common(touch, 1), _common(touch, 2)))
        put(motion.force[b], sub(force, (0.0, 0.0, mass * GRAVITY)))
        if chain.inverse_inertia[e, b, 0, 0] > 0.0:
            torque = (line[at + 3], line[at + 4], line[at + 5])
            torque = add(torque, (_common(touch, 3), _common(touch, 4), _common(touch, 5)))
            put(motion.torque[b], sub(torque, cross(center, tmul(attitude, force))))
        for j in range(6):
            motion.impulse[b, j] = 0.0


@kernel
def _common(touch, j):
    """Return the smaller one of a contact's two last values, 0 where their signs differ."""
    last, before = touch[0, j], touch[1, j]
    if last * before <= 0.0:
        return 0.0
    return last if abs(last) < abs(before) else before


@kernel
def _find_links(e, i, h, state, chain, nodes, motion):
    """Find direction and stretch of every link, the bodies' motion without cables, and the linear system of a substep.

    Row j of a cable, over h (k h + c): (1/(h (k h + c)) + 1/m_upper + 1/m_lower) T_j less what its neighbours do to the
    nodes that they share, equals (k s_j/(k h + c) + rate of stretch without cables)/h.
    """
    # Bodies without cables. The momentum is in the world frame, so the gyroscopic torque needs no term.
    for b in range(chain.mass.shape[1]):
        mass, attitude = chain.mass[e, b], matrow(motion.rotation[i], b)
        force = add(row(motion.force, b), row(motion.bend_force, b))
        put(motion.free_velocity[b], add(row(motion.velocity[i], b), scale(h / mass, force)))
        torque = add(mul(attitude, row(motion.torque, b)), row(motion.bend_moment, b))
        momentum = add(row(motion.momentum, b), scale(h, torque))
        turning = mul(matrow(chain.inverse_inertia[e], b), tmul(attitude, momentum))
        put(motion.free_rates[b], mul(attitude, turning))

    payload, payload_inverse = matrow(motion.rotation[i], 0), matrow(chain.inverse_inertia[e], 0)
    for n in range(chain.segments.shape[0]):
        links = chain.segments[n]
        k, c, length = chain.stiffness[e, n], chain.damping[n], chain.length[e, n]
        gain = k * h + c
        node = 1.0 / chain.node_mass[e, n]

        # Along the cable, from the anchor on the payload up.
        arm = mul(payload, sub(row(chain.anchors, n), row(chain.center[e], 0)))
        put(motion.ends[n, 0], arm)
        low = add(row(motion.position[i], 0), arm)
        low_velocity = add(row(motion.free_velocity, 0), cross(row(motion.free_rates, 0), arm))
        before, weight = (0.0, 0.0, 0.0), 0.0
        for j in range(links):
            if j < links - 1:
                high, weight_up = row(nodes.position[e, n], j), node
                high_velocity = _free_node(e, n, j, h, chain, nodes, motion)
            else:
                drone = matrow(motion.rotation[i], 1 + n)
                arm = mul(drone, row(chain.hooks, n))
                put(motion.ends[n, 1], arm)
                high = add(row(motion.position[i], 1 + n), arm)
                high_velocity = add(row(motion.free_velocity, 1 + n), cross(row(motion.free_rates, 1 + n), arm))
                weight_up = 1.0 / chain.mass[e, 1 + n]
            link = sub(high, low)
            size = norm(link)
            d = scale(1.0 / max(size, 1e-9), link)
            if j == links - 1:  # a pull at the hook turns the drone, too
                moment = tmul(drone, cross(arm, d))
                weight_up += dot(moment, mul(matrow(chain.inverse_inertia[e], 1 + n), moment))
            put(motion.direction[n, j], d)
            motion.stretch[i, n, j] = size - length
            opening = sub(high_velocity, low_velocity)
            motion.turning[n, j] = _turning(d, size, opening, h)
            rate = dot(d, opening)
            motion.diagonal[n, j] = 1.0 / (h * gain) + weight_up + weight
            motion.right[n, j] = (k * (size - length) / gain + rate) / h
            motion.coupling[n, j] = -weight * dot(d, before)
            if j == 0:
                turning = mul(payload_inverse, tmul(payload, cross(row(motion.ends[n], 0), d)))
                put(motion.twist[n], mul(payload, turning))
            low, low_velocity, before, weight = high, high_velocity, d, weight_up


@kernel
def _factorize(e, state, chain, motion):
    """Factorize the system of a substep: eliminate each cable from its drone down, then Cholesky of the first links."""
    count = chain.segments.shape[0]
    for n in range(count):
        for j in range(_top(e, n, state, chain), 0, -1):
            share = motion.coupling[n, j] / motion.diagonal[n, j]
            motion.diagonal[n, j - 1] -= share * motion.coupling[n, j]
    for n in range(count):
        d, arm = row(motion.direction[n], 0), row(motion.ends[n], 0)
        for m in range(n + 1):
            there = add(scale(1.0 / chain.mass[e, 0], row(motion.direction[m], 0)), cross(row(motion.twist, m), arm))
            total = dot(d, there)
            if m == n:
                total += motion.diagonal[n, 0]
            for k in range(m):
                total -= motion.matrix[n, k] * motion.matrix[m, k]
            motion.matrix[n, m] = sqrt(total) if m == n else total / motion.matrix[m, m]


@kernel
def _solve_tensions(e, h, state, chain, motion):
    """Solve for the tensions of all links by the factors, with what the links' turning adds to their stretch."""
    count = chain.segments.shape[0]
    for n in range(count):
        top = _top(e, n, state, chain)
        for j in range(chain.segments[n]):
            motion.cable_force[n, j] = motion.right[n, j] + motion.turning[n, j] / h
        for j in range(top, 0, -1):
            motion.cable_force[n, j - 1] -= motion.coupling[n, j] / motion.diagonal[n, j] * motion.cable_force[n, j]
    for n in range(count):
        total = motion.cable_force[n, 0]
        for k in range(n):
            total -= motion.matrix[n, k] * motion.cable_force[k, 0]
        motion.cable_force[n, 0] = total / motion.matrix[n, n]
    for n in range(count - 1, -1, -1):
        total = motion.cable_force[n, 0]
        for k in range(n + 1, count):
            total -= motion.matrix[k, n] * motion.cable_force[k, 0]
        motion.cable_force[n, 0] = total / motion.matrix[n, n]
        top = _top(e, n, state, chain)
        for j in range(1, top + 1):
            known = motion.cable_force[n, j] - motion.coupling[n, j] * motion.cable_force[n, j - 1]
            motion.cable_force[n, j] = known / motion.diagonal[n, j]
        for j in range(top + 1, chain.segments[n]):
            motion.cable_force[n, j] = 0.0


@kernel
def _top(e, n, state, chain):
    """Return the last link of cable n that holds: a cable breaks next to its drone."""
    return chain.segments[n] - (2 if state.cable_broken[e, n] else 1)


@kernel
def _add_turning(e, i, h, state, chain, nodes, motion):
    """Solve again for the tensions, with what the links' turning adds to their stretch, until that has settled."""
    for _ in range(_PASSES):
        if _find_turning(e, i, h, chain, nodes, motion) < _SETTLED:
            break
        _solve_tensions(e, h, state, chain, motion)


@kernel
def _find_turning(e, i, h, chain, nodes, motion):
    """Find by how much faster than d · (u - w) links stretch as they turn, by the last tensions; return its change."""
    change = 0.0
    for n in range(chain.segments.shape[0]):
        links = chain.segments[n]
        low_velocity = _pulled_end(e, i, 0, n, 0, h, chain, motion)
        for j in range(links):
            if j < links - 1:
                force = scale(motion.cable_force[n, j + 1], row(motion.direction[n], j + 1))
                force = sub(force, scale(motion.cable_force[n, j], row(motion.direction[n], j)))
                high_velocity = _free_node(e, n, j, h, chain, nodes, motion)
                high_velocity = add(high_velocity, scale(h / chain.node_mass[e, n], force))
            else:
                high_velocity = _pulled_end(e, i, 1 + n, n, 1, h, chain, motion)
            d, size = row(motion.direction[n], j), chain.length[e, n] + motion.stretch[i, n, j]
            turning = _turning(d, size, sub(high_velocity, low_velocity), h)
            change = max(change, abs(turning - motion.turning[n, j]))
            motion.turning[n, j] = turning
            low_velocity = high_velocity
    return change


@kernel
def _turning(d, size, opening, h):
    """Return how much faster than d · opening a link of a given size along d stretches in time h [m/s]."""
    rate = dot(d, opening)
    along = size + h * rate
    across = h * h * max(dot(opening, opening) - rate * rate, 0.0)
    return across / (h * (sqrt(along * along + across) + along))


@kernel
def _pulled_end(e, i, b, n, end, h, chain, motion):
    """Return the velocity of an end of cable n after a substep, on body b."""
    arm, impulse, moment = row(motion.ends[n], end), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if b == 0:
        for m in range(chain.segments.shape[0]):
            cable_force = scale(h * motion.cable_force[m, 0], row(motion.direction[m], 0))
            impulse, moment = (
                add(impulse, cable_force),
                add(moment, scale(h * motion.cable_force[m, 0], row(motion.twist, m))),
            )
    else:
        last = chain.segments[n] - 1
        impulse = scale(-h * motion.cable_force[n, last], row(motion.direction[n], last))
        attitude = matrow(motion.rotation[i], b)
        moment = mul(attitude, mul(matrow(chain.inverse_inertia[e], b), tmul(attitude, cross(arm, impulse))))
    velocity = add(row(motion.free_velocity, b), scale(1.0 / chain.mass[e, b], impulse))
    return add(velocity, cross(add(row(motion.free_rates, b), moment), arm))


@kernel
def _steepness(e, h, state, chain, motion):
    """Return the largest |T| h²/(m l) of all links: at 1 their motion across becomes unstable."""
    worst = 0.0
    for n in range(chain.segments.shape[0]):
        inertia = chain.node_mass[e, n] * chain.length[e, n]
        for j in range(chain.segments[n]):
            worst = max(worst, abs(motion.cable_force[n, j]) / inertia)
    return worst * h * h


@kernel
def _free_node(e, n, j, h, chain, nodes, motion):
    """Return the velocity of a node after a substep, were it not for the tensions."""
    change = scale(h / chain.node_mass[e, n], row(motion.bending[n], j))
    return sub(add(row(nodes.velocity[e, n], j), change), (0.0, 0.0, h * GRAVITY))


@kernel
def _move(e, i, h, state, chain, nodes, motion):
    """Give nodes and bodies the velocities that follow from the tensions, and move them."""
    motion.dissipated[i] += h * motion.bend_power[0]
    for b in range(chain.mass.shape[1]):
        put(motion.velocity[i, b], row(motion.free_velocity, b))
        torque = add(mul(matrow(motion.rotation[i], b), row(motion.torque, b)), row(motion.bend_moment, b))
        put(motion.momentum[b], add(row(motion.momentum, b), scale(h, torque)))
        if chain.bends:
            force, moment = scale(h, row(motion.bend_force, b)), scale(h, row(motion.bend_moment, b))
            _note_impulse(b, i, force, moment, e, chain, motion)

    for n in range(chain.segments.shape[0]):
        links, top = chain.segments[n], chain.segments[n] - 1
        share = h / chain.node_mass[e, n]
        k, c = chain.stiffness[e, n], chain.damping[n]
        for j in range(links - (1 if state.cable_broken[e, n] else 0)):
            rate = (motion.cable_force[n, j] - k * motion.stretch[i, n, j]) / (k * h + c)
            motion.dissipated[i] += h * c * rate * rate
        for j in range(links - 1):
            below, above = motion.cable_force[n, j], motion.cable_force[n, j + 1]
            force = sub(scale(above, row(motion.direction[n], j + 1)), scale(below, row(motion.direction[n], j)))
            velocity = add(_free_node(e, n, j, h, chain, nodes, motion), scale(share, force))
            put(nodes.velocity[e, n, j], velocity)
            put(nodes.position[e, n, j], add(row(nodes.position[e, n], j), scale(h, velocity)))
        first = scale(h * motion.cable_force[n, 0], row(motion.direction[n], 0))
        last = scale(-h * motion.cable_force[n, top], row(motion.direction[n], top))
        _push(e, i, 0, first, row(motion.ends[n], 0), chain, motion)
        _push(e, i, 1 + n, last, row(motion.ends[n], 1), chain, motion)
        motion.tension[i, n] = tension = max(0.0, motion.cable_force[n, top])
        motion.peak[i, n] = max(motion.peak[i, n], tension)
        if tension > chain.breaking_load[n]:
            state.cable_broken[e, n] = True

    # The attitude follows the momentum by the midpoint rule.
    for b in range(chain.mass.shape[1]):
        put(motion.position[i, b], add(row(motion.position[i], b), scale(h, row(motion.velocity[i], b))))
        if chain.inverse_inertia[e, b, 0, 0] > 0.0:
            attitude, inverse = matrow(motion.rotation[i], b), matrow(chain.inverse_inertia[e], b)
            momentum = row(motion.momentum, b)
            rates = mul(inverse, tmul(attitude, momentum))
            rates = mul(inverse, tmul(turned(attitude, scale(0.5 * h, rates)), momentum))
            attitude = turned(attitude, scale(h, rates))
            putmat(motion.rotation[i, b], attitude)
            put(motion.rates[i, b], mul(inverse, tmul(attitude, momentum)))


@kernel
def _push(e, i, b, impulse, arm, chain, motion):
    """Give body b an impulse [N s] at `arm` from its centre of mass, world frame."""
    put(motion.velocity[i, b], add(row(motion.velocity[i], b), scale(1.0 / chain.mass[e, b], impulse)))
    moment = cross(arm, impulse)
    put(motion.momentum[b], add(row(motion.momentum, b), moment))
    _note_impulse(b, i, impulse, moment, e, chain, motion)


@kernel
def _note_impulse(b, i, impulse, moment, e, chain, motion):
    """Add an impulse and its moment about the centre of mass to those that MuJoCo's body is to feel."""
    attitude = matrow(motion.rotation[i], b)
    turning = add(tmul(attitude, moment), cross(row(chain.center[e], b), tmul(attitude, impulse)))
    for j in range(3):
        motion.impulse[b, j] += impulse[j]
        motion.impulse[b, 3 + j] += turning[j]


@kernel
def turned(attitude, vector):
    """Return an attitude turned by a rotation vector in the body frame."""
    return matmul(attitude, axis_angle(unit(vector), norm(vector)))
