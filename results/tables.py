"""The tables of the documents, from the files that `reproduce.py evaluate` writes for each flight."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from flights import FLIGHTS, HERE, ROOT, error_metric

from multilift_marl.control.scripted import SCRIPTED
from multilift_marl.evaluation.metrics import bootstrap, is_gain

TEAMS = (*(name for name, script in SCRIPTED.items() if script.INTERFACE == "reference"), "searched")
"""Scripts of the tables: those that move slots, and the best one of a search for a flight (searched.py)."""
_DETAILS = (  # of each team: metric, title, factor, digits
    ("success_rate", "success [%]", 100, 1),
    ("payload_position_error_m", "position error [cm]", 100, 2),
    ("payload_position_error_m_successful", "... successful [cm]", 100, 2),
    ("payload_attitude_error_deg", "attitude error [deg]", 1, 2),
    ("payload_attitude_error_deg_successful", "... successful [deg]", 1, 2),
    ("settling_time_s", "settling time [s]", 1, 2),
    ("return", "return", 1, 1),
)


def table() -> str:
    """Return all flights and all teams as a Markdown table: success and error, of learned ones the mean of seeds."""
    rows = []
    for name, flight in FLIGHTS.items():
        scripts = [_cell([HERE / name / f"{script}.json"], error_metric(flight)) for script in TEAMS]
        rows.append([flight.title, *_learned(name), gain(name), *scripts, flight.published])
    return _markdown(["learned", "training seeds", "learned - best script", *TEAMS, "published"], rows)


def summary() -> str:
    """Return the same of the learned teams and the best script of each flight alone."""
    rows = []
    for name, flight in FLIGHTS.items():
        best = best_script(name)
        script = f"{best}: {_cell([HERE / name / f'{best}.json'], error_metric(flight))}" if best else "-"
        difference = gain(name).replace(f", {best}", "")
        rows.append([flight.title, *_learned(name), script, difference, flight.published])
    return _markdown(["learned", "training seeds", "best script", "learned - best script", "published"], rows)


def _learned(flight: str) -> tuple[str, str]:
    """Return success and error of the learned teams, and how many there are."""
    teams = learned_teams(flight)
    return _cell([HERE / flight / f"{team}.json" for team in teams], error_metric(FLIGHTS[flight])), str(len(teams))


def learned_teams(flight: str) -> list[str]:
    """Return the names of the evaluated learned teams, one for each training seed."""
    return sorted(path.stem for path in (HERE / flight).glob("seed*.npz"))


def _markdown(columns: list[str], rows: list[list[str]]) -> str:
    """Return a table of which the first column has no name."""
    head = [f"| | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])


def best_script(flight: str) -> str:
    """Return the script with the least error of those that succeed most often, within noise; "" if there is none.

    Within noise: `as_often`. Up to it error counts, not success.
    """
    scripts = {name: np.load(path) for name in TEAMS if (path := HERE / flight / f"{name}.npz").is_file()}
    success = {name: script["success"].astype(float) for name, script in scripts.items()}
    most = max(success.values(), default=None, key=np.mean)
    good = [name for name, own in success.items() if as_often(own, most)]
    return min(good, default="", key=lambda name: (scripts[name]["error"].mean(), -success[name].mean()))


def as_often(own: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two rows of successes (0 or 1) of the same episodes differ by no more than chance.

    The exact test of McNemar (1947), two-sided at 5 %: of episodes in which one alone succeeds, half should be each's.
    """
    alone, count = int((own > other).sum()), int((own != other).sum())
    tail = sum(comb(count, k) for k in range(min(alone, count - alone) + 1)) / 2**count
    return min(2 * tail, 1.0) >= 0.05


def gain(flight: str) -> str:
    """Return the gain of learned teams over the best script: success and error, paired by episode.

    Of several training seeds each episode counts by its mean. Errors are compared in episodes that end alike for all;
    `is_gain` decides whether learning gains; a team that succeeds less often within noise is judged by its error.
    """
    learned = [np.load(HERE / flight / f"{team}.npz") for team in learned_teams(flight)]
    best = best_script(flight)
    if not learned or not best:
        return "-"
    script = np.load(HERE / flight / f"{best}.npz")
    parts = []
    differences = []
    for key, unit, digits in (("success", "points", 1), ("error", "cm", 2)):
        mean = np.mean([each[key].astype(float) for each in learned], axis=0)
        difference = 100 * (mean - script[key].astype(float))
        differences.append(difference)
        shown = difference if key == "success" else difference[differences[0] == 0]
        if shown.size:
            low, high = (f"{bound:+.{digits}f}" for bound in bootstrap(shown))
            parts.append(f"{shown.mean():+.{digits}f} ({low} to {high}) {unit}")
    verdict = "" if is_gain(*differences, strict=False) else "; **learning gains nothing**"
    return f"{', '.join(parts)}, {best}{verdict}"


def _cell(paths: list[Path], error: str) -> str:
    """Return "success %, error cm", means of these results, with the smallest and the largest where they differ."""
    teams = [json.loads(path.read_text(encoding="utf-8"))["metrics"] for path in paths if path.is_file()]
    if not teams:
        return "-"
    parts = []
    for metric, unit, digits in (("success_rate", "%", 1), (error, "cm", 2)):
        values = [100 * one[metric]["mean"] for one in teams]
        least, most = (f"{value:.{digits}f}" for value in (min(values), max(values)))
        spread = f" ({least} - {most})" if least != most else ""
        parts.append(f"{sum(values) / len(values):.{digits}f}{spread} {unit}")
    return ", ".join(parts)


def details(flights: Sequence[str]) -> str:
    """Return the metrics of every team of some flights as a Markdown table: means and 95 % intervals over episodes."""
    rows = []
    for flight in flights:
        for team in (*TEAMS, *learned_teams(flight)):
            if not (HERE / flight / f"{team}.npz").is_file():
                continue
            metrics = json.loads((HERE / flight / f"{team}.json").read_text(encoding="utf-8"))["metrics"]
            named = team.replace("seed", "learned, seed ")
            rows.append([f"{FLIGHTS[flight].title}: {named}" if len(flights) > 1 else named])
            rows[-1] += [_interval(metrics.get(name), factor, digits) for name, _, factor, digits in _DETAILS]
    return _markdown([title for _, title, _, _ in _DETAILS], rows)


def shifts(flights: Sequence[str]) -> str:
    """Return the learned team and the best script of some flights under each change that `shifts.py` made."""
    rows = []
    for flight in flights:
        for row in json.loads((HERE / flight / "shifts.json").read_text(encoding="utf-8"))["rows"]:
            change, *teams = row
            cells = []
            for team in teams:
                found = row[team]
                refused = "refused" in found
                cells.append("refused" if refused else f"{100 * found['success']:.1f} %, {100 * found['error']:.2f} cm")
            rows.append([f"{FLIGHTS[flight].title}: {row[change]}", *cells, teams[-1]])
    return _markdown(["learned", "best script", "which"], rows)


def _interval(metric: dict[str, Any] | None, factor: float, digits: int) -> str:
    if metric is None:
        return "-"
    mean, low, high = (f"{factor * value:.{digits}f}" for value in (metric["mean"], *metric["ci95"]))
    return f"{mean} ({low} - {high})"


def write_tables() -> None:
    """Replace the text between the markers in the documents."""
    marked = re.compile(r"(<!-- (results|shifts)(?: of ([\w ]+))? -->\n).*?(<!-- end of \2 -->)", re.DOTALL)
    for path in sorted((ROOT / "docs").glob("*.md")):
        whole = summary if path.name == "results.md" else table

        def fill(found: re.Match[str], whole: Callable[[], str] = whole) -> str:
            kind = shifts if found[2] == "shifts" else details
            content = kind(found[3].split()) if found[3] else whole()
            return f"{found[1]}{content}\n{found[4]}"

        text = path.read_text(encoding="utf-8")
        path.write_text(marked.sub(fill, text), encoding="utf-8")
