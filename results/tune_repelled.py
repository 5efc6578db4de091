"""Search the numbers of `policy=formation_repelled`: `python results/tune_repelled.py [config=…] [maps=32]`.

A grid on training maps of `navigate_senses`, or of another configuration; prints the successes of each, best last.
"""

from __future__ import annotations

import sys
from itertools import product

import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.repelled import FormationRepelled

SEED = 500
DISTANCES, GAINS, SWAYS = (0.6, 0.9, 1.3, 1.8, 2.4), (0.2, 0.4, 0.7, 1.0, 1.5), (0.0, 1.0)


def main(arguments: list[str]) -> None:
    """Fly all of the grid."""
    values = {"config": "navigate_senses", "maps": "32"} | dict(argument.split("=", 1) for argument in arguments)
    config = load_config(values["config"], {"env.num_threads": 1})
    found = []
    for distance, gain, sway in product(DISTANCES, GAINS, SWAYS):

        def make(vec: MultiliftVec, numbers: tuple[float, float, float] = (distance, gain, sway)) -> FormationRepelled:
            policy = FormationRepelled(vec)
            policy.DISTANCE, policy.GAIN, policy.SWAY = numbers
            return policy

        flown = run_episodes(config, make, int(values["maps"]), SEED)
        found.append((100 * float(np.mean(flown["success_rate"])), distance, gain, sway))
        print(describe(*found[-1]), flush=True)
    print("best:", describe(*max(found)))


def describe(success: float, distance: float, gain: float, sway: float) -> str:
    """Return a line on a point of the grid."""
    return f"{success:.1f} % by DISTANCE={distance:g} GAIN={gain:g} SWAY={sway:g}"


if __name__ == "__main__":
    main(sys.argv[1:])
