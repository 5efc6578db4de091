"""Imitation of a planner that sees more than the drones do: `train.algorithm=dagger` (Ross et al., AISTATS 2011).

The network flies, and learns what the teacher would have commanded at each step in the teacher's place; at first the
teacher flies most episodes itself. The teacher may know the true states (`train.dagger.truth`) and read what no
drone observes: what the network makes of it rests on each drone's own observation alone. All steps are kept, up to
`train.dagger.capacity`, and learned from again and again. They are not saved, nor is what a teacher plans: a training
that is resumed begins new episodes, and collects anew.
"""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from multilift_marl.agents.learning_rollouts import LearningRollouts, join_steps, list_step
from multilift_marl.agents.mappo import Learner
from multilift_marl.agents.rollouts import Batches
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.policy import OwnPolicy, Policy
from multilift_marl.policies.truth import with_truth
from multilift_marl.schema.training import TrainConfig

SMALL = 0.05
"""[-] differences of actions below which they are squared: above it the network takes sides, and no mean."""
TEACHER = 4  # purpose of seeds, beside those of `envs/core.py` and `rollouts.NOISE`


def check_dagger(train: TrainConfig) -> None:
    """Refuse, by a ConfigError, what cannot be learned from a teacher."""
    for key in ("gru", "workers", "rigs", "stages"):
        if getattr(train, key):
            raise ConfigError(f"train.algorithm=dagger has no train.{key}; leave it out, or take mappo")


def make_teacher(name: str, vec: MultiliftVec) -> Policy:
    """Return the teacher of a name, a baseline or one's own module:Class, for environments."""
    return OwnPolicy(name, vec, "train.dagger.teacher") if ":" in name else make_scripted(name, vec)


class DaggerRollouts(LearningRollouts):
    """Flights whose steps the policy is fitted to the teacher's commands of; see `LearningRollouts`.

    Attributes:
        observed, taught: (S, N, D), (S, N, A) steps that are kept, and the teacher's commands in them.
        count: of steps so far; those beyond S have overwritten the oldest.

    Raises:
        ConfigError: a teacher that cannot fly these environments, or more steps than this machine's memory holds.
    """

    def __init__(self, env: MultiliftEnv, learner: Learner, total: int):
        super().__init__(env, learner, total)
        vec, train = env.vec, learner.config
        self._train, self._settings = train, train.dagger
        self._teacher = make_teacher(self._settings.teacher, with_truth(vec) if self._settings.truth else vec)
        size, n = min(self._settings.capacity, train.frames + vec.num_envs * train.horizon), vec.num_drones
        needed = 4 * size * n * (vec.observation_size + vec.action_size)
        if needed > (there := os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")):
            raise ConfigError(
                f"{size} steps take {needed / 1e9:.0f} GB, but this machine has {there / 1e9:.0f} GB; lower "
                "train.dagger.capacity"
            )
        self.observed = torch.zeros(size, n, vec.observation_size)
        self.taught = torch.zeros(size, n, vec.action_size)
        self.count = 0
        self._by_teacher: np.ndarray | None = None  # which episodes it flies

    def collect(self, iteration: int) -> Batches:
        """See `LearningRollouts.collect`."""
        self.start()
        vec, train = self.env.vec, self._train
        share = max(0.0, 1.0 - iteration * vec.num_envs * train.horizon / max(self._settings.handover, 1))
        share = max(share, self._settings.teacher_share)
        rng = np.random.default_rng(np.random.SeedSequence(vec.config.seed, spawn_key=(TEACHER, iteration)))
        if self._by_teacher is None:
            self._by_teacher = rng.uniform(size=vec.num_envs) < share
        rows: list[dict[str, np.ndarray]] = []
        observation, _ = vec.current()
        for _ in range(train.horizon):
            began = vec.ended
            taught = self._teacher.act(observation)
            self._keep(observation, taught, ~began)
            action = np.where(self._by_teacher[:, None, None], taught, self.act(observation))
            outcome = vec.step_live(action, restart=True)
            if began.any():
                self._teacher.reset(began)
                self._by_teacher[began] = rng.uniform(size=int(began.sum())) < share
            observation = outcome.observation.copy()
            rows.append(list_step(outcome, vec))
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
        recent = torch.arange(max(self.count - fresh, 0), self.count) % len(self.observed)
        learner.actor.normalizer.update(self.observed[recent])
        size = max(fresh // train.minibatches, 1)
        losses = []
        for _ in range(train.epochs * train.minibatches):
            chosen = torch.randint(kept, (size,))
            learner.optimizer.zero_grad(set_to_none=True)
            mean = learner.actor(self.observed[chosen])[0]
            loss = functional.smooth_l1_loss(mean, self.taught[chosen], beta=SMALL)
            loss.backward()
            parameters = [each for each in learner.actor.parameters() if each.grad is not None]
            torch.nn.utils.clip_grad_norm_(parameters, train.max_grad_norm)
            learner.optimizer.step()
            losses.append(loss.detach())
        return float(torch.stack(losses).mean())

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on in the episodes after those that were under way."""
        super().set_state(saved)
        self.env.vec.reset()
