"""Hard limits g ≥ 0 of a plan: their values, and what each adds to a quadratic model of a plan's cost.

Step k has 4 N + N (N − 1)/2 of them, in this order: least tension of each cable in its middle; and at its end largest
and least thrust and tilt of each thrust vector, and the distance of each pair of drones. All count in tolerances.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import dot, row, scale, sub
from multilift_marl.planning.curvature import curve_rotation
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
    tolerance: np.ndarray
    """(3,) of tensions [N], thrusts [N] and distances [m]."""


def limit_names(num_drones: int) -> list[str]:
    """Return the names of the limits of a step."""
    kinds = [f"{kind}_{n}" for kind in ("tension", "largest_thrust", "least_thrust", "tilt") for n in range(num_drones)]
    return kinds + [f"separation_{n}_{o}" for n in range(num_drones) for o in range(n)]


@kernel
def evaluate_limits(x, limits, problem, w, values):
    """Write the values (4 N + N (N − 1)/2,) of the limits of state x, those of tensions left out."""
    count = limits.tension.shape[0]
    f = 12 + 4 * count
    unit, near = 1.0 / limits.tolerance[1], 1.0 / limits.tolerance[2]
    place_drones(x, 6 + 2 * count, problem.model, w)
    at = 4 * count
    for n in range(count):
        up = x[f + 3 * n + 2]
        thrust = sqrt(x[f + 3 * n] ** 2 + x[f + 3 * n + 1] ** 2 + up**2)
        values[count + n] = unit * (limits.largest[n] - thrust)
        values[2 * count + n] = unit * (thrust - limits.least[n])
        values[3 * count + n] = unit * (up - limits.upright * thrust)
        for o in range(n):
            away = sub(row(w.place, n), row(w.place, o))
            values[at] = near * (sqrt(dot(away, away)) - limits.separation[n, o])
            at += 1


@kernel
def add_limits(x, push, stiffness, exact, limits, problem, w, costate):
    """Add the limits of a state to `w.value`, `w.linear` and `costate`.

    Args:
        x: (12 + 7 N,) state.
        push: (4 N + N (N − 1)/2,) multiplier z of each limit, whose gradient adds −z ∇g.
        stiffness: likewise, which adds stiffness ∇g ∇gᵀ.
        exact: whether −z ∇²g counts too where it may take curvature away.
        limits: Limits.
        problem, w: see `riccati.recur`.
        costate: (12 + 7 N,).
    """
    count = limits.tension.shape[0]
    unit = 1.0 / limits.tolerance[1]
    for n in range(count):
        at = 12 + 4 * count + 3 * n
        thrust = sqrt(x[at] ** 2 + x[at + 1] ** 2 + x[at + 2] ** 2) + 1e-12
        most, least, tilt = unit * push[count + n], unit * push[2 * count + n], unit * push[3 * count + n]
        stiff = unit * unit * (stiffness[count + n] + stiffness[2 * count + n])
        upright = unit * unit * stiffness[3 * count + n]
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
    _add_separations(x, push, stiffness, exact, limits, problem, w, costate)


@kernel
def _add_separations(x, push, stiffness, exact, limits, problem, w, costate):
    """Add the distances of drones, see `add_limits`."""
    count, model, m = limits.tension.shape[0], problem.model, w.model
    near = 1.0 / limits.tolerance[2]
    place_drones(x, 6 + 2 * count, model, w)
    at = 4 * count
    for n in range(count):
        for o in range(n):
            z, stiff = near * push[at], near * near * stiffness[at]
            at += 1
            away = sub(row(w.place, n), row(w.place, o))
            distance = sqrt(dot(away, away)) + 1e-12
            e = scale(1.0 / distance, away)
            for i in range(7):  # attitude, c of the one, c of the other
                first, p = _slope(i, n, o, w)
                slope = dot(e, p)
                w.linear[first] -= z * slope
                costate[first] -= z * slope
                for j in range(7):
                    second, r = _slope(j, n, o, w)
                    other = dot(e, r)
                    part = stiff * slope * other
                    if exact:
                        part -= z / distance * (dot(p, r) - slope * other)
                    w.value[first, second] += part
            if exact:
                arm = sub(row(model.anchors, n), row(model.anchors, o))
                curve_rotation(e, arm, x, m.rotation, m.turning, -z, w.value[3:6, 3:6])
                _add_chart(n, x, -z * e[2] * model.length[n], w.value)
                _add_chart(o, x, z * e[2] * model.length[o], w.value)


@kernel
def _slope(i, n, o, w):
    """Return the number in the state of number i of the pair, and what the way from o to n changes by it."""
    if i < 3:
        ahead = (w.place_slope[n, 0, i], w.place_slope[n, 1, i], w.place_slope[n, 2, i])
        return 3 + i, sub(ahead, (w.place_slope[o, 0, i], w.place_slope[o, 1, i], w.place_slope[o, 2, i]))
    if i < 5:
        return 6 + 2 * n + i - 3, (w.place_slope[n, 0, i], w.place_slope[n, 1, i], w.place_slope[n, 2, i])
    s = w.place_slope[o]
    return 6 + 2 * o + i - 5, (-s[0, i - 2], -s[1, i - 2], -s[2, i - 2])


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
