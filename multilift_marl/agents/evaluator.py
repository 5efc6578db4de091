"""Evaluations during training: how good the policy is, which one is the best, and what training gained.

All episodes are on seeds of evaluation during training. They come in blocks: every evaluation takes block 0,
so that its numbers can be compared over a training; the others have decided nothing before, so that no policy is called
better for having been lucky.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.agents.policy import LearnedPolicy
from multilift_marl.agents.rigs import evaluated_rigs
from multilift_marl.config.config import Config
from multilift_marl.envs.core import TRAINING_EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.evaluation.metrics import FEWEST, is_better, join_episodes, summarize
from multilift_marl.evaluation.rollout import run_episodes, trace_episode
from multilift_marl.policies.baselines import make_base_policy
from multilift_marl.policies.policy import Policy
from multilift_marl.tasks import find_task

_METRICS = (
    "success_rate", "payload_position_error_m", "payload_rmse_m", "payload_attitude_error_deg", "settling_time_s",
    "return",
)  # fmt: skip
_BLOCK = 2**20  # episodes


class Gain(NamedTuple):
    """What training gained over the policy that it began with, on the same fresh episodes."""

    script: dict[str, float]
    """Means by metric of that policy: the base policy, or that of `train.init`."""
    learned: dict[str, float]
    """The same of the best policy."""
    better: bool
    """Whether the best policy is better beyond the noise of these episodes."""
    worse: bool
    """Whether it is worse beyond that noise: it was the best of others."""

    def values(self) -> dict[str, float]:
        """Return the numbers to log, by name."""
        teams = {"script": self.script, "learned": self.learned}
        means = {f"final/{team}_{name}": mean for team, metrics in teams.items() for name, mean in metrics.items()}
        return means | {"final/gained": float(self.better)}


class Evaluator:
    """Evaluates the policies of one training and keeps one of them (`eval.keep`).

    Args:
        config: of the training.

    Attributes:
        error: metric by which policies that succeed alike are compared, the task's `ERROR`.
        best: what a checkpoint holds of the policy that is kept, its `iteration`, and its `score` in its evaluation,
            success and negative error, which is `compared_by`, over so many `episodes`; None before the first.
        initial: the same of the policy of `train.init`, without score; None where there is none.
    """

    def __init__(self, config: Config):
        self.config = config
        self.error = find_task(config.task).ERROR
        self.best: dict[str, Any] | None = None
        self.initial: dict[str, Any] | None = None

    def evaluate(self, content: dict[str, Any]) -> dict[str, float]:
        """Fly a policy without exploration; keep it if it is better than the best so far, or the last is kept.

        Args:
            content: of the policy's checkpoint, and its `iteration`.

        Returns:
            The evaluation's numbers by name, the iteration of the best policy among them.
        """
        start, policy = time.perf_counter(), LearnedPolicy(content, "the run")
        flown = self._fly(policy.bind, 0)
        summary, score = summarize(flown), self._score(flown)
        values = {f"eval/{name}": summary[name]["mean"] for name in self._metrics}
        self._score_anew()
        best, keep_last = self.best, self.config.eval.keep == "last"
        if best is None or keep_last or (score > best["score"] and self._confirm(policy, content["iteration"])):
            weights = {name: tensor.clone() for name, tensor in content["actor"].items()}  # learning changes them
            best = self.best = content | {"actor": weights, "score": score} | self._measure
        return values | {
            "eval/best_iteration": float(best["iteration"]),
            "eval/seconds": time.perf_counter() - start,
        }

    def measure_success(self, content: dict[str, Any], environment: Config) -> float:
        """Return the share of successes of a policy without exploration in a stage's environment, on fresh episodes."""
        policy = LearnedPolicy(content, "the run")
        flown = self._fly(policy.bind, content["iteration"] + 1, environment)
        return float(flown["success_rate"].mean())

    def measure_gain(self, iterations: int) -> Gain:
        """Fly the best policy and the one that training of so many iterations began with."""
        learned = self._fly(self.best_policy().bind, iterations + 1)
        script = self._fly(self._beginning(), iterations + 1)
        before = {name: float(script[name].mean()) for name in self._metrics}
        after = {name: float(learned[name].mean()) for name in self._metrics}
        return Gain(before, after, is_better(learned, script, self.error), is_better(script, learned, self.error))

    @property
    def _metrics(self) -> tuple[str, ...]:
        return _METRICS if self.error in _METRICS else (*_METRICS, self.error)

    @property
    def _measure(self) -> dict[str, Any]:
        """What scores have to have in common to be compared."""
        measure = {"compared_by": self.error, "episodes": self.config.eval.episodes}
        # Scores without that number are of rigs that all flew the same episodes.
        return measure | ({"rigs": len(rigs)} if (rigs := self.config.train.rigs) else {})

    def _score(self, flown: dict[str, np.ndarray]) -> list[float]:
        if self.error not in flown:
            hint = nearest(self.error, [name for name, value in flown.items() if value.dtype == float])
            raise ConfigError(f"task {self.config.task}: ERROR names no metric, '{self.error}'{hint}")
        if not np.isfinite(flown[self.error]).all():
            raise ConfigError(
                f"task {self.config.task}: the metric '{self.error}', by which policies are compared (ERROR), is not "
                "finite in some episodes; give it a number in each, such as a bound"
            )
        return [float(flown["success_rate"].mean()), -float(flown[self.error].mean())]

    def _score_anew(self) -> None:
        """Score the best policy where a resumed training has other episodes, or another error, than it had before."""
        best = self.best
        if best is not None and {name: best.get(name) for name in self._measure} != self._measure:
            best |= {"score": self._score(self._fly(self.best_policy().bind, 0))} | self._measure

    def _beginning(self) -> Callable[[MultiliftVec], Policy]:
        if self.initial is None:
            return partial(make_base_policy, self.config.train.residual)
        return LearnedPolicy(self.initial, "the initial policy").bind

    def best_policy(self) -> LearnedPolicy:
        """Return the best policy so far."""
        assert self.best is not None
        return LearnedPolicy(self.best, "the run's best")

    def draw_best(self, folder: Path) -> Path:
        """Return the path of a picture in a folder, of the first episode of the best policy so far."""
        from multilift_marl.evaluation.plots import plot_paths  # matplotlib takes a while

        assert self.best is not None
        policy, path = self.best_policy(), folder / "flight.png"
        trace = trace_episode(self.config, policy.bind, 0, self.config.seed)
        plot_paths(path, trace, f"best policy so far, iteration {self.best['iteration']}")
        return path

    def _confirm(self, candidate: LearnedPolicy, iteration: int) -> bool:
        """Return whether a policy beats the best one on fresh episodes, too.

        The policy that training began with gives way to a gain beyond the noise; among trained ones, whose
        gains add up in steps smaller than that, and in too few episodes for any noise, the means decide.
        """
        untrained = self.best_policy().frames == 0 and self.config.eval.episodes >= FEWEST
        flown, best = self._fly(candidate.bind, iteration), self._fly(self.best_policy().bind, iteration)
        return is_better(flown, best, self.error, beyond_noise=untrained)

    def _fly(
        self, make_policy: Callable[[MultiliftVec], Policy], block: int, environment: Config | None = None
    ) -> dict[str, np.ndarray]:
        """Return the metrics of each episode of a block, in the task's own environment or in another one."""
        rigs, seed = evaluated_rigs(environment or self.config), self.config.seed
        # Rounded up, so that each rig has its share; neither those of two rigs nor blocks of episodes ever meet.
        each, first = -(-self.config.eval.episodes // len(rigs)), block * _BLOCK
        return join_episodes([
            run_episodes(rig, make_policy, each, seed, TRAINING_EVALUATION, first=first + k * each)
            for k, rig in enumerate(rigs)
        ])  # fmt: skip
