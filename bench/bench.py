"""Speed against the limit: every door of the environment as a ratio to bare MuJoCo stepping of the same model.

    python bench/bench.py [repeats=5] [seconds=1.0] [any configuration key]

Bare stepping is `Batch.step(nstep=control interval)` of the compiled model, contacts and all, on the same threads,
with the drones' hover thrust applied. All are measured in turn, in one run, and the medians reported: these ratios
compare on a noisy machine, times do not. Doors fly random actions in the shipped configuration, resets included.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from mujoco.batch import Batch

import multilift_marl as ml
from multilift_marl.config.load import load_config, parse_overrides
from multilift_marl.envs.core import MultiliftVec

Runner = Callable[[], int]
"""Does a chunk of work and returns how many environment steps it made."""


def bare(vec: MultiliftVec, threads: int) -> Runner:
    """Return a runner of bare stepping, from the states and loads that the teams of `vec` are in at present."""
    batch = Batch(vec.world.model, vec.num_envs, nthread=threads)
    interval, ticks = vec.world.system.control_interval, vec.control_ticks
    batch.bind("sensordata")

    def run() -> int:
        batch.state[:] = np.concatenate([shard.batch.state for shard in vec.world.shards])
        for _ in range(20 * ticks):
            batch.step(nstep=interval)
        return 20 * vec.num_envs

    return run


def core(vec: MultiliftVec) -> Runner:
    """Return a runner of the batched core."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (20, vec.num_envs, vec.num_drones, vec.action_size)).astype(np.float32)
    vec.reset()

    def run() -> int:
        for action in actions:
            _, _, terminated, truncated, _ = vec.step(action)
            over = terminated | truncated
            if over.any():
                vec.reset(mask=over)
        return len(actions) * vec.num_envs

    return run


def torchrl(env) -> Runner:
    """Return a runner of the TorchRL door with its own random actions."""
    carried = env.reset()

    def run() -> int:
        nonlocal carried
        for _ in range(20):
            _, carried = env.step_and_maybe_reset(env.rand_action(carried))
        return 20 * env.batch_size[0]

    return run


def pettingzoo(env) -> Runner:
    """Return a runner of the PettingZoo door."""
    rng = np.random.default_rng(0)
    size = env.action_space("drone_0").shape[0]
    actions = [
        {agent: rng.uniform(-1, 1, size).astype(np.float32) for agent in env.possible_agents} for _ in range(200)
    ]
    env.reset()

    def run() -> int:
        for action in actions:
            env.step(action)
            if not env.agents:
                env.reset()
        return len(actions)

    return run


def measure(runners: dict[str, Runner], repeats: int, seconds: float) -> dict[str, list[float]]:
    """Return environment steps per second of each runner, `repeats` times, in turn."""
    for run in runners.values():
        run()
    rates: dict[str, list[float]] = {name: [] for name in runners}
    for _ in range(repeats):
        for name, run in runners.items():
            start, steps = time.perf_counter(), 0
            while (passed := time.perf_counter() - start) < seconds:
                steps += run()
            rates[name].append(steps / passed)
    return rates


def main(arguments: list[str]) -> dict:
    """Measure, print a table, and return the numbers."""
    values = {"env.num_envs": 256} | parse_overrides(arguments)
    repeats, seconds = int(values.pop("repeats", 5)), float(values.pop("seconds", 1.0))
    config = load_config("hover", values)
    vec = ml.make_vec(config)
    threads = len(vec.world.shards)
    many = {"bare": bare(vec, threads), "core": core(vec), "torchrl_env": torchrl(ml.torchrl_env(config))}
    single = ml.make_vec(config, num_envs=1, num_threads=1)
    one = {"bare": bare(single, 1), "core": core(single), "parallel_env": pettingzoo(ml.parallel_env(config))}
    result = {}
    print(f"{config.env.num_drones} drones; medians of {repeats}")
    print("| door | environments | threads | steps/s | simulated s/s | ratio to bare (least - largest) |")
    print("|---|---|---|---|---|---|")
    for runners, envs, used in ((many, vec.num_envs, threads), (one, 1, 1)):
        rates = measure(runners, repeats, seconds)
        for name, values in rates.items():
            ratios = [value / reference for value, reference in zip(values, rates["bare"], strict=True)]
            rate, ratio = statistics.median(values), statistics.median(ratios)
            result[f"{name}_{envs}"] = {"steps_per_s": rate, "ratio": ratio}
            print(
                f"| {name} | {envs} | {used} | {rate:,.0f} | {rate / config.env.policy_hz:,.0f} | "
                f"{ratio:.2f} ({min(ratios):.2f} - {max(ratios):.2f}) |"
            )
    return result


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
