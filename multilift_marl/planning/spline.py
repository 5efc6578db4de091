"""Quintic splines through rows of times and values, at rest at both ends.

Each piece is a quintic, and the first four derivatives are continuous, so that the velocity, acceleration and jerk of
references are. At both ends velocity and acceleration are zero. Of all curves through the rows that rest at both ends
this one has the least mean square jerk.
"""

from __future__ import annotations

import numpy as np

from multilift_marl.kernels.jit import kernel

NO_FILE = np.zeros((2, 13))  # the table of a task without a file: at rest at the origin


def fit_spline(rows: np.ndarray, start: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """Return the quintic spline through rows (K, 1 + D) as a table (K, 1 + 3 D): time, values, rates, second rates.

    Each piece is the quintic with the given value, velocity and acceleration at its two ends. Velocity and
    acceleration at the inner rows follow from the continuity of the third and fourth derivative there: two equations
    for two unknowns of each row, coupled to its neighbours, solved by block elimination. At both ends they are zero.

    Args:
        rows: t [s] and D values, four in paths; at least 2 rows, t increasing.
        start: velocity and acceleration (D,) at the first row, if it is not at rest there.
    """
    count, unit = len(rows), float(np.median(np.diff(rows[:, 0])))  # a unit of time for which the equations are even
    h, d = np.diff(rows[:, 0]) / unit, np.diff(rows[:, 1:], axis=0)
    solution = np.zeros((count, 2, d.shape[1]))
    upper, right = np.zeros((count, 2, 2)), np.zeros_like(solution)
    if start is not None:
        solution[0] = right[0] = start[0] * unit, start[1] * unit**2
    for i in range(1, count - 1):  # the first line of each block is of the third derivative, the second of the fourth
        p, q = h[i - 1], h[i]
        before = np.array([[-24 / p**2, -3 / p], [-168 / p**3, -24 / p**2]])
        after = np.array([[24 / q**2, -3 / q], [-168 / q**3, 24 / q**2]])
        own = np.array([[36 / q**2 - 36 / p**2, 9 / p + 9 / q], [-192 / p**3 - 192 / q**3, 36 / p**2 - 36 / q**2]])
        known = np.stack([60 * d[i] / q**3 - 60 * d[i - 1] / p**3, -360 * d[i] / q**4 - 360 * d[i - 1] / p**4])
        # Block Thomas algorithm; a row's block is 2 × 2, of velocity and acceleration there.
        pivot = own - before @ upper[i - 1]
        upper[i] = np.linalg.solve(pivot, after)
        right[i] = np.linalg.solve(pivot, known - before @ right[i - 1])
    for i in range(count - 2, 0, -1):
        solution[i] = right[i] - upper[i] @ solution[i + 1]
    return np.hstack([rows, solution[:, 0] / unit, solution[:, 1] / unit**2])


def sample_spline(table: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the values of a spline and their first three derivatives at times (T,) [s], (4, T, D)."""
    size = (table.shape[1] - 1) // 3
    t = np.clip(t, 0.0, table[-1, 0])
    i = np.clip(np.searchsorted(table[:, 0], t, side="right") - 1, 0, len(table) - 2)
    first, last, s = table[i], table[i + 1], (t - table[i, 0])[:, None]
    h = (last[:, 0] - first[:, 0])[:, None]
    u = s / h
    value, rate, bend = first[:, 1 : 1 + size], first[:, 1 + size : 1 + 2 * size], first[:, 1 + 2 * size :]
    then = last[:, 1 : 1 + size], last[:, 1 + size : 1 + 2 * size], last[:, 1 + 2 * size :]
    c, d, e = _quintic(value, rate, bend, *then, h)
    return np.stack(
        [
            value + s * (rate + 0.5 * s * bend) + u**3 * (c + u * (d + u * e)),
            rate + s * bend + u**2 * (3 * c + u * (4 * d + 5 * u * e)) / h,
            bend + u * (6 * c + u * (12 * d + 20 * u * e)) / h**2,
            (6 * c + u * (24 * d + 60 * u * e)) / h**3,
        ]
    )


def _quintic(
    p0: np.ndarray, v0: np.ndarray, a0: np.ndarray, p1: np.ndarray, v1: np.ndarray, a1: np.ndarray, h: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coefficients of the third to fifth power of a quintic, from its values at both ends of a time h."""
    gap = p1 - p0 - v0 * h - 0.5 * a0 * h * h
    speed = (v1 - v0 - a0 * h) * h
    bend = (a1 - a0) * h * h
    return 10.0 * gap - 4.0 * speed + 0.5 * bend, -15.0 * gap + 7.0 * speed - bend, 6.0 * gap - 3.0 * speed + 0.5 * bend


_compiled_quintic = kernel(_quintic)  # the same of numbers


@kernel
def find_piece(table, t):
    """Return the piece of a spline (K, 13) that holds time t [s], by bisection."""
    low, high = 0, table.shape[0] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if table[middle, 0] <= t:
            low = middle
        else:
            high = middle
    return low


@kernel
def spline_value(table, i, t, k):
    """Return value k of a spline, 0 to 3, at time t [s] of its piece i."""
    h, s = table[i + 1, 0] - table[i, 0], t - table[i, 0]
    if h <= 0.0:  # no file
        return 0.0
    p0, v0, a0 = table[i, 1 + k], table[i, 5 + k], table[i, 9 + k]
    c, d, e = _compiled_quintic(p0, v0, a0, table[i + 1, 1 + k], table[i + 1, 5 + k], table[i + 1, 9 + k], h)
    u = s / h
    return p0 + s * (v0 + 0.5 * s * a0) + u * u * u * (c + u * (d + u * e))


@kernel
def spline_place(table, t):
    """Return where the path of a file is at t [s], at rest before its first row and after its last [m]."""
    t = min(max(t, 0.0), table[-1, 0])
    i = find_piece(table, t)
    return (spline_value(table, i, t, 0), spline_value(table, i, t, 1), spline_value(table, i, t, 2))


@kernel
def spline_yaw(table, t):
    """Return the heading of the target of a file's path at t [s], in the form of a place: (yaw [rad], 0, 0)."""
    t = min(max(t, 0.0), table[-1, 0])
    return (spline_value(table, find_piece(table, t), t, 3), 0.0, 0.0)
