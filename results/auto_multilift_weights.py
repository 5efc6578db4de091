"""Learn a planner's weights on Auto-Multilift's path: `python results/auto_multilift_weights.py <path.csv> [seeds=5]`.

<path.csv> has columns t, x, y, z of their figure-eight (fig8.npy of results/auto_multilift.py does, too). For each seed
`track_auto6_weights` is trained for 20 episodes, from weights that are all equal in SI units; `ways=signs` does so in
their way: updates in each step by signs, at 1e-4. Stated are the loss of an episode without learning and of each one in
training, and RMS errors by axis of the best policy of evaluations after every second episode, over the whole path of
eight other episodes. It all goes to docs/data/auto_multilift_weights.csv.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from script import check_known, read_options, run_script

from multilift_marl.agents.trainer import Trainer
from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import run_episodes

TABLE = Path(__file__).parents[1] / "docs" / "data" / "auto_multilift_weights.csv"
AXES = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
THEIRS = {
    "train.learning_rate": 1e-4, "train.final_learning_rate": 1.0, "train.diffmpc.every": 1,
    "train.diffmpc.fresh_adam": True,
}  # fmt: skip
WAYS: dict[str, dict[str, Any]] = {"adam": {}, "signs": THEIRS}


def train(way: str, seed: int, path: str) -> dict[str, str]:
    """Return the line of a training."""
    flown = {
        "task_options.path": "file", "task_options.file": path, "task_options.rmse_from": 0.0,
        "task_options.start_radius": 0.013, "env.num_threads": 1, "seed": seed,
    }  # fmt: skip
    config = load_config("track_auto6_weights", flown | WAYS[way])
    with tempfile.TemporaryDirectory() as folder:
        first = Trainer(load_config("track_auto6_weights", flown | {"train.learning_rate": 1e-12}), Path(folder))
        untrained = first.step()["loss"]
        (Path(folder) / "checkpoints").mkdir()
        trainer = Trainer(config, Path(folder))
        losses = []
        while not trainer.finished:
            losses.append(trainer.step()["loss"])
            if trainer.iteration % 2 == 0:
                trainer.evaluate()
        policy = trainer.evaluator.best_policy()
    measured = run_episodes(config, policy.bind, 8, 1000)
    within = next((str(k + 1) for k, loss in enumerate(losses) if loss < untrained / 30), "-")
    line = {"way": way, "seed": str(seed), "untrained_loss": f"{untrained:.4g}", "episodes_to_a_thirtieth": within}
    line |= {"last_loss": f"{losses[-1]:.4g}", "losses": " ".join(f"{loss:.4g}" for loss in losses)}
    line |= {f"rmse_{axis}": f"{np.mean(measured[f'payload_rmse_{axis}']):.4f}" for axis in AXES}
    return line | {"success_percent": f"{100 * measured['success_rate'].mean():.0f}"}


def main(arguments: list[str]) -> None:
    """Train and write the table."""
    path, *rest = arguments or ["help"]
    if not Path(path).is_file():
        sys.exit(__doc__)
    values = read_options(rest, {"seeds": 5, "ways": "adam"})
    check_known("way", values["ways"].split(","), WAYS)
    lines = []
    for way in values["ways"].split(","):
        for seed in range(values["seeds"]):
            lines.append(train(way, seed, path))
            print(lines[-1], flush=True)
            with TABLE.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, list(lines[0]), lineterminator="\n")
                writer.writeheader()
                writer.writerows(lines)


if __name__ == "__main__":
    run_script(main)
