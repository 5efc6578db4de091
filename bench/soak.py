"""Whether memory and threads stay flat over many steps, and nothing that a learner is given is NaN.

    python bench/soak.py mode=random|policy|training [minutes=3 | steps=<N>] [iterations=200] [num_envs=64] \
        [num_threads=0] [task=<name>]

`random` flies every task in turn by random actions, which soon fail, so that episodes start often; `policy` by the
policy that comes with the package; `training` trains `hover` in small batches. It fails, with exit status 1, by NaN,
and by threads that were added or memory that grew beyond `BOUND` within a task (of training: within the run), each
after the first quarter of it. `task` is the only one to fly, in place of all. `steps`, of all tasks together, are made
in place of `minutes`, an equal share by each.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

import multilift_marl as ml
from multilift_marl.config.load import parse_overrides

BOUND = 8.0  # [MB]
WARM = 0.25  # share of a run in which what is made once is made
SAMPLES = 20
MEGABYTE = 1e6


class Watch:
    """Samples of this process: environment steps, resident memory [MB], threads."""

    def __init__(self) -> None:
        self._process = psutil.Process()
        self.samples: list[tuple[int, float, int]] = []

    def sample(self, steps: int) -> None:
        """Keep what there is now."""
        gc.collect()
        self.samples.append((steps, self._process.memory_info().rss / MEGABYTE, self._process.num_threads()))

    def warm(self) -> list[tuple[int, float, int]]:
        """Return the samples after the warm-up."""
        return self.samples[int(WARM * len(self.samples)) :]

    def growth(self) -> float:
        """Return the growth of memory after the warm-up [MB]."""
        warm = self.warm()
        return warm[-1][1] - warm[0][1]

    def new_threads(self) -> int:
        """Return how many threads were added after the warm-up."""
        warm = self.warm()
        return warm[-1][2] - warm[0][2]


def check_finite(name: str, *arrays: Any) -> None:
    """Exit with a message if a number is NaN or infinite."""
    for array in arrays:
        if not np.isfinite(np.asarray(array)).all():
            sys.exit(f"{name}: NaN or infinite numbers would be given to a learner")


def fly(
    task: str, mode: str, seconds: float, num_envs: int, most: float | None = None, num_threads: int = 0
) -> tuple[Watch, int]:
    """Step a task for some time, or `most` environment steps; return the samples and how many episodes ended."""
    vec = ml.make_vec(task, num_envs=num_envs, num_threads=num_threads)
    policy = ml.load_policy(task) if mode == "policy" else None
    rng = np.random.Generator(np.random.PCG64(0))
    observation, _ = vec.reset(seed=0)
    vec.step(np.zeros((num_envs, vec.num_drones, vec.action_size)))  # kernels are compiled before the clock starts
    observation, _ = vec.reset(seed=0)
    vec.stagger()
    watch, steps, episodes, start = Watch(), 0, 0, time.monotonic()

    def done() -> float:
        return (time.monotonic() - start) / seconds if most is None else steps / most

    for i in range(SAMPLES + 1):
        before = steps
        while steps == before or done() < i / SAMPLES:  # one at least, however short it is
            shape = (num_envs, vec.num_drones, len(vec.action_names))
            action = rng.uniform(-1.0, 1.0, shape) if policy is None else policy.act(observation)
            observation, reward, terminated, truncated, _ = vec.step(action)
            check_finite(task, observation, reward, vec.state())
            over = terminated | truncated
            if over.any():
                observation, _ = vec.reset(mask=over)
                check_finite(task, observation)
                episodes += int(over.sum())
                if policy is not None:
                    policy.reset(over)
            steps += num_envs
        watch.sample(steps)
    return watch, episodes


def train(iterations: int, num_envs: int) -> tuple[Watch, int]:
    """Train hover in small batches; return the samples and how many iterations there were."""
    from multilift_marl.agents.trainer import Trainer

    horizon = 32
    values = {"env.num_envs": num_envs, "train.horizon": horizon, "train.frames": iterations * num_envs * horizon}
    trainer = Trainer(ml.load_config("hover", values | {"train.minibatches": 2}), Path("runs"))  # which stays unwritten
    trainer.rollouts.collect = checked(trainer.rollouts.collect)
    watch = Watch()
    every = max(1, iterations // SAMPLES)
    while not trainer.finished:
        check_finite("numbers of the training", *trainer.step().values())
        if trainer.iteration % every == 0:
            watch.sample(trainer.frames)
    return watch, trainer.iteration


def checked(collect: Callable[[int], Any]) -> Callable[[int], Any]:
    """Return `collect` of rollouts, all of whose numbers must be finite."""

    def collect_checked(iteration: int) -> Any:
        batches = collect(iteration)
        for key, value in (item for batch in batches for item in batch.items(include_nested=True, leaves_only=True)):
            if value.is_floating_point():
                check_finite(f"batch, {key}", value.numpy())
        return batches

    return collect_checked


def main(arguments: list[str]) -> int:
    """Run one mode, print a table; return the exit status."""
    defaults = {"mode": "random", "minutes": 3.0, "iterations": 200, "num_envs": 64, "num_threads": 0}
    options = defaults | parse_overrides(arguments)
    mode, count, threads = str(options["mode"]), int(options["num_envs"]), int(options["num_threads"])
    if mode not in ("random", "policy", "training"):
        sys.exit(__doc__)
    print("| | env steps | episodes | memory [MB] | growth [MB] | growth [B/step] | threads |")
    print("|---|---|---|---|---|---|---|")
    failed = False
    tasks = ["hover"] if mode == "training" else [str(options["task"])] if "task" in options else ml.list_tasks()
    for name in tasks:
        if mode == "training":
            watch, episodes = train(int(options["iterations"]), count)
        else:
            most = float(options["steps"]) / len(tasks) if "steps" in options else None
            watch, episodes = fly(name, mode, 60.0 * float(options["minutes"]) / len(tasks), count, most, threads)
        warm = watch.warm()
        rate = MEGABYTE * watch.growth() / max(warm[-1][0] - warm[0][0], 1)
        failed |= watch.growth() > BOUND or watch.new_threads() > 0
        shown = "-" if mode == "training" else str(episodes)
        print(
            f"| {name} | {warm[-1][0]} | {shown} | {warm[-1][1]:.1f} | {watch.growth():+.2f} | {rate:+.3f} "
            f"| {warm[0][2]} to {warm[-1][2]} |",
            flush=True,
        )
    print(f"memory grew beyond {BOUND} MB within a task, or threads were added" if failed else "flat")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
