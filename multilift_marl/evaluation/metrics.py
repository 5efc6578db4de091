"""From episodes to metrics with intervals: Wilson for rates, bootstrap for means and paired differences."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from multilift_marl.tasks.failures import CAUSES

_Z = 1.959964  # two-sided 95 %
_RESAMPLES = 2000
_APART = (  # also over the episodes without failure, and over the successful ones
    "payload_position_error_m", "payload_attitude_error_deg", "payload_tilt_deg", "payload_rmse_m", "settling_time_s",
)  # fmt: skip


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of the rate of `successes` in `trials`, at least one (Wilson 1927)."""
    rate, square = successes / trials, _Z**2 / trials
    centre = (rate + square / 2) / (1 + square)
    half = _Z / (1 + square) * sqrt(rate * (1 - rate) / trials + square / (4 * trials))
    return max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half))


def bootstrap(values: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the mean of `values` (n,), the same for the same values."""
    rng = np.random.default_rng(seed)
    means = values[rng.integers(0, len(values), (_RESAMPLES, len(values)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def summarize(episodes: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Return {metric: {"mean", "ci95": [low, high]}} of what `fly_episodes` measured.

    Errors include failed episodes at the failure bound; "<metric>_held" takes the episodes without failure alone,
    "<metric>_successful" the successful ones; they are missing where there are none.
    """
    success, cause = episodes["success_rate"], episodes["failure_cause"]
    count = len(success)
    result = {"success_rate": _rate(int(success.sum()), count)}
    for name, values in episodes.items():
        if name in ("success_rate", "failure_cause"):
            continue
        result[name] = _rate(int(values.sum()), count) if values.dtype == bool else _mean(values)
        for kind, chosen in (("held", cause == 0), ("successful", success)):
            if name in _APART and chosen.any():
                result[f"{name}_{kind}"] = _mean(values[chosen])
    for index, name in enumerate(CAUSES):
        if index > 0:
            result[f"failure_{name}_rate"] = _rate(int((cause == index).sum()), count)
    return result


def compare(policy: dict[str, np.ndarray], baseline: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Return the mean paired difference, policy minus baseline, of every metric of `fly_episodes`.

    Both on the same episodes, (n,) each; the form is that of `summarize`.
    """
    return {
        name: _mean(values.astype(float) - baseline[name].astype(float))
        for name, values in policy.items()
        if name != "failure_cause"
    }


def is_better(policy: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    """Return whether a policy is better than another one on the same episodes, in the sense of `is_gain`."""
    names = ("success_rate", "payload_position_error_m")
    success, error = (policy[name].astype(float) - other[name].astype(float) for name in names)
    return is_gain(success, error)


def is_gain(success: np.ndarray, error: np.ndarray) -> bool:
    """Return whether paired differences of success and error (n,) are an improvement beyond the noise.

    That is in success or, succeeding no less often, in error: the 95 % interval of the difference leaves out zero.
    """
    return bootstrap(success)[0] > 0 or (success.mean() >= 0 and bootstrap(error)[1] < 0)


def _mean(values: np.ndarray) -> dict[str, Any]:
    return {"mean": float(values.mean()), "ci95": list(bootstrap(values))}


def _rate(successes: int, trials: int) -> dict[str, Any]:
    return {"mean": successes / trials, "ci95": list(wilson(successes, trials))}
