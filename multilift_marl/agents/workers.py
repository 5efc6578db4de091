"""Rollouts by several processes: actors of Ray, each with its share of the environments, in step with the learner.

Each actor gets the weights, returns its rows of the batch and the state of its environments after it. An actor that
dies is replaced; the new one goes on from the last state and simulates its rows of the batch again, bit for bit.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from multilift_marl import _ray
from multilift_marl._platform import STOPPING, cpu_count
from multilift_marl.agents.mappo import StochasticPolicy, make_actor
from multilift_marl.agents.networks import Actor
from multilift_marl.agents.rollouts import Batches, Rollouts
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError

Arrays = dict[Any, np.ndarray]
_TRIES = 3  # actors that may die in a row for the same rows


class Workers:
    """The rollouts of K processes, with the interface of `Rollouts`.

    Args:
        config: of all environments; `train.workers` of it is K, `train.ray` the cluster.
        actor: the policy that learns.

    Attributes:
        received: bytes of batches and states that the last batch brought here.

    Raises:
        ConfigError: no such cluster, or fewer environments than workers.
    """

    def __init__(self, config: Config, actor: Actor):
        count, total = config.train.workers, config.env.num_envs
        if total < count:
            raise ConfigError(f"train.workers={count} exceeds env.num_envs={total}; lower it or raise env.num_envs")
        self._owns = _ray.connect(config.train.ray, count, "train.ray")
        import ray

        self._ray, self._config, self._actor = ray, config, actor
        self._bounds = [total * k // count for k in range(count + 1)]
        self._states: list[Arrays | None] = [None] * count  # after the last batch
        self._workers = [self._make(k) for k in range(count)]
        self.received = 0

    def collect(self, iteration: int) -> Batches:
        """Return the next T steps of all environments, one batch of size [E, T]."""
        weights = self._ray.put({name: tensor.numpy() for name, tensor in self._actor.state_dict().items()})
        pending = [worker.collect.remote(weights, iteration) for worker in self._workers]
        parts = []
        for k in range(len(pending)):
            part, self._states[k] = self._await(k, pending[k], weights, iteration)
            parts.append(part)
        self.received = sum(array.nbytes for part in (*parts, *self._states) for array in (part or {}).values())
        joined = {key: torch.from_numpy(np.concatenate([part[key] for part in parts])) for key in parts[0]}
        size = (self._bounds[-1], self._config.train.horizon)
        batch = TensorDict({}, size)
        for key, tensor in joined.items():
            batch[key] = tensor
        return [batch]

    def get_state(self) -> dict[str, torch.Tensor]:
        """Return all that later batches depend on beside the weights, environment first."""
        for k, state in enumerate(self._states):
            if state is None:
                self._states[k] = self._ray.get(self._workers[k].get_state.remote())
        states = [state for state in self._states if state is not None]
        return {key: torch.from_numpy(np.concatenate([state[key] for state in states])) for key in states[0]}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Go on from what `get_state` returned of as many environments, of any number of workers.

        Raises:
            ValueError: see `MultiliftEnv.set_state`.
        """
        total = self._bounds[-1]
        for key, tensor in saved.items():
            if not isinstance(tensor, torch.Tensor) or tensor.dim() == 0 or len(tensor) != total:
                raise ValueError(f"the saved state does not fit: '{key}' has no row for each of {total} environments")
        for k, worker in enumerate(self._workers):
            rows = {key: tensor[self._bounds[k] : self._bounds[k + 1]].numpy() for key, tensor in saved.items()}
            try:
                self._ray.get(worker.set_state.remote(rows))
            except self._ray.exceptions.RayTaskError as error:
                raise ValueError(str(error.cause)) from error
            self._states[k] = rows

    def close(self) -> None:
        """End the workers, and the cluster if it was started for them."""
        for worker in self._workers:
            self._ray.kill(worker)
        self._workers = []
        if self._owns:
            _ray.disconnect()

    def _make(self, k: int) -> Any:
        """Return an actor for the k-th share of the environments."""
        first, end = self._bounds[k], self._bounds[k + 1]
        config, total = self._config, self._bounds[-1]
        threads = config.env.num_threads or max(1, cpu_count() // config.train.workers)
        values = build_config(
            config.model_dump(), {"env.num_envs": end - first, "env.num_threads": threads}
        ).model_dump(mode="json")
        actor = self._ray.remote(num_cpus=1, max_restarts=0)(_Worker)
        return actor.remote(values, first, total, os.getcwd(), list(sys.path))

    def _await(self, k: int, result: Any, weights: Any, iteration: int) -> tuple[Arrays, Arrays]:
        """Return what a worker collected; where it dies, what another one in its place does."""
        for _ in range(_TRIES):
            try:
                found: tuple[Arrays, Arrays] = self._ray.get(result)
                return found
            except self._ray.exceptions.RayActorError:
                self._workers[k] = self._make(k)
                state = self._states[k]
                if state is not None:
                    self._workers[k].set_state.remote(state)
                result = self._workers[k].collect.remote(weights, iteration)
        raise ConfigError(
            f"the worker of environments {self._bounds[k]} to {self._bounds[k + 1] - 1} died {_TRIES} times in a row; "
            "give it more memory, or set train.workers=0"
        )


class _Worker:
    """One process's share of the environments, as an actor of Ray.

    Args:
        values: of the configuration of its environments.
        first: number of its first environment.
        total: environments of the training.
        folder, path: working folder and Python's path of the learner, for modules of one's own.
    """

    def __init__(self, values: dict[str, Any], first: int, total: int, folder: str, path: list[str]):
        for number in STOPPING:
            if number != signal.SIGTERM:  # Ctrl-C reaches all processes of a terminal; the learner ends its workers
                signal.signal(number, signal.SIG_IGN)
        if os.path.isdir(folder):
            os.chdir(folder)
        sys.path += [each for each in path if each not in sys.path]
        torch.set_num_threads(1)
        config = build_config(values, {})
        self._env = MultiliftEnv(config, first_env=first, memory=config.train.gru)
        self._actor = make_actor(config.train, self._env.vec)
        self._rollouts = Rollouts(self._env, StochasticPolicy(self._actor), config.train.horizon, total)

    def collect(self, weights: Arrays, iteration: int) -> tuple[Arrays, Arrays]:
        """Return a batch's rows by key, and the state of the environments after it."""
        self._actor.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in weights.items()})
        [batch] = self._rollouts.collect(iteration)
        return {key: tensor.numpy() for key, tensor in batch.items(True, True)}, self.get_state()

    def get_state(self) -> Arrays:
        """Return the state of the environments."""
        return {key: tensor.numpy() for key, tensor in self._rollouts.get_state().items()}

    def set_state(self, rows: Arrays) -> None:
        """Go on from a state."""
        self._rollouts.set_state({key: torch.from_numpy(array.copy()) for key, array in rows.items()})
