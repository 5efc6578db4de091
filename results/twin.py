"""Compare learned teams with their linear twins: `python results/twin.py policy=<run>[,<run>] [others=a,b]`.

The twin is the linear map of the same observation, with a constant, that fits the learned team's actions best: by least
squares over the steps of `rounds=4` batches of flights (0: no twin), the first flown by the learned team, the others by
the twin so far, with what the learned team would have done. All, and other baselines by name, fly the same
`episodes=200`. Of several training seeds, differences are to their mean, with intervals over seeds and episodes.

Further arguments change the configuration. `table=<file>` is a CSV file that the rows go to; those that it has of the
same changes are replaced.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from multilift_marl.agents.policy import load_policy
from multilift_marl.command import CommandOptions, run_command, split_options
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.evaluation.metrics import bootstrap_seeds, wilson
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import SCRIPTED, make_scripted
from multilift_marl.policies.policy import Policy
from multilift_marl.schema.values import Int

TRAINING, EVALUATION = 500, 1000  # seeds
BATCH = 64  # episodes of a round
RIDGE = 1e-6  # of the mean square of each number


class Linear:
    """Acts by a matrix (D + 1, A), the last row constant."""

    def __init__(self, matrix: np.ndarray):
        self.matrix = matrix

    @classmethod
    def bind(cls, matrix: np.ndarray, vec: MultiliftVec) -> Linear:
        """Return one that flies environments."""
        return cls(matrix)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, A)."""
        return np.clip(observation @ self.matrix[:-1] + self.matrix[-1], -1.0, 1.0)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Do nothing."""


class Taught:
    """Flies by one policy, and adds what another would do to sums of squares."""

    def __init__(self, flies: Policy, teaches: Policy, sums: tuple[np.ndarray, np.ndarray]):
        self._flies, self._teaches, self._sums = flies, teaches, sums

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, A)."""
        taught = self._teaches.act(observation)
        rows = np.concatenate([observation, np.ones((*observation.shape[:-1], 1))], -1, dtype=float)
        rows = rows.reshape(-1, rows.shape[-1])
        self._sums[0][:] += rows.T @ rows
        self._sums[1][:] += rows.T @ taught.reshape(len(rows), -1)
        return self._flies.act(observation)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Begin anew in the environments of the mask (E,)."""
        self._flies.reset(mask)
        self._teaches.reset(mask)


def fit(config: Config, learned: Callable[[MultiliftVec], Policy], rounds: int) -> np.ndarray:
    """Return the matrix (D + 1, A) of the twin of a policy."""
    vec = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1}))
    size = vec.observation_size + 1
    sums = np.zeros((size, size)), np.zeros((size, vec.action_size))
    matrix = None
    for number in range(rounds):

        def make(vec: MultiliftVec, matrix: np.ndarray | None = matrix) -> Taught:
            return Taught(learned(vec) if matrix is None else Linear(matrix), learned(vec), sums)

        run_episodes(config, make, BATCH, TRAINING, first=number * BATCH)
        square = sums[0] + RIDGE * np.diag(np.diag(sums[0]) + 1e-9)
        matrix = np.linalg.solve(square, sums[1])
    assert matrix is not None
    return matrix


class Options(CommandOptions):
    """Keys of the comparison beside those of the configuration."""

    policy: str = Field("", description="the learned teams, runs of one recipe, with commas between them")
    episodes: Annotated[Int, Field(ge=1)] = Field(200, description="that all of them fly")
    rounds: Annotated[Int, Field(ge=0)] = Field(4, description="of flights that the twin is fitted to; 0: no twin")
    others: str = Field("", description="baselines, with commas between them")
    table: str | None = Field(None, description="CSV file that the rows go to")


def main(given: dict[str, Any]) -> int:
    """Fit, fly and say."""
    options, values = split_options(Options, given)
    if not options.policy:
        raise ConfigError("policy= is missing; give the learned team: policy=runs/<run>, or a shipped one")
    others, episodes = [name for name in options.others.split(",") if name], options.episodes
    for other in others:
        if other not in SCRIPTED and ":" not in other:
            raise ConfigError(f"others names no baseline '{other}'{nearest(other, SCRIPTED)}")
    policies = [load_policy(name) for name in options.policy.split(",")]
    config = build_config(policies[0].config.model_dump(), values)
    seeds = [f" of seed {policy.config.seed}" if len(policies) > 1 else "" for policy in policies]
    if len(set(seeds)) < len(seeds):
        raise ConfigError("policies of one recipe are compared by their training seeds, but two have the same one")
    teams: dict[str, Callable[[MultiliftVec], Policy]] = {}
    for seed, policy in zip(seeds, policies, strict=True):
        teams[f"learned{seed}"] = policy.bind
        if options.rounds:
            matrix = fit(config, policy.bind, options.rounds)
            teams[f"linear twin{seed}"] = partial(Linear.bind, matrix)
    for other in others:
        teams[other] = partial(make_scripted, other)
    flown = {
        who: run_episodes(config, make, episodes, EVALUATION)["success_rate"].astype(float)
        for who, make in teams.items()
    }
    learned = np.array([flown[f"learned{seed}"] for seed in seeds])
    rows = []
    for who, success in flown.items():
        low, high = (100 * each for each in wilson(int(success.sum()), episodes))
        row = {"team": who, "episodes": episodes, "success_percent": f"{100 * success.mean():.1f}"}
        row |= {"ci95": f"{low:.1f}-{high:.1f}"}
        if not who.startswith("learned"):
            low, high = (100 * each for each in bootstrap_seeds(learned - success))
            row["learned_minus_this"] = f"{low:.1f} to {high:.1f}"
        rows.append(row)
        print(*(f"{key}={value}" for key, value in row.items()))
    if options.table:
        keep(Path(options.table), " ".join(f"{key}={value}" for key, value in values.items()), rows)
    return 0


def keep(path: Path, changes: str, rows: list[dict[str, Any]]) -> None:
    """Put rows into a table, in place of those of the same changes."""
    rows = [{"changes": changes, **row} for row in rows]
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if row["changes"] != changes] + rows
    columns = dict.fromkeys(name for row in rows for name in row)  # learned teams alone have no difference
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns), lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__ or "", Options, None, None))
