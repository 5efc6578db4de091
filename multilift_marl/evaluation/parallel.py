"""Evaluation by several processes: each flies some of the episodes, as actors of Ray."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from multilift_marl import _ray
from multilift_marl._versions import find_versions
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.metrics import join_episodes
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.evaluation.trajectories import Recording, TrajectoryWriter, make_arrays
from multilift_marl.policies.policy import Policy

_PART, _RECORDED = 256, 32  # episodes of one task at most; of one that returns trajectories

_idle: list[_Worker] | None = None
"""Workers of earlier evaluations in a `cluster`, which keeps them."""


@contextmanager
def cluster(address: str, workers: int) -> Iterator[None]:
    """Be connected to Ray meanwhile, see `_ray.connect`; processes go from one evaluation to the next."""
    global _idle
    owns = _ray.connect(address, workers, "ray")
    _idle = []
    try:
        yield
    finally:
        for worker in _idle:
            worker.end()
        _idle = None
        if owns:
            _ray.disconnect()


class Evaluation(NamedTuple):
    """Which episodes a policy flies, and by how many processes; see `run_episodes`."""

    episodes: int
    seed: int
    workers: int = 0
    """Processes of Ray; 0: none but this one."""
    factors: Mapping[str, Any] | None = None


def divide_episodes(episodes: int, workers: int, most: int) -> list[tuple[int, int]]:
    """Return the first episode and the number of each part: `most`, or a worker's share so that all have something."""
    size = min(most, -(-episodes // workers))
    return [(first, min(size, episodes - first)) for first in range(0, episodes, size)]


def evaluate_parallel(
    config: Config, make_policy: Callable[[MultiliftVec], Policy], evaluation: Evaluation,
    progress: Callable[[int], Any] | None = None, writer: TrajectoryWriter | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Do as `run_episodes`, by actors of Ray, to which this process is connected; the metrics are the same.

    `writer` gets the trajectories, part by part.

    Raises:
        ConfigError, ValueError: see `run_episodes`.
    """
    import ray
    from ray import cloudpickle

    workers = evaluation.workers
    parts = divide_episodes(evaluation.episodes, workers, _PART if writer is None else _RECORDED)
    values = build_config(config.model_dump(), {"env.num_threads": 1}).model_dump(mode="json")
    # Once for all parts, and by value: what makes the policy may be a function of a script or a closure.
    task = ray.put(cloudpickle.dumps((values, make_policy, evaluation, writer is not None)))
    crew = [_idle.pop() if _idle else _Worker() for _ in parts[:workers]]
    waiting, flown, head = list(parts), dict[int, dict[str, np.ndarray]](), _ray.Head()
    try:
        while len(flown) < len(parts):
            for worker in crew:
                if worker.part is None and waiting:
                    worker.fly(task, waiting.pop(0))
            # A second at most, so that a head node or a worker that is gone is noticed.
            ray.wait([worker.result for worker in crew if worker.part is not None], timeout=1.0)
            head.check()
            for worker in crew:
                if worker.part is None or (found := worker.take()) is None:
                    continue
                (first, _), worker.part = worker.part, None
                flown[first], recorded = found
                if writer is not None:
                    writer.put(first, recorded)
                if progress is not None:
                    progress(sum(count for begin, count in parts if begin in flown))
    # Ctrl-C, too: no process is left behind.
    except BaseException:
        for worker in crew:
            worker.end()
        raise
    for worker in crew:
        if _idle is None:
            worker.end()
        else:
            _idle.append(worker)
    # In the order of the episodes, not in that in which parts came back.
    return join_episodes([flown[first] for first, _ in parts])


class _Worker:
    """A process of Ray that flies parts of evaluations; where it dies or falls silent, another one does its part.

    Attributes:
        part: that it flies: number of the first episode, and how many; None for none.
        result: of it, to be waited for.
    """

    def __init__(self) -> None:
        self._task: Any = None
        self._tries = 0
        self.part: tuple[int, int] | None = None
        self.result: Any = None
        self._begin()

    def _begin(self) -> None:
        import ray

        actor: Any = ray.remote(**_ray.ACTOR)(_Flyer)
        self._actor, self._pulse = actor.remote(os.getcwd(), list(sys.path)), _ray.Pulse("workers")

    def fly(self, task: Any, part: tuple[int, int]) -> None:
        """Begin with a part of a task, see `_fly_part`."""
        self._task, self.part, self._tries = task, part, 0
        self.result = self._actor.fly.remote(find_versions(), task, *part)

    def take(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]] | None:
        """Return the metrics and trajectories of its part once they are there.

        Raises:
            ConfigError: too many processes died of it, or one has not started; see also `run_episodes`.
        """
        import ray

        try:
            self._pulse.check(self._actor)
            if ray.wait([self.result], timeout=0)[0]:
                found: tuple[dict[str, np.ndarray], dict[str, np.ndarray]] = _ray.get(self.result)
                return found
        except (ray.exceptions.RayActorError, ray.exceptions.ObjectLostError, _ray.Silent):
            assert self.part is not None
            self.end()
            self._tries += 1
            if self._tries == _ray.TRIES:
                first, count = self.part
                raise ConfigError(
                    f"the worker of episodes {first} to {first + count - 1} died {_ray.TRIES} times in a row; give it "
                    "more memory, or set workers=0"
                ) from None
            self._begin()
            self.result = self._actor.fly.remote(find_versions(), self._task, *self.part)
        return None

    def end(self) -> None:
        """End its process, whatever that does."""
        import ray

        ray.kill(self._actor)


class _Flyer:
    """A process that evaluates, as an actor of Ray; see `enter_worker` for its arguments."""

    def __init__(self, folder: str, path: list[str]):
        _ray.enter_worker(folder, path)

    def pulse(self) -> int:
        """Return the number of this process, by a thread of its own: it runs."""
        return os.getpid()

    def fly(
        self, versions: dict[str, str], task: bytes, first: int, count: int
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Do as `_fly_part`, after `check_versions` of the caller's."""
        _ray.check_versions(versions)  # before what it may read otherwise
        return _fly_part(task, first, count)


def _fly_part(task: bytes, first: int, count: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Fly some episodes; return their metrics, and trajectories where these are asked for.

    Args:
        task: pickled configuration values, maker of the policy, Evaluation and whether trajectories are asked for.
        first, count: number of the first episode, and how many.
    """
    from ray import cloudpickle

    values, make_policy, evaluation, records = cloudpickle.loads(task)
    config = build_config(values, {})
    # Where the policy has brought torch along; others need not wait for its import.
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
    arrays = make_arrays(MultiliftVec(build_config(values, {"env.num_envs": 1})), count) if records else {}
    record = partial(Recording, arrays) if records else None
    flown = run_episodes(
        config, make_policy, count, evaluation.seed, first=first, factors=evaluation.factors, record=record
    )
    return flown, arrays
