"""Rollouts by several processes: actors of Ray, each with its share of the environments, in step with the learner.

Each actor gets the weights, returns its rows of the batch and the state of its environments after it. An actor that
dies, or does not say any more that it is alive, is replaced; the new one goes on from the last state and simulates its
rows of the batch again, bit for bit.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from multilift_marl import _ray
from multilift_marl._platform import cpu_count
from multilift_marl._versions import find_versions
from multilift_marl.agents.mappo import StochasticPolicy, make_actor
from multilift_marl.agents.networks import Actor
from multilift_marl.agents.rollouts import Batches, Rollouts
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import TRAINING
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError

Arrays = dict[Any, np.ndarray]


class Workers:
    """The rollouts of K processes, with the interface of `Rollouts`.

    Args:
        config: of all environments; `train.workers` of it is K, `train.ray` the cluster.
        actor: the policy that learns.
        purpose: of the environments' seeds.

    Attributes:
        received: bytes of batches and states that the last batch brought here.

    Raises:
        ConfigError: no such cluster, or fewer environments than workers.
    """

    def __init__(self, config: Config, actor: Actor, purpose: int = TRAINING):
        count, total = config.train.workers, config.env.num_envs
        if total < count:
            raise ConfigError(f"train.workers={count} exceeds env.num_envs={total}; lower it or raise env.num_envs")
        self._owns = _ray.connect(config.train.ray, count, "train.ray")
        import ray

        self._ray, self._config, self._actor, self._purpose = ray, config, actor, purpose
        # Shares differ by one at most, and each environment keeps its number: results do not depend on K.
        self._bounds = [total * k // count for k in range(count + 1)]
        self._states: list[Arrays | None] = [None] * count  # after the last batch
        self._head = _ray.Head()
        self._pulses = [_ray.Pulse("train.workers") for _ in range(count)]
        self._built: list[Any] = [None] * count  # results of their building
        self._workers = [self._make(k) for k in range(count)]
        self.received = 0

    def collect(self, iteration: int) -> Batches:
        """Return the next T steps of all environments, one batch of size [E, T]."""
        weights = self._ray.put({name: tensor.numpy() for name, tensor in self._actor.state_dict().items()})
        pending = [worker.collect.remote(weights, iteration) for worker in self._workers]
        parts = []
        for k in range(len(pending)):
            part, self._states[k] = self._ask(k, lambda worker: worker.collect.remote(weights, iteration), pending[k])
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
                self._states[k] = self._ask(k, lambda worker: worker.get_state.remote())
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
        for k in range(len(self._workers)):
            rows = {key: tensor[self._bounds[k] : self._bounds[k + 1]].numpy() for key, tensor in saved.items()}
            self._ask(k, partial(_set_state, rows=rows))
            self._states[k] = rows

    def close(self, at_once: bool = False) -> None:
        """End the workers, and the cluster if it was started for them.

        Args:
            at_once: leave that to the end of this process, by `_interrupt.leave`: Ray, when it is asked to end, takes
                handlers of signals away.
        """
        if at_once:
            return
        for worker in self._workers:
            self._ray.kill(worker)
        self._workers = []
        if self._owns:
            _ray.disconnect()
        self._owns = False

    def _make(self, k: int) -> Any:
        """Return an actor for the k-th share of the environments."""
        first, end = self._bounds[k], self._bounds[k + 1]
        config, total = self._config, self._bounds[-1]
        threads = config.env.num_threads or max(1, cpu_count() // config.train.workers)
        values = build_config(
            config.model_dump(), {"env.num_envs": end - first, "env.num_threads": threads}
        ).model_dump(mode="json")
        worker: Any = self._ray.remote(**_ray.ACTOR)(_Worker).remote(os.getcwd(), list(sys.path))
        self._built[k] = worker.build.remote(values, first, total, self._purpose, find_versions())
        self._pulses[k] = _ray.Pulse("train.workers")
        return worker

    def _ask(self, k: int, ask: Callable[[Any], Any], pending: Any = None) -> Any:
        """Return what the k-th worker answers; where it dies, what another one in its place does.

        Args:
            k: number of the worker.
            ask: asks a worker.
            pending: the answer that it has been asked for already.
        """
        for _ in range(_ray.TRIES):
            try:
                return self._get(k, ask(self._workers[k]) if pending is None else pending)
            except (self._ray.exceptions.RayActorError, _ray.Silent):
                pending = None
                self._ray.kill(self._workers[k])
                self._workers[k] = self._make(k)
                # The state before this batch: the same rows come again, bit for bit.
                if self._states[k] is not None:
                    self._workers[k].set_state.remote(self._states[k])
        raise ConfigError(
            f"the worker of environments {self._bounds[k]} to {self._bounds[k + 1] - 1} died {_ray.TRIES} times in a "
            "row; give it more memory, or set train.workers=0"
        )

    def _get(self, k: int, result: Any) -> Any:
        """Return a result of the k-th worker.

        Raises:
            ConfigError: the cluster is lost, has no room for the worker, or cannot build its environments.
            Silent: the worker does not say that it is alive.
            Exception: what the worker itself raised.
        """
        if self._built[k] is not None:
            _ray.wait(self._built[k], lambda: self._check(k))
            _ray.get(self._built[k])
            self._built[k] = None
        _ray.wait(result, lambda: self._check(k))
        return _ray.get(result)

    def _check(self, k: int) -> None:
        """Refuse a cluster that is lost, and a worker that has not been heard of for too long."""
        self._head.check()
        self._pulses[k].check(self._workers[k])


def _set_state(worker: Any, rows: Arrays) -> Any:
    return worker.set_state.remote(rows)


class _Worker:
    """One process's share of the environments, as an actor of Ray.

    Args:
        folder, path: working folder and Python's path of the learner, for modules of one's own.
    """

    def __init__(self, folder: str, path: list[str]):
        _ray.enter_worker(folder, path)

    def pulse(self) -> int:
        """Return the number of this process, by a thread of its own: it runs."""
        return os.getpid()

    def build(self, values: dict[str, Any], first: int, total: int, purpose: int, versions: dict[str, str]) -> None:
        """Make the environments.

        Args:
            values: of their configuration.
            first: number of the first.
            total: environments of the training.
            purpose: of their seeds.
            versions: of the learner.

        Raises:
            ConfigError: versions here are others.
        """
        _ray.check_versions(versions)
        # Processes are the parallel part; threads of each would fight for the same cores.
        torch.set_num_threads(1)
        config = build_config(values, {})
        self._env = MultiliftEnv(config, purpose, first, config.train.gru)
        self._actor = make_actor(config.train, self._env.vec)
        self._rollouts = Rollouts(self._env, StochasticPolicy(self._actor), config.train.horizon, total)

    def collect(self, weights: Arrays, iteration: int) -> tuple[Arrays, Arrays]:
        """Return a batch's rows by key, and the state of the environments after it."""
        # Copied: arrays from Ray's store are read-only, and gone with it.
        self._actor.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in weights.items()})
        [batch] = self._rollouts.collect(iteration)
        return {key: tensor.numpy() for key, tensor in batch.items(True, True)}, self.get_state()

    def get_state(self) -> Arrays:
        """Return the state of the environments."""
        return {key: tensor.numpy() for key, tensor in self._rollouts.get_state().items()}

    def set_state(self, rows: Arrays) -> None:
        """Go on from a state."""
        self._rollouts.set_state({key: torch.from_numpy(array.copy()) for key, array in rows.items()})
