"""Paths that a payload is to follow: circle, figure-eight, lemniscate, helix, smooth random ones, and those of files.

A path is a curve over its own time τ, turned by a heading and moved to a centre; it starts at rest: τ runs slower than
time at first, smoothly to the third derivative. The path of a file is followed as written, in its own time, neither
turned nor moved. Velocity, acceleration and jerk are central differences of five points.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, put, row, scale, sub, turn
from multilift_marl.planning.spline import spline_place

PATHS = ("circle", "figure8", "lemniscate", "helix", "random", "file")
CIRCLE, FIGURE8, LEMNISCATE, HELIX, RANDOM, FILE = range(len(PATHS))
RAMP = 2.0  # [s] from rest to full speed
WAYPOINTS = 12  # of a random path, with the first and the last
STEP = 0.01  # [s] between the places that are differentiated


class Path(NamedTuple):
    """The path of each environment."""

    kind: np.ndarray
    """(E,) int64, an index into PATHS."""
    centre: np.ndarray
    """(E, 3) [m]."""
    heading: np.ndarray
    """(E,) [rad]."""
    size: np.ndarray
    """(E,) radius or half-width A [m]."""
    rate: np.ndarray
    """(E,) ω [rad/s]; of a random path the way-points passed in a second [1/s]."""
    climb: np.ndarray
    """(E,) half the height that a helix goes up and down [m]."""
    curve: np.ndarray
    """(E, WAYPOINTS, 2, 3) way-points of a random path and the second derivatives of its spline there."""

    @classmethod
    def zeros(cls, num_envs: int) -> Path:
        """Return paths that stay where they are."""
        e = num_envs
        shapes = ((e, 3), (e,), (e,), (e,), (e,), (e, WAYPOINTS, 2, 3))
        return cls(np.zeros(e, np.int64), *(np.zeros(shape) for shape in shapes))


@kernel
def own_time(t):
    """Return τ of a time since the start [s]: its rate rises from 0 to 1 within RAMP."""
    s = min(max(t / RAMP, 0.0), 1.0)
    # The integral of `ease`'s fraction s⁴ (35 - 84 s + 70 s² - 20 s³) over time: the rate and its first three
    # derivatives join at both ends. RAMP/2 is lost against the clock.
    return RAMP * s**5 * (7.0 - 14.0 * s + 10.0 * s**2 - 2.5 * s**3) + max(t - RAMP, 0.0)


@kernel
def place(e, t, path, table):
    """Return where the path of environment e is t seconds after the start [m]; `table` is the spline of a file."""
    kind = path.kind[e]
    if kind == FILE:
        return spline_place(table, t)
    a, angle = path.size[e], path.rate[e] * own_time(t)
    if kind == CIRCLE:
        at = (a * cos(angle), a * sin(angle), 0.0)
    elif kind == FIGURE8:
        at = (a * sin(angle), 0.5 * a * sin(2.0 * angle), 0.0)
    elif kind == LEMNISCATE:  # of Bernoulli
        width = a / (1.0 + sin(angle) ** 2)
        at = (width * cos(angle), width * sin(angle) * cos(angle), 0.0)
    elif kind == HELIX:
        at = (a * cos(angle), a * sin(angle), path.climb[e] * sin(0.25 * angle))
    else:
        at = _spline(path.curve[e], angle)
    return add(row(path.centre, e), turn(cos(path.heading[e]), sin(path.heading[e]), at))


@kernel
def _spline(curve, u):
    """Return the cubic spline with knots at 0, 1, 2 ... at u; after the last it stays there."""
    # Even knots need no search for the piece. The quintic of `spline.py` through the same way-points is another curve,
    # and recorded results are of this one.
    last = curve.shape[0] - 1
    u = min(u, 1.0 * last)
    i = min(int(u), last - 1)
    after = u - i
    before = 1.0 - after
    x = scale(before, row(curve[i], 0))
    x = add(x, scale(after, row(curve[i + 1], 0)))
    x = add(x, scale((before**3 - before) / 6.0, row(curve[i], 1)))
    return add(x, scale((after**3 - after) / 6.0, row(curve[i + 1], 1)))


@kernel
def motion(e, t, path, table):
    """Return position, velocity, acceleration and jerk of the path of environment e, [m] and [s]; see `place`."""
    a, b, c = place(e, t - 2.0 * STEP, path, table), place(e, t - STEP, path, table), place(e, t, path, table)
    return differences(a, b, c, place(e, t + STEP, path, table), place(e, t + 2.0 * STEP, path, table))


@kernel
def differences(a, b, c, d, f):
    """Return position and its first three derivatives at the third of five places that are STEP apart."""
    inner, outer = sub(d, b), sub(f, a)
    velocity = scale(1.0 / (12.0 * STEP), sub(scale(8.0, inner), outer))
    # Central differences: of fourth order for velocity and acceleration, of second for the jerk.
    middle = sub(scale(16.0, add(b, d)), add(scale(30.0, c), add(a, f)))
    jerk = scale(1.0 / (2.0 * STEP**3), sub(outer, scale(2.0, inner)))
    return c, velocity, scale(1.0 / (12.0 * STEP**2), middle), jerk


@kernel
def set_goal(e, motion, goal):
    """Write position, velocity, acceleration and jerk of a goal."""
    put(goal.position[e], motion[0])
    put(goal.velocity[e], motion[1])
    put(goal.acceleration[e], motion[2])
    put(goal.jerk[e], motion[3])


def draw_curve(rng: np.random.Generator, half: np.ndarray, lowest: float = -np.inf) -> np.ndarray:
    """Return (WAYPOINTS, 2, 3): way-points uniform in a box of half edges (3,) [m], and their spline's curvature.

    The first way-point is the centre; the curve rests at both ends. It swings beyond its way-points, and is drawn again
    where it is lower than `lowest` [m], which is -half[2] or less.
    """
    curve = _join(rng.uniform(-half, half, (WAYPOINTS, 3)))
    while _lowest(curve) < lowest:
        curve = _join(rng.uniform(-half, half, (WAYPOINTS, 3)))
    return curve


def _join(points: np.ndarray) -> np.ndarray:
    """Return the curve through way-points, the first one moved to the centre, see `draw_curve`.

    Second derivatives follow from the smoothness of the first ones, as in any textbook on splines.
    """
    points[0] = 0.0
    # Clamped ends, the speed zero at both: 2 M_0 + M_1 = 6 (p_1 - p_0), and the mirror image of it.
    matrix, right = np.zeros((WAYPOINTS, WAYPOINTS)), np.zeros((WAYPOINTS, 3))
    for i in range(1, WAYPOINTS - 1):
        matrix[i, i - 1 : i + 2] = 1.0, 4.0, 1.0
        right[i] = 6.0 * (points[i - 1] - 2.0 * points[i] + points[i + 1])
    matrix[0, :2], right[0] = (2.0, 1.0), 6.0 * (points[1] - points[0])
    matrix[-1, -2:], right[-1] = (1.0, 2.0), -6.0 * (points[-1] - points[-2])
    return np.stack([points, np.linalg.solve(matrix, right)], axis=1)


def _pieces(curve: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return, all along a curve, the row before and after, and the shares of the way from the one to the other."""
    u = np.linspace(0, WAYPOINTS - 1, 40 * WAYPOINTS + 1)
    i = np.minimum(u.astype(int), WAYPOINTS - 2)
    after = (u - i)[:, None]
    return curve[i], curve[i + 1], 1 - after, after


def _lowest(curve: np.ndarray) -> float:
    """Return the lowest height of a curve [m], see `_spline`."""
    first, second, before, after = _pieces(curve[:, :, 2:])
    bend = (before**3 - before) * first[:, 1] + (after**3 - after) * second[:, 1]
    return float((before * first[:, 0] + after * second[:, 0] + bend / 6).min())


def largest_rates(curve: np.ndarray) -> tuple[float, float]:
    """Return the largest speed and acceleration of a random path that passes one way-point in a second."""
    first, second, before, after = _pieces(curve)
    velocity = second[:, 0] - first[:, 0] + ((3 * after**2 - 1) * second[:, 1] - (3 * before**2 - 1) * first[:, 1]) / 6
    acceleration = before * first[:, 1] + after * second[:, 1]
    return float(np.linalg.norm(velocity, axis=1).max()), float(np.linalg.norm(acceleration, axis=1).max())
