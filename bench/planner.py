"""Processor time of a Gauss-Newton iteration of the planner, one team on one thread.

    python bench/planner.py [repeats=200] [drones=3,4,6,8] [any configuration key]

A team is 0.1 m from its target at rest. Stated are medians, and the least and the largest time [ms], of an iteration:
the trajectory linearised, the Riccati recursion, and its step; and of a whole plan with its flat states.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config, parse_overrides
from multilift_marl.planning.flatness import FlatWork, make_flat_team, set_flat_state
from multilift_marl.planning.riccati import IterationWork, Problem, find_gains, take_step
from multilift_marl.planning.team_model import state_size
from multilift_marl.planning.team_planner import TeamPlanner

DEFAULTS = {"repeats": 200, "drones": "3,4,6,8"}


def timed(call: Callable[[], object], repeats: int) -> np.ndarray:
    """Return the processor times of calls [ms], the first, which compiles, left out."""
    call()
    times = []
    for _ in range(repeats):
        began = time.thread_time()
        call()
        times.append(1e3 * (time.thread_time() - began))
    return np.array(times)


def measure(config: Config, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of iterations and of plans [ms]."""
    system, settings = config.system, config.planner
    n, steps = system.num_drones, settings.steps
    planner = TeamPlanner(system, settings, 1)
    rest, still = np.zeros(state_size(n)), np.zeros(7)
    pose = np.tile([0.0, 0.0, 1.0], (5, 1)), np.tile(np.eye(3), (5, 1, 1))
    set_flat_state(*pose, 0.0, still, make_flat_team(planner.model, system), FlatWork.of(n), rest)
    start = rest.copy()
    start[0] += 0.1
    states, inputs = np.tile(rest, (steps + 1, 1)), np.zeros((steps, 3 * n))
    problem = Problem(states.copy(), inputs.copy(), settings.step, planner.model, still, planner.objective)
    work = IterationWork.of(steps, n)

    def iterate() -> None:
        find_gains(states, inputs, problem, 0.0, work)
        take_step(start, states, inputs, problem, work)

    shape = (1, *planner.times.shape)
    motion = np.tile([0.0, 0.0, 1.0], (*shape, 1)), np.tile(np.eye(3), (*shape, 1, 1))
    offsets = np.zeros((*shape[:2], 12))
    return timed(iterate, repeats), timed(lambda: planner.plan(start[None], *motion, 0.02, offsets), repeats)


def main(arguments: list[str]) -> None:
    """Print the table."""
    values = parse_overrides(arguments, ["drones"])
    repeats, drones = (values.pop(key, default) for key, default in DEFAULTS.items())
    print("| drones | iteration [ms] | plan [ms] |\n|---|---|---|")
    for n in str(drones).split(","):
        cells = (
            f"{np.median(times):.2f} ({times.min():.2f} - {times.max():.2f})"
            for times in measure(load_config("hover", values | {"env.num_drones": int(n)}), int(repeats))
        )
        print(f"| {n} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
