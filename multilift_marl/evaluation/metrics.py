"""From episodes to metrics with intervals, as a table and as metrics.json.

Intervals are Wilson's for rates, bootstrapped for means and paired differences.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.tasks.failures import CAUSES

_Z = 1.959964  # two-sided 95 %
_RESAMPLES = 2000
_APART = (  # also over the episodes without failure, and over the successful ones
    "payload_position_error_m", "payload_attitude_error_deg", "payload_tilt_deg", "payload_rmse_m", "settling_time_s",
)  # fmt: skip
_ROWS = (  # metric, heading, factor, digits
    ("success_rate", "success [%]", 100, 1),
    ("precise_rate", "within 1 cm and 1 deg [%]", 100, 1),
    ("payload_position_error_m", "position error [cm]", 100, 2),
    ("payload_position_error_m_held", "... without failure [cm]", 100, 2),
    ("payload_attitude_error_deg", "attitude error [deg]", 1, 2),
    ("payload_tilt_deg_held", "tilt without failure [deg]", 1, 2),
    ("settling_time_s", "settling time [s]", 1, 2),
    ("return", "return", 1, 1),
    ("payload_rmse_m", "RMSE [cm]", 100, 1),
    ("cable_tension_min_n", "least tension [N]", 1, 2),
    ("cable_tension_max_n", "largest tension [N]", 1, 2),
    ("slack_time_s", "slack [s]", 1, 2),
    ("min_separation_m", "least separation [m]", 1, 2),
    ("energy_j", "rotor energy [J]", 1, 0),
    ("action_rate", "action rate [rms/step]", 1, 4),
)


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


def is_better(policy: dict[str, np.ndarray], other: dict[str, np.ndarray], beyond_noise: bool = True) -> bool:
    """Return whether a policy is better than another one on the same episodes: in success first, then in error.

    Args:
        policy, other: what `fly_episodes` measured of both.
        beyond_noise: by `is_gain`; else by the means alone.
    """
    names = ("success_rate", "payload_position_error_m")
    success, error = (policy[name].astype(float) - other[name].astype(float) for name in names)
    if beyond_noise:
        return is_gain(success, error)
    alike = error[success == 0]
    return success.sum() > 0 or (success.sum() == 0 and alike.size > 0 and alike.mean() < 0)


def is_gain(success: np.ndarray, error: np.ndarray, strict: bool = True) -> bool:
    """Return whether paired differences of success and error (n,) are an improvement beyond the noise.

    That is in success or, succeeding no less often, in error: the 95 % interval of the difference leaves out zero.
    Errors are compared in episodes that end alike: the others differ by metres, and count as successes already.

    Args:
        success, error: (n,).
        strict: no less often by the mean; else within the interval of the difference.
    """
    low, high = bootstrap(success)
    alike = error[success == 0]
    as_often = success.mean() >= 0 if strict else high >= 0
    return bool(low > 0 or (as_often and alike.size > 0 and bootstrap(alike)[1] < 0))


def _mean(values: np.ndarray) -> dict[str, Any]:
    return {"mean": float(values.mean()), "ci95": list(bootstrap(values))}


def _rate(successes: int, trials: int) -> dict[str, Any]:
    return {"mean": successes / trials, "ci95": list(wilson(successes, trials))}


def make_report(
    config: Config, seed: int, policy: dict[str, np.ndarray], baselines: Mapping[str, dict[str, np.ndarray]]
) -> dict[str, Any]:  # fmt: skip
    """Return the content of metrics.json.

    Args:
        config: the environment.
        seed: evaluation seed.
        policy: what `fly_episodes` measured of the policy.
        baselines: the same of every baseline, on the same episodes.
    """
    return {
        "episodes": len(policy["return"]),
        "seed": seed,
        "config": config.model_dump(mode="json"),
        "policy": summarize(policy),
        "baselines": {name: summarize(episodes) for name, episodes in baselines.items()},
        "paired": {name: compare(policy, episodes) for name, episodes in baselines.items()},
    }


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write what `make_report` returned to `path`, metrics.json by custom."""
    path.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def format_table(report: dict[str, Any], name: str = "policy") -> str:
    """Return the report as a Markdown table: mean and 95 % interval of each metric, a column for each policy."""
    columns = {name: report["policy"], **report["baselines"]}
    causes = {
        key for summary in columns.values() for key in summary if key.startswith("failure_") and summary[key]["mean"]
    }
    rows = [*_ROWS, *((key, f"{key[8:-5].replace('_', ' ')} [%]", 100, 1) for key in sorted(causes))]
    cells = [["", *columns]]
    for key, heading, factor, digits in rows:
        cells.append([heading, *(_cell(summary.get(key), factor, digits) for summary in columns.values())])
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def _cell(value: dict[str, Any] | None, factor: float, digits: int) -> str:
    if value is None:
        return "-"
    low, high = value["ci95"]
    return f"{factor * value['mean']:.{digits}f} ({factor * low:.{digits}f} - {factor * high:.{digits}f})"
