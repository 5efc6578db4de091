"""Tensions of the links of chains in a substep: a linear system, and what the links' turning adds to it.

In a substep h, the force of link j is along its direction d_j at the start of the substep, with the tension

    T_j = k (s_j + ½ (1 + η) (s_j' - s_j) - ½ (1 - η) (s_j - s_j°)) + c (s_j' - s_j)/h

of its stretch s_j before and s_j' after it, and s_j° one substep earlier. η = 1 would be backward Euler, which takes
the energy of a bounce, η = 0 a symplectic rule that keeps it, with that of waves that no substep resolves; a small η
leaves slow motion alone and calms those in time. With the velocities u, w of the ends of a link after the substep,

    s_j' = s_j + h d_j · (u - w) + h r_j,

where r_j is what the link's turning adds. Without r_j the tensions solve a linear system: one tridiagonal matrix a
cable, eliminated from the drone down to its first link, and one dense matrix (N, N) of the first links, which meet at
the payload. A few passes with the same factors bring r_j in.
"""

from __future__ import annotations

from math import sqrt

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, cross, dot, matrow, mul, norm, put, row, scale, sub, tmul
from multilift_marl.physical import GRAVITY

_CALMING = 0.01  # [-] η: it damps a bounce of frequency ω [rad/s] by η ω² h/2 [1/s], 5e-3 at 10 Hz
_PASSES = 2  # at most, over what the links' turning adds: docs/cables.md compares with none
_SETTLED = 1e-6  # [m/s] change of that which needs no further pass: 2.5e-10 m of stretch in a substep


@kernel
def find_links(e, h, state, chain, work):
    """Find direction and stretch of every link, the bodies' motion without cables, and the linear system of a substep.

    With g = ½ (1 + η) k h + c, row j of a cable, over h g: (1/(h g) + 1/m_upper + 1/m_lower) T_j less the effect of its
    neighbours on the nodes between them equals (T_j at an unchanged stretch over g + rate of stretch without cables)/h.
    """
    bodies = chain.bodies
    motion = chain.motion
    nodes = chain.nodes
    # Bodies without cables. The momentum is in the world frame, so the gyroscopic torque needs no term.
    for b in range(bodies.mass.shape[1]):
        attitude = matrow(motion.rotation[e], b)
        # Forces in the world frame, loads' torques in the body frame, moments of bending in the world frame.
        force = add(row(work.force, b), row(work.bend_force, b))
        put(work.free_velocity[b], add(row(motion.velocity[e], b), scale(h / bodies.mass[e, b], force)))
        torque = add(mul(attitude, row(work.torque, b)), row(work.bend_moment, b))
        momentum = add(row(work.momentum, b), scale(h, torque))
        # Ω = J⁻¹ Rᵀ L in the body frame, then turned to the world.
        turning = mul(matrow(bodies.inverse[e], b), tmul(attitude, momentum))
        put(work.free_rates[b], mul(attitude, turning))

    payload = matrow(motion.rotation[e], 0)
    payload_inverse = matrow(bodies.inverse[e], 0)
    for n in range(chain.segments.shape[0]):
        links = chain.segments[n]
        k = chain.stiffness[e, n]
        gain = stretch_gain(k, chain.damping[n], h)
        # The part of T_j that remembers: ½ (1 - η) k (s_j - s_j°), with the rate of a substep ago times h.
        memory = 0.5 * (1.0 - _CALMING) * k * h
        node = 1.0 / chain.node_mass[e, n]

        # Along the cable, from the anchor on the payload up.
        arm = mul(payload, sub(row(chain.cables.anchors, n), row(bodies.center[e], 0)))
        put(work.ends[n, 0], arm)
        low = add(row(motion.position[e], 0), arm)
        low_velocity = add(row(work.free_velocity, 0), cross(row(work.free_rates, 0), arm))
        low_last = _last_velocity(e, 0, payload, arm, motion)
        before = (0.0, 0.0, 0.0)  # direction of the link below
        # The first link's lower end is the payload, which all cables share: its mobility is in the matrix of
        # `factorize`.
        weight = 0.0  # that a unit impulse of this link gives its lower end along it [1/kg]
        for j in range(links):
            # The upper end: a node, or the hook.
            if j < links - 1:
                high = row(nodes.position[e, n], j)
                weight_up = node
                high_velocity = _free_velocity(e, n, j, h, chain, work)
                high_last = row(nodes.velocity[e, n], j)
            else:
                drone = matrow(motion.rotation[e], 1 + n)
                arm = mul(drone, row(chain.cables.hooks, n))
                put(work.ends[n, 1], arm)
                high = add(row(motion.position[e], 1 + n), arm)
                high_velocity = add(row(work.free_velocity, 1 + n), cross(row(work.free_rates, 1 + n), arm))
                high_last = _last_velocity(e, 1 + n, drone, arm, motion)
                weight_up = 1.0 / bodies.mass[e, 1 + n]

            # Direction, stretch and the row of the link.
            link = sub(high, low)
            # Two nodes in one place have no direction between them: the floor leaves d = 0 and no force, in place of
            # NaN.
            size = max(norm(link), 1e-9)
            per_size = 1.0 / size
            d = scale(per_size, link)
            if j == links - 1:  # a force at the hook turns the drone, too
                moment = tmul(drone, cross(arm, d))
                weight_up += dot(moment, mul(matrow(bodies.inverse[e], 1 + n), moment))
            put(work.direction[n, j], d)
            motion.stretch[e, n, j] = size - chain.length[e, n]
            opening = sub(high_velocity, low_velocity)
            work.turning[n, j] = _turning(d, size, opening, h)
            rate = dot(d, opening)
            last = sub(high_last, low_last)
            # (s_j - s_j°)/h, to second order in h: the link's velocity across it lengthens it by h² |across|²/2 l in a
            # substep.
            past = dot(d, last)
            past -= 0.5 * h * per_size * max(dot(last, last) - past * past, 0.0)  # rate of stretch one substep ago
            # T_j = steady + g times the rate of stretch in the substep, and the rate is that without cables less h
            # times what the tensions take of it: divided by h g, row j of the system.
            work.steady[n, j] = k * (size - chain.length[e, n]) - memory * past
            work.diagonal[n, j] = 1.0 / (h * gain) + weight_up + weight
            work.right[n, j] = (work.steady[n, j] / gain + rate) / h
            # T_j draws the node below it up, which stretches the link below by d · before of that; row j - 1 has the
            # same number.
            work.coupling[n, j] = -weight * dot(d, before)
            if j == 0:
                turning = mul(payload_inverse, tmul(payload, cross(row(work.ends[n], 0), d)))
                put(work.twist[n], mul(payload, turning))
            low = high
            low_velocity = high_velocity
            low_last = high_last
            before = d
            weight = weight_up


@kernel
def stretch_gain(stiffness, damping, h):
    """Return by how much a link's tension grows with the rate of its stretch in a substep [N s/m]."""
    return 0.5 * (1.0 + _CALMING) * stiffness * h + damping


@kernel
def _last_velocity(e, b, attitude, arm, motion):
    """Return the velocity of a point of body b at the start of a substep, `arm` from its centre of mass."""
    return add(row(motion.velocity[e], b), cross(mul(attitude, row(motion.rates[e], b)), arm))


@kernel
def factorize(e, state, chain, work):
    """Factorize the system of a substep: eliminate each cable from its drone down, then Cholesky of the first links."""
    count = chain.segments.shape[0]
    for n in range(count):
        for j in range(_top(e, n, state, chain), 0, -1):
            # From the drone down: what is left at the first link depends on the payload alone, and a broken cable just
            # begins one link lower. The diagonal keeps the pivots for `solve_tensions`.
            factor = work.coupling[n, j] / work.diagonal[n, j]
            work.diagonal[n, j - 1] -= factor * work.coupling[n, j]
    for n in range(count):
        d = row(work.direction[n], 0)
        arm = row(work.ends[n], 0)
        for m in range(n + 1):
            # Velocity at anchor n along link n for a unit impulse along link m: of the shift d_m/M, and of the turn J⁻¹
            # (r_m × d_m).
            there = scale(1.0 / chain.bodies.mass[e, 0], row(work.direction[m], 0))
            total = dot(d, add(there, cross(row(work.twist, m), arm)))
            if m == n:
                total += work.diagonal[n, 0]
            # Cholesky, row by row; the matrix is positive definite, since every diagonal has 1/(h g) > 0.
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
            # r_j of the last pass; the first has it from velocities without cables (`find_links`).
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
        # The directions d_j stay those of the start of the substep: only their effect on lengths is brought up to date.
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
    # The link after the substep has the part size + h d · opening along d, and h times the rest of `opening` across it.
    # Its length less `along`, over h, is (√(along² + across) - along)/h; written as a quotient, because the difference
    # of two nearly equal lengths loses all digits where a link hardly turns.
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
            # The payload feels all cables: each draws it up along its first link.
            size = h * work.tension[m, 0]
            impulse = add(impulse, scale(size, row(work.direction[m], 0)))
            moment = add(moment, scale(size, row(work.twist, m)))
    else:
        last = chain.segments[n] - 1
        # The drone feels its own cable, which draws it down.
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
            # Of pushed links too: compression drives the motion across it apart, a tension makes it swing.
            worst = max(worst, abs(work.tension[n, j]) / inertia)
    return worst * h * h
