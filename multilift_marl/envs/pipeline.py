"""The order of a policy step on one page: the named stages of a shard, in the order in which they run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import groupby
from operator import attrgetter
from time import perf_counter
from typing import NamedTuple

import numpy as np

from multilift_marl.control.controller import Controller
from multilift_marl.control.obstacle_margin import Surroundings, sector_planes
from multilift_marl.control.swing import anchor_line
from multilift_marl.envs.history import History
from multilift_marl.kernels.jit import kernel_name
from multilift_marl.sensing.estimator import StateEstimator
from multilift_marl.sensing.measurement import Sensing
from multilift_marl.sim.world import Shard, World
from multilift_marl.tasks.base import Task


class Stage(NamedTuple):
    """A part of a policy step; it runs for one shard, several at the same time, and may write their rows only.

    Those that are NumPy functions run for all environments at once, when all shards have come that far.
    """

    name: str
    call: Callable[[], None]
    times: int = 1
    """How often it runs in a policy step."""
    is_whole: bool = False
    """Whether it runs once, for all environments."""


class StageContext(NamedTuple):
    """What the stages of E environments work on."""

    world: World
    controller: Controller
    task: Task
    estimator: StateEstimator | None
    sensing: Sensing
    commands: np.ndarray
    """(E, N, A) what the controller takes: the task's own array of actions, unless a planner makes it from them."""
    history: History
    """What was observed before."""


def build_stages(teams: StageContext, shard: Shard, ticks: int) -> tuple[list[Stage], list[Stage], list[Stage]]:
    """Return what runs for a shard before its control ticks, at each of `ticks`, and after them."""
    world, controller, task, estimator, sensing, commands, history = teams
    lo, hi = shard.lo, shard.hi
    on_shard = {name: partial(call, lo, hi) for name, call in task.stages.items()}
    arriving = sensing.applied if sensing.delays_action else commands

    # once, before: the action arrives
    own, every = task.numpy, (0, world.num_envs)
    before = [Stage("goals (NumPy)", partial(own.plan_goals, *every), is_whole=True)] if own.plans else []
    plan = on_shard.get("plan")
    seen, load = sensing.obstacles, sensing.load
    points = np.zeros((world.num_envs, world.num_drones, 0, 3)) if seen is None else seen.readings.placed
    planes, line = sector_planes(world.system.slot_azimuth), anchor_line(world.system.anchors)
    around = Surroundings(points, load.position, load.rotation, planes, line)
    set_action, control = controller.bind(lo, hi, arriving, task.planned, plan, around)
    if sensing.delays_action:
        before.append(Stage("delay action", partial(sensing.bind_send(commands), lo, hi)))
    before.append(Stage("set action", set_action))

    # at each control tick: plan, references, rejection of disturbances, rotor thrusts; then physics, sensors, filters
    named = {plan: "advance plan", set_action: "set action"}
    tick = [Stage(named.get(call) or kernel_name(call), call, ticks) for call in control]
    tick.append(Stage("physics", partial(world.advance, shard, world.system.control_interval), ticks))
    if estimator is not None:
        tick.append(Stage("read sensors", partial(estimator.read, lo, hi), ticks))
        tick.append(Stage("estimate own state", partial(estimator.estimate, lo, hi), ticks))

    # once, after: measure, reward, observe
    after = [Stage("errors and failures", on_shard["check"])]
    if own.judges:
        after.append(Stage("failures, reward (NumPy)", partial(own.judge, *every), is_whole=True))
    after.append(Stage("reward", on_shard["reward"]))
    after.append(Stage("observe state", on_shard["observe state"]))
    if sensing.measures:
        after.append(Stage("sense", partial(sensing.bind_sense(task.view), lo, hi)))
    if sensing.obstacles is not None:
        after.append(Stage("sense obstacles", partial(sensing.obstacles.sense, lo, hi)))
    after.append(Stage("observe", on_shard["observe"]))
    if own.observes:
        after.append(Stage("observe (NumPy)", partial(own.observe, *every), is_whole=True))
    if sensing.delays_observation:
        after.append(Stage("delay observation", partial(sensing.bind_delay(task.observation), lo, hi)))
    if (stack := history.bind(lo, hi)) is not None:
        after.append(Stage("stack", stack))
    return before, tick, after


class Pipeline:
    """The stages of one shard.

    Args:
        teams: of all environments.
        shard: the environments that are stepped.
        ticks: control ticks of a policy step.

    Attributes:
        stages: each of them once, in order.
        parts: calls of a policy step, in runs that are for all environments (True) or this shard alone (False): one of
            the latter where no stage is for all.
        before, tick, after: calls of those that run before the control ticks, at each of them, and after them.
    """

    def __init__(self, teams: StageContext, shard: Shard, ticks: int):
        before, tick, after = build_stages(teams, shard, ticks)
        self.before, self.tick, self.after = (tuple(stage.call for stage in part) for part in (before, tick, after))
        self.stages = [*before, *tick, *after]
        first, last = len(before), len(before) + len(tick)
        self._order = [*range(first), *[*range(first, last)] * ticks, *range(last, len(self.stages))]
        self._calls = tuple(self.stages[i].call for i in self._order)
        runs = groupby((self.stages[i] for i in self._order), key=attrgetter("is_whole"))
        self.parts = [(whole, tuple(stage.call for stage in stages)) for whole, stages in runs]

    def run(self, part: int) -> None:
        """Run one of the parts of a policy step."""
        for call in self.parts[part][1]:
            call()

    def run_timed(self, seconds: np.ndarray) -> None:
        """Make one policy step and add to `seconds` (S,) what each of the stages took."""
        for i, call in zip(self._order, self._calls, strict=True):
            begin = perf_counter()
            call()
            seconds[i] += perf_counter() - begin


def join_pipelines(pipelines: dict[int, Pipeline], world: World) -> list[Callable[[], None]]:
    """Return what makes a policy step, one call after the other: those of all shards at a time, or of all environments.

    Args:
        pipelines: of all shards, by their first environment.
        world: of the shards.
    """

    def run_shard(part: int, shard: Shard) -> None:
        pipelines[shard.lo].run(part)

    first = pipelines[0]
    return [
        partial(first.run, part) if is_whole else partial(world.run, partial(run_shard, part))
        for part, (is_whole, _) in enumerate(first.parts)
    ]


def describe_stages(stages: list[Stage], seconds: np.ndarray) -> str:
    """Return the stages of a policy step as a table, with the time (S,) [s] that each takes in a step."""
    lines = [f"{'stage':<24} {'times':>5} {'µs a step':>10} {'share':>6}"]
    for stage, spent in zip(stages, seconds, strict=True):
        lines.append(f"{stage.name:<24} {stage.times:>5} {1e6 * spent:>10.1f} {spent / seconds.sum():>6.0%}")
    return "\n".join(lines)
