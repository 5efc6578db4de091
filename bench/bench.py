"""Speed of every API of the environment as a ratio to stepping the same model by MuJoCo alone.

    python bench/bench.py [repeats=5] [seconds=1.0] [clock=wall|processor] [any configuration key]

MuJoCo alone is `Batch.step(nstep=control interval)` of the compiled model, with contacts, on the same threads, with
the drones' hover thrust applied. All are measured alternately in one run, and the medians reported: on a noisy machine
ratios compare, times do not; what other processes do counts least with `clock=processor env.num_threads=1`. The APIs
are stepped in the shipped configuration, with resets, by actions that were drawn at random before.
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

CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}  # the latter counts all threads
Runner = Callable[[], int]
"""Does a chunk of work and returns how many environment steps it made."""


def mujoco_alone(vec: MultiliftVec, threads: int) -> Runner:
    """Return a runner of MuJoCo alone, from the present states and loads of the teams of `vec`."""
    batch = Batch(vec.world.model, vec.num_envs, nthread=threads)
    interval = vec.world.system.control_interval
    ticks = vec.control_ticks
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
    """Return a runner of the TorchRL environment."""
    actions = [env.action_spec.rand() for _ in range(20)]
    carried = env.reset()

    def run() -> int:
        nonlocal carried
        for action in actions:
            _, carried = env.step_and_maybe_reset(carried.update(action))
        return len(actions) * env.batch_size[0]

    return run


def pettingzoo(env) -> Runner:
    """Return a runner of the PettingZoo environment."""
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


def measure(
    runners: dict[str, Runner], repeats: int, seconds: float, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Return environment steps per second of each runner by a clock [s], `repeats` times, alternately."""
    for run in runners.values():
        run()
    rates: dict[str, list[float]] = {name: [] for name in runners}
    for _ in range(repeats):
        for name, run in runners.items():
            start = clock()
            steps = 0
            while (passed := clock() - start) < seconds:
                steps += run()
            rates[name].append(steps / passed)
    return rates


def settings(defaults: dict, arguments: list[str]) -> tuple[dict, int, float]:
    """Return configuration values, repeats and seconds of key=value arguments."""
    values = defaults | parse_overrides(arguments)
    return values, int(values.pop("repeats", 5)), float(values.pop("seconds", 1.0))


def main(arguments: list[str]) -> dict:
    """Measure, print a table, and return the numbers."""
    values, repeats, seconds = settings({"env.num_envs": 256}, arguments)
    name = values.pop("clock", "wall")
    if name not in CLOCKS:
        raise SystemExit(f"clock={name} must be {' or '.join(CLOCKS)}")
    clock = CLOCKS[name]
    config = load_config("hover", values)
    vec = ml.make_vec(config)
    threads = len(vec.world.shards)
    many = {"mujoco": mujoco_alone(vec, threads), "core": core(vec), "torchrl_env": torchrl(ml.torchrl_env(config))}
    single = ml.make_vec(config, num_envs=1, num_threads=1)
    one = {"mujoco": mujoco_alone(single, 1), "core": core(single), "parallel_env": pettingzoo(ml.parallel_env(config))}
    result = {}
    print(f"{config.env.num_drones} drones; medians of {repeats}")
    print("| API | environments | threads | steps/s | simulated s/s | ratio to MuJoCo alone (least - largest) |")
    print("|---|---|---|---|---|---|")
    for runners, envs, used in ((many, vec.num_envs, threads), (one, 1, 1)):
        rates = measure(runners, repeats, seconds, clock)
        for name, values in rates.items():
            ratios = [value / reference for value, reference in zip(values, rates["mujoco"], strict=True)]
            rate = statistics.median(values)
            ratio = statistics.median(ratios)
            result[f"{name}_{envs}"] = {"steps_per_s": rate, "ratio": ratio}
            print(
                f"| {name} | {envs} | {used} | {rate:,.0f} | {rate / config.env.policy_hz:,.0f} | "
                f"{ratio:.2f} ({min(ratios):.2f} - {max(ratios):.2f}) |"
            )
    return result


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
