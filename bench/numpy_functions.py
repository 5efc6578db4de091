"""What a task's own functions cost, as kernels and as NumPy functions of whole arrays.

    python bench/numpy_functions.py [repeats=5] [seconds=1.0] [clock=wall|processor] [any configuration key]

The task is hover without anything of its own, then with a failure, a reward term and an observation of a pole, of
either kind. Reported are simulated seconds of all teams per second, medians of runs that alternate.
"""

from __future__ import annotations

import statistics
import sys
from math import hypot

import numpy as np

import multilift_marl as ml
from bench import CLOCKS, core, measure, settings
from multilift_marl.config.load import load_config
from multilift_marl.kernels import inlined
from multilift_marl.math3d import sub
from multilift_marl.math3d import vec as vector
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import Term
from multilift_marl.tasks.hover import Hover

X, Y, RADIUS = 9.0, 0.0, 0.3  # [m] of a pole that no team comes near, so that all episodes are the same


def gap(v):
    """Return how far payloads are from the pole (E,) [m]."""
    return np.hypot(v.state.payload_position[:, 0] - X, v.state.payload_position[:, 1] - Y)


def touch(v):
    """Fail near the pole."""
    return gap(v) < RADIUS


def clear(v, margin):
    """Payload away from the pole."""
    return np.minimum(gap(v) / margin, 1.0)


def to_pole(v):
    """From each drone to the pole."""
    return np.array([X, Y, 1.0]) - v.estimated.drone_position


@inlined
def gap_kernel(e, v):
    """Return how far a payload is from the pole [m]."""
    return hypot(v.state.payload_position[e, 0] - X, v.state.payload_position[e, 1] - Y)


@inlined
def touch_kernel(e, v):
    """Fail near the pole."""
    return gap_kernel(e, v) < RADIUS


@inlined
def clear_kernel(e, v, margin):
    """Payload away from the pole."""
    return min(gap_kernel(e, v) / margin, 1.0)


@inlined
def to_pole_kernel(e, n, v):
    """From each drone to the pole."""
    return sub((X, Y, 1.0), vector(v.estimated.drone_position, e, n))


def declare(task: str, touch, clear, to_pole) -> None:
    """Register hover with a pole."""
    declared = {
        "name": task,
        "FAILURES": {"pole": touch},
        "REWARD": Hover.REWARD | {"clear": Term(0.2, clear, 0.5, "m")},
        "EXTRA": (Component("pole", 3, "slot", "m", "from the drone to the pole", to_pole),),
    }
    ml.register_task(type("Pole", (Hover,), declared), {"base": "hover", "task": task})


def main(arguments: list[str]) -> None:
    """Measure and print a table."""
    values, repeats, seconds = settings({}, arguments)
    clock = CLOCKS[values.pop("clock", "wall")]
    declare("pole_numpy", touch, clear, to_pole)
    declare("pole_kernels", touch_kernel, clear_kernel, to_pole_kernel)
    teams = {}
    for task in ("hover", "pole_kernels", "pole_numpy"):
        teams[task] = ml.make_vec(load_config(task, values))
    rates = measure({task: core(vec) for task, vec in teams.items()}, repeats, seconds, clock)
    print("| task | simulated s/s | to hover |\n|---|---|---|")
    for task, vec in teams.items():
        ratios = [own / plain for own, plain in zip(rates[task], rates["hover"], strict=True)]
        print(f"| {task} | {statistics.median(rates[task]) * vec.task.dt:.0f} | {statistics.median(ratios):.2f} |")


if __name__ == "__main__":
    main(sys.argv[1:])
