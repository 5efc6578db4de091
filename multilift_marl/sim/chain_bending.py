"""The resistance of chains to bending: springs and dampers between neighbouring links."""

from __future__ import annotations

from math import atan2

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, cross, dot, matrow, mul, norm, put, row, scale, sub


@kernel
def find_bending(e, i, state, chain, nodes, motion):
    """Find the forces of bending on nodes and bodies: of the moment κ θ + β θ̇ at the angle θ between two links.

    The forces on the three points of a bend are the moment times the derivatives of θ by their places. They have
    neither a sum nor a moment. Anchor and hook are free pivots.
    """
    motion.bend_power[0] = 0.0
    motion.bend_force[:] = 0.0
    motion.bend_moment[:] = 0.0
    motion.bending[:] = 0.0
    payload = matrow(motion.rotation[i], 0)
    for n in range(chain.segments.shape[0]):
        links = chain.segments[n]
        arm = mul(payload, sub(row(chain.anchors, n), row(chain.center[e], 0)))
        low, low_velocity = _end(i, 0, arm, motion)
        middle, middle_velocity = row(nodes.position[e, n], 0), row(nodes.velocity[e, n], 0)
        for j in range(links - 1):
            if j < links - 2:
                high, high_velocity = row(nodes.position[e, n], j + 1), row(nodes.velocity[e, n], j + 1)
            elif state.cable_broken[e, n]:
                break
            else:
                hook = mul(matrow(motion.rotation[i], 1 + n), row(chain.hooks, n))
                high, high_velocity = _end(i, 1 + n, hook, motion)
            first, second = sub(middle, low), sub(high, middle)
            size1, size2 = norm(first), norm(second)
            d1, d2 = scale(1.0 / size1, first), scale(1.0 / size2, second)
            sine, cosine = norm(cross(d1, d2)), dot(d1, d2)
            if sine > 1e-9:
                # The angle shrinks as d1 moves along e1 and d2 along e2, unit vectors across the links in the bend.
                e1 = scale(1.0 / (sine * size1), sub(d2, scale(cosine, d1)))
                e2 = scale(1.0 / (sine * size2), sub(d1, scale(cosine, d2)))
                closing = dot(e1, sub(middle_velocity, low_velocity)) + dot(e2, sub(high_velocity, middle_velocity))
                motion.bend_power[0] += chain.bending_damping[n] * closing * closing
                moment = chain.bending_stiffness[n] * atan2(sine, cosine) - chain.bending_damping[n] * closing
                on_low, on_high = scale(-moment, e1), scale(moment, e2)
                on_middle = sub((0.0, 0.0, 0.0), add(on_low, on_high))
                put(motion.bending[n, j], add(row(motion.bending[n], j), on_middle))
                if j > 0:
                    put(motion.bending[n, j - 1], add(row(motion.bending[n], j - 1), on_low))
                else:
                    put(motion.bend_force[0], add(row(motion.bend_force, 0), on_low))
                    put(motion.bend_moment[0], add(row(motion.bend_moment, 0), cross(arm, on_low)))
                if j < links - 2:
                    put(motion.bending[n, j + 1], add(row(motion.bending[n], j + 1), on_high))
                else:
                    put(motion.bend_force[1 + n], on_high)
                    put(motion.bend_moment[1 + n], cross(hook, on_high))
            low, low_velocity, middle, middle_velocity = middle, middle_velocity, high, high_velocity


@kernel
def _end(i, b, arm, motion):
    """Return place and velocity of a point of body b, `arm` from its centre of mass in the world frame."""
    rates = mul(matrow(motion.rotation[i], b), row(motion.rates[i], b))
    return add(row(motion.position[i], b), arm), add(row(motion.velocity[i], b), cross(rates, arm))
