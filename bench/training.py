"""Computing time of the parts of a training iteration.

    python bench/training.py [repeats=15] [any configuration key of hover]

Of each iteration of `python train.py config=hover` these are timed: physics, control, observation and reward, in the
threads that step the shards; the actor in the rollouts; starts of episodes; the update. All else is TorchRL's
collector, TensorDict and Python, the package's own too.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from multilift_marl.agents.mappo import update
from multilift_marl.agents.trainer import Trainer
from multilift_marl.config.load import load_config, parse_overrides

PARTS = {
    "core": "physics, control, observation, reward",
    "actor": "actor in the rollouts",
    "learning": "update",
    "starts": "starts of episodes",
    "other": "collector, TensorDict, Python",
}


def timed(function: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """Return `function`, whose time [s] adds up in `spent[name]`."""

    def call(*arguments: Any, **named: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            spent[name] = spent.get(name, 0.0) + time.perf_counter() - start

    return call


def main(arguments: list[str]) -> dict:
    """Measure, print a table, and return the numbers."""
    values = parse_overrides(arguments)
    repeats = int(values.pop("repeats", 15))
    trainer = Trainer(load_config("hover", {"train.target_kl": 1e3} | values), Path("runs"))  # nothing is written there
    spent: dict[str, float] = {}
    vec, network = trainer.env.vec, trainer.learner.policy
    vec.world.run = timed(vec.world.run, "core", spent)
    vec.reset = timed(vec.reset, "starts", spent)
    network.forward = timed(network.forward, "actor", spent)
    learn = timed(update, "learning", spent)
    iterations = []
    for i in range(repeats + 2):
        spent.clear()
        start = time.perf_counter()
        batches = trainer.rollouts.collect(i)
        torch.set_num_threads(trainer.config.train.threads)
        learn(trainer.learner, batches)
        spent["total"] = time.perf_counter() - start
        torch.set_num_threads(1)
        if i >= 2:
            iterations.append(dict(spent))
    for found in iterations:
        found["other"] = found["total"] - sum(found.get(name, 0.0) for name in PARTS if name != "other")
    result = {}
    print(f"{trainer.frames_per_batch} steps in an iteration; medians of {repeats}")
    print("| part | time [ms] | share (least - largest) |")
    print("|---|---|---|")
    for name, title in PARTS.items():
        shares = [100 * found.get(name, 0.0) / found["total"] for found in iterations]
        taken = statistics.median(found.get(name, 0.0) for found in iterations)
        share = statistics.median(shares)
        result[name] = {"seconds": taken, "percent": share}
        print(f"| {title} | {1e3 * taken:.0f} | {share:.1f} % ({min(shares):.1f} - {max(shares):.1f}) |")
    return result


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
