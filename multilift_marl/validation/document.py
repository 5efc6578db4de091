"""The results as Markdown: tables and pictures, from the files that a run has written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from multilift_marl.validation.experiment import Experiment, Result

MARKER = "<!-- results -->\n"
_KEYS = ("theory", "simulated", "error", "limit")


def describe(name: str, experiment: Experiment, result: Result) -> dict[str, Any]:
    """Return what experiments.json tells of an experiment: its name, purpose, number of rows, and figures."""
    about = " ".join((experiment.__doc__ or "").split("\n\n")[0].split())
    figures = [{"file": f"{plot.name}.png", "caption": plot.caption or plot.title} for plot in result.plots]
    return {"name": name, "about": about, "rows": len(result.rows), "figures": figures}


def format_table(rows: list[dict[str, Any]]) -> str:
    """Return the rows of validation.json as a Markdown table."""
    lines = ["| experiment | quantity | theory | simulated | error | limit | pass |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        numbers = ("-" if row[key] is None else f"{row[key]:.6g}" for key in _KEYS)
        cells = [row["experiment"], row["quantity"], *numbers, "yes" if row["pass"] else "NO"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def write_document(path: Path, out: Path) -> None:
    """Replace what stands after the line "<!-- results -->" of a Markdown file by the results in a folder.

    Pictures are copied to images/<name of the file> beside it.

    Args:
        path: of the Markdown file.
        out: folder with validation.json, experiments.json and the pictures of a run.
    """
    rows = json.loads((out / "validation.json").read_text(encoding="utf-8"))
    index = json.loads((out / "experiments.json").read_text(encoding="utf-8"))
    images = path.parent / "images" / path.stem
    failed = sum(not row["pass"] for row in rows)
    parts = [f"{len(rows) - failed} of {len(rows)} rows pass."]
    for experiment in index:
        own, rows = rows[: experiment["rows"]], rows[experiment["rows"] :]
        command = f"python -m multilift_marl.validation --only {experiment['name']}"
        parts += [f"### {experiment['name']}", experiment["about"], f"```\n{command}\n```", format_table(own)]
        for figure in experiment["figures"]:
            if (out / figure["file"]).is_file():
                images.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(out / figure["file"], images / figure["file"])
                parts.append(f"![{figure['caption']}](images/{path.stem}/{figure['file']})\\\n*{figure['caption']}*")
    head = path.read_text(encoding="utf-8").partition(MARKER)[0]
    path.write_text(head + MARKER + "\n" + "\n\n".join(parts) + "\n", encoding="utf-8")
