"""What obstacles and their sensing cost: `python bench/obstacles.py [obstacles=20] [repeats=9]`.

CPU time of a policy step of one environment of `hover`, pillars on four rings about the team, in turns with the same
without obstacles; medians, and the median of the ratios of each turn.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

import multilift_marl as ml

RINGS = 1.6, 3.0, 4.5, 6.0  # [m] radii on which pillars stand in turn
ENVS, STEPS = 64, 60
SENSING: dict[str, dict[str, Any]] = {
    "no sensing": {},
    "map, 3 points": {"env.obstacle_sensing": "map"},
    "local": {"env.obstacle_sensing": "local", "env.obstacles.rate": 25, "env.obstacles.noise": 0.02},
    "ranges, 16 beams": {"env.obstacle_sensing": "ranges", "env.obstacles.noise": 0.02},
}


def pillars(count: int) -> list[dict[str, Any]]:
    """Return pillars of 30 cm and 4 m."""
    angle, radius = 2 * np.pi * np.arange(count) / count, np.resize(RINGS, count)
    places = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, 2.0)]).tolist()
    return [{"shape": "cylinder", "size": [0.3, 4.0], "position": place} for place in places]


def main(arguments: list[str]) -> None:
    """Print a table."""
    values = {"obstacles": "20", "repeats": "9"} | dict(argument.split("=", 1) for argument in arguments)
    near = {"task_options.start_radius": 0.1, "task_options.target_xy": 0.1}
    around = {"scene.obstacles": pillars(int(values["obstacles"]))}
    cases = {"without obstacles": near, **{name: near | around | own for name, own in SENSING.items()}}
    made = {name: ml.make_vec("hover", num_envs=ENVS, num_threads=1, **own) for name, own in cases.items()}
    taken: dict[str, list[float]] = {name: [] for name in made}
    for turn in range(int(values["repeats"])):
        for name, vec in made.items():
            vec.reset(seed=turn)
            action = np.zeros((ENVS, vec.num_drones, vec.action_size))
            begin = time.process_time()
            for _ in range(STEPS):
                vec.step(action)
            taken[name].append((time.process_time() - begin) / STEPS / ENVS)
    free = np.array(taken["without obstacles"])
    print("| | µs a step | speed over that without obstacles |", "|---|---|---|", sep="\n")
    for name, each in taken.items():
        print(f"| {name} | {1e6 * np.median(each):.1f} | {np.median(free / each):.2f} |")


if __name__ == "__main__":
    main(sys.argv[1:])
