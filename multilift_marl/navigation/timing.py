"""The speed along a route: as fast as limits of all bodies allow, from rest to rest.

The curve through pose and shape is a quintic B-spline of its knots. Payload and drones keep limits of speed and
acceleration along it, those of speed lower where obstacles are close: two passes along the curve give the fastest
speeds. Their means over a short time make a curve of continuous derivatives in time.
"""

from __future__ import annotations

from math import comb, factorial

import numpy as np

from multilift_marl.planning.spline import fit_spline

SAMPLES = 4  # of the curve between two knots
KNOT = 0.1  # [s] between the knots in time
BOXES = 4  # means that are taken in turn, each over ...
BOX = 0.2  # [s]
_TICK = 0.02  # [s] of the times at which means are taken
_FIRST = 9  # ticks from which rates at a start are found


def sample_curve(knots: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return values (M, D) of the quintic B-spline of knots (K, D) at parameters u (M,) from -1 to K - 1.

    It is at the first and the last knot at 0 and K - 1, since knots are mirrored in them.
    """
    head, tail = 2 * knots[0] - knots[3:0:-1], 2 * knots[-1] - knots[-2:-5:-1]
    points = np.vstack([head, knots, tail])
    i = np.clip(np.floor(u).astype(int), -1, len(knots) - 2)
    t = u - i
    value = np.zeros((len(u), knots.shape[1]))
    for k in range(6):
        value += _basis(t + 5 - k)[:, None] * points[i + k + 1]
    return value


def _basis(x: np.ndarray) -> np.ndarray:
    """Return the quintic B-spline whose support is 0 to 6."""
    binomials = (1, -6, 15, -20, 15, -6)
    return sum(b * np.maximum(x - k, 0.0) ** 5 for k, b in enumerate(binomials)) / 120.0


def fit_speeds(points: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, pace: float = 0.0) -> np.ndarray:
    """Return the times (M,) [s] at which samples are passed, to rest at the last one.

    Args:
        points: (M, P, 3) of all bodies at even parameters of the curve [m].
        speed: (M,) of any body, at most [m/s].
        acceleration: (M,) the same, of turning and of gaining speed each at most 1/√2 of it [m/s²].
        pace: samples per second at the first one.
    """
    each = acceleration / 2**0.5
    first = np.gradient(points, axis=0)
    second = np.gradient(first, axis=0)
    rate = np.maximum(np.linalg.norm(first, axis=-1).max(axis=1), 1e-9)  # [m] per sample
    bend = np.maximum(np.linalg.norm(second, axis=-1).max(axis=1), 1e-9)
    square = np.minimum((speed / rate) ** 2, each / bend)  # of samples per second
    gain = 2.0 * each / rate
    # From a start that is faster than that, the team brakes.
    brake = 0.5 * (gain[1:] + gain[:-1])
    square = np.maximum(square, pace**2 - np.append(0.0, np.cumsum(brake)))
    square[0], square[-1] = pace**2, 0.0
    for i in range(1, len(square)):
        square[i] = min(square[i], square[i - 1] + 0.5 * (gain[i] + gain[i - 1]))
    for i in range(len(square) - 2, -1, -1):
        square[i] = min(square[i], square[i + 1] + 0.5 * (gain[i] + gain[i + 1]))
    paces = np.sqrt(square)
    return np.append(0.0, np.cumsum(2.0 / np.maximum(paces[1:] + paces[:-1], 1e-6)))


def smooth_times(times: np.ndarray, pace: tuple[float, float] = (0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Return even times (T,) [s] from 0 and the samples passed then, as means of those at the given times (M,).

    The means take half of `BOXES * BOX` seconds more at a rest.

    Args:
        times: see `fit_speeds`.
        pace: samples per second at the first one, and their change in a second, which goes on before it.
    """
    width = round(BOX / _TICK)
    spread = BOXES * (width - 1) // 2
    before = spread if pace[0] > 0.0 else 2 * spread
    at = np.arange(-before, int(np.ceil(times[-1] / _TICK)) + 1 + 2 * spread) * _TICK
    passed = np.interp(at, times, np.arange(len(times)))
    past = np.minimum(at, 0.0)
    passed += pace[0] * past + 0.5 * pace[1] * past**2
    box = np.full(width, 1.0 / width)
    for _ in range(BOXES):
        passed = np.convolve(passed, box, mode="valid")
    return np.arange(len(passed)) * _TICK, passed


def time_route(
    knots: np.ndarray,
    points: np.ndarray,
    speed: np.ndarray,
    acceleration: np.ndarray,
    pace: tuple[float, float] = (0.0, 0.0),
    departure: np.ndarray | None = None,
    fade: float = 1.0,
) -> np.ndarray:
    """Return the route through knots as a table, see `fit_spline`.

    Args:
        knots: (K, D) of the curve.
        points, speed, acceleration: see `fit_speeds`, at `SAMPLES` for each piece.
        pace: see `smooth_times`.
        departure: (4, D) values and three orders of rates at the start; None: at rest. What the curve lacks of them is
            added, and fades away.
        fade: time in which it does [s].
    """
    times, passed = smooth_times(fit_speeds(points, speed, acceleration, pace[0]), pace)
    stride = round(KNOT / _TICK)
    last = -(-(len(times) - 1) // stride) * stride  # whole knots; the curve rests at its end
    index = np.minimum(np.arange(0, last + 1, stride), len(times) - 1)
    at = np.arange(0, last + 1, stride) * _TICK
    u = np.clip(passed / SAMPLES, -1, len(knots) - 1)
    values = sample_curve(knots, u[index])
    values[-1] = knots[-1]
    if departure is None:
        values[0] = knots[0]
        return fit_spline(np.column_stack([at, values]))
    # What the curve has at the start, from the polynomial through its first ticks.
    along = _TICK * np.arange(_FIRST)
    fitted = np.polynomial.polynomial.polyfit(along, sample_curve(knots, u[:_FIRST]), 5)
    has = fitted[: len(departure)] * np.cumprod([1.0, *range(1, len(departure))])[:, None]
    has[0] = values[0]
    values += fade_out(departure - has, at, min(fade, at[-1]))
    return fit_spline(np.column_stack([at, values]), (departure[1], departure[2]))


def fade_out(lack: np.ndarray, times: np.ndarray, fade: float) -> np.ndarray:
    """Return polynomials (T, D) whose value and rates at 0 are `lack` (K, D), and which end within `fade` [s].

    They are (1 - u)^K times a polynomial of degree K - 1 of u, the share of the time that has passed.
    """
    order = len(lack)
    u = np.clip(times / fade, 0.0, 1.0)[:, None]
    taylor = [each * fade**k / factorial(k) for k, each in enumerate(lack)]
    # The Taylor series of (1 - u)^-K has the coefficients C(K - 1 + j, j).
    left = sum(u**k * sum(taylor[k - j] * comb(order - 1 + j, j) for j in range(k + 1)) for k in range(order))
    faded: np.ndarray = (1.0 - u) ** order * left
    return faded
