"""The pulls with which the cables exert a wrench on the payload, and where the drones are that pull so."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.control.formation import hook_arm, place_formation
from multilift_marl.math3d import (
    add,
    cross,
    dot,
    matmul,
    matrow,
    mul,
    norm,
    put,
    row,
    scale,
    sub,
    tmul,
    transpose,
    unit,
    vec,
)
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.cables.catenary import cable_end

TILT_WIDENING = 1.8  # [-] at tilted targets, see `place_balanced`
MIN_TENSION_RATIO = 0.2  # of its given tension, with which every cable is to pull
BALANCED = 1e-6  # [N] and [N m] for each N of weight: balance to within rounding
_DAMPING = 1e-9  # relative; makes moments that no pulls can exert harmless
_ITERATIONS = 20
_STILL = (0.0, 0.0, 0.0)


class WrenchDistribution(NamedTuple):
    """How `spread` finds λ = A F + B M and μ = Bᵀ F + C M, all in the payload's frame."""

    a: tuple[float, ...]
    """9 numbers, like the next ones."""
    b: tuple[float, ...]
    c: tuple[float, ...]


def make_wrench_distribution(anchors: np.ndarray) -> WrenchDistribution:
    """Return how wrenches are spread over anchors (N, 3) [m].

    Where pulls cannot exert one, what is left is least, moments over a lever counted as forces are.
    """
    x, y, z = anchors.T
    zero, lever = np.zeros_like(x), np.sqrt((anchors**2).sum(axis=1).mean() * 2 / 3) or 1.0
    arms = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]) / lever  # r ×
    exerted = np.vstack([np.tile(np.eye(3), len(anchors)), arms.transpose(0, 2, 1).reshape(3, -1)])
    inverse = np.linalg.pinv(exerted @ exerted.T, rcond=1e-9, hermitian=True)
    parts = inverse[:3, :3], inverse[:3, 3:] / lever, inverse[3:, 3:] / lever**2
    return WrenchDistribution(*(tuple(part.ravel().tolist()) for part in parts))


@kernel
def spread(force, moment, attitude, by):
    """Return λ, μ such that pulls changed by λ + μ × r_i, the least change that does so, exert a wrench more.

    With it `solve_pulls` is solved at once where no cable is at its bound.

    Args:
        force, moment: to be exerted beside what the pulls exert [N], [N m], world frame.
        attitude: of the payload, 9 numbers.
        by: Spread over the anchors.
    """
    f, m = tmul(attitude, force), tmul(attitude, moment)
    linear, angular = add(mul(by.a, f), mul(by.b, m)), add(tmul(by.b, f), mul(by.c, m))
    return mul(attitude, linear), mul(attitude, angular)


@kernel
def solve_cable_forces(force, moment, attitude, anchors, least, cable_force):
    """Replace the pulls (N, 3) by the nearest ones that exert a wrench, every cable pulling; return the imbalance.

    Pulls f_i minimise Σ |f_i - n_i|² subject to Σ f_i = F, Σ r_i × f_i = M and u_i · f_i ≥ t_i, with n_i the given
    ones, u_i = n_i/|n_i|, t_i = `least` |n_i|. By the conditions of Karush, Kuhn and Tucker f_i = v_i +
    max(0, t_i - u_i · v_i) u_i with v_i = n_i + λ + μ × r_i, so that only six numbers are sought, which Newton's method
    finds exactly in a few steps: the six equations are linear while the same cables are at their bounds.

    Args:
        force, moment: F on the payload [N], M about its centre of mass [N m], world frame.
        attitude: of the payload, 9 numbers.
        anchors: (N, 3) in its frame [m].
        least: tension of every cable over that of its given pull, at least; -inf for no bound.
        pull: (N, 3) n_i, world frame [N]; written.

    Returns:
        What is left of F and M, the largest component [N], [N m]; of a moment that these cables cannot exert, most.
    """
    linear, angular = _STILL, _STILL
    imbalance, exact = np.inf, 1e-13 * max(_largest(force), 1.0)
    for _ in range(_ITERATIONS):
        lacking, twisting, a, b, c = _balance(force, moment, attitude, anchors, least, cable_force, linear, angular)
        left = max(_largest(lacking), _largest(twisting))
        stalled = abs(left - imbalance) < 0.01 * imbalance
        imbalance = left
        if stalled or left <= exact:
            break
        inverse = _inverse(a, _DAMPING * (a[0] + a[4] + a[8]))
        # a symmetric system in blocks: a Δλ + b Δμ = lacking, bᵀ Δλ + c Δμ = twisting
        through = matmul(transpose(b), inverse)
        schur = _minus(c, matmul(through, b))
        change = mul(_inverse(schur, _DAMPING * (c[0] + c[4] + c[8])), sub(twisting, mul(through, lacking)))
        linear = add(linear, mul(inverse, sub(lacking, mul(b, change))))
        angular = add(angular, change)
    for i in range(cable_force.shape[0]):
        given = (cable_force[i, 0], cable_force[i, 1], cable_force[i, 2])
        arm = mul(attitude, (anchors[i, 0], anchors[i, 1], anchors[i, 2]))
        put(cable_force[i], _pull(given, arm, least, linear, angular)[0])
    return imbalance


@kernel
def _pull(given, arm, least, linear, angular):
    """Return f_i and whether the cable is at its bound."""
    free = add(add(given, linear), cross(angular, arm))
    size = norm(given)
    along = scale(1.0 / size, given)
    short = least * size - dot(along, free)
    if short > 0.0:
        return add(free, scale(short, along)), True
    return free, False


@kernel
def _balance(force, moment, attitude, anchors, least, cable_force, linear, angular):
    """Return what is left of force and moment, and the blocks a, b, c of their derivative by λ and μ."""
    a = b = c = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for i in range(cable_force.shape[0]):
        given = (cable_force[i, 0], cable_force[i, 1], cable_force[i, 2])
        arm = mul(attitude, (anchors[i, 0], anchors[i, 1], anchors[i, 2]))
        own, bound = _pull(given, arm, least, linear, angular)
        force, moment = sub(force, own), sub(moment, cross(arm, own))
        u = scale(1.0 if bound else 0.0, unit(given))
        p = (
            1.0 - u[0] * u[0], -u[0] * u[1], -u[0] * u[2],
            -u[1] * u[0], 1.0 - u[1] * u[1], -u[1] * u[2],
            -u[2] * u[0], -u[2] * u[1], 1.0 - u[2] * u[2],
        )  # fmt: skip
        x = (0.0, arm[2], -arm[1], -arm[2], 0.0, arm[0], arm[1], -arm[0], 0.0)  # x μ = μ × r
        px = matmul(p, x)
        a, b, c = _plus(a, p), _plus(b, px), _plus(c, matmul(transpose(x), px))
    return force, moment, a, b, c


@kernel
def _largest(v):
    return max(abs(v[0]), abs(v[1]), abs(v[2]))


@kernel
def _plus(p, q):
    return (
        p[0] + q[0], p[1] + q[1], p[2] + q[2], p[3] + q[3], p[4] + q[4], p[5] + q[5], p[6] + q[6], p[7] + q[7],
        p[8] + q[8],
    )  # fmt: skip


@kernel
def _minus(p, q):
    return (
        p[0] - q[0], p[1] - q[1], p[2] - q[2], p[3] - q[3], p[4] - q[4], p[5] - q[5], p[6] - q[6], p[7] - q[7],
        p[8] - q[8],
    )  # fmt: skip


@kernel
def _inverse(m, damping):
    """Return the inverse of a symmetric, positive semidefinite matrix with `damping` added to its diagonal."""
    damping = max(damping, 1e-30)
    x = (m[0] + damping, m[3], m[6])
    y = (m[1], m[4] + damping, m[7])
    z = (m[2], m[5], m[8] + damping)
    r0, r1, r2 = cross(y, z), cross(z, x), cross(x, y)
    k = 1.0 / dot(x, r0)
    return (k * r0[0], k * r0[1], k * r0[2], k * r1[0], k * r1[1], k * r1[2], k * r2[0], k * r2[1], k * r2[2])


@kernel
def drone_offset(n, cable_force, hanging):
    """Return where the drone is, from its anchor, that pulls the payload by `pull` [N] through cable n at rest [m]."""
    middle = add(cable_force, (0.0, 0.0, 0.5 * hanging.weight[n]))
    size = norm(middle)
    return cable_end(
        scale(1.0 / size, middle), size, hanging.length[n], hanging.stiffness[n], hanging.segments[n], hanging.weight[n]
    )


@kernel
def place_slots(e, goal, rig, hanging):
    """Write the slots of environment e from which drones pull as `goal.pull`, there with the payload's pulls, says.

    The pulls become those of the drones, which carry the cables too.
    """
    target, position = matrow(goal.rotation, e), row(goal.position, e)
    for n in range(rig.anchors.shape[0]):
        cable_force = vec(goal.cable_force, e, n)
        anchor, held = add(position, mul(target, row(rig.anchors, n))), add(cable_force, (0.0, 0.0, hanging.weight[n]))
        hook = add(anchor, drone_offset(n, cable_force, hanging))
        put(goal.cable_force[e, n], held)
        put(goal.slots[e, n], sub(hook, hook_arm(n, held, goal.drone_yaw[e], rig)))


@kernel
def place_balanced(e, goal, rig, hanging):
    """Do as `place_formation`, for tilted targets too; return whether the team can hold the payload there.

    Over a level target the formation balances. Over one tilted by θ its pulls, with 1 + `WIDER` (1 - cos θ) times their
    level parts, are changed as little as balances weight and moment, each cable keeping `LEAST` of its widened pull;
    the slots follow from them. Wider pulls keep cables apart whose anchors come to lie one over the other.
    """
    place_formation(e, goal, rig)
    target = matrow(goal.rotation, e)
    if target[8] > 1.0 - 1e-12 or not np.any(rig.anchors != 0.0):
        return True
    for n in range(rig.anchors.shape[0]):
        cable_force = vec(goal.cable_force, e, n)
        wide = 1.0 + TILT_WIDENING * (1.0 - target[8])
        put(goal.cable_force[e, n], (wide * cable_force[0], wide * cable_force[1], cable_force[2] - hanging.weight[n]))
    weight = hanging.payload_mass * GRAVITY
    left = solve_cable_forces((0.0, 0.0, weight), _STILL, target, rig.anchors, MIN_TENSION_RATIO, goal.cable_force[e])
    place_slots(e, goal, rig, hanging)
    return left <= BALANCED * weight


@kernel
def is_stable(e, goal, rig, hanging, stiffness):
    """Return whether the payload, pushed a little, would come back to a tilted goal, the drones held by springs.

    The potential energy of payload, cables and springs is to be convex there. Between its spring and the payload a
    cable gives way across by L/T and along by 1/k, so that an anchor moved by x is pulled back by S x,
    S⁻¹ = (T/L (1 - u uᵀ) + k u uᵀ)⁻¹ + 1/κ; where the payload turns, the arm of the pull turns too.

    Args:
        e, goal, rig, hanging: after `place_balanced`.
        stiffness: (N,) κ [N/m].
    """
    target = matrow(goal.rotation, e)
    a = b = c = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for n in range(rig.anchors.shape[0]):
        r = mul(target, row(rig.anchors, n))
        f = sub(vec(goal.cable_force, e, n), (0.0, 0.0, hanging.weight[n]))
        size = norm(f)
        u, soft = scale(1.0 / size, f), 1.0 / stiffness[n]
        across = 1.0 / (hanging.length[n] / size + soft)
        along = 1.0 / (1.0 / hanging.stiffness[n] + soft) - across
        s = _plus(_diagonal(across), _outer(scale(along, u), u))
        x = (0.0, r[2], -r[1], -r[2], 0.0, r[0], r[1], -r[0], 0.0)  # x θ = θ × r
        sx, arm = matmul(s, x), _outer(scale(0.5, r), f)
        a, b = _plus(a, s), _plus(b, sx)
        c = _plus(c, _minus(_plus(matmul(transpose(x), sx), _diagonal(dot(r, f))), _plus(arm, transpose(arm))))
    m = _minus(c, matmul(matmul(transpose(b), _inverse(a, 0.0)), b))
    determinant = dot((m[0], m[1], m[2]), cross((m[3], m[4], m[5]), (m[6], m[7], m[8])))
    return m[0] > 0.0 and m[0] * m[4] - m[1] * m[3] > 0.0 and determinant > 0.0


@kernel
def _diagonal(x):
    return (x, 0.0, 0.0, 0.0, x, 0.0, 0.0, 0.0, x)


@kernel
def _outer(x, y):
    return (
        x[0] * y[0], x[0] * y[1], x[0] * y[2], x[1] * y[0], x[1] * y[1], x[1] * y[2], x[2] * y[0], x[2] * y[1],
        x[2] * y[2],
    )  # fmt: skip
