"""The validation page: its table, one line for each experiment, and all rows and captions as CSV files beside it."""

from __future__ import annotations

import csv
import io
import re
import shutil
from pathlib import Path
from typing import Any, NamedTuple

from multilift_marl._files import write_whole
from multilift_marl.validation.experiment import Result

MARKER = "<!-- results -->\n"
COLUMNS = ("only", "experiment", "quantity", "theory", "simulated", "error", "limit", "pass")
PLOT_COLUMNS = ("only", "file", "caption")
_BOUND = re.compile(r"(?:shortfall of|stays below|excess over) ([\d.]+)( %)?$")


class Summary(NamedTuple):
    """What the page says of an experiment beside its numbers."""

    checked: str
    reference: str
    measures: dict[str, str]
    """Words of the table, each with a regular expression that the quantities of its rows match from their first letter;
    each row with a limit has one."""


SUMMARIES: dict[str, Summary] = {
    "single_cable": Summary(
        "One cable, loads of 0.1–5 kg released at natural length, both models",
        "Second-order system; matrix exponential of the chain; report table 1, figs 8–11",
        {"static stiffness": "static stiffness", "elongation over 0.1 s, RMS over static stretch": "elongation"},
    ),
    "six_cables": Summary(
        "Six cables 30° from the vertical, 6–60 kg, both models",
        "Second-order system; eqs 14–16 by the implicit midpoint rule; report figs 12–14",
        {
            "static stiffness": "static stiffness",
            "elongation, RMS": "elongation",
            "real-time factor, massless": "real-time.*of 200$",
            "chains": "real-time.*of 10$",
        },
    ),
    "stiff_cables": Summary(
        "k = 1e6 N/m, c = 1e4 N s/m, steps of 0.5–5 ms, push of 0.2 m/s",
        "No solver warning, no gain of speed",
        {"warnings": "warnings", "payload speed [m/s]": "largest payload speed"},
    ),
    "integrators": Summary(
        "Chain of 10 springs, 1 kg, 1 ms, under MuJoCo's integrators",
        "Statics; report fig. 4",
        {"`discrete`": "depth", "each other integrator": "the same"},
    ),
    "slack_taut": Summary(
        "Drone and payload part at 2 m/s in free fall until the cable is taut; elastic bounce",
        "Momentum; closed form of two bodies on a spring and damper",
        {
            "momentum": "vertical momentum",
            "pushing force [N]": "least tension",
            "tension while slack [N]": "largest tension",
            "parting speed, 0.25 ms and below": "speed of parting after",
            "order": "speed of parting: order",
            "order of the energy loss": "energy lost: order",
        },
    ),
    "static_teams": Summary(
        "2–8 drones at rest; payload with its centre of mass 6 cm off",
        "m g/(N cos θ); law of the lever",
        {"tension": "tension"},
    ),
    "swing": Summary(
        "1 kg swings from 30° for 20 s",
        "Pendulum period (arithmetic-geometric mean); energy",
        {"period": "period", "energy lost at 4 ms": "energy lost in", "order": "numerical part"},
    ),
    "free_fall": Summary(
        "Drone and payload fall or coast for 1 s, steps of 1–4 ms",
        "Closed forms without and with drag",
        {
            "speed without drag": "speed without",
            "depth": r"depth without drag \[",
            "speed with drag": r"speed with drag \[",
            "coasting speed": r"speed of a coasting drone \[",
            "orders": ".*order in",
        },
    ),
    "spin": Summary(
        "Drone tumbles without torque at 20 rad/s for 10 s, steps of 1–4 ms",
        "Conservation",
        {
            "energy": "energy",
            "size of angular momentum": "size of",
            "its direction": "angular momentum within",
            "order": "angular momentum: order",
        },
    ),
    "ground": Summary(
        "Payload and drones dropped from 0.3 m, tilted by 10°",
        "Rigid contact at rest",
        {"height [m]": "height", "later motion [m]": "motion"},
    ),
    "motor_lag": Summary(
        "Step of the commanded rotor speed", "1 - exp(-t/τ)", {"rotor speed, any step": "rotor speed"}
    ),
    "momentum": Summary(
        "Asymmetric team in wind, some cables slack at first",
        "Momentum balance with all external impulses",
        {
            "each step": ".*each step",
            "linear, 5 s": r"linear momentum less impulses, \d",
            "angular, 5 s": r"angular momentum less impulses, \d",
            "order": "drift",
        },
    ),
    "conservation": Summary(
        "Teams of 4 and 6 tumble in free fall at up to 2 rad/s for 10 s; one drone is cut loose",
        "Conservation; energy with the dampers' losses (chains)",
        {
            "centre-of-mass speed [m/s]": "speed",
            "angular momentum": "angular",
            "energy": "energy",
            "cut drone's velocity [m/s]": "velocity off",
        },
    ),
    "symmetry": Summary(
        "Asymmetric team and its twins turned by 73°, mirrored and renumbered, 5 s",
        "Equivariance",
        {"positions [m], attitudes": "largest difference"},
    ),
    "release": Summary(
        "Each preset released at rest in 1003 attitudes",
        "Return to within 5 cm in 30 s",
        {"drones not back": "drones not back"},
    ),
    "turbulence": Summary(
        "Dryden turbulence at 3 and 30 m in 5 m/s",
        "MIL-F-8785C: variance, autocorrelation, spectrum",
        {"autocorrelation over variance": "autocorrelation", "|log| of the spectral ratio": "spectral"},
    ),
    "gust": Summary(
        '"1 - cosine" gust and a drone\'s response',
        "Formula; convolution with linear drag",
        {"profile [m/s]": "largest error", "speed": "speed"},
    ),
    "wash": Summary(
        "Wash below a hovering `falcon`",
        "Momentum theory; momentum flux = thrust; far jet",
        {
            "at the rotor": "under a rotor",
            "above [m/s]": "speed above",
            "flux": "momentum flux",
            "far jet": "20 m below",
            "push on a payload": "acceleration",
        },
    ),
    "inflow": Summary(
        "Thrust in climbs of -2 to 7 m/s, three presets",
        "Blade elements and momentum, solved by bisection",
        {"thrust": "thrust", "slope at hover": "slope"},
    ),
    "ground_effect": Summary(
        "Thrust at 1–1000 rotor radii",
        "Cheeseman and Bennett 1955; images of four rotors",
        {"four rotors": "thrust over", "one rotor": "one rotor"},
    ),
    "flight": Summary(
        "`report4`, `falcon4`: ground, lift, circle of 5 m at 0.2 and 0.4 rad/s",
        "Reference path; limits of report §4.2",
        {
            "motion on the ground [m]": "motion of",
            "slack tension [N]": "largest tension",
            "peak over static tension": "peak",
            "overshoot, payload [m]": "payload's altitude",
            "drones [m]": "a drone's altitude",
            "off the path, any drone [m]": "a drone off",
            "payload [m]": "the payload off",
            "on the circle: mean drone error [m]": "mean position",
            "mean yaw [deg]": "mean yaw",
            "largest yaw [deg]": "largest yaw",
            "mean payload error [m]": "mean payload",
        },
    ),
    "flight_in_wind": Summary(
        "The same circles in 5 m/s with turbulence, `control.disturbance=indi`",
        "Reference path",
        {"mean drone error [m]": "mean position"},
    ),
}


def write_document(path: Path, results: dict[str, Result], out: Path) -> None:
    """Record results beside a Markdown file, and replace everything after its line "<!-- results -->" by their table.

    Rows and captions go to data/<name of the file>.csv and data/<name>_plots.csv, pictures from the folder `out` to
    images/<name>. Of experiments that are not in `results` what was recorded before is kept.
    """
    data, images = path.parent / "data", path.parent / "images" / path.stem
    for folder in (data, images):
        folder.mkdir(parents=True, exist_ok=True)
    rows, plots = [], []
    for name, result in results.items():
        rows += [{"only": name, **_as_text(row.as_dict())} for row in result.rows]
        for plot in result.plots:
            shutil.copyfile(out / f"{plot.name}.png", images / f"{plot.name}.png")
            plots.append({"only": name, "file": f"{plot.name}.png", "caption": plot.caption})
    rows = _record(data / f"{path.stem}.csv", COLUMNS, rows, results)
    plots = _record(data / f"{path.stem}_plots.csv", PLOT_COLUMNS, plots, results)
    head = path.read_text(encoding="utf-8").partition(MARKER)[0]
    write_whole(path, f"{head}{MARKER}\n{format_summary(rows, plots, path.stem)}".encode())


def read_csv(path: Path) -> list[dict[str, str]]:
    """Return the rows of a recorded file; none if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _record(
    path: Path, columns: tuple[str, ...], rows: list[dict[str, str]], results: dict[str, Result]
) -> list[dict[str, str]]:
    """Put rows in place of those of the same experiments in a file, in the order of `SUMMARIES`; return all of it."""
    order = list(SUMMARIES)
    kept = [row for row in read_csv(path) if row["only"] not in results]
    every = sorted(kept + rows, key=lambda row: order.index(row["only"]))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(every)
    write_whole(path, text.getvalue().encode())
    return every


def _as_text(row: dict[str, Any]) -> dict[str, str]:
    numbers = {key: "" if row[key] is None else f"{row[key]:.6g}" for key in ("theory", "simulated", "error", "limit")}
    return {**row, **numbers, "pass": "yes" if row["pass"] else "NO"}


def format_summary(rows: list[dict[str, str]], plots: list[dict[str, str]], stem: str) -> str:
    """Return the table of the page `stem`: a line for each experiment that has recorded rows."""
    passed = sum(row["pass"] == "yes" for row in rows)
    lines = [
        f"{passed} of {len(rows)} rows pass; [all of them](data/{stem}.csv), [captions of the plots]"
        f"(data/{stem}_plots.csv).",
        "",
        "| `--only` | what is checked | reference | largest error (limit) | pass | plots |",
        "|---|---|---|---|---|---|",
    ]
    for name, summary in SUMMARIES.items():
        own = [row for row in rows if row["only"] == name]
        if own:
            measured = "; ".join(f"{words} {measure(own, pattern)}" for words, pattern in summary.measures.items())
            passes = f"{sum(row['pass'] == 'yes' for row in own)}/{len(own)}"
            files = [plot["file"] for plot in plots if plot["only"] == name]
            links = ", ".join(f"[{i}](images/{stem}/{file})" for i, file in enumerate(files, 1))
            cells = [f"`{name}`", summary.checked, summary.reference, measured, passes, links]
            lines.append(f"| {' | '.join(cell.replace('|log|', 'log') for cell in cells)} |")
    return "\n".join(lines) + "\n"


def measure(rows: list[dict[str, str]], pattern: str) -> str:
    """Return the error that is nearest to its limit among the rows whose quantity matches, and in brackets the limit.

    Where errors count beyond a bound, what is simulated and the bound are given instead.
    """
    own = [row for row in rows if row["limit"] and re.match(pattern, row["quantity"])]
    if not own:
        return "not measured"
    bound = _BOUND.search(own[0]["quantity"])
    simulated = [float(row["simulated"]) for row in own]
    if bound and "stays below" in bound[0]:
        off = min(abs(float(row["simulated"]) / float(row["theory"]) - 1) for row in own)
        return f"{_short(100 * off)} % (≥ {bound[1]} %)"
    if bound:
        largest = "excess" in bound[0]
        extreme = max(simulated) if largest else min(simulated)
        return f"{_short(extreme)} ({'≤' if largest else '≥'} {bound[1]})"
    worst = max(own, key=lambda row: float(row["error"]) / (float(row["limit"]) or 1.0))
    return f"{_short(float(worst['error']))} ({_short(float(worst['limit']))})"


def _short(value: float) -> str:
    """Return a number with two digits, without the padding of exponents."""
    return re.sub(r"e([+-])0", r"e\1", f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}")
