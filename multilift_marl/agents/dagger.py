"""Imitation of a planner that sees more than the drones do: `train.algorithm=dagger` (Ross et al., AISTATS 2011).

The network flies, and learns what the teacher would have commanded at each step in the teacher's place; at first the
teacher flies most episodes itself. The teacher may know the true states (`train.dagger.truth`) and read what no
drone observes: what the network makes of it rests on each drone's own observation alone. All steps are kept, up to
`train.dagger.capacity`, and learned from again and again. They are not saved, nor is what a teacher plans: a training
that is resumed begins new episodes, and collects anew.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from multilift_marl.agents.mappo import Learner
from multilift_marl.agents.rollouts import Batches, join_steps
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.truth import with_truth
from multilift_marl.schema.training import TrainConfig

TEACHER = 4  # purpose of seeds, beside those of `envs/core.py` and `rollouts.NOISE`


def check_dagger(train: TrainConfig) -> None:
    """Refuse, by a ConfigError, what cannot be learned from a teacher."""
    for key in ("gru", "workers", "rigs", "stages"):
        if getattr(train, key):
            raise ConfigError(f"train.algorithm=dagger has no train.{key}; leave it out, or take mappo")


class DaggerRollouts:
    """Flights whose steps the learner's policy is fitted to the teacher's commands of; see `Rollouts`.

    Args:
        env: what is simulated.
        learner: whose actor flies, and learns.
        total: environments of the training.

    Attributes:
        env: as given.
        values: numbers to log of the last batch.
        observed, taught: (S, N, D), (S, N, A) steps that are kept, and the teacher's commands in them.
        count: of steps so far; those beyond S have overwritten the oldest.
    """

    def __init__(self, env: MultiliftEnv, learner: Learner, total: int):
        self.env, self.values = env, dict[str, float]()
        vec, train = env.vec, learner.config
        self._learner, self._total, self._train, self._settings = learner, total, train, train.dagger
        self._teacher = make_scripted(self._settings.teacher, with_truth(vec) if self._settings.truth else vec)
        size = min(
            self._settings.capacity, -(-train.frames // (vec.num_envs * train.horizon)) * vec.num_envs * train.horizon
        )
        n = vec.num_drones
        self.observed = torch.zeros(size, n, vec.observation_size)
        self.taught = torch.zeros(size, n, vec.action_size)
        self.count = 0
        self._by_teacher = np.ones(vec.num_envs, bool)
        self._started = False

    def collect(self, iteration: int) -> Batches:
        """Fly the next steps of all environments, learn, and return them as one batch of size [E, T]."""
        self._start()
        vec, train = self.env.vec, self._train
        share = max(0.0, 1.0 - iteration * vec.num_envs * train.horizon / max(self._settings.handover, 1))
        share = max(share, self._settings.teacher_share)
        rng = np.random.default_rng(np.random.SeedSequence(vec.config.seed, spawn_key=(TEACHER, iteration)))
        rows: list[dict[str, np.ndarray]] = []
        observation, _ = vec.current()
        for _ in range(train.horizon):
            began = vec.ended
            taught = self._teacher.act(observation)
            with torch.no_grad():
                own = self._learner.actor(torch.from_numpy(observation))[0].clamp(-1, 1).numpy()
            self._keep(observation, taught, ~began)
            outcome = vec.step_live(np.where(self._by_teacher[:, None, None], taught, own), restart=True)
            if began.any():
                self._teacher.reset(began)
                self._by_teacher[began] = rng.uniform(size=int(began.sum())) < share
            observation = outcome.observation.copy()
            terminated, truncated, success, failure, diverged = outcome.flags
            rows.append(
                {
                    "reward": outcome.reward[..., None].copy(), "done": (terminated | truncated)[:, None].copy(),
                    "reward_terms": vec.task.terms.copy(), "success": success[:, None].copy(),
                    "failure": failure[:, None].copy(), "diverged": diverged[:, None].copy(),
                }
            )  # fmt: skip
        begin = time.perf_counter()
        torch.set_num_threads(train.threads)
        loss = self._learn(vec.num_envs * train.horizon)
        torch.set_num_threads(1)
        self.values = {"loss": loss, "teacher_share": share, "learning_seconds": time.perf_counter() - begin}
        return [join_steps(rows, vec)]

    def _keep(self, observation: np.ndarray, taught: np.ndarray, mask: np.ndarray) -> None:
        """Keep the steps of the environments in the mask."""
        count = int(mask.sum())
        at = (self.count + np.arange(count)) % len(self.observed)
        self.observed[at] = torch.from_numpy(observation[mask])
        self.taught[at] = torch.from_numpy(taught[mask].astype(np.float32))
        self.count += count

    def _learn(self, fresh: int) -> float:
        """Fit the policy to what is kept, `epochs` times as many steps as there are `fresh` ones; return the loss."""
        learner, train, kept = self._learner, self._train, min(self.count, len(self.observed))
        parameters = [each for each in learner.actor.parameters()]
        recent = torch.arange(max(self.count - fresh, 0), self.count) % len(self.observed)
        learner.actor.normalizer.update(self.observed[recent])
        size = max(fresh // train.minibatches, 1)
        losses = []
        for _ in range(train.epochs * train.minibatches):
            chosen = torch.randint(kept, (size,))
            learner.optimizer.zero_grad(set_to_none=True)
            mean = learner.actor(self.observed[chosen])[0]
            loss = (mean - self.taught[chosen]).square().mean()
            loss.backward()
            torch.nn.utils.clip_grad_norm_([each for each in parameters if each.grad is not None], train.max_grad_norm)
            learner.optimizer.step()
            losses.append(loss.detach())
        return float(torch.stack(losses).mean())

    def get_state(self) -> dict[str, torch.Tensor]:
        """See `Rollouts.get_state`."""
        self._start()
        return self.env.get_state()

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on in the episodes after those that were under way."""
        self.env.set_state(saved)
        self.env.vec.reset()
        self._started = True

    def close(self, at_once: bool = False) -> None:
        """Do nothing: there is no other process."""

    def _start(self) -> None:
        if not self._started:
            vec: MultiliftVec = self.env.vec
            vec.reset(seed=vec.config.seed)
            vec.stagger(self._total)
            self._started = True
