"""Processor time of the planner, one team on one thread, and how plans within hard limits converge.

    python bench/planner.py [repeats=200] [drones=3,4,6,8] [starts=100] [any configuration key]

First, a team is 0.1 m from its target at rest. Stated are medians, and the least and the largest time [ms], of a
Gauss-Newton iteration: the trajectory linearised, the Riccati recursion, and its step; of a whole plan with its flat
states; and of one drone's share in plans of drones that plan for themselves, with `planner.sweeps`; and of the plans of
20 policy steps whose derivatives are wanted, and of these (`diffmpc/`). Then plans within
hard limits, from the random states of `TeamExpert.random_states`: how many converge within 40 iterations; iterations
and times, median and ninth decile; the same a policy step later, from states that are disturbed by 5 mm, 2 cm/s, 0.01
and 0.05 1/s at most; and times of a quadratic program of the same size by PIQP, if it is installed
(`pip install piqp`).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from planner_qp import time_piqp

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config, parse_overrides
from multilift_marl.diffmpc.weighted_planner import FlightGradient, WeightedPlanner
from multilift_marl.planning.distributed_planner import DistributedPlanner
from multilift_marl.planning.expert import TeamExpert
from multilift_marl.planning.flatness import FlatMotion, FlatWork, make_flat_team, set_flat_state, steady_shape
from multilift_marl.planning.goals import pose_goal
from multilift_marl.planning.riccati import IterationWork, Problem, find_gains, take_step
from multilift_marl.planning.team_model import ModelWork, state_size, step_state
from multilift_marl.planning.team_planner import TeamPlanner
from multilift_marl.sensing.communication import Links

DEFAULTS = {"repeats": 200, "drones": "3,4,6,8", "starts": 100}
LATER = 0.02  # [s], a policy step
DISTURBED = 0.005, 0.02, 0.01, 0.05  # [m], [m/s], of c [-], of ċ [1/s]


def timed(call: Callable[[], object], repeats: int) -> np.ndarray:
    """Return the processor times of calls [ms], the first, which compiles, left out."""
    call()
    times = []
    for _ in range(repeats):
        began = time.thread_time()
        call()
        times.append(1e3 * (time.thread_time() - began))
    return np.array(times)


def measure(config: Config, repeats: int) -> tuple[np.ndarray, ...]:
    """Return the times of iterations, of plans, and of one drone's share in distributed ones [ms]."""
    system, settings = config.system, config.planner
    n, steps = system.num_drones, settings.steps
    planner = TeamPlanner(system, settings, 1)
    rest, still = np.zeros(state_size(n)), np.zeros(7)
    pose = np.tile([0.0, 0.0, 1.0], (5, 1)), np.tile(np.eye(3), (5, 1, 1))
    team = make_flat_team(planner.model, system)
    set_flat_state(FlatMotion(*pose, steady_shape(team)), 0.0, still, team, FlatWork.of(n), rest)
    start = rest.copy()
    start[0] += 0.1
    states, inputs = np.tile(rest, (steps + 1, 1)), np.zeros((steps, 3 * n))
    targets = states.copy(), inputs.copy()
    problem = Problem(*targets, settings.step, planner.model, still[None], planner.objective, planner.around)
    work = IterationWork.of(steps, n)

    def iterate() -> None:
        find_gains(states, inputs, problem, 0.0, work)
        take_step(start, states, inputs, problem, work)

    shape = (1, *planner.times.shape)
    motion = np.tile([0.0, 0.0, 1.0], (*shape, 1)), np.tile(np.eye(3), (*shape, 1, 1))
    offsets = np.zeros((*shape[:2], 12))
    links = Links(~np.eye(n, dtype=bool), 0, 0.0, np.inf)
    apart = DistributedPlanner(system, settings, 1, None, links)
    known = start[None], *motion, LATER, offsets
    knows = *(np.repeat(each, n, axis=0) for each in known[:3]), LATER, np.repeat(offsets, n, axis=0)
    return (
        timed(iterate, repeats),
        timed(lambda: planner.plan(*known), repeats),
        timed(lambda: apart.plan(*knows), repeats) / n,
    )


def differentiate(config: Config, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of 20 plans that leave what derivatives need, and of all their derivatives [ms]."""
    n, steps, horizon = config.system.num_drones, 20, config.planner.steps
    planner = WeightedPlanner(config.system, config.planner, 1)
    rest = TeamExpert(config).rest_states(np.array([0.0, 0.0, 1.0]))
    start = rest.copy()
    start[:, 0] += 0.1
    shape = (1, *planner.times.shape)
    motion = np.tile([0.0, 0.0, 1.0], (*shape, 1)), np.tile(np.eye(3), (*shape, 1, 1))
    offsets = np.zeros((1, horizon + 1, 12))
    flight = FlightGradient(planner, steps, LATER)
    for kept, mine in zip(flight.weights, planner.weights, strict=True):
        kept[:] = mine

    def fly() -> None:
        for t in range(steps):
            planner.slot = t
            planner.plan(start, *motion, LATER, offsets)

    fly()
    flight.tape.states[:, steps] = start
    slopes = np.ones((1, steps + 1, state_size(n)))
    return timed(fly, repeats // 10), timed(lambda: flight.find(slopes), repeats // 10)


def converge(config: Config, count: int) -> list[str]:
    """Return the cells of a row about plans within hard limits."""
    expert, home = TeamExpert(config), np.array([0.0, 0.0, 1.0])
    goal = pose_goal(expert.times, home)
    starts = expert.random_states(count)
    off = expert.random_states(count, seed=1, ranges=DISTURBED) - expert.rest_states(home)
    expert.solve(starts[:1], goal)
    cold, warm, cold_ms, warm_ms = [], [], [], []
    m = ModelWork.of(len(expert.model.anchors))
    for start, disturbance in zip(starts, off, strict=True):
        began = time.thread_time()
        plan = expert.solve(start, goal)
        cold_ms.append(1e3 * (time.thread_time() - began))
        later = np.zeros_like(start)
        step_state(start, plan.inputs[0, 0], LATER, expert.model, np.zeros(7), m, later)
        began = time.thread_time()
        again = expert.solve(later + disturbance, goal, last=plan, elapsed=LATER)
        warm_ms.append(1e3 * (time.thread_time() - began))
        cold.append(plan)
        warm.append(again)
    within = [sum(int(plan.converged[0]) for plan in plans) for plans in (cold, warm)]
    iterations = [np.array([plan.iterations[0] for plan in plans]) for plans in (cold, warm)]
    cells = []
    for number, each, ms in zip(within, iterations, (cold_ms, warm_ms), strict=True):
        cells += [f"{number} of {count}", deciles(each, 0), deciles(np.array(ms), 1)]
    try:
        cells.append(deciles(time_piqp(expert, starts[: min(count, 20)])[1:], 1))
    except ModuleNotFoundError:
        cells.append("-")
    return cells


def deciles(values: np.ndarray, digits: int) -> str:
    """Return median and ninth decile."""
    return f"{np.median(values):.{digits}f} / {np.percentile(values, 90):.{digits}f}"


def main(arguments: list[str]) -> None:
    """Print the tables."""
    values = parse_overrides(arguments, ["drones"])
    repeats, drones, starts = (values.pop(key, default) for key, default in DEFAULTS.items())
    configs = {n: load_config("hover", values | {"env.num_drones": int(n)}) for n in str(drones).split(",")}
    titles = "drones", "iteration [ms]", "plan [ms]", "share of one drone [ms]", "20 plans [ms]", "derivatives [ms]"
    print(f"| {' | '.join(titles)} |", f"|{'---|' * len(titles)}", sep="\n")
    for n, config in configs.items():
        cells = (
            f"{np.median(times):.2f} ({times.min():.2f} - {times.max():.2f})"
            for times in (*measure(config, int(repeats)), *differentiate(config, int(repeats)))
        )
        print(f"| {n} | {' | '.join(cells)} |", flush=True)
    if not int(starts):
        return
    titles = "drones", *(f"{kind}{of}" for kind in ("", "warm ") for of in ("converged", "iterations", "ms")), "PIQP ms"
    print("", f"| {' | '.join(titles)} |", f"|{'---|' * len(titles)}", sep="\n")
    for n, config in configs.items():
        print(f"| {n} | {' | '.join(converge(config, int(starts)))} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
