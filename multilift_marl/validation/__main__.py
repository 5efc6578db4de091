"""`python -m multilift_marl.validation`: run all experiments, print a table, write validation.json and plots."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from multilift_marl.errors import nearest
from multilift_marl.validation import air, bodies, cables, flight
from multilift_marl.validation.experiment import Experiment, Result, Row

EXPERIMENTS: dict[str, Experiment] = {
    "single_cable": cables.single_cable,
    "six_cables": cables.six_cables,
    "stiff_cables": cables.stiff_cables,
    "integrators": cables.integrators,
    "slack_taut": bodies.slack_taut,
    "static_teams": bodies.static_teams,
    "swing": bodies.swing,
    "motor_lag": bodies.motor_lag,
    "spin": bodies.spin,
    "circle": flight.circle,
    "turbulence": air.turbulence_spectra,
    "gust": air.gust,
    "wash": air.wash,
    "ground_effect": air.ground_effect,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run experiments; return 0 if all passed, 1 if one failed, 2 for wrong arguments."""
    parser = argparse.ArgumentParser(prog="python -m multilift_marl.validation", description=__doc__)
    parser.add_argument("--only", metavar="NAME", help=f"one experiment: {', '.join(EXPERIMENTS)}")
    parser.add_argument("--fast", action="store_true", help="coarser, under a minute")
    parser.add_argument("--out", type=Path, default=Path("validation"), help="folder for results (default: validation)")
    parser.add_argument("--document", type=Path, help="also write the table into this Markdown file, after its marker")
    given = parser.parse_args(arguments)
    if given.only is not None and given.only not in EXPERIMENTS:
        print(f"error: unknown experiment '{given.only}'{nearest(given.only, EXPERIMENTS)}", file=sys.stderr)
        return 2
    try:
        from tqdm import tqdm
    except ModuleNotFoundError:
        print("error: tqdm is missing; pip install 'multilift_marl[train]'", file=sys.stderr)
        return 2
    chosen = [given.only] if given.only else list(EXPERIMENTS)
    results: dict[str, Result] = {}
    with tqdm(chosen, unit="experiment") as bar:
        for name in bar:
            bar.set_postfix_str(name)
            results[name] = EXPERIMENTS[name](given.fast)
    rows = [row for result in results.values() for row in result.rows]
    given.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps([row.as_dict() for row in rows], indent=1, default=float).replace("Infinity", "null")
    (given.out / "validation.json").write_text(text + "\n", encoding="utf-8")
    draw(results, given.out)
    print(format_table(rows))
    failed = sum(not row.passed for row in rows)
    print(f"\n{len(rows) - failed} of {len(rows)} passed; wrote {given.out / 'validation.json'} and plots")
    if given.document is not None:
        write_document(given.document, json.loads(text))
    return 1 if failed else 0


def format_table(rows: list[Row]) -> str:
    """Return the rows as a Markdown table."""
    return _table([row.as_dict() for row in rows])


def _table(rows: list[dict]) -> str:
    lines = ["| experiment | quantity | theory | simulated | error | limit | pass |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        numbers = (_number(row[key]) for key in ("theory", "simulated", "error", "limit"))
        cells = [row["experiment"], row["quantity"], *numbers, "yes" if row["pass"] else "NO"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None or value == float("inf") else f"{value:.6g}"


def write_document(path: Path, rows: list[dict]) -> None:
    """Replace what stands after the line "<!-- results -->" of a Markdown file by the table of `rows`."""
    head, marker, _ = path.read_text(encoding="utf-8").partition("<!-- results -->\n")
    path.write_text(f"{head}{marker}\n{_table(rows)}\n", encoding="utf-8")


def draw(results: dict[str, Result], out: Path) -> None:
    """Write every plot of `results` as a PNG; say so on stderr if matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        print("no plots: matplotlib is missing; pip install 'multilift_marl[train]'", file=sys.stderr)
        return
    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # Okabe & Ito 2008
    for plot in (plot for result in results.values() for plot in result.plots):
        figure = Figure(figsize=(6.4, 3.8), layout="constrained")
        axes = figure.subplots()
        simulated = [curve for curve in plot.curves if not curve.theory]
        for curve, colour in zip(simulated, colours, strict=False):
            axes.plot(curve.x, curve.y, color=colour, label=curve.label, linewidth=1.6)
        for curve in plot.curves:
            if curve.theory:
                axes.plot(curve.x, curve.y, color="black", label=curve.label, linewidth=1.2, linestyle=(0, (4, 3)))
        axes.set(title=plot.title, xlabel=plot.x_label, ylabel=plot.y_label)
        axes.grid(color="0.9")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False)
        if plot.log:
            axes.set(xscale="log", yscale="log")
        if plot.equal:
            axes.set_aspect("equal")
        figure.savefig(out / f"{plot.name}.png", dpi=110)


if __name__ == "__main__":
    sys.exit(main())
