"""Second derivatives of a step of the reduced model, weighted by the costate: what Gauss-Newton iterations leave out.

Weighted by y, the costate of c̈ of a drone, by τ, that of its tension t, and by μ, that of the payload's laws, what
depends on the drone's own 13 numbers is ℓ = (y·h + s B)/L, with the drone's acceleration h beside the anchor's,
B = d·h + L |ḋ|² = t/m and s = m L τ + d·(m L (μ_lin + R (μ_ang × r)) − y). Its second derivatives, by the accelerations
a of the payload too, and the derivatives of a give those of the whole step.
"""

from __future__ import annotations

from math import cos, sin, sqrt, tan
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, cross, dot, mul, row, scale, sub, tmul
from multilift_marl.planning.riccati import set_euler
from multilift_marl.planning.team_model import LOCAL, SLOW, euler_rates, solve_factorised, state_size, turning_of_anchor


class CurvatureWork(NamedTuple):
    """Arrays that `set_curvature` works in, and its result."""

    hessian: np.ndarray
    """(12 + 7 N, 12 + 7 N) by the state at the start of a step; the input adds half of a step to its thrust vectors."""
    local: np.ndarray
    cross: np.ndarray
    """(6, 5) by the payload's accelerations, and by attitude and c: no other number counts with them."""
    pull_slope: np.ndarray
    by_acceleration: np.ndarray
    euler: np.ndarray
    turned: np.ndarray
    adjoint: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, n: int) -> CurvatureWork:
        """Return arrays for N drones."""
        size, q = state_size(n), 6 + 2 * n
        shapes = (size, size), (LOCAL, LOCAL), (6, 5), (LOCAL,), (6, q), (15,), (3, 3), (6, 1), (q,)
        return cls(*(np.zeros(shape) for shape in shapes))


@kernel
def set_curvature(k, x, costate, pull, problem, w, c):
    """Write the second derivatives of costate·f − Σ pull t over step k.

    Args:
        k: the step, which `riccati.linearise` has just linearised: it left the model's numbers in `w.model`.
        x: (12 + 7 N,) state at its start.
        costate: (12 + 7 N,) of the state at its end.
        pull: (N,) weight of the tensions in its middle.
        problem, w: see `riccati.recur`.
        c: CurvatureWork, whose `hessian` is written.
    """
    h, model, m = problem.step, problem.model, w.model
    count = model.anchors.shape[0]
    q = 6 + 2 * count
    size = 2 * q + 3 * count
    hessian = c.hessian
    _weigh(x, costate, pull, problem, m, c)

    # by the state in the middle of the step: what each drone's numbers bend, and what they bend with accelerations
    hessian[:] = 0.0
    c.by_acceleration[:] = 0.0
    _add_payload(m.middle, q, model, hessian, c.adjoint)
    for n in range(count):
        _curve_drone(n, q, pull[n], model, m, c)
        for i in range(LOCAL):
            for j in range(LOCAL):
                hessian[m.column[n, i], m.column[n, j]] += c.local[i, j]
        for j in range(6):
            for i in range(3):
                c.by_acceleration[j, 3 + i] += c.cross[j, i]
            for i in range(2):
                c.by_acceleration[j, 6 + 2 * n + i] += c.cross[j, 3 + i]
    for i in range(3, size):
        for j in range(3, q):
            part = 0.0
            for b in range(6):
                part += m.slope[b, i] * c.by_acceleration[b, j]
            hessian[i, j] += part
            hessian[j, i] += part

    # by the state at its start, whose attitude turns at rates that depend on it, in the middle and at the end
    rates, a = (x[q + 3], x[q + 4], x[q + 5]), m.acceleration
    set_euler(x, rates, c.euler)
    _to_start(hessian, q, size, 0.5 * h, c.euler)
    lean = (_lean(0, q, pull, m, c), _lean(1, q, pull, m, c), _lean(2, q, pull, m, c))
    _add_turning(lean, 0.5 * h, x, rates, q, hessian, c.turned)
    mean = (rates[0] + 0.5 * h * a[3], rates[1] + 0.5 * h * a[4], rates[2] + 0.5 * h * a[5])
    _add_turning((costate[3], costate[4], costate[5]), h, x, mean, q, hessian, c.turned)
    for i in range(2):
        for j in range(3, size):
            part = 0.0
            for b in range(3):
                part += 0.5 * h * c.turned[i, b] * w.slope[k, 3 + b, j]
            hessian[3 + i, j] += part
            hessian[j, 3 + i] += part


@kernel
def _weigh(x, costate, pull, problem, m, c):
    """Write what the accelerations count for, y, and by the adjoint of the payload's laws what those do, μ."""
    h, model = problem.step, problem.model
    q = 6 + 2 * model.anchors.shape[0]
    y, mu = c.weight, c.adjoint
    t = euler_rates(x[3], x[4])
    for i in range(q):
        y[i] = 0.5 * h * h * costate[i] + h * costate[q + i]
    y[4] = 0.5 * h * h * (t[0] * costate[3] + t[2] * costate[4] + t[4] * costate[5]) + h * costate[q + 4]
    y[5] = 0.5 * h * h * (t[1] * costate[3] + t[3] * costate[4] + t[5] * costate[5]) + h * costate[q + 5]
    for i in range(6):
        mu[i, 0] = y[i]
    for n in range(model.anchors.shape[0]):
        d, length = row(m.direction, n), model.length[n]
        across = (y[6 + 2 * n] / length, y[7 + 2 * n] / length, 0.0)
        along = -pull[n] * model.drone_mass[n] - dot(d, across)
        moment = cross(row(model.anchors, n), tmul(_rotation(m), across))
        for i in range(3):
            mu[i, 0] -= across[i] + along * d[i]
            mu[3 + i, 0] -= moment[i] + along * m.arm[n, 3 + i]
    solve_factorised(m.mass, mu, 6, 1)


@kernel
def _lean(j, q, pull, m, c):
    """Return the derivative of y·ν̇ − Σ pull t by roll, pitch or yaw j in the middle of the step."""
    total = 0.0
    for i in range(q):
        total += c.weight[i] * m.slope[i, 3 + j]
    for n in range(pull.shape[0]):
        total -= pull[n] * m.tension_slope[n, 3 + j]
    return total


@kernel
def _rotation(m):
    r = m.rotation
    return (r[0, 0], r[0, 1], r[0, 2], r[1, 0], r[1, 1], r[1, 2], r[2, 0], r[2, 1], r[2, 2])


@kernel
def _add_payload(middle, q, model, hessian, mu):
    """Add the second derivatives of the payload's drag and gyroscopic moment."""
    j = model.inertia
    force, moment = (mu[0, 0], mu[1, 0], mu[2, 0]), (mu[3, 0], mu[4, 0], mu[5, 0])
    v = (middle[q], middle[q + 1], middle[q + 2])
    speed = sqrt(dot(v, v) + SLOW)
    along = dot(force, v)
    for i in range(3):
        first = (1.0 * (i == 0), 1.0 * (i == 1), 1.0 * (i == 2))
        for k in range(3):
            second = (1.0 * (k == 0), 1.0 * (k == 1), 1.0 * (k == 2))
            bent = mu[i, 0] * v[k] + mu[k, 0] * v[i] + along * (i == k) - along * v[i] * v[k] / speed**2
            hessian[q + i, q + k] -= model.drag * bent / speed
            spin = add(cross(first, (j[0, k], j[1, k], j[2, k])), cross(second, (j[0, i], j[1, i], j[2, i])))
            hessian[q + 3 + i, q + 3 + k] -= dot(moment, spin)


@kernel
def curve_rotation(weight, arm, x, rotation, turning, factor, target):
    """Add `factor` times the second derivatives of weight·(R arm) by roll, pitch and yaw to `target` (3, 3)."""
    u, v = weight, arm
    rolled, left = (0.0, -v[2], v[1]), (u[1], -u[0], 0.0)
    sr, cr, sy, cy = sin(x[3]), cos(x[3]), sin(x[5]), cos(x[5])
    straight = _between(u, rotation, v)
    level = (u[1] * cy - u[0] * sy) * (cr * v[1] - sr * v[2])  # which pitch does not change
    target[0, 0] += factor * _between(u, rotation, (0.0, -v[1], -v[2]))
    target[1, 1] += factor * (level - straight)
    target[2, 2] += factor * _between((-u[0], -u[1], 0.0), rotation, v)
    sides = (_between(u, turning[1], rolled), _between(left, rotation, rolled), _between(left, turning[1], v))
    target[1, 0] += factor * sides[0]
    target[0, 1] += factor * sides[0]
    target[2, 0] += factor * sides[1]
    target[0, 2] += factor * sides[1]
    target[2, 1] += factor * sides[2]
    target[1, 2] += factor * sides[2]


@kernel
def _between(u, matrix, v):
    total = 0.0
    for i in range(3):
        total += u[i] * (matrix[i, 0] * v[0] + matrix[i, 1] * v[1] + matrix[i, 2] * v[2])
    return total


@kernel
def _curve_drone(n, q, pull, model, m, c):
    """Write the second derivatives of ℓ of drone n by its own numbers, and by those and the payload's accelerations."""
    mass, length, mu, weight = model.drone_mass[n], model.length[n], c.adjoint, c.weight
    c.local[:] = 0.0
    c.cross[:] = 0.0
    d, rotation = row(m.direction, n), _rotation(m)
    y = (weight[6 + 2 * n], weight[7 + 2 * n], 0.0)
    turned = cross((mu[3, 0], mu[4, 0], mu[5, 0]), row(model.anchors, n))
    lever = sub(scale(mass * length, add((mu[0, 0], mu[1, 0], mu[2, 0]), mul(rotation, turned))), y)
    s = dot(d, lever) - mass * length * pull
    _add_attitude(n, q, add(y, scale(s, d)), turned, model, m, c)
    _add_swing(n, s, lever, turned, model, m, c)
    _add_product(n, lever, turned, model, m, c)
    for i in range(LOCAL):
        for j in range(LOCAL):
            c.local[i, j] /= length
    for j in range(6):
        for i in range(5):
            c.cross[j, i] /= length


@kernel
def _add_attitude(n, q, along, turned, model, m, c):
    """Add what attitude and body rates bend: along·h, and B d·(m L R turned)."""
    r, x, local, d = row(model.anchors, n), m.middle, c.local, row(m.direction, n)
    curve_rotation(along, turning_of_anchor(n, model.anchors[n], m), x, m.rotation, m.turning, -1.0, local)
    curve_rotation(d, turned, x, m.rotation, m.turning, model.length[n] * m.tension[n], local)
    w, v = (x[q + 3], x[q + 4], x[q + 5]), tmul(_rotation(m), along)
    for k in range(3):
        t = m.turning[k]
        by_angle = (
            t[0, 0] * along[0] + t[1, 0] * along[1] + t[2, 0] * along[2],
            t[0, 1] * along[0] + t[1, 1] * along[1] + t[2, 1] * along[2],
            t[0, 2] * along[0] + t[1, 2] * along[1] + t[2, 2] * along[2],
        )
        moment = cross(r, by_angle)
        for j in range(3):
            spin = by_angle[j] * dot(w, r) + dot(by_angle, w) * r[j] - 2.0 * dot(by_angle, r) * w[j]
            local[k, 3 + j] -= spin
            local[3 + j, k] -= spin
            local[3 + k, 3 + j] -= v[k] * r[j] + v[j] * r[k] - 2.0 * dot(v, r) * (k == j)
            c.cross[3 + j, k] -= moment[j]


@kernel
def _add_swing(n, s, lever, turned, model, m, c):
    """Add what direction and swing of the cable bend in s d·h + s L |ḋ|² + B d·lever, the last two steady."""
    mass, length, local = model.drone_mass[n], model.length[n], c.local
    d, swing, h, big = m.direction[n], m.swing[n], row(m.across, n), m.tension[n] / mass
    z = d[2]
    square, p = z * z, d[0] * swing[0] + d[1] * swing[1]
    for i in range(2):
        for j in range(2):
            same = 1.0 * (i == j)
            curved = -(same + d[i] * d[j] / square) / z  # of z, by c
            # of |ḋ|² = |ċ|² + (c·ċ)²/z²
            twice = (2.0 * swing[i] * swing[j] + 2.0 * p * p * same / square) / square
            twice += 4.0 * p * (swing[i] * d[j] + d[i] * swing[j]) / square**2 + 8.0 * p * p * d[i] * d[j] / square**3
            mixed = 2.0 * (swing[i] * d[j] + p * same) / square + 4.0 * p * d[i] * d[j] / square**2
            local[6 + i, 6 + j] += s * (curved * h[2] + length * twice) + big * curved * lever[2]
            local[6 + i, 8 + j] += s * length * mixed
            local[8 + j, 6 + i] += s * length * mixed
            local[8 + i, 8 + j] += 2.0 * s * length * (same + d[i] * d[j] / square)
        by_c = row(m.by_c[n], i)
        for j in range(LOCAL):  # those that turn h: all but c and ċ
            part = s * dot(by_c, row(m.by_across[n], j))
            local[6 + i, j] += part
            local[j, 6 + i] += part
        for k in range(3):
            part = big * mass * length * _between(by_c, m.turning[k], turned)
            local[6 + i, k] += part
            local[k, 6 + i] += part
        for j in range(6):
            c.cross[j, 3 + i] -= s * m.by_arm[n, 6 + i, j]


@kernel
def _add_product(n, lever, turned, model, m, c):
    """Add the product of the slopes of s, by attitude and c alone, and of B."""
    mass, length, d, swing = model.drone_mass[n], model.length[n], row(m.direction, n), m.swing[n]
    p, square = d[0] * swing[0] + d[1] * swing[1], d[2] * d[2]
    for j in range(LOCAL):
        c.pull_slope[j] = dot(d, row(m.by_across[n], j))
    for i in range(2):
        bent = p * m.direction[n, i] / square
        c.pull_slope[6 + i] += dot(row(m.by_c[n], i), row(m.across, n))
        c.pull_slope[6 + i] += 2.0 * length * p * (swing[i] + bent) / square
        c.pull_slope[8 + i] += 2.0 * length * (swing[i] + bent)
    for k in range(5):
        at = k if k < 3 else 3 + k
        slope = mass * length * _between(d, m.turning[k], turned) if k < 3 else dot(row(m.by_c[n], k - 3), lever)
        for j in range(LOCAL):
            part = slope * c.pull_slope[j]
            c.local[at, j] += part
            c.local[j, at] += part
        for j in range(6):
            c.cross[j, k] -= m.arm[n, j] * slope


@kernel
def _to_start(hessian, q, size, half, euler):
    """Replace second derivatives by the state in the middle of a step by those by the state at its start."""
    for i in range(3, size):
        line = hessian[i]
        e0, e1, e2 = line[3], line[4], line[5]
        for j in range(3, q):
            if j < 4 or j > 5:
                line[q + j] += half * line[j]
        line[q + 4] += half * (e0 * euler[0] + e1 * euler[2] + e2 * euler[4])
        line[q + 5] += half * (e0 * euler[1] + e1 * euler[3] + e2 * euler[5])
        for j in range(3):
            line[3 + j] += half * (e0 * euler[6 + j] + e1 * euler[9 + j] + e2 * euler[12 + j])
    for j in range(3, size):
        e0, e1, e2 = hessian[3, j], hessian[4, j], hessian[5, j]
        for i in range(3, q):
            if i < 4 or i > 5:
                hessian[q + i, j] += half * hessian[i, j]
        hessian[q + 4, j] += half * (e0 * euler[0] + e1 * euler[2] + e2 * euler[4])
        hessian[q + 5, j] += half * (e0 * euler[1] + e1 * euler[3] + e2 * euler[5])
        for i in range(3):
            hessian[3 + i, j] += half * (e0 * euler[6 + i] + e1 * euler[9 + i] + e2 * euler[12 + i])


@kernel
def _add_turning(weight, factor, x, rates, q, hessian, turned):
    """Add the second derivatives of factor weight·T ω by attitude and ω; those by both stay in `turned`."""
    sr, cr, tp, cp = sin(x[3]), cos(x[3]), tan(x[4]), cos(x[4])
    side, sunk = sr * rates[1] + cr * rates[2], cr * rates[1] - sr * rates[2]
    w0, w1, w2 = factor * weight[0], factor * weight[1], factor * weight[2]
    steep = w0 * tp + w2 / cp
    steeper = w0 / (cp * cp) + w2 * tp / cp
    bent = 2.0 * w0 * tp / (cp * cp) + w2 * (1.0 + 2.0 * tp * tp) / cp
    hessian[3, 3] -= side * steep + w1 * sunk
    hessian[3, 4] += sunk * steeper
    hessian[4, 3] += sunk * steeper
    hessian[4, 4] += side * bent
    turned[:] = 0.0
    turned[0, 1], turned[0, 2] = cr * steep - sr * w1, -sr * steep - cr * w1
    turned[1, 1], turned[1, 2] = sr * steeper, cr * steeper
    for i in range(2):
        for j in range(3):
            hessian[3 + i, q + 3 + j] += turned[i, j]
            hessian[q + 3 + j, 3 + i] += turned[i, j]
