"""What learning a planner's weights gains: `python results/planner_weights.py [seeds=3] [frames=96000] [episodes=48]`.

Four ways to weights of `control.action=planner_weights`, in `track_weights_realistic`: those of `planner` as they are;
CMA-ES over 13 constants (`pip install cma`); a network by `train.algorithm=diffmpc`; and one by `mappo`, the last three
with as many environment steps. Each is flown on the paths below, on the same evaluation episodes. What is done is kept
in results/planner_weights, and not done again; docs/data/planner_weights.csv is written of all that is there, with
seeds=0 of that alone. Changes are 95 % intervals over training seeds and episodes.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cma
import numpy as np
from script import check_known, read_options, run_script

from multilift_marl.agents.policy import load_policy, strip_checkpoint
from multilift_marl.agents.trainer import Trainer
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import TRAINING_EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.metrics import bootstrap_seeds
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.policy import Policy

HERE = Path(__file__).parent / "planner_weights"
TABLE = Path(__file__).parents[1] / "docs" / "data" / "planner_weights.csv"
CONFIG, SEED = "track_weights_realistic", 1000
PATHS: dict[str, dict[str, Any]] = {
    "figure-eight, 2 m/s, 4 m/s2": {},
    "circle, 0.45 rad/s (held out)": {"task_options.path": "circle", "task_options.rate": 0.45},
    "figure-eight, 4 m/s, 6 m/s2 (held out)": {"task_options.speed": 4.0, "task_options.acceleration": 6.0},
}
METHODS = "cma", "diffmpc", "mappo"
POPULATION, BATCH = 8, 8  # candidates of a generation, episodes of each


class Constant:
    """The same weights at all times."""

    def __init__(self, vec: MultiliftVec, action: np.ndarray):
        self._action = np.broadcast_to(action, (vec.num_envs, vec.num_drones, vec.action_size))

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, A)."""
        return self._action

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Do nothing."""


def search(config: Config, frames: int, seed: int) -> np.ndarray:
    """Return 13 numbers that CMA-ES finds within so many environment steps."""
    environment = build_config(config.model_dump(), {**config.train.overrides, "env.num_envs": BATCH})
    search = cma.CMAEvolutionStrategy(np.zeros(13), 0.2, {"seed": seed + 1, "popsize": POPULATION, "verbose": -9})
    used = generation = 0
    while used < frames:
        candidates = search.ask()
        costs = []
        for candidate in candidates:
            action = np.clip(candidate, -1, 1)
            make: Callable[[MultiliftVec], Policy] = lambda vec, action=action: Constant(vec, action)  # noqa: E731
            flown = run_episodes(environment, make, BATCH, seed, TRAINING_EVALUATION, first=generation * BATCH)
            lost = ~flown["success_rate"].astype(bool)
            costs.append(float(np.mean(np.minimum(flown["payload_rmse_m"], 0.5) + 0.1 * lost)))
            used += BATCH * round(config.env.episode_seconds * config.env.policy_hz)
        search.tell(candidates, costs)
        generation += 1
        print("cma", seed, used, f"{100 * np.median(costs):.2f} cm", flush=True)
    return np.clip(search.result.xfavorite, -1, 1)


def learn(config: Config, method: str, frames: int, seed: int) -> Path:
    """Return the checkpoint of a team that was trained so."""
    own: dict[str, Any] = {"seed": seed, "train.frames": frames, "env.num_threads": 1}
    if method == "mappo":
        own |= {"train.algorithm": "mappo", "train.horizon": 128, "train.warmup": 4, "train.initial_std": 0.2}
    folder = HERE / f"run_{method}_{seed}"
    (folder / "checkpoints").mkdir(parents=True, exist_ok=True)
    if not Trainer(build_config(config.model_dump(), own), folder).run():
        sys.exit(f"stopped: {method} of seed {seed} is not kept; start again to train it anew")
    path = HERE / f"{method}_{seed}.pt"
    strip_checkpoint(folder / "checkpoints" / "last.pt", path)
    return path


def find(config: Config, method: str, frames: int, seed: int) -> Callable[[MultiliftVec], Policy]:
    """Return the maker of a method's policy, found now unless it is kept."""
    if method == "cma":
        kept = HERE / f"cma_{seed}.json"
        if not kept.exists():
            found = {"frames": frames, "action": search(config, frames, seed).round(4).tolist()}
            kept.write_text(json.dumps(found), encoding="utf-8")
        found = json.loads(kept.read_text(encoding="utf-8"))
        check_kept(kept, "frames", found["frames"], frames)
        action = np.array(found["action"])
        return lambda vec: Constant(vec, action)
    path = HERE / f"{method}_{seed}.pt"
    policy = load_policy(path if path.exists() else learn(config, method, frames, seed))
    check_kept(path, "frames", policy.config.train.frames, frames)
    return policy.bind


def check_kept(path: Path, what: str, kept: int, asked: int) -> None:
    """Refuse, by a ConfigError, a file that is kept of another effort than is asked for."""
    if kept != asked:
        raise ConfigError(f"{path} is kept of {what}={kept}, not {asked}; set {what}={kept}, or delete it")


def fly(
    config: Config, name: str, make: Callable[[MultiliftVec], Policy] | None, episodes: int
) -> list[dict[str, np.ndarray]]:
    """Return success and errors of episodes on each path, flown now unless they are kept; without a policy all are."""
    flown = []
    for number, options in enumerate(PATHS.values()):
        kept = HERE / f"{name}_path{number}.npz"
        if make is not None and not kept.exists():
            found = run_episodes(build_config(config.model_dump(), options), make, episodes, SEED)
            np.savez_compressed(kept, **{key: found[key] for key in ("success_rate", "payload_rmse_m")})
        flown.append(dict(np.load(kept)))
        check_kept(kept, "episodes", len(flown[-1]["success_rate"]), episodes)
    return flown


def change(errors: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    """Return the 95 % interval of the mean difference of errors (S, n) from others' in the same episodes.

    Seeds of the one have nothing to do with those of the other, so that any pairs of them do; one seed stands for all.
    """
    pairs = min((len(each) for each in (errors, others) if len(each) > 1), default=1)
    return bootstrap_seeds(errors[:pairs] - others[:pairs])


def main(arguments: list[str]) -> None:
    """Train, search, fly, and write the table."""
    defaults = {"seeds": 3, "frames": 96000, "episodes": 48, "methods": ",".join(METHODS)}
    values = read_options(arguments, defaults, zero=["seeds"])
    seeds, frames, episodes = (values[key] for key in ("seeds", "frames", "episodes"))
    methods = values["methods"].split(",")
    check_known("method", methods, METHODS)
    config = load_config(CONFIG, {"env.num_threads": 1})
    HERE.mkdir(exist_ok=True)
    hand = fly(config, "hand", lambda vec: Constant(vec, np.zeros(vec.action_size)), episodes)
    for seed in range(seeds):
        for method in methods:
            make = find(config, method, frames, seed)
            flown = fly(config, f"{method}_{seed}", make, episodes)
            print(method, seed, [f"{100 * each['payload_rmse_m'].mean():.2f}" for each in flown], flush=True)
    teams = {"hand": [hand]}
    for method in METHODS:
        names = sorted(path.name.removesuffix("_path0.npz") for path in HERE.glob(f"{method}_*_path0.npz"))
        if names:
            teams[method] = [fly(config, name, None, episodes) for name in names]
    lines = []
    for number, path in enumerate(PATHS):
        for method, flights in teams.items():
            errors = np.stack([flight[number]["payload_rmse_m"] for flight in flights])
            success = np.stack([flight[number]["success_rate"] for flight in flights])
            line = {"path": path, "weights": method, "seeds": len(flights), "episodes": errors.shape[1]}
            line["success_percent"] = f"{100 * success.mean():.1f}"
            line["rmse_cm"] = f"{100 * errors.mean():.2f}"
            line["median_rmse_cm"] = f"{100 * np.median(errors):.2f}"
            line["rmse_of_seeds_cm"] = " ".join(f"{100 * each.mean():.2f}" for each in errors)
            for other in ("hand", "cma"):
                if other in teams and other != method:
                    low, high = change(errors, np.stack([flight[number]["payload_rmse_m"] for flight in teams[other]]))
                    line[f"change_from_{other}_cm"] = f"{100 * low:.2f} to {100 * high:.2f}"
            lines.append(line)
    columns = list(dict.fromkeys(name for line in lines for name in line))
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


if __name__ == "__main__":
    run_script(main)
