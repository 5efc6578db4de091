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
    unit = float(np.median(np.diff(rows[:, 0])))  # a unit of time for which the equations are even
    rest = np.zeros(rows.shape[1] - 1)
    velocity, acceleration = (rest, rest) if start is None else start
    table = np.zeros((len(rows), 3 * rows.shape[1] - 2))
    table[:, : rows.shape[1]] = rows
    solution = np.zeros((len(rows), 2, len(rest)))
    solution[0] = velocity * unit, acceleration * unit**2
    _solve_pieces(table, unit, solution, np.zeros((len(rows), 2, 2)))
    return table


@kernel
def _solve_pieces(table, unit, solution, upper):
    """Write the rates at the rows of a table, see `fit_spline`, by the block Thomas algorithm.

    Args:
        table: (K, 1 + 3 D), times and values.
        unit: of time [s].
        solution: (K, 2, D) velocity and acceleration at the rows in that unit; those at the first and last are given.
        upper: (K, 2, 2) zeros.
    """
    count, size = table.shape[0], (table.shape[1] - 1) // 3
    for i in range(1, count - 1):
        p, q = (table[i, 0] - table[i - 1, 0]) / unit, (table[i + 1, 0] - table[i, 0]) / unit
        # The first line of each 2 × 2 block, of velocity and acceleration, is of the third derivative, the second of
        # the fourth.
        b00, b01, b10, b11 = -24 / p**2, -3 / p, -168 / p**3, -24 / p**2
        a00, a01, a10, a11 = 24 / q**2, -3 / q, -168 / q**3, 24 / q**2
        m00 = 36 / q**2 - 36 / p**2 - (b00 * upper[i - 1, 0, 0] + b01 * upper[i - 1, 1, 0])
        m01 = 9 / p + 9 / q - (b00 * upper[i - 1, 0, 1] + b01 * upper[i - 1, 1, 1])
        m10 = -192 / p**3 - 192 / q**3 - (b10 * upper[i - 1, 0, 0] + b11 * upper[i - 1, 1, 0])
        m11 = 36 / p**2 - 36 / q**2 - (b10 * upper[i - 1, 0, 1] + b11 * upper[i - 1, 1, 1])
        det = m00 * m11 - m01 * m10
        upper[i, 0, 0], upper[i, 0, 1] = (m11 * a00 - m01 * a10) / det, (m11 * a01 - m01 * a11) / det
        upper[i, 1, 0], upper[i, 1, 1] = (m00 * a10 - m10 * a00) / det, (m00 * a11 - m10 * a01) / det
        for k in range(size):
            after, before = table[i + 1, 1 + k] - table[i, 1 + k], table[i, 1 + k] - table[i - 1, 1 + k]
            third = 60 * after / q**3 - 60 * before / p**3
            fourth = -360 * after / q**4 - 360 * before / p**4
            third -= b00 * solution[i - 1, 0, k] + b01 * solution[i - 1, 1, k]
            fourth -= b10 * solution[i - 1, 0, k] + b11 * solution[i - 1, 1, k]
            solution[i, 0, k] = (m11 * third - m01 * fourth) / det
            solution[i, 1, k] = (m00 * fourth - m10 * third) / det
    for i in range(count - 2, 0, -1):
        for k in range(size):
            rate, bend = solution[i + 1, 0, k], solution[i + 1, 1, k]
            solution[i, 0, k] -= upper[i, 0, 0] * rate + upper[i, 0, 1] * bend
            solution[i, 1, k] -= upper[i, 1, 0] * rate + upper[i, 1, 1] * bend
    for i in range(count):
        for k in range(size):
            table[i, 1 + size + k] = solution[i, 0, k] / unit
            table[i, 1 + 2 * size + k] = solution[i, 1, k] / unit**2


def sample_spline(table: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the values of a spline and their first three derivatives at times (T,) [s], (4, T, D)."""
    t = np.asarray(t, float)
    found = np.empty((4, len(t), (table.shape[1] - 1) // 3))
    _sample_pieces(np.ascontiguousarray(table), t, found)
    return found


@kernel
def _quintic(p0, v0, a0, p1, v1, a1, h):
    """Return the coefficients of the third to fifth power of a quintic, from its values at both ends of a time h."""
    gap = p1 - p0 - v0 * h - 0.5 * a0 * h * h
    speed = (v1 - v0 - a0 * h) * h
    bend = (a1 - a0) * h * h
    return 10.0 * gap - 4.0 * speed + 0.5 * bend, -15.0 * gap + 7.0 * speed - bend, 6.0 * gap - 3.0 * speed + 0.5 * bend


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
def _sample_pieces(table, times, found):
    """See `sample_spline`."""
    size, last = (table.shape[1] - 1) // 3, table[-1, 0]
    for j in range(times.shape[0]):
        t = min(max(times[j], 0.0), last)
        i = find_piece(table, t)
        h, s = table[i + 1, 0] - table[i, 0], t - table[i, 0]
        u = s / h
        for k in range(size):
            p0, v0, a0 = table[i, 1 + k], table[i, 1 + size + k], table[i, 1 + 2 * size + k]
            p1, v1, a1 = table[i + 1, 1 + k], table[i + 1, 1 + size + k], table[i + 1, 1 + 2 * size + k]
            c, d, e = _quintic(p0, v0, a0, p1, v1, a1, h)
            found[0, j, k] = p0 + s * (v0 + 0.5 * s * a0) + u * u * u * (c + u * (d + u * e))
            found[1, j, k] = v0 + s * a0 + u * u * (3 * c + u * (4 * d + 5 * u * e)) / h
            found[2, j, k] = a0 + u * (6 * c + u * (12 * d + 20 * u * e)) / (h * h)
            found[3, j, k] = (6 * c + u * (24 * d + 60 * u * e)) / (h * h * h)


@kernel
def spline_value(table, i, t, k):
    """Return value k of a spline, 0 to 3, at time t [s] of its piece i."""
    h, s = table[i + 1, 0] - table[i, 0], t - table[i, 0]
    if h <= 0.0:  # no file
        return 0.0
    p0, v0, a0 = table[i, 1 + k], table[i, 5 + k], table[i, 9 + k]
    c, d, e = _quintic(p0, v0, a0, table[i + 1, 1 + k], table[i + 1, 5 + k], table[i + 1, 9 + k], h)
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
