"""The core relative to stepping the same model by MuJoCo alone, for every task and for teams of 2 to 16 drones.

    python bench/tasks.py [repeats=5] [seconds=1.0] [key=value ...]

MuJoCo alone starts repeatedly from the states of the core's teams, with their contacts.
"""

from __future__ import annotations

import statistics
import sys

import multilift_marl as ml
from bench import core, measure, mujoco_alone, settings
from multilift_marl.config.load import load_config

TEAMS = (2, 4, 8, 16)


def ratio(config: str, repeats: int, seconds: float, overrides: dict) -> tuple[float, float, float]:
    """Return the core's ratio to MuJoCo alone, and both times of an environment step [µs]."""
    vec = ml.make_vec(load_config(config, {"env.num_envs": 256} | overrides))
    rates = measure({"mujoco": mujoco_alone(vec, len(vec.world.shards)), "core": core(vec)}, repeats, seconds)
    ratios = [value / reference for value, reference in zip(rates["core"], rates["mujoco"], strict=True)]
    return statistics.median(ratios), *(1e6 / statistics.median(rates[name]) for name in ("mujoco", "core"))


def main(arguments: list[str]) -> None:
    """Measure and print two tables."""
    values, repeats, seconds = settings({}, arguments)
    print("| task | ratio to MuJoCo alone | MuJoCo [µs] | core [µs] |\n|---|---|---|---|")
    for task in ml.list_tasks():
        found, plain, whole = ratio(task, repeats, seconds, values)
        print(f"| {task} | {found:.2f} | {plain:.1f} | {whole:.1f} |", flush=True)
    print("\n| drones | ratio to MuJoCo alone | MuJoCo [µs] | core [µs] |\n|---|---|---|---|")
    for count in TEAMS:
        found, plain, whole = ratio("hover", repeats, seconds, values | {"env.num_drones": count})
        print(f"| {count} | {found:.2f} | {plain:.1f} | {whole:.1f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
