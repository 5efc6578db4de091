"""Tune the numbers of a rule by CMA-ES (Hansen, arXiv 1604.00772) on training maps or episodes: `pip install cma`.

  python results/tune_rules.py policy=formation_filed config=navigate_slots [maps=48] [generations=12] [seed=500]

Cost: failed episodes, and the payload's distance from the goal at their end (a fifth, at most 3 m). All candidates of a
generation fly the same maps, each generation others; at last the best of each generation and the numbers in the code
fly as many fresh maps.
"""

from __future__ import annotations

import cma
import numpy as np
from script import check_known, read_options, run_script

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import SCRIPTED
from multilift_marl.policies.policy import Policy

RANGES = {
    "formation_repelled": {"DISTANCE": (0.4, 2.5), "GAIN": (0.1, 2.0), "SWAY": (0.0, 1.0)},
    "formation_filed": {
        "STOP": (0.3, 1.4), "SLIDE": (0.1, 1.5), "ROOM": (0.0, 0.6), "FOLLOW": (0.0, 1.0), "TURN": (0.5, 2.8),
    },
    "formation_adaptive": {
        "GIVE": (0.0, 1.0), "LEAN": (0.0, 1.2), "FILTER": (0.1, 3.0), "LIFT": (0.0, 1.5), "LIFT_RATE": (0.0, 1.5),
        "SHIFT_RATE": (0.0, 1.0),
    },
}  # fmt: skip
"""What is tuned, and within what."""


def fly(config: Config, policy: str, numbers: dict[str, float], maps: int, seed: int) -> tuple[float, float]:
    """Return cost and success on maps of a seed."""

    def make(vec: MultiliftVec) -> Policy:
        flown: Policy = SCRIPTED[policy](vec)
        vars(flown).update(numbers)
        return flown

    flown = run_episodes(config, make, maps, seed)
    failed = 1 - float(np.mean(flown["success_rate"]))
    return failed + 0.2 * float(np.minimum(flown["payload_position_error_m"] / 3, 1).mean()), 1 - failed


def main(arguments: list[str]) -> None:
    """Search."""
    named = {"policy": "formation_repelled", "config": "navigate_senses"}
    values = read_options(arguments, named | {"maps": 48, "generations": 12, "seed": 500}, zero=["seed"])
    policy, maps, seed = values["policy"], values["maps"], values["seed"]
    check_known("rule", [policy], RANGES)
    config, ranges = load_config(values["config"], {"env.num_threads": 1}), RANGES[policy]
    kept = {name: float(getattr(SCRIPTED[policy], name)) for name in ranges}
    low, high = np.array(list(ranges.values())).T
    begin = (np.array(list(kept.values())) - low) / (high - low)
    options = {"bounds": [0, 1], "popsize": 8, "seed": seed, "verbose": -9}
    search = cma.CMAEvolutionStrategy(begin, 0.25, options)
    best = [kept]
    for generation in range(values["generations"]):
        points = search.ask()
        candidates = [dict(zip(ranges, (low + point * (high - low)).tolist(), strict=True)) for point in points]
        flown = [fly(config, policy, numbers, maps, seed + 1 + generation) for numbers in candidates]
        search.tell(points, [cost for cost, _ in flown])
        first = min(range(len(flown)), key=lambda k: flown[k][0])
        best.append(candidates[first])
        print(generation, describe(candidates[first], flown[first][1]), flush=True)
    last = [(fly(config, policy, numbers, 4 * maps, seed)[1], numbers) for numbers in best]
    print("in the code:", describe(kept, last[0][0]))
    success, numbers = max(last, key=lambda each: each[0])
    print("best:", describe(numbers, success))


def describe(numbers: dict[str, float], success: float) -> str:
    """Return a line on numbers."""
    return f"{100 * success:.1f} % by " + " ".join(f"{name}={number:.3g}" for name, number in numbers.items())


if __name__ == "__main__":
    run_script(main)
