"""Minimum-snap polynomials through way-points, and the times at which they are passed.

Of all curves through given values at given times, at rest at both ends to their jerk, the spline of degree seven has
the least J = ∫ |snap|² (Mellinger and Kumar, ICRA 2011): a quadrotor's moments go with snap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from multilift_marl.errors import ConfigError, pip_install

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_DEGREE = 7
_LEVER = 0.1  # [m] a team whose slots are nearer, such as one drone above its payload, turns as a point so far away
_SAMPLES = 100  # of each piece, where speeds and accelerations are measured


def fit_minimum_snap(times: np.ndarray, values: np.ndarray) -> BSpline:
    """Return the minimum-snap spline through values (K, D) at times (K,) [s], increasing; call it as f(t, derivative).

    Raises:
        ConfigError: scipy is not installed.
    """
    rest = [(derivative, np.zeros(values.shape[1])) for derivative in (1, 2, 3)]
    return _scipy("interpolate").make_interp_spline(times, values, _DEGREE, bc_type=(rest, rest))


def allocate_times(poses: np.ndarray, slots: np.ndarray, speed: float, acceleration: float) -> np.ndarray:
    """Return times (K,) [s] at which minimum-snap polynomials pass poses (K, 4) just within these limits.

    The shares of the pieces in the time are those of the least J (Mellinger and Kumar, section V-B), to which yaw
    counts as the way of the outermost slot. Twice the time is half the speed and a quarter of the acceleration, which
    gives the time of all.

    Args:
        poses: places [m] and yaw [rad].
        slots: (N, 2) from the payload, which turn with it [m].
        speed, acceleration: largest ones of the payload and of every slot [m/s], [m/s²].
    """
    if np.linalg.norm(slots, axis=1).max() < _LEVER:
        slots = np.array([[_LEVER, 0.0]])
    values = poses * [1, 1, 1, np.linalg.norm(slots, axis=1).max()]
    gaps = np.diff(values, axis=0)
    shares = np.linalg.norm(gaps, axis=1) ** 0.5
    if len(shares) > 1:
        found = _scipy("optimize").minimize(_relative_cost, np.log(shares), (values,), "L-BFGS-B", jac=True)
        shares = np.exp(found.x)
    times = np.append(0.0, np.cumsum(shares)) / shares.sum()
    spline = fit_minimum_snap(times, poses)
    t = np.unique(times[:-1, None] + np.diff(times)[:, None] * np.linspace(0, 1, _SAMPLES + 1))
    fastest, hardest = _fastest(spline(t), spline(t, 1), spline(t, 2), slots)
    return times * max(fastest / speed, np.sqrt(hardest / acceleration))


def _scipy(module: str) -> Any:
    """Return a module of scipy, which is imported here alone."""
    try:
        return import_module(f"scipy.{module}")
    except ModuleNotFoundError:
        raise ConfigError(f"minimum-snap polynomials need scipy; {pip_install('plan')}") from None


def _relative_cost(logs: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Return log J + 7 log Σ h, which no scale of the durations h = exp(logs) changes, and its slope.

    J changes with the duration of a piece by -H, with H = s² - 2 j s' + 2 a s'' - 2 v s''' the Hamiltonian, which is
    constant in a piece; v, a, j and s are velocity to snap. By parts, J = -Σ gap · s''' over the pieces, since the
    curve rests at both ends and s to s'' are continuous.
    """
    steps = np.exp(logs)
    times = np.append(0.0, np.cumsum(steps))
    spline = fit_minimum_snap(times, values)
    v, a, j, s, s1, s2, s3 = (spline(times[:-1] + 0.5 * steps, derivative) for derivative in range(1, 8))
    cost = -(np.diff(values, axis=0) * s3).sum()
    energy = (s**2 - 2 * j * s1 + 2 * a * s2 - 2 * v * s3).sum(axis=1)
    return np.log(cost) + 7 * np.log(steps.sum()), steps * (7 / steps.sum() - energy / cost)


def _fastest(pose: np.ndarray, first: np.ndarray, second: np.ndarray, slots: np.ndarray) -> tuple[float, float]:
    """Return largest speed and acceleration of the payload and its slots, by poses (T, 4) and their derivatives."""
    c, s = np.cos(pose[:, 3:]), np.sin(pose[:, 3:])
    points = np.vstack([np.zeros(2), slots])  # the payload itself first
    x, y = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]
    rate, change = first[:, 3:], second[:, 3:]
    speed = np.sqrt((first[:, :1] - rate * y) ** 2 + (first[:, 1:2] + rate * x) ** 2 + first[:, 2:3] ** 2)
    ahead = second[:, :1] - change * y - rate**2 * x
    aside = second[:, 1:2] + change * x - rate**2 * y
    return float(speed.max()), float(np.sqrt(ahead**2 + aside**2 + second[:, 2:3] ** 2).max())
