"""Rollouts: environments that the current policy steps, and the noise that it explores with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from multilift_marl.agents.mappo import StochasticPolicy
from multilift_marl.envs.torchrl_env import MultiliftEnv

Batches = list[TensorDictBase]
"""Of each rig that is trained, E environments for T steps."""
NOISE = 3  # purpose of seeds, beside those of `envs/core.py`


def exploration_noise(seed: int, envs: range, iteration: int, shape: tuple[int, ...]) -> torch.Tensor:
    """Return the standard normal noise (T, E, N, A) of some environments in one iteration of a training.

    Each environment has a stream of its own for each iteration, so that its actions depend neither on how many others
    there are nor on which process simulates it.

    Args:
        seed: of the training.
        envs: numbers of the environments.
        iteration: of the training.
        shape: (T, N, A).
    """
    noise = np.empty((len(envs), *shape), np.float32)
    for row, e in zip(noise, envs, strict=True):
        sequence = np.random.SeedSequence(seed, spawn_key=(NOISE, e, iteration))
        np.random.Generator(np.random.PCG64(sequence)).standard_normal(out=row, dtype=np.float32)
    # Drawn environment by environment, used step by step.
    return torch.from_numpy(noise).transpose(0, 1).contiguous()


class Rollouts:
    """The rollouts of one process.

    Args:
        env: what is simulated; after the first batch it belongs to the collector.
        policy: that acts in it; its weights may change between two batches.
        horizon: T, steps of each environment in a batch.
        total: environments of the training, of which these are those from `env.vec.first_env` on.
        rigs: that share them.

    Attributes:
        env: as given.
    """

    def __init__(self, env: MultiliftEnv, policy: StochasticPolicy, horizon: int, total: int, rigs: int = 1):
        self.env, self._policy, self._horizon = env, policy, horizon
        self._total, self._rigs = total, rigs
        self._batches: Iterator[TensorDictBase] | None = None  # of the collector, once it has started
        self._restored = False

    def collect(self, iteration: int) -> Batches:
        """Return the next T steps of all environments, one batch of size [E, T]; valid until the next call."""
        self._start()
        assert self._batches is not None
        vec = self.env.vec
        envs = range(vec.first_env, vec.first_env + vec.num_envs)
        shape = (self._horizon, vec.num_drones, vec.action_size)
        self._policy.noise = iter(exploration_noise(vec.config.seed, envs, iteration, shape))
        return [next(self._batches)]

    def get_state(self) -> dict[str, torch.Tensor]:
        """Return all that later batches depend on beside the weights, environment first."""
        self._start()
        return self.env.get_state()

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on, before the first batch, from what `get_state` returned of as many environments.

        Raises:
            ValueError: see `MultiliftEnv.set_state`.
        """
        own = self.env.get_state()
        for key in ("world.system", "task_name"):  # which the first checkpoints do not hold
            saved.setdefault(key, own[key])
        self.env.set_state(saved)
        self._restored = True

    def close(self, at_once: bool = False) -> None:
        """Do nothing: there is no other process."""

    def _start(self) -> None:
        """Reset the environments, by the collector, when they are first needed."""
        if self._batches is not None:
            return
        vec = self.env.vec
        blank = torch.zeros(vec.num_envs, vec.num_drones, vec.action_size)
        # Not of any stream: an iteration's noise is the same whether its rollouts are the first of a process or not.
        self._policy.noise = iter([blank])  # the collector acts once to see what a policy writes
        collector = Collector(
            self.env,
            self._policy,
            frames_per_batch=vec.num_envs * self._horizon,
            total_frames=-1,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            return_same_td=True,  # a batch is used up before the next one
            device="cpu",
        )
        self._batches = iter(collector)
        if not self._restored:
            vec.stagger(self._total, self._rigs)


class Part(Protocol):
    """Rollouts of one rig, see `Rollouts`."""

    def collect(self, iteration: int) -> Batches:
        """See `Rollouts.collect`."""

    def get_state(self) -> dict[str, torch.Tensor]:
        """See `Rollouts.get_state`."""

    def set_state(self, saved: dict[str, Any]) -> None:
        """See `Rollouts.set_state`."""


class RigRollouts:
    """The rollouts of teams with different rigs, one after the other, with the interface of `Rollouts`.

    Args:
        parts: of each rig.
    """

    def __init__(self, parts: Sequence[Part]):
        self._parts = parts

    def collect(self, iteration: int) -> Batches:
        """Return the next T steps of all environments, a batch for each rig; valid until the next call."""
        return [batch for part in self._parts for batch in part.collect(iteration)]

    def get_state(self) -> dict[str, torch.Tensor]:
        """Return all that later batches depend on beside the weights, the keys of each rig after its number."""
        states = enumerate(part.get_state() for part in self._parts)
        return {f"{k}/{key}": tensor for k, state in states for key, tensor in state.items()}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on, before the first batch, from what `get_state` returned of the same rigs.

        Raises:
            ValueError: see `MultiliftEnv.set_state`.
        """
        for k, part in enumerate(self._parts):
            own = {key.partition("/")[2]: tensor for key, tensor in saved.items() if key.startswith(f"{k}/")}
            part.set_state(own)

    def close(self, at_once: bool = False) -> None:
        """Do nothing: there is no other process."""
