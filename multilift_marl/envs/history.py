"""Observations of several steps: `env.history`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from multilift_marl.kernels.jit import bind, kernel


class History:
    """What was observed some steps ago, beside what is observed now.

    Args:
        observation: (E, N, D) float32 of the present step, overwritten by each.
        ages: H, how many steps ago each of the observations is, rising from 0.

    Attributes:
        stacked: (E, N, H D) float32, the newest first; `observation` itself where H = 1.
        past: (E, P, N, D) of the last P steps, in a ring; none where H = 1.
        newest: (E,) its row of the last step.
    """

    def __init__(self, observation: np.ndarray, ages: tuple[int, ...]):
        self._observation, self._ages = observation, np.array(ages)
        several, (e, n, d) = len(ages) > 1, observation.shape
        self.stacked = np.tile(observation, len(ages)) if several else observation
        self.past = np.zeros((e, ages[-1] + 1 if several else 0, n, d), np.float32)
        self.newest = np.zeros(e, np.int64)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what later steps depend on beside `stacked`, by name."""
        return {"past": self.past, "newest": self.newest} if len(self._ages) > 1 else {}

    def begin(self, e: int) -> None:
        """Let environment e have observed from ever what it observes now."""
        self.past[e] = self._observation[e]
        self.stacked[e] = np.tile(self._observation[e], len(self._ages))

    def bind(self, lo: int, hi: int) -> Callable[[], Any] | None:
        """Return what takes in a step of environments lo to hi; None where nothing is to be done."""
        if len(self._ages) == 1:
            return None
        return bind(stack, lo, hi, self._observation, self._ages, self.past, self.newest, self.stacked)


@kernel
def stack(lo, hi, observation, ages, past, newest, stacked):
    """Put the observations (E, N, D) into the ring, and those of all ages into `stacked`; see `History`."""
    depth, size = past.shape[1], observation.shape[2]
    for e in range(lo, hi):
        now = (newest[e] + 1) % depth
        newest[e] = now
        for n in range(observation.shape[1]):
            for k in range(size):
                past[e, now, n, k] = observation[e, n, k]
            for j in range(ages.shape[0]):
                row = (now - ages[j]) % depth
                for k in range(size):
                    stacked[e, n, j * size + k] = past[e, row, n, k]
