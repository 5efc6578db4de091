"""Flights by PX4 over seeds that nobody chose: each row of the table is a task, a team and a policy.

  python results/px4_flights.py px4=DIR [rows=hover,circle] [flights=20] [out=docs/data/px4_runs.csv] [policy=RUN]
                                [instance=0]
  python results/px4_flights.py table [out=...]     what docs/flight.md says of them

`policy` flies `hover_px4` as row `hover_learned`. Each flight is one run of `python -m multilift_marl.px4`, or of
`multilift_marl.sitl` in rows of nodes; those that the file has are not flown again.
"""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from script import check_known, read_options, run_script

from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.metrics import bootstrap

ROOT = Path(__file__).resolve().parent.parent
FIRST = 2000  # seed of the first flight; tuning and training used others
CIRCLE = ["config=track_circle", "policy=formation_lead", "env.episode_seconds=36"]
GENTLY = ["policy=formation_integral", "task_options.pace=0.5", "task_options.margin=0.05"]
ROWS: dict[str, list[str]] = {
    "hover": ["config=hover", "policy=formation_integral"],
    "circle": CIRCLE,
    "circle_6": [*CIRCLE, "env.num_drones=6"],
    "hover_6": ["config=hover", "policy=formation_integral", "env.num_drones=6"],
    "takeoff": ["config=takeoff", *GENTLY, "env.episode_seconds=35"],
    "land": ["config=land", *GENTLY, "env.episode_seconds=31"],
    "pose": ["config=pose", "policy=formation_integral"],
    "hover_rtk_halved": ["config=hover", "policy=formation_integral", "position_errors=0.5"],
    "hover_conditions": ["config=hover_px4", "policy=formation_integral"],
    "navigate": ["config=navigate_px4", "policy=formation_route"],
    "navigate_learned": ["policy=navigate_senses_px4"],
    "navigate_repelled": ["config=navigate_senses_px4", "policy=formation_repelled"],
}
EIGHT = ("task_options.speed=2", "task_options.acceleration=2")
LONGER = [f"{part}.env.episode_seconds=20" for part in ("flight", "nodes.planner")]  # integrals begin with the task
RATES, LEAD = "nodes.control.output=rates", "nodes.planner.policy=formation_lead"


def pipeline(config: str, planner: str, *more: str) -> list[str]:
    """Return arguments of `multilift_marl.sitl`: a flight, a planner, geometric control and a clock."""
    return [
        f"flight.config={config}", "flight.sync=false", f"nodes.planner.config={config}",
        f"nodes.planner.role={planner}", "nodes.planner.receiver=geometric_control",
        "nodes.control.role=geometric_control", f"nodes.control.config={config}", "nodes.control.patience=0.2",
        "nodes.clock.role=clock", "nodes.clock.patience=60", "common.domain=77", *more,
    ]  # fmt: skip


def eight(planner: str, *more: str) -> list[str]:
    """Return the same of a figure-eight of 2 m/s and 2 m/s²."""
    spans = [f"{part}.{key}" for part in ("flight", "nodes.planner") for key in EIGHT]
    return pipeline("track", planner, *spans, *more)


PIPELINES: dict[str, list[str]] = {
    "nodes_hover": pipeline("hover", "trajectory_planner", "nodes.planner.policy=formation_integral", *LONGER),
    "nodes_circle": pipeline("track_circle", "trajectory_planner", LEAD),
    "nodes_circle_mpc": pipeline("track_circle", "mpc_planner", RATES),
    "nodes_eight": eight("trajectory_planner", LEAD),
    "nodes_eight_rates": eight("trajectory_planner", LEAD, RATES),
    "nodes_eight_mpc": eight("mpc_planner"),
    "nodes_eight_mpc_rates": eight("mpc_planner", RATES),
}
ROWS |= {
    "eight": ["config=track", "policy=formation_lead", *EIGHT],
}
COLUMNS = (
    "row", "seed", "success", "position_cm", "rmse_cm", "attitude_deg", "drones_cm", "estimates_cm", "separation_m",
    "tension_task_N", "tension_N", "tilt_deg", "seconds", "margin_m", "real_time_factor", "latency_50_ms",
    "latency_99_ms", "ended",
)  # fmt: skip


def fly(row: str, seed: int, px4: str, instance: str) -> dict[str, Any]:
    """Fly once; return what the table says of it."""
    with tempfile.TemporaryDirectory() as folder:
        out, flight = Path(folder) / "out", "flight." if row in PIPELINES else ""
        module, keys = ("sitl", PIPELINES[row]) if row in PIPELINES else ("px4", ROWS[row])
        command = [sys.executable, "-m", f"multilift_marl.{module}", *keys, f"{flight}seed={seed}", f"out={out}"]
        done = subprocess.run(
            [*command, f"{flight}px4={px4}", f"{flight}instance={instance}"], cwd=ROOT, capture_output=True, text=True
        )
        written = out / ("flight" if row in PIPELINES else "") / "metrics.json"
        latency = _read_latency(out / "control.log")
        said = (done.stderr or done.stdout).strip().split("\n")[-1]
        if not written.is_file():
            return {"row": row, "seed": seed, "success": 0, "ended": said}
        report = json.loads(written.read_text())
    metrics = {name: value["mean"] for name, value in report["policy"].items()}
    flight, phases = report["px4"], report["px4"]["phases"]
    own = next(phase for phase in phases if phase["name"] == report["config"]["task"])
    return {
        "row": row, "seed": seed,
        "success": round(metrics["success_rate"]),
        "position_cm": round(100 * metrics["payload_position_error_m"], 2),
        "rmse_cm": round(100 * metrics["payload_rmse_m"], 2),
        "attitude_deg": round(metrics["payload_attitude_error_deg"], 2),
        "drones_cm": "" if flight["drone_error_m"] is None else round(100 * flight["drone_error_m"], 2),
        "estimates_cm": round(100 * flight["estimate_error_m"], 2),
        "separation_m": round(min(phase["separation"] for phase in phases), 3),
        "tension_task_N": round(own["tension"], 1), "tension_N": round(max(phase["tension"] for phase in phases), 1),
        "tilt_deg": round(max(phase["tilt"] for phase in phases), 1),
        "seconds": round(sum(phase["seconds"] for phase in phases), 1), "margin_m": flight["margin_m"],
        "real_time_factor": round(flight["real_time_factor"], 2),
        **latency,
        "ended": flight["ended"],
    }  # fmt: skip


def _read_latency(log: Path) -> dict[str, float]:
    """Return how long after odometry attitudes or rates were asked for, as the log of that node says at its end."""
    text = log.read_text() if log.is_file() else ""
    found = re.search(r"followed odometry by ([\d.]+) / ([\d.]+) /", text)
    return {f"latency_{share}_ms": float(found[k]) for k, share in ((1, 50), (2, 99))} if found else {}


def print_table(lines: list[dict[str, str]]) -> None:
    """Print a row of the table for each row that was flown, and what the learned team gains over its baseline.

    Flights whose take-off and landing had no margin are rows of their own.
    """
    flown: dict[str, dict[str, dict[str, str]]] = {}
    for line in lines:
        row = line["row"] + ("" if float(line["margin_m"] or 0) else ", no margin")
        flown.setdefault(row, {})[line["seed"]] = line
    for row, flights in flown.items():

        def column(name: str, flights: dict[str, dict[str, str]] = flights) -> np.ndarray:
            return np.array([float(line[name]) for line in flights.values()])

        place, angle, success = column("position_cm"), column("attitude_deg"), int(column("success").sum())
        numbers = [
            row, len(flights), success, f"{np.median(place):.1f} ({place.max():.1f})",
            f"{np.median(angle):.1f} ({angle.max():.1f})", (angle <= 5.0).sum(), f"{column('separation_m').min():.2f}",
            f"{column('tension_task_N').max():.1f}, {column('tension_N').max():.0f}",
            f"{np.median(column('rmse_cm')):.1f} ({column('rmse_cm').max():.1f})",
        ]  # fmt: skip
        print("|" + "|".join(str(number) for number in numbers) + "|")
    nodes = [line for line in lines if line["latency_50_ms"]]
    for name in ("latency_50_ms", "latency_99_ms", "real_time_factor", "separation_m") if nodes else ():
        values = np.array([float(line[name]) for line in nodes])
        print(
            f"{len(nodes)} flights by nodes, {name}: {np.median(values):.2f} ({values.min():.2f} to {values.max():.2f})"
        )
    for margin in ("", ", no margin"):
        learned, base = flown.get(f"hover_learned{margin}", {}), flown.get(f"hover_conditions{margin}", {})
        both = sorted(learned.keys() & base.keys())
        for name in ("position_cm", "attitude_deg") if both else ():
            gain = np.array([float(learned[seed][name]) - float(base[seed][name]) for seed in both])
            low, high = bootstrap(gain)
            print(f"hover_learned - hover_conditions{margin}, {name}: {gain.mean():.2f} ({low:.2f} to {high:.2f})")


def main(arguments: list[str]) -> None:
    """Fly what is not in the file yet."""
    defaults = {"out": str(ROOT / "docs" / "data" / "px4_runs.csv"), "rows": "hover,circle", "flights": 20}
    defaults |= {"px4": "", "policy": "", "instance": "0"}
    options = read_options([argument for argument in arguments if argument != "table"], defaults)
    out = Path(options["out"])
    if "table" in arguments:
        if not out.is_file():
            raise ConfigError(f"there is no {out}; fly first, or give out=")
        with out.open(newline="") as file:
            print_table(list(csv.DictReader(file)))
        return
    rows = options["rows"].split(",")
    if not options["px4"]:
        raise ConfigError("px4= is missing; give the folder of a built PX4: px4=DIR")
    if options["policy"]:
        ROWS["hover_learned"] = ["config=hover_px4", f"policy={options['policy']}"]
    check_known("row", rows, ROWS)
    known: set[tuple[str, int]] = set()
    if out.is_file():
        with out.open(newline="") as file:
            known = {(line["row"], int(line["seed"])) for line in csv.DictReader(file)}
    else:
        out.write_text(",".join(COLUMNS) + "\n")
    for row in rows:
        for seed in range(FIRST, FIRST + options["flights"]):
            if (row, seed) in known:
                continue
            line = fly(row, seed, options["px4"], options["instance"])
            with out.open("a", newline="") as file:
                csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(line)
            print(line, flush=True)


if __name__ == "__main__":
    run_script(main)
