"""From episodes to metrics with intervals, as a table and as metrics.json.

Intervals are Wilson's for rates, bootstrapped for means and paired differences.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np

from multilift_marl._files import write_whole
from multilift_marl.config.config import Config
from multilift_marl.evaluation.shortfalls import explain, format_explanation, is_shortfall
from multilift_marl.mdp.failures import CAUSES
from multilift_marl.tasks import find_task

_Z = 1.959964  # two-sided 95 %
_RESAMPLES = 2000
_AT_ONCE = 1_000_000  # values drawn, so that many episodes take no gigabytes
FEWEST = 10  # episodes that an interval of a mean takes; of fewer a bootstrap's is far too narrow, of one it is a point
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
    ("min_clearance_m", "least clearance [m]", 1, 3),
    ("arrival_time_s", "arrival [s]", 1, 2),
    ("path_length_ratio", "way over straight line [-]", 1, 3),
    ("energy_j", "rotor energy [J]", 1, 0),
    ("action_rate", "action rate [rms/step]", 1, 4),
)


def name_error(metric: str) -> str:
    """Return what an error in metres is called above a column, such as "position error"."""
    return next((heading.partition(" [")[0] for name, heading, *_ in _ROWS if name == metric), metric)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of the rate of `successes` in `trials`, at least one (Wilson 1927)."""
    rate, square = successes / trials, _Z**2 / trials
    # Wilson's interval is (p + z²/2n ± z √(p (1 - p)/n + z²/4n²))/(1 + z²/n); `square` is z²/n.
    centre = (rate + square / 2) / (1 + square)
    half = _Z / (1 + square) * sqrt(rate * (1 - rate) / trials + square / (4 * trials))
    # Round-off may put the rate itself outside at 0 and 1.
    return max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half))


def bootstrap(values: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the mean of `values` (n,), the same for the same values."""
    rng = np.random.default_rng(seed)
    count, rows = len(values), max(1, _AT_ONCE // len(values))
    parts = [min(rows, _RESAMPLES - done) for done in range(0, _RESAMPLES, rows)]
    means = [values[rng.integers(0, count, (part, count))].mean(axis=1) for part in parts]
    low, high = np.quantile(np.concatenate(means), [0.025, 0.975])
    return float(low), float(high)


def bootstrap_seeds(values: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the mean of several training seeds in the same episodes.

    Training seeds and episodes are both drawn anew, with replacement (the pigeonhole bootstrap; Owen, Annals of Applied
    Statistics 2007). Of three training seeds that differ far beyond the noise of the episodes it covers 76 %,
    otherwise 95 %.

    Args:
        values: (S, n) of S training seeds in n episodes; NaN where there is none. A training seed counts by its mean.
        seed: of the draws.
    """
    rng, (count, episodes) = np.random.default_rng(seed), values.shape
    drawn = rng.multinomial(episodes, np.full(episodes, 1 / episodes), _RESAMPLES).astype(float)
    there = np.isfinite(values)
    sums, counts = drawn @ np.where(there, values, 0.0).T, drawn @ there.T.astype(float)
    means = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
    means = np.nanmean(np.take_along_axis(means, rng.integers(0, count, (_RESAMPLES, count)), axis=1), axis=1)
    low, high = np.nanquantile(means, [0.025, 0.975])
    return float(low), float(high)


def join_episodes(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return what `run_episodes` measured in several parts as one; metrics that one lacks are left out.

    A single drone has no separation, a team without obstacles no clearance.
    """
    names = [name for name in parts[0] if all(name in part for part in parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def summarize(episodes: dict[str, np.ndarray], causes: Sequence[str] = CAUSES) -> dict[str, dict[str, Any]]:
    """Return {metric: {"mean", "ci95": [low, high]}} of what `run_episodes` measured.

    Episodes where a metric is not finite have none; means of fewer than `FEWEST` have no interval ("ci95": None).
    Errors include failed episodes at the failure bound; "<metric>_held" takes the episodes without failure alone,
    "<metric>_successful" the successful ones; they are missing where there are none.

    Args:
        episodes: (n,) each.
        causes: names of the causes of failures, see `Task.causes`.
    """
    success, cause = episodes["success_rate"], episodes["failure_cause"]
    count = len(success)
    result = {"success_rate": _rate(int(success.sum()), count)}
    for name, values in episodes.items():
        if name in ("success_rate", "failure_cause") or is_shortfall(name) or not np.isfinite(values).any():
            continue
        result[name] = _rate(int(values.sum()), count) if values.dtype == bool else _mean(values)
        for kind, chosen in (("held", cause == 0), ("successful", success)):
            if name in _APART and chosen.any():
                result[f"{name}_{kind}"] = _mean(values[chosen])
    for index, name in enumerate(causes):
        if index > 0:
            result[f"failure_{name}_rate"] = _rate(int((cause == index).sum()), count)
    return result


def derived_names(causes: Sequence[str]) -> set[str]:
    """Return the names of what `summarize` derives from what is measured."""
    rates = {f"failure_{cause}_rate" for cause in causes[1:]}
    return rates | {f"{name}_{kind}" for name in _APART for kind in ("held", "successful")}


def compare(policy: dict[str, np.ndarray], baseline: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Return the mean paired difference, policy minus baseline, of every metric of `run_episodes`.

    Both on the same episodes, (n,) each; the form is that of `summarize`. Metrics that one of them lacks are left out.
    """
    names = [name for name in policy if name in baseline and name != "failure_cause" and not is_shortfall(name)]
    with np.errstate(invalid="ignore"):  # inf - inf
        differences = {name: policy[name].astype(float) - baseline[name].astype(float) for name in names}
    return {name: _mean(values) for name, values in differences.items() if np.isfinite(values).any()}


def is_better(
    policy: dict[str, np.ndarray], other: dict[str, np.ndarray], metric: str, beyond_noise: bool = True
) -> bool:
    """Return whether a policy is better than another one on the same episodes: in success first, then in error.

    Args:
        policy, other: what `run_episodes` measured of both.
        metric: the error, see `Task.ERROR`.
        beyond_noise: by `is_gain`; else by the means alone.
    """
    names = ("success_rate", metric)
    success, error = (policy[name].astype(float) - other[name].astype(float) for name in names)
    if beyond_noise:
        return is_gain(success, error)
    alike = error[success == 0]
    return success.sum() > 0 or (success.sum() == 0 and alike.size > 0 and alike.mean() < 0)


def is_gain(success: np.ndarray, error: np.ndarray) -> bool:
    """Return whether paired differences of success and error (n,) are an improvement beyond the noise.

    Of fewer than `FEWEST` nothing is. That is in success or, succeeding no less often, in error: the 95 % interval of
    the difference leaves out zero. Errors are compared in episodes that end alike: the others differ by metres, and
    count as successes already.
    """
    if success.size < FEWEST:
        return False
    low, _ = bootstrap(success)
    alike = error[success == 0]
    return bool(low > 0 or (success.mean() >= 0 and alike.size >= FEWEST and bootstrap(alike)[1] < 0))


def _mean(values: np.ndarray) -> dict[str, Any]:
    values = values[np.isfinite(values)]
    return {"mean": float(values.mean()), "ci95": list(bootstrap(values)) if values.size >= FEWEST else None}


def _rate(successes: int, trials: int) -> dict[str, Any]:
    return {"mean": successes / trials, "ci95": list(wilson(successes, trials))}


def make_report(
    config: Config, seed: int, policy: dict[str, np.ndarray], baselines: Mapping[str, dict[str, np.ndarray]]
) -> dict[str, Any]:  # fmt: skip
    """Return the content of metrics.json.

    Args:
        config: the environment.
        seed: evaluation seed.
        policy: what `run_episodes` measured of the policy.
        baselines: the same of every baseline, on the same episodes.
    """
    causes = find_task(config.task).causes()
    return {
        "episodes": len(policy["return"]),
        "seed": seed,
        "config": config.model_dump(mode="json"),
        "policy": summarize(policy, causes),
        "baselines": {name: summarize(episodes, causes) for name, episodes in baselines.items()},
        "paired": {name: compare(policy, episodes) for name, episodes in baselines.items()},
        "unsuccessful": {
            "policy": explain(policy, causes),
            "baselines": {name: explain(episodes, causes) for name, episodes in baselines.items()},
        },
    }


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write what `make_report` returned to `path`, metrics.json by custom; null for what is not finite."""
    write_whole(path, f"{json.dumps(_finite(report), indent=2, allow_nan=False)}\n".encode())


def _finite(value: Any) -> Any:
    """Return a report with None for numbers that are not finite: one drone has no distance from others."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def format_table(report: dict[str, Any], name: str = "policy") -> str:
    """Return the report as a Markdown table: mean and 95 % interval of each metric, a column for each policy.

    What no policy has, such as a distance from obstacles where there are none, is left out.
    """
    columns = {name: report["policy"], **report["baselines"]}
    causes = {
        key for summary in columns.values() for key in summary if key.startswith("failure_") and summary[key]["mean"]
    }
    rows = [*_ROWS, *((key, f"{key[8:-5].replace('_', ' ')} [%]", 100, 1) for key in sorted(causes))]
    cells = [["", *columns]]
    for key, heading, factor, digits in rows:
        found = [_cell(summary.get(key), factor, digits) for summary in columns.values()]
        if any(cell != "-" for cell in found):
            cells.append([heading, *found])
    return _align(cells)


def format_reasons(report: dict[str, Any], name: str = "policy") -> str:
    """Return why episodes of each policy were no success, as lines of text; "" where all were."""
    found = report["unsuccessful"]
    policies = {name: found["policy"], **found["baselines"]}
    return "\n".join(
        filter(None, (format_explanation(each, key, report["episodes"]) for key, each in policies.items()))
    )


def format_card(card: dict[str, Any]) -> str:
    """Return a card of the benchmark as Markdown: a table of the tasks, and why the policy cannot fly the others."""
    cells = [["task", "policy", "best baseline", "shipped policy", "policy - baseline: points, cm"]]
    refused, warnings, reasons = [], [], []
    for name, row in card["tasks"].items():
        if "not_applicable" in row:
            cells.append([name, "not applicable", "-", "-", "-"])
            refused.append(f"- {name}: {row['not_applicable']}")
            continue
        warnings += [
            f"- {name}: {each['name']} {each['warning']}" for each in row["policies"].values() if "warning" in each
        ]
        if unsuccessful := row["policies"]["policy"].get("unsuccessful"):  # none in cards of former versions
            reasons.append(format_explanation(unsuccessful, name, card["episodes"]))
        cells.append([name])
        for label in ("policy", "baseline", "shipped"):
            each = row["policies"].get(label, {"name": "", "metrics": {}})
            success, error = (_cell(each["metrics"].get(key), 100, 2 - rate) for key, rate in _shown(row))
            title = "" if label == "policy" else f"{each['name']}: "
            cells[-1].append(f"{title}{success} %, {error} cm" if each["metrics"] else "-")
        gain = row["paired"].get("baseline")
        cells[-1].append("-" if gain is None else ", ".join(_gain(gain[key], 2 - rate) for key, rate in _shown(row)))
    place = f"{card['benchmark']}, suite {card['suite']}, digest {card['digest'][:12]}, seed {card['seed']}"
    whole = "" if card["complete"] else "; not complete"
    told = f"{card['policy']['name']}: {place}, {card['episodes']} episodes of each task{whole}"
    parts = [told, _align(cells), *(["Not applicable:\n\n" + "\n".join(refused)] if refused else [])]
    if warnings:
        parts.append("Warnings:\n\n" + "\n".join(warnings))
    if any(reasons):
        parts.append("The policy, by task:\n\n```\n" + "\n".join(filter(None, reasons)) + "\n```")
    return "\n\n".join(parts) + "\n"


def _shown(row: dict[str, Any]) -> tuple[tuple[str, bool], ...]:
    """Return the metrics of a task in a card's table, and whether each is a rate."""
    return ("success_rate", True), (row["error"], False)


def _gain(value: dict[str, Any], digits: int) -> str:
    mean, *bounds = (f"{100 * each:+.{digits}f}" for each in (value["mean"], *(value["ci95"] or ())))
    return f"{mean} ({', '.join(bounds) or 'too few episodes'})"


def _align(cells: list[list[str]]) -> str:
    """Return lines of cells, the first of headings, as a Markdown table."""
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in cells
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def _cell(value: dict[str, Any] | None, factor: float, digits: int) -> str:
    if value is None:
        return "-"
    mean, *bounds = (f"{factor * each:.{digits}f}" for each in (value["mean"], *(value["ci95"] or ())))
    return f"{mean} ({' - '.join(bounds)})" if bounds else mean
