"""Evaluation by several processes: each flies some of the episodes, as tasks of Ray."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from multilift_marl import _ray
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.control.policy import Policy
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.evaluation.rollout import fly_episodes

_PART = 256  # episodes of one task at most


@contextmanager
def cluster(address: str, workers: int) -> Iterator[None]:
    """Be connected to Ray meanwhile; see `_ray.connect`."""
    owns = _ray.connect(address, workers, "ray")
    try:
        yield
    finally:
        if owns:
            _ray.disconnect()


def fly_apart(
    config: Config, make_policy: Callable[[MultiliftVec], Policy], episodes: int, seed: int, workers: int,
    progress: Callable[[int], Any] | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Do as `fly_episodes`, by tasks of Ray, to which this process is connected; the metrics are the same.

    Raises:
        ConfigError, ValueError: see `fly_episodes`.
    """
    import ray
    from ray import cloudpickle

    size = min(_PART, -(-episodes // workers))
    parts = [(first, min(size, episodes - first)) for first in range(0, episodes, size)]
    values = build_config(config.model_dump(), {"env.num_threads": 1}).model_dump(mode="json")
    here = os.getcwd(), list(sys.path)
    task = ray.remote(num_cpus=1, max_retries=2)(_fly_part)
    policy = ray.put(cloudpickle.dumps(make_policy))
    pending = [task.remote(values, policy, seed, first, count, *here) for first, count in parts]
    try:
        return _gather(pending, parts, progress)
    except BaseException as error:
        for result in pending:  # not by force: Ray aborts this process if such a task completes meanwhile
            ray.cancel(result)
        if isinstance(error, ray.exceptions.RayTaskError):
            raise error.cause from error
        raise


def _gather(
    pending: list[Any], parts: list[tuple[int, int]], progress: Callable[[int], Any] | None
) -> dict[str, np.ndarray]:
    """Return the joined results of all parts, and report as they come."""
    import ray

    waiting, done = list(pending), 0
    while waiting:
        ready, waiting = ray.wait(waiting)
        ray.get(ready)
        done += parts[pending.index(ready[0])][1]
        if progress is not None:
            progress(done)
    found = ray.get(pending)
    return {name: np.concatenate([part[name] for part in found]) for name in found[0]}


def _fly_part(
    values: dict[str, Any], policy: bytes, seed: int, first: int, count: int, folder: str, path: list[str]
) -> dict[str, np.ndarray]:
    """Fly some episodes in a process of Ray."""
    from ray import cloudpickle

    if os.path.isdir(folder):
        os.chdir(folder)
    sys.path += [each for each in path if each not in sys.path]
    config = build_config(values, {})
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
    return fly_episodes(config, cloudpickle.loads(policy), count, seed, first=first)
