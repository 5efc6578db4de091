"""Draw what teams learn from nothing: return and error of the evaluations during training, beside those of scripts.

python results/curves.py [docs/images/from_nothing.png]
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from flights import HERE, ROOT

RECIPES = {
    "hover_acc_rates": "accelerations and tilt rates", "hover_ctbr": "thrust and body rates",
    "hover_ctbm": "thrust and moments", "hover_rotor": "rotor thrusts",
}  # fmt: skip
SCRIPTS = {"formation_integral": "--", "payload_geometric": ":", "searched": "-."}
PANELS = (  # column of the curves, metric of the scripts, factor, label
    ("eval/return", "return", 1.0, "return of an episode"),
    ("eval/payload_position_error_m", "payload_position_error_m", 100.0, "position error [cm]"),
)


def draw(path: Path) -> None:
    """Write the picture."""
    figure, axes = plt.subplots(1, len(PANELS), figsize=(10, 3.6), layout="constrained")
    for panel, (column, metric, factor, label) in zip(axes, PANELS, strict=True):
        for colour, (recipe, title) in enumerate(RECIPES.items()):
            for seed, curve in enumerate(sorted((HERE / recipe).glob("seed*/curve.csv"))):
                rows = list(csv.DictReader(curve.open(encoding="utf-8")))
                frames = [float(row["frames"]) / 1e6 for row in rows]
                values = [factor * float(row[column]) for row in rows]
                panel.plot(frames, values, f"C{colour}", lw=1.2, label=None if seed else title)
        for script, style in SCRIPTS.items():
            file = HERE / "hover_acc_rates" / f"{script}.json"
            report: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
            level = factor * report["metrics"][metric]["mean"]
            panel.axhline(level, color="0.4", ls=style, lw=1, label=f"script {script}")
        panel.set_xlabel("environment steps [millions]")
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    axes[1].set_yscale("log")
    axes[0].legend(fontsize="small", loc="lower right")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images" / "from_nothing.png")
