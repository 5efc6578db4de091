"""Shards of a world at work at once, each on a thread of its own."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

Shard = TypeVar("Shard")


class Threads:
    """Threads that are made when they are first needed, and anew after a fork, which none survives."""

    def __init__(self) -> None:
        self._pool: tuple[int, ThreadPoolExecutor] | None = None  # with its process

    def run(self, work: Callable[[Shard], None], shards: Sequence[Shard]) -> None:
        """Call `work` for every shard; return, or raise what one has raised, when none runs any more."""
        # The main thread takes the first shard itself: one thread fewer, and none at all for one shard.
        if len(shards) == 1:
            return work(shards[0])
        if self._pool is None or self._pool[0] != os.getpid():
            self._pool = os.getpid(), ThreadPoolExecutor(len(shards) - 1, thread_name_prefix="multilift")
        others: list[Future[None]] = []
        try:
            for shard in shards[1:]:
                others.append(self._pool[1].submit(work, shard))
            work(shards[0])
        finally:
            try:
                wait(others)
            finally:
                wait(others)  # Ctrl-C has ended the first one
        for other in others:
            other.result()
