"""A node that broadcasts one time to all, /sync_time, and says how far the autopilots' clocks are from it."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.messages import INT64, SYNC, SYNC_EVERY, Topic
from multilift_marl.deploy.ros.types import (
    VEHICLE_ODOMETRY,
    px4_namespace,
    read_measurement,
    read_vehicle_odometry,
    stamp_ns,
)

CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock", False)
_REMEMBERED = 10_000
Say = Callable[[str], None]


class ClockNode:
    """Broadcasts the time of /clock, that of a simulation, or of the machine where none is heard, at 20 Hz.

    Once /clock has been heard it counts for good: a simulation may stand still.

    Args:
        num_drones: whose odometry is compared.
        node: publishes and subscribes.
        patience: for /clock, before the machine's time counts [s].
        machine: returns the machine's time [ns].
        say: called with what happens.

    Attributes:
        sent: how many times have been broadcast.
    """

    def __init__(
        self, num_drones: int, node: Node, patience: float = 0.0, machine: Callable[[], int] = time.time_ns,
        say: Say = print,
    ):  # fmt: skip
        self._node, self._patience, self._machine, self._say = node, patience, machine, say
        self._take_clock = node.subscription(CLOCK, lambda message: stamp_ns(message.clock))
        read = partial(read_measurement, read_vehicle_odometry)
        self._take_odometry = [
            node.subscription(Topic(f"{px4_namespace(i)}/out/vehicle_odometry", VEHICLE_ODOMETRY, False), read)
            for i in range(num_drones)
        ]
        self._publish = node.publisher(SYNC)
        self._offsets: list[list[int]] = [[] for _ in range(num_drones)]
        self._heard: int | None = None  # the last time of /clock [ns]
        self._since, self._said = time.monotonic(), ""
        self._synced = self.sent = 0

    def spin_once(self, seconds: float) -> None:
        """Wait for something new, for some seconds or half a period at most, and broadcast if that is due."""
        self._node.wait(min(seconds, SYNC_EVERY / 2))
        self._node.check_publishers()
        for time_ns in self._take_clock():
            self._heard = time_ns
        if self._heard is None and time.monotonic() < self._since + self._patience:
            return
        now = self._now()
        for offsets, take in zip(self._offsets, self._take_odometry, strict=True):
            offsets.extend(stamp - now for stamp, _ in take())
            del offsets[:-_REMEMBERED]
        due = now // round(SYNC_EVERY * 1e9)
        if due != self._synced:
            self._synced, self.sent = due, self.sent + 1
            self._publish(self._message(now))

    def spin(self, seconds: float) -> None:
        """Broadcast for some seconds of real time."""
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0:
            self.spin_once(left)

    def _now(self) -> int:
        source = "this machine" if self._heard is None else "/clock"
        if source != self._said:
            self._said = source
            self._say(f"the time is that of {source}")
        return self._machine() if self._heard is None else self._heard

    def _message(self, now: int) -> Any:
        return self._node.store.types[INT64](data=now // 1000)

    def offsets(self) -> np.ndarray:
        """Return the median of each drone's stamps beside the broadcast time (N,) [s], NaN where nothing is heard."""
        return np.array([1e-9 * np.median(each) if each else np.nan for each in self._offsets])
