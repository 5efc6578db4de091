"""The clock node: whose time it broadcasts, how often, and how far others are from it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from ros_wire import Wire

from multilift_marl.deploy.ros.clock_node import ClockNode
from multilift_marl.deploy.ros.messages import SYNC
from multilift_marl.deploy.ros.types import px4_namespace, vehicle_odometry

MS = 1_000_000  # [ns]


class Bench:
    """A clock node on a wire; the machine's time is that of the test."""

    def __init__(self, monkeypatch, patience: float = 0.0):
        self.wire, self.said, self.now = Wire(), [], 5 * 10**18
        monkeypatch.setattr("multilift_marl.deploy.ros.clock_node.time.monotonic", lambda: 1e-9 * self.now)
        self.node = ClockNode(2, self.wire, patience, lambda: self.now, self.said.append)

    def simulate(self, time_ns: int) -> None:
        clock = self.wire.store.types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        self.wire.queues["/clock"].append(self.wire.store.types["rosgraph_msgs/msg/Clock"](clock=clock))

    def sent(self) -> list[int]:
        return [message.data for message in self.wire.sent[SYNC.name]]


def test_without_a_simulation_it_is_the_machines_time_20_times_a_second(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(100):
        bench.now += 10 * MS
        bench.node.spin_once(0.01)
    assert len(bench.sent()) == pytest.approx(20, abs=1)
    assert (np.diff(bench.sent())[1:] == 50_000).all()
    assert bench.sent()[-1] <= bench.now // 1000 < bench.sent()[-1] + 50_000
    assert bench.said == ["the time is that of this machine"]


def test_the_time_of_a_simulation_counts_even_while_it_stands_still(monkeypatch):
    bench = Bench(monkeypatch, patience=3.0)
    bench.now += 1000 * MS
    bench.node.spin_once(0.01)
    assert not bench.sent()  # it waits
    for step in range(100):
        bench.simulate(20 * MS * step)
        bench.node.spin_once(0.01)
    bench.now += 60_000 * MS
    bench.node.spin_once(0.01)
    # of 1.98 s in steps of 20 ms, those that are the first in 50 ms
    assert bench.sent() == [1000 * 20 * -(-5 * k // 2) for k in range(1, 40)]
    assert bench.said == ["the time is that of /clock"]


def test_it_says_how_far_the_stamps_of_each_drone_are_from_it(monkeypatch):
    bench = Bench(monkeypatch)
    motion = (np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    for step in range(1, 10):
        bench.simulate(20 * MS * step)
        message = vehicle_odometry(bench.wire.store, 20 * MS * step - 7 * MS, motion)
        bench.wire.queues[f"{px4_namespace(0)}/out/vehicle_odometry"].append(message)
        bench.node.spin_once(0.01)
    offsets = bench.node.offsets()
    assert offsets[0] == pytest.approx(-0.007) and np.isnan(offsets[1])
