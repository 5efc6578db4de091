"""Tune the numbers of the simple baselines of task `navigate` by flights on training maps.

  python results/tune_navigate.py tune [maps=8] [seed=0] [policies=mpc_payload,mpc_narrow,mpc_potential]
  python results/tune_navigate.py fly [maps=40] [seed=0] [policies=mpc,mpc_payload,...]

`tune` prints the share of maps of each level on which each candidate succeeds, `fly` that of policies as they are.
Maps are those of `reset(seed)`, of which no evaluation draws any. A flight counts once the team rests at the goal; it
has `SECONDS` for that, less than an episode, to save time. `mpc without clearance` is policy=mpc with
planner.clearance=0.
"""

from __future__ import annotations

import sys
from time import process_time
from typing import Any

import numpy as np
from script import check_known, read_options, run_script

import multilift_marl as ml
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.policies.baselines import make_scripted

LEVELS = {"sparse": "navigate", "dense": "navigate_dense", "narrow": "navigate_narrow", "unknown": "navigate_unknown"}
CANDIDATES: dict[str, list[dict[str, float]]] = {
    "mpc_payload": [{"RADIUS": r, "SPEED": v} for r, v in ((0.45, 1.5), (0.6, 1.5), (0.45, 1.0), (0.3, 1.5))],
    "mpc_narrow": [
        {"RADIUS": 0.3, "DRAWN": 0.8, "SPEED": 1.0},
        *({"RADIUS": r, "DRAWN": d, "SPEED": 1.5} for r, d in ((0.3, 0.8), (0.4, 0.8), (0.4, 1.0), (0.5, 0.8))),
    ],
    "mpc_potential": [{"DISTANCE": d, "GAIN": g} for d, g in ((0.9, 0.3), (0.9, 0.05), (1.3, 0.05), (0.6, 0.3))],
}
BARE = "mpc without clearance"
POLICIES = ("mpc", BARE, *CANDIDATES, "mpc_route")
SECONDS = 16.0  # for routes; the straight line, at the task's speed, has the whole episode


def fly(level: str, name: str, numbers: dict[str, float], maps: int, seed: int) -> float:
    """Return the share of maps of a level on which a policy with other numbers, by name, succeeds."""
    straight = name in ("mpc", BARE)
    options: dict[str, Any] = {"control.action": "acc_rates"}
    options |= {} if straight else {"task_options.speed": 2.0}  # of the target, which routes do not follow
    options |= {"planner.clearance": 0.0} if name == BARE else {}
    vec: MultiliftVec = ml.make_vec(LEVELS[level], num_envs=maps, num_threads=1, **options)
    observation, _ = vec.reset(seed=seed)
    policy = make_scripted("mpc" if straight else name, vec)
    vars(policy).update(numbers)
    ended, succeeded = np.zeros((2, maps), bool)
    steps = vec.max_steps if straight else round(SECONDS / vec.task.dt)
    for _ in range(steps):
        observation, _, terminated, truncated, info = vec.step(policy.act(observation))
        over = terminated | truncated
        arrived = np.where(truncated, info["success"], vec.task.succeeded()) & ~terminated
        succeeded |= arrived & ~ended
        ended |= over | arrived
        if ended.all():
            break
        if over.any():
            observation, _ = vec.reset(mask=over)
            policy.reset(over)
    return float(succeeded.mean())


def main(arguments: list[str]) -> None:
    """Print the table."""
    what, *pairs = arguments or ["help"]
    if what not in ("tune", "fly"):
        sys.exit(__doc__)
    maps, known = (8, tuple(CANDIDATES)) if what == "tune" else (40, POLICIES)
    options = read_options(pairs, {"maps": maps, "seed": 0, "policies": ",".join(known)}, zero=["seed"])
    policies = options["policies"].split(",")
    check_known("policy", policies, known)
    print(f"{'':74s}{''.join(f'{level:>9s}' for level in [*LEVELS, 'mean'])}", flush=True)
    for name in policies:
        for numbers in CANDIDATES[name] if what == "tune" else [{}]:
            begun = process_time()
            shares = [fly(level, name, numbers, options["maps"], options["seed"]) for level in LEVELS]
            cells = "".join(f"{100 * share:9.1f}" for share in [*shares, np.mean(shares)])
            print(f"{name:22s} {numbers or ''!s:50s} {cells}  {process_time() - begun:5.0f} s of CPU", flush=True)


if __name__ == "__main__":
    run_script(main)
