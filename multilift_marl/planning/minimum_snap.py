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
_SAMPLES = 100  # of each piece, where speeds and accelerations are measured


def fit_minimum_snap(times: np.ndarray, values: np.ndarray) -> BSpline:
    """Return the minimum-snap spline through values (K, D) at times (K,) [s], increasing; call it as f(t, derivative).

    Raises:
        ConfigError: scipy is not installed.
    """
    rest = [(derivative, np.zeros(values.shape[1])) for derivative in (1, 2, 3)]
    return _scipy("interpolate").make_interp_spline(times, values, _DEGREE, bc_type=(rest, rest))


def allocate_times(values: np.ndarray, speed: float, acceleration: float) -> np.ndarray:
    """Return times (K,) [s] at which minimum-snap polynomials pass values (K, D) just within these limits.

    The shares of the pieces in the time are those of the least J (Mellinger and Kumar, section V-B). Twice the time
    is half the speed and a quarter of the acceleration, which gives the time of all.

    Args:
        values: the first three of each are a place [m]; the others are limited each on its own, as lengths are.
        speed, acceleration: largest ones [m/s], [m/s²].
    """
    gaps = np.diff(values, axis=0)
    shares = np.linalg.norm(gaps, axis=1) ** 0.5
    if len(shares) > 1:
        found = _scipy("optimize").minimize(_relative_cost, np.log(shares), (values,), "L-BFGS-B", jac=True)
        shares = np.exp(found.x)
    times = np.append(0.0, np.cumsum(shares)) / shares.sum()
    spline = fit_minimum_snap(times, values)
    t = np.unique(times[:-1, None] + np.diff(times)[:, None] * np.linspace(0, 1, _SAMPLES + 1))
    fastest, hardest = (_largest(spline(t, derivative)) for derivative in (1, 2))
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


def _largest(derivatives: np.ndarray) -> float:
    """Return the largest length of the first three of numbers (T, D), and of each other one."""
    lengths = np.linalg.norm(derivatives[:, :3], axis=1).max()
    return float(max(lengths, np.abs(derivatives[:, 3:]).max(initial=0.0)))
