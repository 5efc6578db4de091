"""Draw learning curves without a base policy: evaluations during training, the band and the median of the seeds.

python results/curves.py [folder]      quickstart.png, imitation.png, from_nothing.png, auto_multilift_weights.png, in
                                       docs/images unless a folder is given
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from flights import HERE, ROOT
from matplotlib.axes import Axes
from tables import title

BASELINES = {"formation_integral": "--", "payload_geometric": ":", "searched": "-."}


class Panel(NamedTuple):
    """One axis of a picture."""

    column: str
    """Of the curves."""
    label: str
    factor: float = 1.0
    metric: str = ""
    """Of the baselines, which are drawn if it is given."""
    logarithmic: bool = False


SUCCESS = Panel("eval/success_rate", "success [%]", 100.0)
ERROR = Panel("eval/payload_position_error_m", "position error [cm]", 100.0, logarithmic=True)
PICTURES = {  # file: recipes and their labels, panels
    "quickstart": ({"quickstart": "hover by thrust and body rates"}, (SUCCESS, ERROR)),
    "imitation": (
        {"navigate_senses": "past unknown obstacles, 2 to 8 drones", "regroup_senses": "drones leave and join"},
        (SUCCESS, ERROR),
    ),
    "from_nothing": (
        {
            "hover_acc_rates": "accelerations and tilt rates", "hover_ctbr": "thrust and body rates",
            "hover_ctbm": "thrust and moments", "hover_rotor": "rotor thrusts",
        },
        (Panel("eval/return", "return of an episode", metric="return"),
         ERROR._replace(metric="payload_position_error_m")),
    ),
}  # fmt: skip

THEIR_EPISODES = 19, 30  # after which training ends, in five trainings (arXiv 2406.04858 and its repository)
THEIR_LOSSES = 1.8e5 / 9e6, 3.8e5 / 9e6  # at the end over that at the start


def read_curves(recipe: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Return steps (K,) in millions and the values (S, K) of each seed's evaluations."""
    curves = []
    for path in sorted((HERE / recipe).glob("seed*/curve.csv")):
        with path.open(encoding="utf-8") as file:
            found = [(float(row["frames"]) / 1e6, float(row[column])) for row in csv.DictReader(file) if row[column]]
        curves.append(np.array(found))
    return curves[0][:, 0], np.stack([curve[:, 1] for curve in curves])


def draw_panel(axes: Axes, panel: Panel, recipes: dict[str, str]) -> None:
    """Draw the recipes' curves, and the levels of the baselines."""
    for colour, (recipe, label) in enumerate(recipes.items()):
        steps, values = read_curves(recipe, panel.column)
        values = panel.factor * values
        axes.fill_between(steps, values.min(axis=0), values.max(axis=0), color=f"C{colour}", alpha=0.25, lw=0)
        axes.plot(steps, np.median(values, axis=0), f"C{colour}", lw=1.8, label=label)
    for baseline, style in BASELINES.items() if panel.metric else ():
        file = HERE / "hover_acc_rates" / f"{baseline}.json"
        report: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        level = panel.factor * report["metrics"][panel.metric]["mean"]
        axes.axhline(level, color="0.4", ls=style, lw=1, label=title(baseline).strip("`"))
    axes.set_xlabel("environment steps [millions]")
    axes.set_ylabel(panel.label)
    axes.grid(alpha=0.3)
    if panel.logarithmic:
        axes.set_yscale("log")


def draw_losses(folder: Path) -> None:
    """Draw the loss of each training on Auto-Multilift's path, and where their five trainings end."""
    with (ROOT / "docs" / "data" / "auto_multilift_weights.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["way"] == "adam"]
    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    for i, row in enumerate(rows):
        untrained = float(row["untrained_loss"])
        shares = [1.0, *(float(loss) / untrained for loss in row["losses"].split())]
        axes.plot(range(len(shares)), shares, "C0", lw=1.2, label=None if i else f"this package, {len(rows)} seeds")
    (first, last), (low, high) = THEIR_EPISODES, THEIR_LOSSES
    axes.fill_between([first, last], low, high, color="C1", alpha=0.4, lw=0, label="Auto-Multilift, end of 5 trainings")
    axes.axhline(1 / 30, color="0.4", ls="--", lw=1, label="a thirtieth")
    axes.set(xlabel="episodes", ylabel="loss over that without learning", yscale="log", xlim=(0, last))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(folder / "auto_multilift_weights.png", dpi=110)


def main(folder: Path) -> None:
    """Write the pictures."""
    draw_losses(folder)
    for name, (recipes, panels) in PICTURES.items():
        figure, all_axes = plt.subplots(1, len(panels), figsize=(10, 3.6), layout="constrained")
        for axes, panel in zip(all_axes, panels, strict=True):
            draw_panel(axes, panel, recipes)
        if len(recipes) > 1:
            all_axes[0].legend(fontsize="small", loc="lower right")
        figure.savefig(folder / f"{name}.png", dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images")
