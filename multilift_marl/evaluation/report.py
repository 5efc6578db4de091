"""The result of an evaluation as a table and as metrics.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.evaluation.metrics import compare, summarize

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


def make_report(
    config: Config, seed: int, policy: dict[str, np.ndarray], baselines: Mapping[str, dict[str, np.ndarray]]
) -> dict[str, Any]:  # fmt: skip
    """Return the content of metrics.json.

    Args:
        config: the environment that was flown.
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
