"""Rollouts that a policy learns in on the way: what those of different algorithms have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict

from multilift_marl.agents.mappo import Learner
from multilift_marl.agents.rollouts import Batches
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.step_kernels import Outcome
from multilift_marl.envs.torchrl_env import MultiliftEnv


class LearningRollouts(ABC):
    """With the interface of `Rollouts`.

    Class attributes:
        begins_anew: whether `set_state` discards the episodes that were under way.

    Args:
        env: what is simulated.
        learner: whose actor flies, and learns.
        total: environments of the training.

    Attributes:
        env: as given.
        values: numbers to log of the last batch.
    """

    begins_anew: ClassVar[bool] = False

    def __init__(self, env: MultiliftEnv, learner: Learner, total: int):
        self.env, self.values = env, dict[str, float]()
        self._learner, self._total = learner, total
        self._started = False

    @abstractmethod
    def collect(self, iteration: int) -> Batches:
        """Fly the next steps of all environments, learn, and return them as one batch of size [E, T]."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's actions (E, N, A), without exploration."""
        with torch.no_grad():
            action: np.ndarray = self._learner.actor(torch.from_numpy(observation))[0].clamp(-1, 1).numpy()
        return action

    def start(self) -> None:
        """Begin episodes, unless there are any."""
        if not self._started:
            self._begin(self.env.vec.config.seed)

    def _begin(self, seed: int | None = None) -> None:
        """Begin episodes, those of a seed or the next ones, at different times."""
        self.env.vec.reset(seed=seed)
        self.env.vec.stagger(self._total, len(self._learner.config.rigs) or 1)
        self._started = True

    def get_state(self) -> dict[str, torch.Tensor]:
        """See `Rollouts.get_state`."""
        self.start()
        return self.env.get_state()

    def set_state(self, saved: dict[str, Any]) -> None:
        """See `Rollouts.set_state`."""
        self.env.set_state(saved)
        self._started = True

    def close(self, at_once: bool = False) -> None:  # noqa: B027 (nothing to close is no omission)
        """Do nothing: there is no other process."""


def list_step(outcome: Outcome, vec: MultiliftVec) -> dict[str, np.ndarray]:
    """Return copies of what `join_steps` takes of a step."""
    terminated, truncated, success, failure, diverged = outcome.flags
    return {
        "reward": outcome.reward[..., None].copy(), "done": (terminated | truncated)[:, None].copy(),
        "reward_terms": vec.task.terms.copy(), "success": success[:, None].copy(),
        "failure": failure[:, None].copy(), "diverged": diverged[:, None].copy(),
    }  # fmt: skip


def join_steps(rows: list[dict[str, np.ndarray]], vec: MultiliftVec) -> TensorDict:
    """Return steps as a batch [E, T], as of TorchRL's collector."""
    joined = {name: torch.from_numpy(np.stack([row[name] for row in rows], axis=1)) for name in rows[0]}
    size = [vec.num_envs, len(rows)]
    info = TensorDict({name: joined[name] for name in ("reward_terms", "success", "failure", "diverged")}, size)
    agents = TensorDict({"reward": joined["reward"]}, size)
    return TensorDict({"next": TensorDict({"agents": agents, "done": joined["done"], "info": info}, size)}, size)
