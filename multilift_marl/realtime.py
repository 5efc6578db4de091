"""A simulation in step with the clock on the wall, and how well it keeps to it."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

_LATE = 0.1  # [s] that a simulation may catch up with
_REMEMBERED = 1_000_000  # steps of which the lateness is known
QUANTILES = (50.0, 99.0, 99.9)  # [%]


class RealTime:
    """Holds a simulation back to a real-time factor; where it is late by more than 0.1 s, it goes on from there.

    Args:
        speed: the factor; 0 holds nothing back.

    Attributes:
        slips: how often it was too late to catch up.
    """

    def __init__(self, speed: float):
        self.speed = speed
        self.slips = 0
        self._begin: float | None = None
        self._late: deque[float] = deque(maxlen=_REMEMBERED)

    def wait(self, seconds: float) -> None:
        """Wait until `seconds` of the simulation may have passed."""
        if not self.speed:
            return
        now = time.perf_counter()
        if self._begin is None:
            self._begin = now - seconds / self.speed
        due = self._begin + seconds / self.speed
        if due > now:
            time.sleep(due - now)
        late = time.perf_counter() - due
        self._late.append(late)
        if late > _LATE:
            self._begin += late
            self.slips += 1

    def lateness(self) -> np.ndarray:
        """Return how late steps began (3,) [s]: median and quantiles of 99 and 99.9 %; NaN before the first."""
        return np.percentile(self._late, QUANTILES) if self._late else np.full(len(QUANTILES), np.nan)
