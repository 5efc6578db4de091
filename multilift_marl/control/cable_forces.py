"""Cable forces that exert a wrench on the payload, and where the drones are that exert them.

One problem: the forces nearest to given ones whose sum and moment are prescribed. Three solvers, which agree to
round-off where the cables can exert them (tests/control/test_cable_forces.py):

- `solve_cable_forces`, a kernel, in general: every cable keeps a least tension, found by Newton's method;
- `distribute_wrench`, a kernel, without that bound: one product with an inverse that `make_wrench_distribution`
  computes once for a rig, for planned motions that ask for it at every control step;
- `balance_forces`, in NumPy, without that bound: many attitudes at once, once for a configuration.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.control.formation import hook_arm, place_formation
from multilift_marl.kernels.jit import kernel
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
from multilift_marl.physical import GRAVITY
from multilift_marl.sim.cables.catenary import cable_end

TILT_WIDENING = 1.8  # [-] at tilted targets, see `place_balanced`
MIN_TENSION_RATIO = 0.2  # least tension of every cable, over its given one
BALANCED = 1e-6  # [N] and [N m] for each N of weight: balance to within rounding
RANK = 1e-9  # singular values below it, relative to the largest, count as zero
_DAMPING = 1e-9  # relative; keeps the equations regular where no cable forces can exert some moment
_ITERATIONS = 20  # Newton's method ends after three to six
_ZERO = (0.0, 0.0, 0.0)


class WrenchDistribution(NamedTuple):
    """How `distribute_wrench` finds λ = A F + B M and μ = Bᵀ F + C M, all in the payload's frame."""

    a: tuple[float, ...]
    """9 numbers, like the next ones."""
    b: tuple[float, ...]
    c: tuple[float, ...]


def wrench_matrix(arms: np.ndarray) -> np.ndarray:
    """Return G (..., 6, 3 N), by which forces (3 N,) at `arms` (..., N, 3) exert force and moment."""
    x, y, z = np.moveaxis(arms, -1, 0)
    zero = np.zeros_like(x)
    cross_matrix = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])  # (3, 3, ..., N): r × of each arm
    moments = np.moveaxis(cross_matrix, (0, 1), (-3, -1)).reshape(*arms.shape[:-2], 3, -1)
    forces = np.broadcast_to(np.tile(np.eye(3), arms.shape[-2]), moments.shape)
    return np.concatenate([forces, moments], axis=-2)


def balance_forces(arms: np.ndarray, nominal: np.ndarray, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the forces nearest to nominal ones that exert a wrench, and by how much they miss it.

    Args:
        arms: from the payload's centre of mass to the anchors, in A attitudes (A, N, 3) [m].
        nominal: forces (N, 3) [N].
        wrench: force and moment in each attitude (A, 6) [N], [N m].

    Returns:
        Forces (A, N, 3) [N], and the largest component of the wrench that they do not exert (A,) [N], [N m].
    """
    matrix, flat = wrench_matrix(arms), nominal.ravel()
    change = np.einsum("aij,aj->ai", np.linalg.pinv(matrix, rcond=RANK), wrench - matrix @ flat)
    missed = np.einsum("aij,aj->ai", matrix, flat + change) - wrench
    return (flat + change).reshape(arms.shape), np.abs(missed).max(axis=1)


def make_wrench_distribution(anchors: np.ndarray) -> WrenchDistribution:
    """Return how wrenches are distributed over anchors (N, 3) [m].

    Where forces cannot exert one, what is left is least, moments over a lever counted as forces are.
    """
    # The mean arm of a moment about any axis: two of three coordinates count. 1 for a point, which has no moments.
    lever = np.sqrt((anchors**2).sum(axis=1).mean() * 2 / 3) or 1.0
    exerted = wrench_matrix(anchors)
    exerted[3:] /= lever
    # f = Gᵀ (G Gᵀ)⁻¹ w, the least-norm solution: its (λ, μ) is (G Gᵀ)⁻¹ w, here in units of force and undone below.
    inverse = np.linalg.pinv(exerted @ exerted.T, rcond=RANK, hermitian=True)
    parts = inverse[:3, :3], inverse[:3, 3:] / lever, inverse[3:, 3:] / lever**2
    return WrenchDistribution(*(tuple(part.ravel().tolist()) for part in parts))


@kernel
def distribute_wrench(force, moment, attitude, distribution):
    """Return λ, μ such that forces changed by λ + μ × r_i, the least change that does so, exert a wrench more.

    It solves the problem of `solve_cable_forces` where no cable is at its bound.

    Args:
        force, moment: to be exerted beside what the given forces exert [N], [N m], world frame.
        attitude: of the payload, 9 numbers.
        distribution: WrenchDistribution over the anchors.
    """
    f = tmul(attitude, force)
    m = tmul(attitude, moment)
    linear = add(mul(distribution.a, f), mul(distribution.b, m))
    angular = add(tmul(distribution.b, f), mul(distribution.c, m))
    return mul(attitude, linear), mul(attitude, angular)


@kernel
def solve_cable_forces(force, moment, attitude, anchors, least, cable_force):
    """Replace forces (N, 3) by the nearest ones that exert a wrench, every cable taut; return the imbalance.

    Forces f_i minimise Σ |f_i - n_i|² subject to Σ f_i = F, Σ r_i × f_i = M and u_i · f_i ≥ t_i, with n_i the given
    ones, u_i = n_i/|n_i|, t_i = `least` |n_i|. By the conditions of Karush, Kuhn and Tucker f_i = v_i +
    max(0, t_i - u_i · v_i) u_i with v_i = n_i + λ + μ × r_i, so that only six numbers are sought, which Newton's method
    finds exactly in a few steps: the six equations are linear while the same cables are at their bounds.

    Args:
        force, moment: F on the payload [N], M about its centre of mass [N m], world frame.
        attitude: of the payload, 9 numbers.
        anchors: (N, 3) in its frame [m].
        least: tension of every cable over its given one, at least; -inf for no bound.
        cable_force: (N, 3) n_i, world frame [N]; written.

    Returns:
        What is left of F and M, the largest component [N], [N m]; of a moment that these cables cannot exert, most.
    """
    linear = _ZERO  # λ
    angular = _ZERO  # μ
    by_linear = by_angular = _ZERO  # the last step
    left = imbalance = np.inf
    at_bounds = -1
    exact = 1e-13 * max(_largest(force), 1.0)  # round-off of the sums
    for _ in range(_ITERATIONS):
        # What the forces of these λ, μ leave of the wrench. It ends there if that is nothing, or stays as it is where
        # the equations are linear. Half of a step is taken back that led far away, to cables that nearly depend on
        # one another.
        wrench = (force, moment)
        missing, (a, b, c), bound = _balance(wrench, attitude, anchors, least, cable_force, linear, angular)
        lacking, twisting = missing
        left = max(_largest(lacking), _largest(twisting))
        if left <= exact or (bound == at_bounds and abs(left - imbalance) < 0.01 * imbalance):
            break
        if bound != at_bounds and left > 1e4 * imbalance:
            by_linear, by_angular = scale(0.5, by_linear), scale(0.5, by_angular)
            linear, angular = sub(linear, by_linear), sub(angular, by_angular)
            continue
        imbalance, at_bounds = left, bound

        # Newton's step, a symmetric system in blocks: a Δλ + b Δμ = lacking, bᵀ Δλ + c Δμ = twisting, by the Schur
        # complement of a.
        # Damped in proportion to the trace: all cables in one line leave a turn about it without stiffness.
        inverse = _inverse(a, _DAMPING * (a[0] + a[4] + a[8]))
        through = matmul(transpose(b), inverse)
        schur = _minus(c, matmul(through, b))
        change = mul(_inverse(schur, _DAMPING * (c[0] + c[4] + c[8])), sub(twisting, mul(through, lacking)))
        by_linear, by_angular = mul(inverse, sub(lacking, mul(b, change))), change
        linear, angular = add(linear, by_linear), add(angular, by_angular)

    # The forces of the λ, μ found.
    for i in range(cable_force.shape[0]):
        arm = mul(attitude, row(anchors, i))
        put(cable_force[i], _bounded_force(row(cable_force, i), arm, least, linear, angular)[0])
    return left


@kernel
def _bounded_force(given, arm, least, linear, angular):
    """Return f_i and whether the cable is at its bound."""
    free = add(add(given, linear), cross(angular, arm))
    size = norm(given)
    along = scale(1.0 / size, given)
    short = least * size - dot(along, free)
    if short > 0.0:
        return add(free, scale(short, along)), True
    return free, False


@kernel
def _balance(wrench, attitude, anchors, least, cable_force, linear, angular):
    """Return what is left of force and moment, blocks a, b, c of its derivative by λ and μ, which cables are at bounds.

    The last is a sum of powers of two.
    """
    force, moment = wrench
    at_bounds = 0
    a = b = c = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for i in range(cable_force.shape[0]):
        # The force of one cable, taken from the wrench.
        given = row(cable_force, i)
        arm = mul(attitude, row(anchors, i))
        own, bound = _bounded_force(given, arm, least, linear, angular)
        force = sub(force, own)
        moment = sub(moment, cross(arm, own))

        # Its derivative: P = 1, or 1 - u uᵀ of a cable at its bound, by λ; P X by μ.
        at_bounds += 2**i if bound else 0
        u = scale(1.0 if bound else 0.0, unit(given))
        p = (
            1.0 - u[0] * u[0], -u[0] * u[1], -u[0] * u[2],
            -u[1] * u[0], 1.0 - u[1] * u[1], -u[1] * u[2],
            -u[2] * u[0], -u[2] * u[1], 1.0 - u[2] * u[2],
        )  # fmt: skip
        x = (0.0, arm[2], -arm[1], -arm[2], 0.0, arm[0], arm[1], -arm[0], 0.0)  # x μ = μ × r
        px = matmul(p, x)
        a, b, c = _plus(a, p), _plus(b, px), _plus(c, matmul(transpose(x), px))
    return (force, moment), (a, b, c), at_bounds


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
    # By cofactors. Of a matrix of zeros the inverse is huge, but finite.
    damping = max(damping, 1e-30)
    x = (m[0] + damping, m[3], m[6])
    y = (m[1], m[4] + damping, m[7])
    z = (m[2], m[5], m[8] + damping)
    r0, r1, r2 = cross(y, z), cross(z, x), cross(x, y)
    k = 1.0 / dot(x, r0)
    return (k * r0[0], k * r0[1], k * r0[2], k * r1[0], k * r1[1], k * r1[2], k * r2[0], k * r2[1], k * r2[2])


@kernel
def drone_offset(n, cable_force, rig):
    """Return where drone n is, from its anchor, as its cable exerts `cable_force` [N] on the payload at rest [m]."""
    middle = add(cable_force, (0.0, 0.0, 0.5 * rig.cable_weight[n]))
    size = norm(middle)
    return cable_end(
        scale(1.0 / size, middle),
        size,
        rig.cable_length[n],
        rig.cable_stiffness[n],
        rig.cable_segments[n],
        rig.cable_weight[n],
    )


@kernel
def place_slots(e, goal, rig):
    """Write the slots of environment e from which drones exert `goal.cable_force` on the payload.

    The forces become those of the drones on their cables, whose weight they carry too.
    """
    target, position = matrow(goal.rotation, e), row(goal.position, e)
    for n in range(rig.anchors.shape[0]):
        cable_force = vec(goal.cable_force, e, n)
        anchor = add(position, mul(target, row(rig.anchors, n)))
        held = add(cable_force, (0.0, 0.0, rig.cable_weight[n]))
        hook = add(anchor, drone_offset(n, cable_force, rig))
        put(goal.cable_force[e, n], held)
        put(goal.slots[e, n], sub(hook, hook_arm(n, held, goal.drone_yaw[e], rig)))


@kernel
def place_balanced(e, goal, rig):
    """Do as `place_formation`, for tilted targets too; return whether the team can hold the payload there.

    Over a level target the formation balances. Over one tilted by θ its cable forces, with 1 + `TILT_WIDENING`
    (1 - cos θ) times their level parts, are changed as little as balances weight and moment, each cable keeping
    `MIN_TENSION_RATIO` of its widened tension; the slots follow from them. The widening keeps cables apart whose
    anchors come to lie one over the other.
    """
    place_formation(e, goal, rig)
    target = matrow(goal.rotation, e)
    if target[8] > 1.0 - 1e-12 or rig.is_point:
        return True
    for n in range(rig.anchors.shape[0]):
        cable_force = vec(goal.cable_force, e, n)
        # target[8] = R33 = cos θ. Goals hold the drones' forces: the cables' weight is taken off, `place_slots` adds it
        # again.
        wide = 1.0 + TILT_WIDENING * (1.0 - target[8])
        put(
            goal.cable_force[e, n],
            (wide * cable_force[0], wide * cable_force[1], cable_force[2] - rig.cable_weight[n]),
        )
    weight = rig.payload_mass * GRAVITY
    left = solve_cable_forces((0.0, 0.0, weight), _ZERO, target, rig.anchors, MIN_TENSION_RATIO, goal.cable_force[e])
    place_slots(e, goal, rig)
    return left <= BALANCED * weight


@kernel
def is_stable(e, goal, rig, stiffness):
    """Return whether the payload, pushed a little, would come back to a tilted goal, the drones held by springs.

    The potential energy of payload, cables and springs is to be convex there. Between its spring and the payload a
    cable gives way across by L/T and along by 1/k, so that an anchor moved by x is drawn back by S x,
    S⁻¹ = (T/L (1 - u uᵀ) + k u uᵀ)⁻¹ + 1/κ; where the payload turns, the arm of the force turns too.

    Args:
        e, goal, rig: after `place_balanced`.
        stiffness: (N,) κ [N/m].
    """
    target = matrow(goal.rotation, e)
    a = b = c = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for n in range(rig.anchors.shape[0]):
        # Stiffness S of one anchor: across and along the cable.
        r = mul(target, row(rig.anchors, n))
        f = sub(vec(goal.cable_force, e, n), (0.0, 0.0, rig.cable_weight[n]))
        size = norm(f)
        u = scale(1.0 / size, f)
        soft = 1.0 / stiffness[n]
        across = 1.0 / (rig.cable_length[n] / size + soft)
        along = 1.0 / (1.0 / rig.cable_stiffness[n] + soft) - across
        s = _plus(_diagonal(across), _outer(scale(along, u), u))

        # The Hessian of the energy in blocks: a by shifts, b mixed, c by turns θ, of which the force's own arm is part.
        x = (0.0, r[2], -r[1], -r[2], 0.0, r[0], r[1], -r[0], 0.0)  # x θ = θ × r
        sx = matmul(s, x)
        arm = _outer(scale(0.5, r), f)
        a = _plus(a, s)
        b = _plus(b, sx)
        c = _plus(c, _minus(_plus(matmul(transpose(x), sx), _diagonal(dot(r, f))), _plus(arm, transpose(arm))))

    # It is positive definite if its Schur complement is.
    return is_positive(_minus(c, matmul(matmul(transpose(b), _inverse(a, 0.0)), b)))


@kernel
def is_positive(m):
    """Return whether a symmetric matrix, 9 numbers, is positive definite, by Sylvester's criterion."""
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
