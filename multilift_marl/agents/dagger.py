"""Imitation of a planner that sees more than the drones do: `train.algorithm=dagger` (Ross et al., AISTATS 2011).

The network flies, and learns what the teacher would have commanded at each step in the teacher's place; at first the
teacher flies most episodes itself. The teacher may know the true states (`train.dagger.truth`) and read what no
drone observes: what the network makes of it rests on each drone's own observation alone. All steps are kept, up to
`train.dagger.capacity`, and learned from again and again. They are not saved, nor is what a teacher plans: a training
that is resumed begins new episodes, and collects anew before it learns on.
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
from multilift_marl.agents.rollouts import Batches, RigRollouts
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.policy import OwnPolicy, Policy
from multilift_marl.policies.truth import with_truth
from multilift_marl.schema.training import TrainConfig

SMALL = 0.05
"""[-] differences of actions below which they are squared: above it the network takes sides, and no mean."""
REFILL = 20
"""Batches that a resumed training collects first, at most as many as there were and half of those to come: few steps
alone would be overfitted."""
TEACHER = 4  # purpose of seeds, beside those of `envs/core.py` and `rollouts.NOISE`


def check_dagger(train: TrainConfig) -> None:
    """Refuse, by a ConfigError, what cannot be learned from a teacher."""
    for key in ("gru", "workers", "stages"):
        if getattr(train, key):
            raise ConfigError(f"train.algorithm=dagger has no train.{key}; leave it out, or take mappo")


def make_teacher(name: str, vec: MultiliftVec) -> Policy:
    """Return the teacher of a name, a baseline or one's own module:Class, for environments."""
    if ":" in name:
        return OwnPolicy(name, vec, "train.dagger.teacher")
    try:
        return make_scripted(name, vec)
    except ConfigError as error:
        raise ConfigError(f"train.dagger.teacher={name} cannot teach here: {error}") from None


def taken_numbers(learner: Learner) -> torch.Tensor:
    """Return which numbers of an observation (U,) the policy takes."""
    actor = learner.actor
    taken = (actor.base != 0).any(0)
    if actor.used is None:
        taken[:] = True
    else:
        taken |= actor.used.reshape(len(taken), -1).any(1)
    return taken.nonzero()[:, 0]


class TaughtFlights(LearningRollouts):
    """Flights of one rig, whose steps are kept with the teacher's commands in them; see `LearningRollouts`.

    Args:
        capacity: S, steps that are kept.

    Attributes:
        observed, taught: (S, N, U), (S, N, A) the numbers that the policy takes of the steps that are kept, and the
            teacher's commands in them.
        count: of steps so far; those beyond S have overwritten the oldest.

    Raises:
        ConfigError: a teacher that cannot fly these environments.
    """

    def __init__(self, env: MultiliftEnv, learner: Learner, total: int, capacity: int):
        super().__init__(env, learner, total)
        vec, settings = env.vec, learner.config.dagger
        self._settings, self._horizon = settings, learner.config.horizon
        self._teacher = make_teacher(settings.teacher, with_truth(vec) if settings.truth else vec)
        self._taken = taken_numbers(learner)
        self.observed = torch.zeros(capacity, vec.num_drones, len(self._taken))
        self._newest = torch.zeros(self.fresh, vec.num_drones, vec.observation_size)
        self.taught = torch.zeros(capacity, vec.num_drones, vec.action_size)
        self.count = 0
        self._by_teacher: np.ndarray | None = None  # which episodes it flies

    def share(self, iteration: int) -> float:
        """Return the share of episodes that the teacher flies if they begin in an iteration."""
        steps, handover = iteration * self._total * self._horizon, self._settings.handover
        return max(1.0 - steps / handover if handover else 0.0, self._settings.teacher_share)

    def collect(self, iteration: int) -> Batches:
        """Fly the next steps of all environments, keep them, and return them as one batch of size [E, T]."""
        self.start()
        vec, share = self.env.vec, self.share(iteration)
        seed = np.random.SeedSequence([vec.config.seed, vec.first_env], spawn_key=(TEACHER, iteration))
        rng = np.random.default_rng(seed)
        if self._by_teacher is None:
            self._teacher.reset()
            self._by_teacher = rng.uniform(size=vec.num_envs) < share
        rows: list[dict[str, np.ndarray]] = []
        observation, _ = vec.current()
        for _ in range(self._horizon):
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
        return [join_steps(rows, vec)]

    def _keep(self, observation: np.ndarray, taught: np.ndarray, mask: np.ndarray) -> None:
        """Keep the steps of the environments in the mask."""
        count = int(mask.sum())
        seen = torch.from_numpy(observation[mask])
        self._newest[(self.count + np.arange(count)) % len(self._newest)] = seen
        at = (self.count + np.arange(count)) % len(self.observed)
        self.observed[at] = seen[..., self._taken]
        self.taught[at] = torch.from_numpy(taught[mask].astype(np.float32))
        self.count += count

    @property
    def fresh(self) -> int:
        """Steps of all environments in a batch."""
        return self.env.vec.num_envs * self._horizon

    def newest(self) -> torch.Tensor:
        """Return what drones observed in the last steps that were kept, as many as a batch has."""
        return self._newest[: self.count]

    def draw(self, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return observations (size, N, D) and the teacher's commands (size, N, A) of steps that are kept, drawn.

        What the policy does not take of the observations is 0.
        """
        chosen = torch.randint(min(self.count, len(self.observed)), (size,))
        observed = torch.zeros(size, *self._newest.shape[1:])
        observed[..., self._taken] = self.observed[chosen]
        return observed, self.taught[chosen]

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on in the episodes after those that were under way."""
        super().set_state(saved)
        self._begin()


class DaggerRollouts(LearningRollouts):
    """Flights of all rigs, on which one policy is fitted to the teacher's commands; see `LearningRollouts`.

    Args:
        envs: of each rig.

    Attributes:
        flights: of each rig; each keeps as many steps.

    Raises:
        ConfigError: a teacher that cannot fly these environments, or more steps than this machine's memory holds.
    """

    begins_anew = True

    def __init__(self, envs: list[MultiliftEnv], learner: Learner, total: int):
        super().__init__(envs[0], learner, total)
        self._train = train = learner.config
        capacity = min(train.dagger.capacity, train.frames + total * train.horizon) // len(envs)
        vecs = [env.vec for env in envs]
        kept = len(taken_numbers(learner)) + vecs[0].action_size
        needed = 4 * capacity * kept * sum(vec.num_drones for vec in vecs)
        if needed > (there := os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")):
            raise ConfigError(
                f"{capacity * len(envs)} steps take {needed / 1e9:.0f} GB, but this machine has {there / 1e9:.0f} GB; "
                "lower train.dagger.capacity"
            )
        self.flights = [TaughtFlights(env, learner, total, max(capacity, 1)) for env in envs]
        self._all = RigRollouts(self.flights)
        self._learns_from: int | None = None  # iteration

    def collect(self, iteration: int) -> Batches:
        """See `LearningRollouts.collect`; a batch for each rig."""
        batches = self._all.collect(iteration)
        begin = time.perf_counter()
        torch.set_num_threads(self._train.threads)
        if self._learns_from is None:
            to_come = -(-self._train.frames // (self._total * self._train.horizon)) - iteration
            self._learns_from = iteration + min(iteration, REFILL, to_come // 2) - 1
        loss = self._learn() if iteration >= self._learns_from else {}
        torch.set_num_threads(1)
        share = self.flights[0].share(iteration)
        self.values = loss | {"teacher_share": share, "learning_seconds": time.perf_counter() - begin}
        return batches

    def _learn(self) -> dict[str, float]:
        """Fit the policy to what is kept, `epochs` times as many steps as a batch has; return the loss by its name."""
        learner, train = self._learner, self._train
        for flights in self.flights:
            learner.actor.normalizer.update(flights.newest())
        losses = []
        for _ in range(train.epochs * train.minibatches):
            learner.optimizer.zero_grad(set_to_none=True)
            parts = [self._fit(*flights.draw(max(flights.fresh // train.minibatches, 1))) for flights in self.flights]
            parameters = [each for each in learner.actor.parameters() if each.grad is not None]
            torch.nn.utils.clip_grad_norm_(parameters, train.max_grad_norm)
            learner.optimizer.step()
            losses.append(torch.stack(parts).sum())
        return {"loss": float(torch.stack(losses).mean())}

    def _fit(self, observed: torch.Tensor, taught: torch.Tensor) -> torch.Tensor:
        """Add the gradient of a rig's share of the loss; return that share."""
        mean = self._learner.actor(observed)[0]
        loss = functional.smooth_l1_loss(mean, taught, beta=SMALL) / len(self.flights)
        loss.backward()
        return loss.detach()

    def get_state(self) -> dict[str, torch.Tensor]:
        """See `RigRollouts.get_state`."""
        return self._all.get_state()

    def set_state(self, saved: dict[str, Any]) -> None:
        """See `RigRollouts.set_state`."""
        self._all.set_state(saved)
