"""Hard limits g ≥ 0 of a plan: their values, and what each adds to a quadratic model of a plan's cost.

Step k has 4 N + N (N − 1) of them, in this order: least tension of each cable in its middle; and at its end largest
and least thrust and tilt of each thrust vector, the distance of each pair of drones, and that of their cables. All
count in tolerances.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, dot, nearest_points, norm, row, scale, sub
from multilift_marl.planning.curvature import curve_rotation
from multilift_marl.planning.riccati import Problem
from multilift_marl.planning.soft_limits import place_drones


class Limits(NamedTuple):
    """Limits of a team."""

    tension: np.ndarray
    """(N,) least [N]."""
    largest: np.ndarray
    """(N,) thrust [N]."""
    least: np.ndarray
    """(N,) thrust [N]."""
    upright: float
    """Least cosine of a thrust vector's angle to the vertical."""
    separation: np.ndarray
    """(N, N) least distance of drones [m]."""
    cables: np.ndarray
    """(N, N) least distance of cables [m]."""
    tolerance: np.ndarray
    """(4,) of tensions [N], thrusts [N], distances of drones and of cables [m]."""


class LimitedProblem(NamedTuple):
    """What a trajectory is to be, and what it may not be."""

    problem: Problem
    limits: Limits


def limit_names(num_drones: int) -> list[str]:
    """Return the names of the limits of a step."""
    kinds = [f"{kind}_{n}" for kind in ("tension", "largest_thrust", "least_thrust", "tilt") for n in range(num_drones)]
    pairs = [f"{n}_{o}" for n in range(num_drones) for o in range(n)]
    return kinds + [f"separation_{pair}" for pair in pairs] + [f"cables_{pair}" for pair in pairs]


@kernel
def evaluate_limits(x, task, w, values):
    """Write the values (4 N + N (N − 1),) of the limits of state x, those of tensions left out."""
    problem, limits = task
    count = limits.tension.shape[0]
    f = 12 + 4 * count
    unit = 1.0 / limits.tolerance[1]
    place_drones(x, 6 + 2 * count, problem.model, w)
    at, pairs = 4 * count, count * (count - 1) // 2
    for n in range(count):
        up = x[f + 3 * n + 2]
        thrust = sqrt(x[f + 3 * n] ** 2 + x[f + 3 * n + 1] ** 2 + up**2)
        values[count + n] = unit * (limits.largest[n] - thrust)
        values[2 * count + n] = unit * (thrust - limits.least[n])
        values[3 * count + n] = unit * (up - limits.upright * thrust)
        for o in range(n):
            far = norm(_away(n, o, 1.0, 1.0, x, problem.model, w))
            values[at] = (far - limits.separation[n, o]) / limits.tolerance[2]
            s, t = _nearest(n, o, x, problem.model, w)
            far = norm(_away(n, o, s, t, x, problem.model, w))
            values[at + pairs] = (far - limits.cables[n, o]) / limits.tolerance[3]
            at += 1


@kernel
def add_limits(x, push, stiffness, exact, task, w, costate):
    """Add the limits of a state to `w.value`, `w.linear` and `costate`.

    Args:
        x: (12 + 7 N,) state.
        push: (4 N + N (N − 1),) multiplier z of each limit, whose gradient adds −z ∇g.
        stiffness: likewise, which adds stiffness ∇g ∇gᵀ.
        exact: whether −z ∇²g counts too where it may take curvature away.
        task: LimitedProblem.
        w: IterationWork.
        costate: (12 + 7 N,).
    """
    problem, limits = task
    count = limits.tension.shape[0]
    unit = 1.0 / limits.tolerance[1]
    for n in range(count):
        at = 12 + 4 * count + 3 * n
        thrust = sqrt(x[at] ** 2 + x[at + 1] ** 2 + x[at + 2] ** 2) + 1e-12
        most, least, tilt = unit * push[count + n], unit * push[2 * count + n], unit * push[3 * count + n]
        stiff = unit * unit * (stiffness[count + n] + stiffness[2 * count + n])
        upright = unit * unit * stiffness[3 * count + n]
        # The gradients are -e of the largest thrust, e of the least, ẑ - upright e of the tilt, with e = f/|f|; the
        # curvature of |f| is (1 - e eᵀ)/|f|. That of the least thrust is negative: it is left out unless exact.
        along = most - least + limits.upright * tilt  # by which the limits push against the thrust
        curved = along + (0.0 if exact else least)
        for i in range(3):
            e = x[at + i] / thrust
            slope = along * e - (tilt if i == 2 else 0.0)
            w.linear[at + i] += slope
            costate[at + i] += slope
            rise = (1.0 if i == 2 else 0.0) - limits.upright * e
            for j in range(3):
                o = x[at + j] / thrust
                across = (1.0 if i == j else 0.0) - e * o
                rising = (1.0 if j == 2 else 0.0) - limits.upright * o
                w.value[at + i, at + j] += stiff * e * o + upright * rise * rising + curved / thrust * across
    # pairs of drones, and of points of their cables: those nearest to each other, taken to stay on their cables
    place_drones(x, 6 + 2 * count, problem.model, w)
    at, pairs = 4 * count, count * (count - 1) // 2
    for n in range(count):
        for o in range(n):
            if stiffness[at] > 0.0:
                unit = 1.0 / limits.tolerance[2]
                weights = unit * push[at], unit * unit * stiffness[at]
                _add_pair((n, o, 1.0, 1.0), weights, exact, x, problem.model, w, costate)
            if stiffness[at + pairs] > 0.0:
                s, t = _nearest(n, o, x, problem.model, w)
                unit = 1.0 / limits.tolerance[3]
                weights = unit * push[at + pairs], unit * unit * stiffness[at + pairs]
                _add_pair((n, o, s, t), weights, exact, x, problem.model, w, costate)
            at += 1


@kernel
def _add_pair(pair, weights, exact, x, model, w, costate):
    """Add the distance of points at shares s and t of cables n and o, see `add_limits`; weights are by metres."""
    (n, o, s, t), (z, stiff), m = pair, weights, w.model
    away = _away(n, o, s, t, x, model, w)
    distance = norm(away) + 1e-12
    e = scale(1.0 / distance, away)
    for i in range(7):  # attitude, c of the one, c of the other
        first, p = _slope(i, n, o, s, t, w)
        slope = dot(e, p)
        w.linear[first] -= z * slope
        costate[first] -= z * slope
        for j in range(7):
            second, r = _slope(j, n, o, s, t, w)
            other = dot(e, r)
            w.value[first, second] += stiff * slope * other
            # A distance |a| has the second derivatives (p · r - (e · p)(e · r))/|a|, and those of a along e below.
            if exact:
                w.value[first, second] -= z / distance * (dot(p, r) - slope * other)
    if exact:
        arm = sub(row(model.anchors, n), row(model.anchors, o))
        curve_rotation(e, arm, x, m.rotation, m.turning, -z, w.value[3:6, 3:6])
        _add_chart(n, x, -z * e[2] * s * model.length[n], w.value)
        _add_chart(o, x, z * e[2] * t * model.length[o], w.value)


@kernel
def _cable(n, x, model):
    """Return cable n from its anchor to its drone."""
    cx, cy = x[6 + 2 * n], x[7 + 2 * n]
    return scale(model.length[n], (cx, cy, sqrt(max(1.0 - cx * cx - cy * cy, 0.01))))


@kernel
def _away(n, o, s, t, x, model, w):
    """Return the way from the point at share t of cable o to that at share s of cable n, by `place_drones`."""
    to = add(row(w.place, n), scale(s - 1.0, _cable(n, x, model)))
    return sub(to, add(row(w.place, o), scale(t - 1.0, _cable(o, x, model))))


@kernel
def _nearest(n, o, x, model, w):
    """Return at which shares of cables n and o they are nearest to each other, by `place_drones`."""
    first, second = _cable(n, x, model), _cable(o, x, model)
    return nearest_points(_away(n, o, 0.0, 0.0, x, model, w), first, second)


@kernel
def _slope(i, n, o, s, t, w):
    """Return the number in the state of number i of the pair, and what `_away` changes by it."""
    if i < 3:
        ahead = (w.place_slope[n, 0, i], w.place_slope[n, 1, i], w.place_slope[n, 2, i])
        return 3 + i, sub(ahead, (w.place_slope[o, 0, i], w.place_slope[o, 1, i], w.place_slope[o, 2, i]))
    if i < 5:
        p = w.place_slope[n]
        return 6 + 2 * n + i - 3, (s * p[0, i], s * p[1, i], s * p[2, i])
    p = w.place_slope[o]
    return 6 + 2 * o + i - 5, (-t * p[0, i - 2], -t * p[1, i - 2], -t * p[2, i - 2])


@kernel
def _add_chart(n, x, factor, target):
    """Add `factor` times the second derivatives of √(1 − |c|²) of cable n."""
    cx, cy = x[6 + 2 * n], x[7 + 2 * n]
    z = sqrt(max(1.0 - cx * cx - cy * cy, 0.01))
    a, b = 6 + 2 * n, 7 + 2 * n
    target[a, a] -= factor * (1.0 + cx * cx / (z * z)) / z
    target[b, b] -= factor * (1.0 + cy * cy / (z * z)) / z
    target[a, b] -= factor * cx * cy / z**3
    target[b, a] -= factor * cx * cy / z**3
