"""The tables of docs/results.md and the files beside it, from what `reproduce.py evaluate` and `shifts.py` recorded."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from flights import FLIGHTS, HERE, PLANNED_EPISODES, ROOT, error_metric

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.metrics import bootstrap_seeds
from multilift_marl.policies.baselines import SCRIPTED

BASELINES = (*(name for name, script in SCRIPTED.items() if script.INTERFACE == "reference"), "searched")
"""Baselines of the tables: those that move slots, and the linear policy tuned for a flight by CMA-ES (searched.py)."""
TUNED = "CMA-ES-tuned linear"
POINT, MILLIMETRE = 1.0, 0.1
"""The smallest differences of a verdict: of success [points], of the error [cm]."""
METRICS = (  # of each policy in results.csv: metric, column, factor
    ("success_rate", "success_percent", 100),
    ("payload_position_error_m", "position_error_cm", 100),
    ("payload_position_error_m_successful", "position_error_successful_cm", 100),
    ("payload_rmse_m", "rmse_cm", 100),
    ("payload_attitude_error_deg", "attitude_error_deg", 1),
    ("payload_attitude_error_deg_successful", "attitude_error_successful_deg", 1),
    ("settling_time_s", "settling_time_s", 1),
    ("return", "return", 1),
)


def flights_of(task: str) -> list[str]:
    """Return the names of the flights of a task."""
    return [name for name, flight in FLIGHTS.items() if load_config(flight.config).task == task]


def rows(names: str) -> str:
    """Return flights, or those of a task, as a Markdown table: learned policies, the best baseline, learning's gain."""
    task = "" if names.split()[0] in FLIGHTS and " " in names else names
    chosen = flights_of(task) if task else names.split()
    published = any(FLIGHTS[name].published for name in chosen)
    planned = bool(task) and any((HERE / name / "mpc.json").is_file() for name in chosen)
    lines = []
    for name in chosen:
        flight, baseline = FLIGHTS[name], best_baseline(name)
        learned = learned_policies(name)
        cell = _cell([HERE / name / f"{policy}.json" for policy in learned], error_metric(flight))
        other = f"{title(baseline)}: {_cell([HERE / name / f'{baseline}.json'], error_metric(flight))}"
        gain, verdict = compare(name) or ("-", "-")
        lines.append(
            [
                flight.title.removeprefix(f"{task}, ") if task else _full_title(name),
                cell,
                other if baseline else "-",
                gain,
                verdict,
                str(len(learned) or "-"),
            ]
        )
        lines[-1] += [_cell([HERE / name / "mpc.json"], error_metric(flight))] * planned
        lines[-1] += [flight.published] * published
    columns = ["conditions", "learned", "best baseline", "gain (95 % interval)", "verdict", "seeds"]
    columns += [f"`mpc`: central, knows the path, {PLANNED_EPISODES} episodes"] * planned
    return _markdown(columns + ["published"] * published, lines)


def _full_title(flight: str) -> str:
    """Return the task of a flight, and its conditions."""
    task, text = load_config(FLIGHTS[flight].config).task, FLIGHTS[flight].title
    return f"`{task}`" if text == task else f"`{task}`: {text.removeprefix(f'{task}, ')}"


def title(policy: str) -> str:
    """Return how the tables call a baseline."""
    return TUNED if policy == "searched" else f"`{policy}`"


def learned_policies(flight: str) -> list[str]:
    """Return the names of the evaluated learned policies, one for each training seed."""
    return sorted(path.stem for path in (HERE / flight).glob("seed*.npz"))


def _markdown(columns: list[str], lines: list[list[str]]) -> str:
    head = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    return "\n".join(head + [f"| {' | '.join(line)} |" for line in lines])


def best_baseline(flight: str) -> str:
    """Return the baseline with the least error of those that succeed most often, within noise; "" if there is none.

    Within noise: `as_often`. Up to it error counts, not success.
    """
    found = {name: np.load(path) for name in BASELINES if (path := HERE / flight / f"{name}.npz").is_file()}
    success = {name: each["success"].astype(float) for name, each in found.items()}
    most = max(success.values(), default=None, key=np.mean)
    good = [name for name, own in success.items() if as_often(own, most)]
    return min(good, default="", key=lambda name: (found[name]["error"].mean(), -success[name].mean()))


def as_often(own: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two rows of successes (0 or 1) of the same episodes differ by no more than chance.

    The exact test of McNemar (1947), two-sided at 5 %: of episodes in which one alone succeeds, half should be each's.
    """
    alone, count = int((own > other).sum()), int((own != other).sum())
    tail = sum(comb(count, k) for k in range(min(alone, count - alone) + 1)) / 2**count
    return min(2 * tail, 1.0) >= 0.05


def compare(flight: str) -> tuple[str, str] | None:
    """Return the gain of learned policies over the best baseline, and the verdict; None where one of both is missing.

    Intervals are over episodes and training seeds. Errors are compared in episodes of the same outcome.
    """
    differences = paired(flight)
    if differences is None:
        return None
    success, error = differences
    parts = []
    for values, unit, digits in ((success, "points", 1), (error, "cm", 2)):
        if values.size and np.nan_to_num(values).any():
            low, high = (_signed(bound, digits) for bound in bootstrap_seeds(values))
            mean = _signed(_mean(values), digits)
            parts.append(f"{mean} {unit}" if low == mean == high else f"{mean} ({low}, {high}) {unit}")
        elif values.size:
            parts.append(f"0 {unit}")
    return ", ".join(parts), judge(success, error)


def paired(flight: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return learned minus best baseline, a row for each training seed, a column for each episode.

    Success [points]; error [cm], NaN where one alone succeeds, without the training seeds that have no other episodes.
    """
    learned = [np.load(HERE / flight / f"{policy}.npz") for policy in learned_policies(flight)]
    best = best_baseline(flight)
    if not learned or not best:
        return None
    baseline = np.load(HERE / flight / f"{best}.npz")
    success, error = (
        100 * np.array([each[key].astype(float) - baseline[key].astype(float) for each in learned])
        for key in ("success", "error")
    )
    alike = success == 0
    return success, np.where(alike, error, np.nan)[alike.any(axis=1)]


def judge(success: np.ndarray, error: np.ndarray) -> str:
    """Return "better", "no significant difference" or "worse".

    A difference counts if its 95 % interval leaves out zero and it is at least a point of success or a millimetre of
    error. Success decides; error does where no difference of success counts, and none in the opposite direction is
    significant, be it over episodes alone.

    Args:
        success: (S, n) learned minus baseline, in points; see `paired`.
        error: (S', n) the same of errors, in cm.
    """
    names = {1: "better", 0: "no significant difference", -1: "worse"}
    often = _direction(success)
    if often and abs(_mean(success)) >= POINT:
        return names[often]
    exact, of_these = -_direction(error), _direction(success.mean(axis=0, keepdims=True))
    if exact and abs(_mean(error)) >= MILLIMETRE and exact != -of_these:
        return names[exact]
    return names[0]


def _mean(values: np.ndarray) -> float:
    """Return the mean over training seeds of the means over episodes."""
    return float(np.nanmean(values, axis=1).mean()) if values.size else 0.0


def _direction(values: np.ndarray) -> int:
    """Return the sign of the mean where its 95 % interval leaves out zero, else 0."""
    if not values.size:
        return 0
    low, high = bootstrap_seeds(values)
    return int(low > 0) - int(high < 0)


def _signed(value: float, digits: int) -> str:
    text = f"{value:+.{digits}f}"
    return text.lstrip("+-") if float(text) == 0 else text.replace("-", "−")


def _cell(paths: list[Path], error: str) -> str:
    """Return "success %, error cm", means of these results, with the smallest and the largest where they differ."""
    found = [json.loads(path.read_text(encoding="utf-8"))["metrics"] for path in paths if path.is_file()]
    if not found:
        return "-"
    parts = []
    for metric, unit, digits in (("success_rate", "%", 1), (error, "cm", 2)):
        values = [100 * one[metric]["mean"] for one in found]
        least, most = (f"{value:.{digits}f}" for value in (min(values), max(values)))
        spread = f" [{least}–{most}]" if least != most else ""
        parts.append(f"{sum(values) / len(values):.{digits}f}{spread} {unit}")
    return ", ".join(parts)


def shifts(flights: Sequence[str]) -> str:
    """Return success under each change that `shifts.py` made, learned / best baseline, a column for each flight."""
    found = {flight: _recorded_shifts(flight) for flight in flights}
    lines = []
    for index, row in enumerate(next(iter(found.values()))):
        cells = []
        for each in found.values():
            assert each[index]["shift"] == row["shift"]
            learned, baseline = each[index].get("learned"), list(each[index].values())[-1]
            values = [None if found is None else found.get("success") for found in (learned, baseline)]
            cells.append("/".join("-" if value is None else f"{100 * value:.1f}" for value in values))
        lines.append([row["shift"], *cells])
    return _markdown(["success [%]", *(f"`{flight}`" for flight in flights)], lines)


def _recorded_shifts(flight: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((HERE / flight / "shifts.json").read_text(encoding="utf-8"))["rows"]
    return found


def policies_csv() -> str:
    """Return every policy of every flight: means and 95 % intervals over the episodes."""
    head = ["task", "flight", "conditions", "policy", "training_seed", "episodes", "episode_seed"]
    head += [f"{column}{part}" for _, column, _ in METRICS for part in ("", "_low", "_high")]
    lines = []
    for flight, entry in FLIGHTS.items():
        for policy in (*BASELINES, "mpc", *learned_policies(flight)):
            path = HERE / flight / f"{policy}.json"
            if not path.is_file():
                continue
            report = json.loads(path.read_text(encoding="utf-8"))
            seed = policy.removeprefix("seed") if policy.startswith("seed") else ""
            name = "learned" if seed else title(policy).strip("`")
            task = load_config(entry.config).task
            line = [task, flight, entry.title, name, seed, report["episodes"], report["seed"]]
            for metric, _, factor in METRICS:
                values = report["metrics"].get(metric)
                parts = ("", "", "") if values is None else (values["mean"], *(values["ci95"] or ("", "")))
                line += [part if part == "" else f"{factor * part:.6g}" for part in parts]
            lines.append(line)
    return _csv(head, lines)


def shifts_csv() -> str:
    """Return every policy of every flight that `shifts.py` evaluated, under each change."""
    head = ["flight", "conditions", "shift", "policy", "success_percent", "error_cm", "attitude_error_deg", "refused"]
    lines = []
    for flight, entry in FLIGHTS.items():
        if not (HERE / flight / "shifts.json").is_file():
            continue
        for row in _recorded_shifts(flight):
            for policy in list(row)[1:]:
                found, name = row[policy], policy if policy == "learned" else title(policy).strip("`")
                factors = (("success", 100), ("error", 100), ("angle", 1))
                values = ["" if key not in found else f"{factor * found[key]:.6g}" for key, factor in factors]
                lines.append([flight, entry.title, row["shift"], name, *values, found.get("refused", "")])
    return _csv(head, lines)


def _csv(head: list[str], lines: list[list[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([head, *lines])
    return text.getvalue()


def fill(text: str) -> str:
    """Return a page with its tables, those of `<!-- results of <task or flights> -->` and `<!-- shifts of … -->`."""
    makers = {"results": rows, "shifts": lambda named: shifts(named.split())}
    marked = re.compile(r"(<!-- (results|shifts) of ([\w ]+) -->\n).*?(<!-- end of \2 -->)", re.DOTALL)
    return marked.sub(lambda found: f"{found[1]}{makers[found[2]](found[3])}\n{found[4]}", text)


def write_tables() -> None:
    """Write the tables of docs/results.md and README, and docs/data/results.csv and shifts.csv."""
    docs = ROOT / "docs"
    for page in (docs / "results.md", ROOT / "README.md"):
        page.write_text(fill(page.read_text(encoding="utf-8")), encoding="utf-8")
    (docs / "data").mkdir(exist_ok=True)
    for name, content in (("results", policies_csv()), ("shifts", shifts_csv())):
        (docs / "data" / f"{name}.csv").write_text(content, encoding="utf-8")
