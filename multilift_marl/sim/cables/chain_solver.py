"""Tensions of the links of chains in a substep: a linear system, and what the links' turning adds to it.

In a substep h, the force of link j is along its direction d_j at the start of the substep, with the tension

    T_j = k s_j' + c (s_j' - s_j)/h

of its stretch s_j before and s_j' after it. With the velocities u, w of the ends of a link after the substep,

    s_j' = s_j + h d_j · (u - w) + h r_j,

where r_j is what the link's turning adds. Without r_j the tensions solve a linear system: one tridiagonal matrix a
cable, eliminated from the drone down to its first link, and one dense matrix (N, N) of the first links, which meet at
the payload. A few passes with the same factors bring r_j in.
"""

from __future__ import annotations

from math import sqrt

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, cross, dot, matrow, mul, norm, put, row, scale, sub, tmul
from multilift_marl.rig.vehicles import GRAVITY

_PASSES = 2  # at most, over what the links' turning adds: docs/cables.md compares with none
_SETTLED = 1e-6  # [m/s] change of that which needs no further pass: 2.5e-10 m of stretch in a substep


@kernel
def find_links(e, h, state, chain, work):
    """Find direction and stretch of every link, the bodies' motion without cables, and the linear system of a substep.

    Row j of a cable, over h (k h + c): (1/(h (k h + c)) + 1/m_upper + 1/m_lower) T_j less the effect of its neighbours
    on the nodes between them equals (k s_j/(k h + c) + rate of stretch without cables)/h.
    """
    bodies = chain.bodies
    motion = chain.motion
    nodes = chain.nodes
    # Bodies without cables. The momentum is in the world frame, so the gyroscopic torque needs no term.
    for b in range(bodies.mass.shape[1]):
        attitude = matrow(motion.rotation[e], b)
        force = add(row(work.force, b), row(work.bend_force, b))
        put(work.free_velocity[b], add(row(motion.velocity[e], b), scale(h / bodies.mass[e, b], force)))
        torque = add(mul(attitude, row(work.torque, b)), row(work.bend_moment, b))
        momentum = add(row(work.momentum, b), scale(h, torque))
        turning = mul(matrow(bodies.inverse[e], b), tmul(attitude, momentum))
        put(work.free_rates[b], mul(attitude, turning))

    payload = matrow(motion.rotation[e], 0)
    payload_inverse = matrow(bodies.inverse[e], 0)
    for n in range(chain.segments.shape[0]):
        links = chain.segments[n]
        k = chain.stiffness[e, n]
        gain = k * h + chain.damping[n]
        node = 1.0 / chain.node_mass[e, n]

        # Along the cable, from the anchor on the payload up.
        arm = mul(payload, sub(row(chain.cables.anchors, n), row(bodies.center[e], 0)))
        put(work.ends[n, 0], arm)
        low = add(row(motion.position[e], 0), arm)
        low_velocity = add(row(work.free_velocity, 0), cross(row(work.free_rates, 0), arm))
        before = (0.0, 0.0, 0.0)  # direction of the link below
        weight = 0.0  # that a unit impulse of this link gives its lower end along it [1/kg]
        for j in range(links):
            # The upper end: a node, or the hook.
            if j < links - 1:
                high = row(nodes.position[e, n], j)
                weight_up = node
                high_velocity = _free_velocity(e, n, j, h, chain, work)
            else:
                drone = matrow(motion.rotation[e], 1 + n)
                arm = mul(drone, row(chain.cables.hooks, n))
                put(work.ends[n, 1], arm)
                high = add(row(motion.position[e], 1 + n), arm)
                high_velocity = add(row(work.free_velocity, 1 + n), cross(row(work.free_rates, 1 + n), arm))
                weight_up = 1.0 / bodies.mass[e, 1 + n]

            # Direction, stretch and the row of the link.
            link = sub(high, low)
            size = norm(link)
            d = scale(1.0 / max(size, 1e-9), link)
            if j == links - 1:  # a force at the hook turns the drone, too
                moment = tmul(drone, cross(arm, d))
                weight_up += dot(moment, mul(matrow(bodies.inverse[e], 1 + n), moment))
            put(work.direction[n, j], d)
            motion.stretch[e, n, j] = size - chain.length[e, n]
            opening = sub(high_velocity, low_velocity)
            work.turning[n, j] = _turning(d, size, opening, h)
            rate = dot(d, opening)
            work.diagonal[n, j] = 1.0 / (h * gain) + weight_up + weight
            work.right[n, j] = (k * (size - chain.length[e, n]) / gain + rate) / h
            work.coupling[n, j] = -weight * dot(d, before)
            if j == 0:
                turning = mul(payload_inverse, tmul(payload, cross(row(work.ends[n], 0), d)))
                put(work.twist[n], mul(payload, turning))
            low = high
            low_velocity = high_velocity
            before = d
            weight = weight_up


@kernel
def factorize(e, state, chain, work):
    """Factorize the system of a substep: eliminate each cable from its drone down, then Cholesky of the first links."""
    count = chain.segments.shape[0]
    for n in range(count):
        for j in range(_top(e, n, state, chain), 0, -1):
            factor = work.coupling[n, j] / work.diagonal[n, j]
            work.diagonal[n, j - 1] -= factor * work.coupling[n, j]
    for n in range(count):
        d = row(work.direction[n], 0)
        arm = row(work.ends[n], 0)
        for m in range(n + 1):
            there = scale(1.0 / chain.bodies.mass[e, 0], row(work.direction[m], 0))
            total = dot(d, add(there, cross(row(work.twist, m), arm)))
            if m == n:
                total += work.diagonal[n, 0]
            for k in range(m):
                total -= work.matrix[n, k] * work.matrix[m, k]
            work.matrix[n, m] = sqrt(total) if m == n else total / work.matrix[m, m]


@kernel
def solve_tensions(e, h, state, chain, work):
    """Solve for the tensions of all links by the factors, with what the links' turning adds to their stretch."""
    # Right-hand sides, eliminated from the drones down.
    count = chain.segments.shape[0]
    for n in range(count):
        top = _top(e, n, state, chain)
        for j in range(chain.segments[n]):
            work.tension[n, j] = work.right[n, j] + work.turning[n, j] / h
        for j in range(top, 0, -1):
            work.tension[n, j - 1] -= work.coupling[n, j] / work.diagonal[n, j] * work.tension[n, j]

    # The first links: forward and backward substitution. The others follow from the payload up.
    for n in range(count):
        total = work.tension[n, 0]
        for k in range(n):
            total -= work.matrix[n, k] * work.tension[k, 0]
        work.tension[n, 0] = total / work.matrix[n, n]
    for n in range(count - 1, -1, -1):
        total = work.tension[n, 0]
        for k in range(n + 1, count):
            total -= work.matrix[k, n] * work.tension[k, 0]
        work.tension[n, 0] = total / work.matrix[n, n]
        top = _top(e, n, state, chain)
        for j in range(1, top + 1):
            known = work.tension[n, j] - work.coupling[n, j] * work.tension[n, j - 1]
            work.tension[n, j] = known / work.diagonal[n, j]
        for j in range(top + 1, chain.segments[n]):
            work.tension[n, j] = 0.0


@kernel
def _top(e, n, state, chain):
    """Return the last link of cable n that holds: a cable breaks next to its drone."""
    return chain.segments[n] - (2 if state.cable_broken[e, n] else 1)


@kernel
def add_turning(e, h, state, chain, work):
    """Solve again for the tensions, with what the links' turning adds to their stretch, until that has settled."""
    for _ in range(_PASSES):
        if _find_turning(e, h, chain, work) < _SETTLED:
            break
        solve_tensions(e, h, state, chain, work)


@kernel
def _find_turning(e, h, chain, work):
    """Find by how much faster than d · (u - w) links stretch as they turn, by the last tensions; return its change."""
    change = 0.0
    for n in range(chain.segments.shape[0]):
        links = chain.segments[n]
        low_velocity = _end_velocity(e, n, 0, h, chain, work)
        for j in range(links):
            if j < links - 1:
                high_velocity = node_velocity(e, n, j, h, chain, work)
            else:
                high_velocity = _end_velocity(e, n, 1, h, chain, work)
            size = chain.length[e, n] + chain.motion.stretch[e, n, j]
            turning = _turning(row(work.direction[n], j), size, sub(high_velocity, low_velocity), h)
            change = max(change, abs(turning - work.turning[n, j]))
            work.turning[n, j] = turning
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
def _end_velocity(e, n, end, h, chain, work):
    """Return the velocity of an end of cable n after a substep: 0 on the payload, 1 on the drone."""
    b = 0 if end == 0 else 1 + n
    arm = row(work.ends[n], end)
    impulse = (0.0, 0.0, 0.0)
    moment = (0.0, 0.0, 0.0)
    if end == 0:
        for m in range(chain.segments.shape[0]):
            size = h * work.tension[m, 0]
            impulse = add(impulse, scale(size, row(work.direction[m], 0)))
            moment = add(moment, scale(size, row(work.twist, m)))
    else:
        last = chain.segments[n] - 1
        impulse = scale(-h * work.tension[n, last], row(work.direction[n], last))
        attitude = matrow(chain.motion.rotation[e], b)
        moment = mul(attitude, mul(matrow(chain.bodies.inverse[e], b), tmul(attitude, cross(arm, impulse))))
    velocity = add(row(work.free_velocity, b), scale(1.0 / chain.bodies.mass[e, b], impulse))
    return add(velocity, cross(add(row(work.free_rates, b), moment), arm))


@kernel
def node_velocity(e, n, j, h, chain, work):
    """Return the velocity of a node after a substep."""
    force = scale(work.tension[n, j + 1], row(work.direction[n], j + 1))
    force = sub(force, scale(work.tension[n, j], row(work.direction[n], j)))
    return add(_free_velocity(e, n, j, h, chain, work), scale(h / chain.node_mass[e, n], force))


@kernel
def _free_velocity(e, n, j, h, chain, work):
    """Return the velocity of a node after a substep, were it not for the tensions."""
    change = scale(h / chain.node_mass[e, n], row(work.bending[n], j))
    return sub(add(row(chain.nodes.velocity[e, n], j), change), (0.0, 0.0, h * GRAVITY))


@kernel
def steepness(e, h, chain, work):
    """Return the largest |T| h²/(m l) of all links: at 1 their motion across becomes unstable."""
    worst = 0.0
    for n in range(chain.segments.shape[0]):
        inertia = chain.node_mass[e, n] * chain.length[e, n]
        for j in range(chain.segments[n]):
            worst = max(worst, abs(work.tension[n, j]) / inertia)
    return worst * h * h
