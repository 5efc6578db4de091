"""`python -m multilift_marl.validation`: run all experiments, print a table, write validation.json and plots."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multilift_marl._files import write_whole
from multilift_marl._interrupt import end_quiet_import
from multilift_marl.command import make_folder
from multilift_marl.errors import ConfigError, nearest, pip_install, reason
from multilift_marl.validation import air, bodies, cables, conservation, flight, symmetry
from multilift_marl.validation.document import write_document
from multilift_marl.validation.experiment import Experiment, Result

EXPERIMENTS: dict[str, Experiment] = {
    "single_cable": cables.single_cable,
    "six_cables": cables.six_cables,
    "stiff_cables": cables.stiff_cables,
    "integrators": cables.integrators,
    "slack_taut": cables.slack_taut,
    "static_teams": cables.static_teams,
    "swing": bodies.swing,
    "free_fall": bodies.free_fall,
    "spin": bodies.spin,
    "ground": bodies.ground,
    "motor_lag": bodies.motor_lag,
    "momentum": conservation.momentum,
    "conservation": conservation.conservation,
    "symmetry": symmetry.symmetry,
    "release": bodies.release,
    "turbulence": air.turbulence_spectra,
    "gust": air.gust,
    "wash": air.wash,
    "inflow": air.inflow,
    "ground_effect": air.ground_effect,
    "flight": flight.flight,
    "flight_in_wind": flight.flight_in_wind,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run experiments; return 0 if all passed, 1 if one failed, 2 for wrong arguments, 130 after Ctrl-C."""
    end_quiet_import()
    parser = argparse.ArgumentParser(prog="python -m multilift_marl.validation", description=__doc__)
    parser.add_argument("--only", metavar="NAME", help=f"one experiment: {', '.join(EXPERIMENTS)}")
    parser.add_argument("--fast", action="store_true", help="shorter flights, under a minute in all")
    parser.add_argument("--out", type=Path, default=Path("validation"), help="folder for results (default: validation)")
    parser.add_argument(
        "--document", type=Path, help="also record the results beside this Markdown file, and their table in it"
    )
    given = parser.parse_args(arguments)
    if given.only is not None and given.only not in EXPERIMENTS:
        print(f"error: unknown experiment '{given.only}'{nearest(given.only, EXPERIMENTS)}", file=sys.stderr)
        return 2
    if given.document is not None and not given.document.is_file():
        print(f"error: there is no {given.document}; give a Markdown file that exists", file=sys.stderr)
        return 2
    try:
        make_folder(given.out, "--out <folder>")
        if given.document is not None:
            given.document.open("r+b").close()
    except (ConfigError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        import matplotlib  # noqa: F401  (the experiments draw with it)
        from tqdm import tqdm
    except ModuleNotFoundError as error:
        print(f"error: {error.name} is missing; {pip_install('train')}", file=sys.stderr)
        return 2
    results: dict[str, Result] = {}
    interrupted = False
    with tqdm([given.only] if given.only else list(EXPERIMENTS), unit="experiment") as bar:
        try:
            for name in bar:
                bar.set_postfix_str(name)
                results[name] = EXPERIMENTS[name](given.fast)
        except KeyboardInterrupt:
            interrupted = True
    rows = [row.as_dict() for result in results.values() for row in result.rows]
    failed = sum(not row["pass"] for row in rows)
    # Printed before they are written, which may fail.
    print(f"{format_table(rows)}\n\n{len(rows) - failed} of {len(rows)} passed", flush=True)
    try:
        print(f"wrote {write(results, rows, given.out)} and plots")
        if given.document is not None and not interrupted:
            write_document(given.document, results, given.out)
    except OSError as error:
        place = error.filename or given.out
        print(f"error: cannot write {place} ({reason(error)}); make room, or use another folder", file=sys.stderr)
        return 2
    if interrupted:
        print(f"interrupted: {len(results)} experiments were complete", file=sys.stderr)
        return 130
    return 1 if failed else 0


def write(results: dict[str, Result], rows: list[dict[str, Any]], out: Path) -> Path:
    """Write rows and plots into a folder; return the file of the rows.

    That is validation.json, unless these are of some experiments only and there is one already.
    """
    path = out / "validation.json"
    if results.keys() != EXPERIMENTS.keys() and path.exists():
        path = out / "validation_partial.json"
    text = json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False)
    write_whole(path, f"{text}\n".encode())
    for result in results.values():
        for plot in result.plots:
            plot.save(out)
    return path


def format_table(rows: list[dict[str, Any]]) -> str:
    """Return the rows of validation.json as a Markdown table."""
    lines = ["| experiment | quantity | theory | simulated | error | limit | pass |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        numbers = ("-" if row[key] is None else f"{row[key]:.6g}" for key in ("theory", "simulated", "error", "limit"))
        cells = [row["experiment"], row["quantity"], *numbers, "yes" if row["pass"] else "NO"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
