"""What an experiment returns: rows that compare with theory, and plots."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multilift_marl._files import write_whole
from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B", "#7F7F7F")  # Okabe & Ito 2008
_DOTS_PER_INCH = 90
_PALETTE = 255  # colours of a picture: enough for thin lines, and half the size
_FEW = 8  # points of a curve that are marked one by one


class Row(NamedTuple):
    """One comparison with theory; `error` and `limit` have the same unit, given in `quantity`."""

    experiment: str
    quantity: str
    theory: float
    simulated: float
    error: float
    limit: float

    @property
    def passed(self) -> bool:
        """Whether the error is within its limit; False for NaN."""
        return bool(self.error <= self.limit)

    def as_dict(self) -> dict[str, Any]:
        """Return the row as it is written to validation.json; what is not finite is None."""
        numbers = {key: float(getattr(self, key)) for key in ("theory", "simulated", "error", "limit")}
        finite = {key: value if np.isfinite(value) else None for key, value in numbers.items()}
        return {"experiment": self.experiment, "quantity": self.quantity, **finite, "pass": self.passed}


class Plot:
    """One picture: a matplotlib figure with panels over a common x, its file name and its caption.

    Args:
        name: of the file, without .png.
        title: above the first panel; also the caption if that is empty.
        x_label: with unit.
        *y_labels: with unit, one for each panel.
        caption: one line for the document.
        log: "" for linear axes, "y" for a logarithmic y axis, "xy" for two.
    """

    def __init__(self, name: str, title: str, x_label: str, *y_labels: str, caption: str = "", log: str = ""):
        from matplotlib.figure import Figure

        self.name = name
        self.caption = caption or title
        self._log = log
        self.figure = Figure(figsize=(6.8, 3.6 if len(y_labels) == 1 else 5.6), layout="constrained")
        self.panels = self.figure.subplots(len(y_labels), sharex=True, squeeze=False)[:, 0]
        self.panels[0].set_title(title, fontsize=11)
        self.panels[-1].set_xlabel(x_label)
        for axes, label in zip(self.panels, y_labels, strict=True):
            axes.set(ylabel=label, xscale="log" if log == "xy" else "linear", yscale="log" if log else "linear")
            axes.set_prop_cycle(color=COLOURS)
            axes.grid(color="0.88", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)

    def add(self, label: str, x: np.ndarray, y: np.ndarray, theory: bool = False, panel: int = 0) -> None:
        """Add a curve, dashed and black if it is theory; one without a label is left out of the legend."""
        axes = self.panels[panel]
        style: dict[str, Any] = {"linewidth": 1.4}
        if theory:
            style = {"linewidth": 1.1, "color": "black", "linestyle": (0, (4, 3))}
        elif self._log == "xy" and len(x) <= _FEW:
            style |= {"marker": "o", "markersize": 4}
            axes.set_xticks(x, [f"{value:g}" for value in x])
            axes.set_xticks([], minor=True)
        axes.plot(x, y, label=label or None, **style)

    def shade(self, phases: Sequence[tuple[str, float, float]]) -> None:
        """Shade every second one of the phases (name, start, end), and write their names above the first panel."""
        top = self.panels[0]
        top.set_title(top.get_title(), fontsize=11, pad=62)
        for i, (name, start, end) in enumerate(phases):
            narrow = (end - start) / (phases[-1][2] - phases[0][1]) < 0.014 * len(name) + 0.01
            top.text(
                0.5 * (start + end), 1.02, name, transform=top.get_xaxis_transform(), rotation=90 if narrow else 0,
                ha="center", va="bottom", fontsize=8, color="0.3",
            )  # fmt: skip
            for axes in self.panels if i % 2 else ():
                axes.axvspan(start, end, color="0.94", linewidth=0)

    def save(self, folder: Path) -> None:
        """Write the picture, with a legend for each panel whose curves are not named in the first one."""
        from PIL import Image

        for axes in self.panels:
            labels = axes.get_legend_handles_labels()[1]
            if axes is self.panels[0] or set(labels) - set(self.panels[0].get_legend_handles_labels()[1]):
                beside: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)} if len(labels) > 3 else {}
                axes.legend(frameon=False, fontsize=9, **beside)
        raw, small = io.BytesIO(), io.BytesIO()
        self.figure.savefig(raw, dpi=_DOTS_PER_INCH, format="png")
        Image.open(raw).convert("RGB").quantize(_PALETTE).save(small, format="png", optimize=True)
        write_whole(folder / f"{self.name}.png", small.getvalue(), flush=False)


@dataclass
class Result:
    """What an experiment found."""

    rows: list[Row] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)

    def check(self, experiment: str, quantity: str, error: float, limit: float = np.inf) -> None:
        """Add a row for something that theory says is zero; without a limit it is for information."""
        self.rows.append(Row(experiment, quantity, 0.0, error, abs(error), limit))

    def compare(self, experiment: str, quantity: str, theory: float, simulated: float, limit: float) -> float:
        """Add a row for a relative error, and return the error."""
        error = abs(simulated - theory) / abs(theory)
        self.rows.append(Row(experiment, quantity, theory, simulated, error, limit))
        return error

    def at_least(self, experiment: str, quantity: str, least: float, simulated: float) -> None:
        """Add a row for something that may not fall short of `least`."""
        self.rows.append(Row(experiment, quantity, least, simulated, max(0.0, least - simulated), 0.0))

    def at_most(self, experiment: str, quantity: str, theory: float, simulated: float, excess: float) -> None:
        """Add a row for something that may not exceed a bound; `excess` is by how much it does, or less than 0."""
        self.rows.append(Row(experiment, quantity, theory, simulated, max(0.0, excess), 0.0))

    def order(
        self, experiment: str, quantity: str, errors: Sequence[float], steps: Sequence[float], least: float = 0.9
    ) -> None:
        """Add the row that asks that `errors` vanish with the time `steps` [s], at least with a power `least`."""
        order = float(np.log(errors[0] / errors[-1]) / np.log(steps[0] / steps[-1]))
        words = f"{quantity}: order in the time step, {ms(steps[0])} to {ms(steps[-1])}, shortfall of {least:g}"
        self.rows.append(Row(experiment, words, 1.0, order, max(0.0, least - order), 0.0))


Experiment = Callable[[bool], Result]
"""Runs an experiment; the argument asks for a fast, coarser version."""


def ms(seconds: float) -> str:
    """Return a time step in words."""
    return f"{1e3 * seconds:g} ms"


def make_config(num_drones: int, timestep: float = 0.004, **overrides: Any) -> Config:
    """Return the configuration of `hover` at a time step [s], controlled at every step; overrides as payload__mass."""
    values = {"env.num_drones": num_drones, "sim.timestep": timestep, "sim.control_hz": 1 / timestep}
    return load_config("hover", values | {key.replace("__", "."): value for key, value in overrides.items()})
