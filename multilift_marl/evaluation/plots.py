"""Plots of episodes and of a training, as PNG files and PDF. No pyplot: nothing global, no window, in any thread."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullFormatter

from multilift_marl.evaluation.metrics import name_error
from multilift_marl.evaluation.outline import find_outline
from multilift_marl.evaluation.rollout import Trace
from multilift_marl.planning.feasibility import Feasibility
from multilift_marl.planning.spline import sample_spline
from multilift_marl.sim.scene import DRONE_COLOURS
from multilift_marl.tasks.base import Task

# Told apart by the colour-blind too (Okabe & Ito, Color Universal Design, 2008).
POLICY_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
TARGET_COLOUR, PAYLOAD_COLOUR = "#009E73", "#222222"
_LINES = ("-", "--", ":", "-.")  # of drones beyond the number of colours
_DPI = 160


def plot_errors(path: str | Path, traces: Mapping[str, Trace], pdf: bool = False) -> None:
    """Plot the payload's distance from its target [m], logarithmic, and its attitude error [deg] over time [s].

    Args:
        path: of the PNG; its folder is made.
        traces: {name of the policy: its trace}, a colour each.
        pdf: whether there is a PDF beside it, too.
    """
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    position, attitude = figure.subplots(2, 1, sharex=True)
    for (name, trace), colour in zip(traces.items(), cycle(POLICY_COLOURS), strict=False):
        position.semilogy(trace.time, trace.distance, color=colour, label=name)
        attitude.plot(trace.time, trace.angle, color=colour)
    _label(position, None, "position error [m]")
    _label(attitude, "time [s]", "attitude error [deg]")
    attitude.set_ylim(bottom=0)
    _legend(figure, position)
    _save(figure, path, pdf)


def plot_tensions(path: str | Path, trace: Trace, title: str = "", pdf: bool = False) -> None:
    """Plot the tension of each cable [N] over time [s], in the colours that the drones have in videos."""
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    for n in range(trace.tension.shape[1]):
        axes.plot(trace.time, trace.tension[:, n], **_drone_style(n), label=f"cable {n}")
    _label(axes, "time [s]", "cable tension [N]", title)
    axes.set_ylim(bottom=0)
    _legend(figure, axes)
    _save(figure, path, pdf)


def plot_paths(path: str | Path, trace: Trace, title: str = "", pdf: bool = False) -> None:
    """Plot the paths of payload and drones [m] from above (x-y) and from the side (x-z), to one scale.

    The team is drawn where the episode ends: the payload by its outline, the cables from their anchors, dots; and so
    are the obstacles.
    """
    figure = Figure(figsize=(8.4, 4.4), layout="constrained")
    for axes, up, name in zip(figure.subplots(1, 2), (1, 2), "yz", strict=True):
        payload, target = trace.payload_position[:, [0, up]].T, trace.target_position[:, [0, up]].T
        for corners in trace.obstacles:  # beyond the paths they are cut off
            shade = PolyCollection(
                [find_outline(corners[:, [0, up]])], color="0.75", alpha=0.6, linewidths=0, zorder=0.5
            )
            axes.add_collection(shade, autolim=False)
        if len(trace.surface):
            outline = PolyCollection(list(trace.surface[..., [0, up]]), facecolors="0.8", edgecolors="0.8", zorder=1)
            axes.add_collection(outline)
        for cable in trace.cables:
            axes.plot(*cable[:, [0, up]].T, color="0.45", linewidth=0.8, zorder=1.5)
            axes.plot(*cable[0, [0, up]], ".", color="0.2", markersize=4)
        for n in range(trace.drone_position.shape[1]):
            drone, style = trace.drone_position[:, n, [0, up]].T, _drone_style(n)
            axes.plot(*drone, **style, linewidth=1.0, alpha=0.8)
            axes.plot(*drone[:, -1], "o", color=style["color"], markersize=6, label=f"drone {n}")
        if np.ptp(target, axis=1).max() > 0:
            axes.plot(*target, color=TARGET_COLOUR, linestyle="--", linewidth=1.2, label="target's path")
        axes.plot(*payload, color=PAYLOAD_COLOUR, linewidth=1.6, label="payload")
        if not len(trace.surface):
            axes.plot(*payload[:, -1], "s", color=PAYLOAD_COLOUR, markersize=6)
        axes.plot(*payload[:, 0], "o", color=PAYLOAD_COLOUR, markerfacecolor="white", markersize=7, label="start")
        axes.plot(*target[:, -1], "*", color=TARGET_COLOUR, markerfacecolor="none", markersize=17, label="target")
        _label(axes, "x [m]", f"{name} [m]", {1: "from above", 2: "from the side"}[up])
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.1)
    figure.suptitle(title, fontsize=11)
    _legend(figure, axes)
    _save(figure, path, pdf)


def plot_plan(path: str | Path, table: np.ndarray, feasibility: Feasibility) -> None:
    """Plot place [m] and speed [m/s] of a planned path, cable tensions [N] and thrusts [N] over time [s].

    Args:
        path: of the PNG; its folder is made.
        table: (K, 13) spline of the path, see `spline.fit_spline`.
        feasibility: of the path. The least of the limits of thrust is drawn, too.
    """
    times = feasibility.times
    place, rate = sample_spline(table, times)[:2]
    thrust = next(quantity for quantity in feasibility.quantities if quantity.name == "thrust")
    figure = Figure(figsize=(6.4, 8.0), layout="constrained")
    position, speed, tension, rotors = figure.subplots(4, 1, sharex=True)
    for k, name in enumerate("xyz"):
        position.plot(times, place[:, k], color=POLICY_COLOURS[k], label=name)
    position.legend(frameon=False, ncols=3, fontsize=9)
    speed.plot(times, np.linalg.norm(rate[:, :3], axis=1), color=PAYLOAD_COLOUR)
    for n in range(thrust.values.shape[1]):
        tension.plot(times, feasibility.tension[:, n], **_drone_style(n))
        rotors.plot(times, thrust.values[:, n], **_drone_style(n), label=f"drone {n}")
    rotors.plot(times, thrust.limits.min(axis=1), color="0.4", linewidth=0.9, linestyle="--", label="limit")
    labels = (position, "position [m]"), (speed, "speed [m/s]"), (tension, "cable tension [N]"), (rotors, "thrust [N]")
    for axes, label in labels:
        _label(axes, "time [s]" if axes is rotors else None, label)
    for axes in (speed, tension, rotors):
        axes.set_ylim(bottom=0)
    _legend(figure, rotors)
    _save(figure, path)


def plot_training(
    path: str | Path, rows: Iterable[Mapping[str, Any]], pdf: bool = False, metric: str = Task.ERROR
) -> None:
    """Plot success rate [%], the error that policies are compared by [cm] and return over the steps of a training.

    Args:
        path: of the PNG; its folder is made.
        rows: lines of metrics.csv, numbers or their text; an empty or missing value is left out. Thin lines are
            episodes with exploration, dots the evaluations of the deterministic policy. Their returns have a panel
            each, as training may pay by other weights.
        pdf: whether there is a PDF beside it, too.
        metric: the error that policies are compared by, see `Task.ERROR`; that of most tasks if no row has it.
    """
    rows = list(rows)
    figure = Figure(figsize=(6.4, 8.0), layout="constrained")
    success, error, total, paid = figure.subplots(4, 1, sharex=True)
    metric = metric if len(_column(rows, f"eval/{metric}")[0]) else Task.ERROR
    panels = (
        (success, "success", "eval/success_rate", 100, "success [%]"),
        (error, None, f"eval/{metric}", 100, f"{name_error(metric)} [cm]"),
        (total, None, "eval/return", 1, "return"),
        (paid, "return", None, 1, "return in training"),
    )
    for axes, explored, evaluated, factor, label in panels:
        if explored is not None:
            frames, values = _column(rows, explored)
            axes.plot(frames, factor * values, color=POLICY_COLOURS[0], linewidth=0.9, alpha=0.6, label="exploring")
        if evaluated is not None:
            frames, values = _column(rows, evaluated)
            axes.plot(frames, factor * values, "o-", color=POLICY_COLOURS[1], markersize=4, label="evaluation")
        _label(axes, None, label)
    success.set_ylim(-3, 103)
    if len(_column(rows, f"eval/{metric}")[0]):
        error.set_yscale("log")
        error.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        error.yaxis.set_major_formatter("{x:g}")
        error.yaxis.set_minor_formatter(NullFormatter())
    paid.set_xlabel("environment steps")
    paid.xaxis.set_major_formatter(EngFormatter(sep=""))
    _legend(figure, success)
    _save(figure, path, pdf)


def plot_card(path: str | Path, card: Mapping[str, Any]) -> None:
    """Plot success [%] and error [cm, logarithmic] of a card of the benchmark with 95 % intervals, a row for each task.

    Args:
        path: of the PNG; its folder is made.
        card: see docs/benchmark.md. Tasks that the policy cannot fly have no bars.
    """
    tasks = card["tasks"]
    figure = Figure(figsize=(8.4, 1.6 + 0.55 * max(len(tasks), 1)), layout="constrained")
    panels = success, error = figure.subplots(1, 2, sharey=True)
    for place, (label, colour) in enumerate(zip(("policy", "baseline", "shipped"), POLICY_COLOURS, strict=False)):
        rows = [(y, row) for y, row in enumerate(tasks.values()) if label in row.get("policies", {})]
        for axes in panels:
            found = [
                row["policies"][label]["metrics"]["success_rate" if axes is success else row["error"]]
                for _, row in rows
            ]
            mean = 100 * np.array([each["mean"] for each in found])
            bounds = [each["ci95"] or (each["mean"], each["mean"]) for each in found]
            low, high = 100 * np.array(bounds).reshape(-1, 2).T
            heights = np.array([y for y, _ in rows]) + 0.26 * (place - 1)
            title = {"policy": card["policy"]["name"], "baseline": "best baseline", "shipped": "shipped policy"}[label]
            axes.barh(
                heights, mean, 0.24, xerr=np.stack([mean - low, high - mean]), color=colour, ecolor="0.3", label=title
            )
    for y, row in enumerate(tasks.values()):
        if "not_applicable" in row:
            success.text(1, y, "not applicable", va="center", color="0.4", fontsize=9)
    success.set(xlim=(0, 103), yticks=range(len(tasks)), yticklabels=list(tasks))
    success.set_ylim(len(tasks) - 0.5, -0.5)
    if any("policies" in row for row in tasks.values()):
        error.set_xscale("log")
        error.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        error.xaxis.set_major_formatter("{x:g}")
        error.xaxis.set_minor_formatter(NullFormatter())
    for axes, name in ((success, "success [%]"), (error, "error [cm]")):
        axes.set_xlabel(name)
        axes.grid(True, axis="x", color="0.9", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{card['benchmark']}, {card['suite']}", fontsize=11)
    _legend(figure, success)
    _save(figure, path)


def _drone_style(n: int) -> dict[str, Any]:
    """Return the colour that drone n has in the scene, and a line of its own where colours repeat."""
    return {
        "color": DRONE_COLOURS[n % len(DRONE_COLOURS)][:3],
        "linestyle": _LINES[n // len(DRONE_COLOURS) % len(_LINES)],
    }


def _column(rows: list[Mapping[str, Any]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return frames and values of the rows that hold a value of `name`."""
    pairs = [(float(row["frames"]), float(row[name])) for row in rows if row.get(name) not in (None, "")]
    frames, values = np.array(pairs).reshape(-1, 2).T
    return frames, values


def _label(axes: Axes, x: str | None, y: str, title: str = "") -> None:
    axes.set_ylabel(y)
    if x is not None:
        axes.set_xlabel(x)
    axes.set_title(title, fontsize=11)
    axes.grid(True, color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.02)
    if axes.get_yscale() == "linear":
        axes.yaxis.set_major_locator(MaxNLocator(6))


def _legend(figure: Figure, axes: Axes) -> None:
    """Put the legend of `axes` below all panels, at most seven entries a line."""
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        columns = -(-len(labels) // -(-len(labels) // 7))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def _save(figure: Figure, path: str | Path, pdf: bool = False) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI, format="png")
    if pdf:
        figure.savefig(Path(path).with_suffix(".pdf"), format="pdf", metadata={"CreationDate": None})
