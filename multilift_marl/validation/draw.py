"""Plots as pictures."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multilift_marl.errors import pip_install
from multilift_marl.validation.experiment import Plot

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B", "#7F7F7F")  # Okabe & Ito 2008
_DOTS = 90  # per inch
_FEW = 8  # points of a curve that are marked one by one
_PALETTE = 255  # colours of a picture: enough for thin lines, and half the size


def draw(plots: list[Plot], out: Path) -> list[Path]:
    """Write every plot as a PNG into a folder and return the files; say so on stderr if matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
        from PIL import Image
    except ModuleNotFoundError:
        print(f"no plots: matplotlib is missing; {pip_install('train')}", file=sys.stderr)
        return []
    files = []
    for plot in plots:
        panels = [plot] if plot.below is None else [plot, plot.below]
        figure = Figure(figsize=(6.8, (4.8 if plot.equal else 3.6) if len(panels) == 1 else 5.6), layout="constrained")
        axes = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
        for panel, axis in zip(panels, axes, strict=True):
            _draw_panel(axis, panel)
        if plot.below is not None and {c.label for c in plot.below.curves} <= {c.label for c in plot.curves}:
            axes[1].get_legend().remove()  # the one above tells it all
        axes[0].set_title(plot.title, fontsize=11)
        axes[-1].set_xlabel(plot.x_label)
        if plot.phases:
            _name_phases(axes[0], plot)
        files.append(out / f"{plot.name}.png")
        raw = io.BytesIO()
        figure.savefig(raw, dpi=_DOTS, format="png")
        Image.open(raw).convert("RGB").quantize(_PALETTE).save(files[-1], optimize=True)
    return files


def _draw_panel(axes: Axes, plot: Plot) -> None:
    from matplotlib.ticker import NullFormatter

    simulated = [curve for curve in plot.curves if not curve.theory]
    for i, (_, start, end) in enumerate(plot.phases):
        if i % 2:
            axes.axvspan(start, end, color="0.94", linewidth=0)
    for i, curve in enumerate(simulated):
        colour = COLOURS[i % len(COLOURS)]
        marker = "o" if plot.log and len(curve.x) <= _FEW else None
        axes.plot(curve.x, curve.y, color=colour, label=curve.label or None, linewidth=1.4, marker=marker, markersize=4)
    for curve in plot.curves:
        if curve.theory:
            label = curve.label or None
            axes.plot(curve.x, curve.y, color="black", label=label, linewidth=1.1, linestyle=(0, (4, 3)))
    axes.set_ylabel(plot.y_label)
    if plot.log or plot.semilog:
        axes.set_yscale("log")
    if plot.log:
        axes.set_xscale("log")
    places = sorted({float(x) for curve in plot.curves for x in curve.x})
    if plot.log and len(places) <= _FEW:
        axes.set_xticks(places)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    if plot.equal:
        axes.set_aspect("equal")
    axes.grid(color="0.88", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    named = [curve for curve in plot.curves if curve.label.strip("_")]
    crowded = len(named) > (3 if plot.phases else 4) or plot.equal
    beside: dict[str, Any] = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)} if crowded else {}
    axes.legend(frameon=False, fontsize=9, **beside)


def _name_phases(axes: Axes, plot: Plot) -> None:
    """Write the phases' names above the panel, upright where they have no room."""
    span = plot.phases[-1][2] - plot.phases[0][1]
    axes.set_title(plot.title, fontsize=11, pad=62 if any(_narrow(p, span) for p in plot.phases) else 18)
    for phase in plot.phases:
        name, start, end = phase
        upright = 90 if _narrow(phase, span) else 0
        looks: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 8, "color": "0.3"}
        place, above = 0.5 * (start + end), axes.get_xaxis_transform()
        axes.text(place, 1.02, name, transform=above, rotation=upright, **looks)


def _narrow(phase: tuple[str, float, float], span: float) -> bool:
    return (phase[2] - phase[1]) / span < 0.014 * len(phase[0]) + 0.01
