"""What is measured of a team's bodies: the newest of each, how old it is, and when a policy step's worth is new."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from multilift_marl.deploy.ros.types import Motion

Source = Callable[[], list[tuple[int, Motion]]]
"""Returns the measurements that have come, each with its time [ns]."""
_FIELDS = ("position", "rotation", "velocity", "body_rates")
_EARLY = 1_000_000  # [ns] before its time that a measurement counts
_BACKWARD = 3  # messages in a row of an earlier time after which a clock is taken to have been set back


class Bodies:
    """The measurements of N drones and of the payload, each by a clock of its own.

    Args:
        sources: of each drone, then of the payload.
        period: between policy steps [s].

    Attributes:
        measured: fields of `SystemState` by name, of one environment; live.
        stamps: of the last measurement of each body (N + 1,) [ns], -1 before the first.
        arrivals: when it came, by this machine's clock (N + 1,) [s].
        refused: measurements of each body that were no newer than the last (N + 1,).
    """

    def __init__(self, sources: list[Source], period: float):
        self._sources, self._period = sources, round(period * 1e9)
        count = len(sources)
        shapes = ((3,), (3, 3), (3,), (3,))
        self.measured = {f"drone_{name}": np.zeros((count - 1, *s)) for name, s in zip(_FIELDS, shapes, strict=True)}
        self.measured |= {f"payload_{name}": np.zeros(s) for name, s in zip(_FIELDS, shapes, strict=True)}
        self.stamps, self._due, self._older = (np.full(count, start, np.int64) for start in (-1, 0, -1))
        self.arrivals, self.refused = np.full(count, -np.inf), np.zeros(count, int)
        self._behind = np.zeros(count, int)

    def poll(self, now: float) -> None:
        """Take in what has come, at a time by this machine's clock [s]."""
        for body, take in enumerate(self._sources):
            for time_ns, motion in take():
                if self._is_newer(body, time_ns):
                    self.stamps[body], self.arrivals[body] = time_ns, now
                    self._write(body, motion)
                else:
                    self.refused[body] += 1

    def _is_newer(self, body: int, time_ns: int) -> bool:
        """Whether a measurement is newer than the last; a clock that was set back is believed after some messages."""
        if time_ns > self.stamps[body]:
            self._behind[body] = 0
            return True
        # Messages out of order come singly among newer ones; those of a clock that was set back rise among themselves.
        self._behind[body] = self._behind[body] + 1 if time_ns > self._older[body] else 0
        self._older[body] = time_ns
        if self._behind[body] < _BACKWARD:
            return False
        self._due[body], self._older[body], self._behind[body] = time_ns, -1, 0
        return True

    def _write(self, body: int, motion: Motion) -> None:
        for name, part in zip(_FIELDS, motion, strict=True):
            if body < len(self.stamps) - 1:
                self.measured[f"drone_{name}"][body] = part
            else:
                self.measured[f"payload_{name}"][:] = part

    def are_due(self) -> bool:
        """Whether all have been measured a policy step, each by its own clock, after the last one that was taken."""
        return bool((self.stamps >= np.maximum(self._due - _EARLY, 0)).all())

    def take_step(self) -> None:
        """Note that a policy step uses what is known: the next one is due a period later, on average."""
        half = self._period // 2
        # A period after it was due, so that lateness does not add up, but at least half of one after what was measured.
        self._due = np.clip(self._due + self._period, self.stamps + half, self.stamps + self._period)

    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [m] and velocities [m/s] of all bodies (N + 1, 3)."""
        parts = ((self.measured[f"drone_{name}"], self.measured[f"payload_{name}"]) for name in _FIELDS[::2])
        position, velocity = (np.concatenate([drones, payload[None]]) for drones, payload in parts)
        return position, velocity

    def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) [m] and rotation (3, 3) of a body."""
        if body < len(self.stamps) - 1:
            return self.measured["drone_position"][body], self.measured["drone_rotation"][body]
        return self.measured["payload_position"], self.measured["payload_rotation"]

    def missing(self, now: float, age: float) -> list[str]:
        """Return, in words, the bodies of which nothing has been heard for longer than `age` [s]."""
        last = len(self.stamps) - 1
        return [f"drone {body}" if body < last else "the payload" for body in self.silent(now, age)]

    def silent(self, now: float, age: float) -> list[int]:
        """Return the bodies, drones first, of which nothing has been heard for longer than `age` [s]."""
        return np.flatnonzero(now - self.arrivals > age).tolist()
