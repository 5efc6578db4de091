"""The set-points that others send for a team: the newest of each drone, how old they are, and the wait for them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.deploy.ros.failsafe import HOLD_AFTER

Take = Callable[[], list[tuple[int, Any]]]
"""Returns the set-points of a drone that have come since the last call, each with its stamp [ns]; 0 is none."""


class Waiting(NamedTuple):
    """How a simulation waits for the set-points of others."""

    wait: Callable[[float], bool]
    """Waits for something new for some seconds at most, and says whether there is, see `Node.wait`."""
    asked: Callable[[], int]
    """Returns the stamp of the state that was published last [ns]; older set-points answer an older one."""
    patience: float
    """[s] of real time in each step."""
    first: float
    """[s] for the first ones of an episode."""


class Answers:
    """Set-points of others for N drones, asked for once in each step.

    Args:
        take: of each drone.
        period: of a step [s].
        waiting: how steps wait for others; None: not at all.

    Attributes:
        age: of each drone's last set-point (N,) [s], infinite before the first.
        late: steps in which a drone had none that was fresh (N,).
    """

    def __init__(self, take: Sequence[Take], period: float, waiting: Waiting | None = None):
        self._take, self._period, self._waiting = take, period, waiting
        self._kept: list[list[tuple[int, Any]]] = [[] for _ in take]
        self._newest: list[Any] = [None] * len(take)
        self._answered = np.zeros(len(take), bool)
        self._patient = True
        self.age, self.late = np.full(len(take), np.inf), np.zeros(len(take), int)

    def begin(self) -> None:
        """Begin an episode: what has come before, but for answers to the last state, does not count."""
        asked = np.inf if self._waiting is None else self._waiting.asked()
        self._kept = [[each for each in take() if each[0] >= asked] for take in self._take]
        self.age[:], self._patient = np.inf, True

    def hear(self) -> list[Any]:
        """Return each drone's newest set-point since the last call, None where nothing has come."""
        self.age += self._period
        self._answered[:] = False
        self._newest = [None] * len(self._take)
        self._read()
        if self._waiting is not None:
            self._wait(self._waiting)
        self.late += self.age > HOLD_AFTER
        return self._newest

    def _wait(self, waiting: Waiting) -> None:
        """Wait for answers to the last state: of all drones for the first, then of those that had one lately."""
        first = self._patient and not np.isfinite(self.age).all()
        self._patient = False
        end = time.monotonic() + (waiting.first if first else waiting.patience)
        while (~self._answered & (first | (self.age <= HOLD_AFTER))).any():
            if (rest := end - time.monotonic()) <= 0.0 or not waiting.wait(rest):
                return
            self._read()

    def _read(self) -> None:
        asked = 0 if self._waiting is None else self._waiting.asked()
        for n, take in enumerate(self._take):
            came, self._kept[n] = [*self._kept[n], *take()], []
            for stamp, setpoint in came:
                self._newest[n], self.age[n] = setpoint, 0.0
                self._answered[n] |= stamp == 0 or stamp >= asked
