"""`python -m multilift_marl.validation`: run all experiments, print a table, write validation.json and plots."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multilift_marl.errors import nearest, pip_install
from multilift_marl.validation import (
    air,
    bodies,
    cables,
    conservation,
    flight,
    momentum,
    release,
    symmetry,
    team_cables,
)
from multilift_marl.validation.document import describe, format_table, write_document
from multilift_marl.validation.draw import draw
from multilift_marl.validation.experiment import Experiment, Result

EXPERIMENTS: dict[str, Experiment] = {
    "single_cable": cables.single_cable,
    "six_cables": cables.six_cables,
    "stiff_cables": cables.stiff_cables,
    "integrators": cables.integrators,
    "slack_taut": team_cables.slack_taut,
    "static_teams": team_cables.static_teams,
    "swing": bodies.swing,
    "free_fall": bodies.free_fall,
    "spin": bodies.spin,
    "ground": bodies.ground,
    "motor_lag": bodies.motor_lag,
    "momentum": momentum.momentum,
    "conservation": conservation.conservation,
    "symmetry": symmetry.symmetry,
    "release": release.release,
    "turbulence": air.turbulence_spectra,
    "gust": air.gust,
    "wash": air.wash,
    "ground_effect": air.ground_effect,
    "flight": flight.flight,
    "flight_in_wind": flight.flight_in_wind,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run experiments; return 0 if all passed, 1 if one failed, 2 for wrong arguments, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m multilift_marl.validation", description=__doc__)
    parser.add_argument("--only", metavar="NAME", help=f"one experiment: {', '.join(EXPERIMENTS)}")
    parser.add_argument("--fast", action="store_true", help="shorter flights, under a minute in all")
    parser.add_argument("--out", type=Path, default=Path("validation"), help="folder for results (default: validation)")
    parser.add_argument(
        "--document", type=Path, help="also write the results into this Markdown file, after its marker"
    )
    given = parser.parse_args(arguments)
    if given.only is not None and given.only not in EXPERIMENTS:
        print(f"error: unknown experiment '{given.only}'{nearest(given.only, EXPERIMENTS)}", file=sys.stderr)
        return 2
    if given.document is not None and not given.document.is_file():
        print(f"error: there is no {given.document}; give a Markdown file that exists", file=sys.stderr)
        return 2
    try:
        from tqdm import tqdm
    except ModuleNotFoundError:
        print(f"error: tqdm is missing; {pip_install('train')}", file=sys.stderr)
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
    rows = write(results, given.out)
    print(format_table(rows))
    failed = sum(not row["pass"] for row in rows)
    print(f"\n{len(rows) - failed} of {len(rows)} passed; wrote {given.out / 'validation.json'} and plots")
    if interrupted:
        print(f"interrupted: {len(results)} experiments were complete", file=sys.stderr)
        return 130
    if given.document is not None:
        write_document(given.document, given.out)
    return 1 if failed else 0


def write(results: dict[str, Result], out: Path) -> list[dict[str, Any]]:
    """Write validation.json, experiments.json and the plots into a folder, and return the rows."""
    out.mkdir(parents=True, exist_ok=True)
    rows = [row.as_dict() for result in results.values() for row in result.rows]
    index = [describe(name, EXPERIMENTS[name], result) for name, result in results.items()]
    for file, content in (("validation.json", rows), ("experiments.json", index)):
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        (out / file).write_text(text + "\n", encoding="utf-8")
    draw([plot for result in results.values() for plot in result.plots], out)
    return rows


if __name__ == "__main__":
    sys.exit(main())
