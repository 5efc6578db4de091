"""How training scales with workers of Ray, and what they send: measured up to the CPUs there are, beyond by a model.

    python bench/workers.py [repeats=9] [workers=0,1,2] [any configuration key of hover]

Iterations of all numbers of workers take turns, so that a machine that slows down slows all. With workers=0 one process
simulates in as many threads as there are CPUs. Of the model, T = S / K + L + b / B:

    S   seconds in which one worker simulates the whole batch, alone
    K   workers, each with a core of its own beside the learner's
    L   seconds of learning
    b/B bytes that reach the learner, by the rate at which it takes them from Ray's object store and joins them
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from multilift_marl._platform import cpu_count
from multilift_marl._ray import connect, disconnect
from multilift_marl.agents.mappo import update
from multilift_marl.agents.trainer import Trainer
from multilift_marl.config.load import load_config, parse_overrides

BEYOND = (2, 4, 8, 16, 32)  # workers of the model


def main(arguments: list[str]) -> dict[str, Any]:
    """Measure, print tables, and return the numbers."""
    values = parse_overrides([each for each in arguments if not each.startswith("workers=")])
    repeats = int(values.pop("repeats", 9))
    asked = next((each.partition("=")[2] for each in arguments if each.startswith("workers=")), "0,1,2")
    counts = [int(each) for each in asked.split(",")]
    connect("local", sum(counts) + 2, "ray")
    trainers = {k: make_trainer(values, k) for k in counts}
    alone = make_trainer(values | {"env.num_threads": 1}, 1)  # S of the model
    sampling: dict[int, list[float]] = {k: [] for k in (*counts, -1)}
    learning: list[float] = []
    for i in range(repeats + 2):
        for k, trainer in (*trainers.items(), (-1, alone)):
            start = time.perf_counter()
            batches = trainer.rollouts.collect(i)
            sampling[k].append(time.perf_counter() - start)
            if k == counts[0]:
                start = time.perf_counter()
                update(trainer.learner, batches)
                learning.append(time.perf_counter() - start)
    medians = {k: statistics.median(seconds[2:]) for k, seconds in sampling.items()}  # the first two warm up
    learn = statistics.median(learning[2:])
    received = alone.rollouts.received
    rate = transport_rate(received, repeats)
    sent = sum(tensor.numel() * tensor.element_size() for tensor in alone.learner.actor.state_dict().values())
    frames = alone.frames_per_batch
    print(f"hover, {frames} steps an iteration, {cpu_count()} CPUs, medians of {repeats}\n")
    print("| workers | collecting [s] | learning [s] | steps/s |\n|---|---|---|---|")
    for k in counts:
        print(f"| {k} | {medians[k]:.3f} | {learn:.3f} | {frames / (medians[k] + learn):,.0f} |")
    print(f"\nto each worker {sent / 1e6:.2f} MB, from all {received / 1e6:.1f} MB, taken at {rate / 1e6:.0f} MB/s\n")
    transport = received / rate
    work = medians[-1] - transport
    print("| workers, each with a core (model) | steps/s | of one worker's |\n|---|---|---|")
    modelled = {k: frames / (work / k + learn + transport) for k in BEYOND}
    one = frames / (work + learn + transport)
    for k, steps in modelled.items():
        print(f"| {k} | {steps:,.0f} | {steps / one:.1f} |")
    for trainer in (*trainers.values(), alone):
        trainer.rollouts.close()
    disconnect()
    return {
        "collecting": medians, "learning": learn, "sent": sent, "received": received, "rate": rate, "model": modelled
    }  # fmt: skip


def make_trainer(values: dict[str, Any], workers: int) -> Trainer:
    """Return a training of hover; nothing is written."""
    overrides = {"train.target_kl": 1e3, "train.ray": "local"} | values | {"train.workers": workers}
    return Trainer(load_config("hover", overrides), Path("runs"))


def transport_rate(size: int, repeats: int) -> float:
    """Return bytes a second at which another process's arrays, `size` bytes in all, are taken and joined here."""
    import ray

    seconds = []
    for _ in range(repeats):
        result = ray.remote(_make_bytes).remote(size)
        ray.wait([result], fetch_local=False)
        start = time.perf_counter()
        np.concatenate([ray.get(result)])
        seconds.append(time.perf_counter() - start)
    return size / statistics.median(seconds)


def _make_bytes(size: int) -> np.ndarray:
    return np.ones(size // 4, np.float32)


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
