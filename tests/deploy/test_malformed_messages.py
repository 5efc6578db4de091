"""Bytes that are no messages, and messages that cannot be true, to every subscriber of every node."""

from __future__ import annotations

import logging
import os
import time

import numpy as np
import pytest
from mutate import mutate

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic as DdsTopic
from ros_wire import Wire
from test_policy_node_failures import Bench

import multilift_marl as ml
from multilift_marl.deploy.ros import __main__ as command
from multilift_marl.deploy.ros import dds
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER
from multilift_marl.deploy.ros.live import LiveFlight
from multilift_marl.deploy.ros.messages import BOOL, NAMES, ODOMETRY, FlightMessages, Topic, pose_stamped
from multilift_marl.deploy.ros.policy_node import FLYING, HOLDING, LANDING
from multilift_marl.deploy.ros.types import (
    ATTITUDE,
    FULL_STATE,
    PX4Setpoint,
    px4_namespace,
    read_measurement,
    read_odometry,
    read_pose,
    read_trajectory,
    trajectory_setpoint,
)

DOMAIN = 140 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
NO_TEXT = b"\xff\xfe\xc3\x28\x80"  # is not UTF-8, and as long as "world"


def odometry(bench: Bench, name: str = "/drone_0/odom"):
    """Return the message that is due on a topic, and what its topic is."""
    return dict(bench.messages.messages(bench.time_ns))[name]


# What a message may say


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("body", [0, 2], ids=["drone", "payload"])
def test_what_cannot_be_read_is_counted_said_once_and_flown_past(monkeypatch, caplog, names, body):
    bench = Bench(monkeypatch, names=names)
    bench.fly()
    topic = list(bench.wire.topics)[body]
    steps = bench.node.steps
    for _ in range(10):
        good = bench.wire.encode(topic, odometry(bench, topic))
        broken = good.replace(b"world", NO_TEXT) if b"world" in good else good[:-9]
        bench.wire.queues[topic] += [broken, b"", good[:20]]
        bench.pass_by()
    assert bench.node.mode == FLYING and bench.node.steps == steps + 10
    assert bench.wire.reader.left_out == {topic: 30}
    said = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert len(said) == 1 and f"what cannot be read on {topic} is left out" in said[0]


@pytest.mark.parametrize("stamp", [2**64 - 1, 2**63 // 1000 + 1, (2**31 - 1) * 10**6])
def test_stamps_that_no_clock_has_are_left_out(monkeypatch, stamp):
    bench = Bench(monkeypatch, names="report")
    bench.fly()
    topic = "/fmu/out/vehicle_odometry"
    for _ in range(round(HOLD_AFTER / 0.02) + 2):
        bad = odometry(bench, topic)
        bad.timestamp = stamp
        bench.wire.queues[topic].append(bad)
        bench.pass_by(silent=(topic,))
    assert bench.node.mode == HOLDING  # as if nothing had come
    bench.pass_by()
    assert bench.node.mode == FLYING


@pytest.mark.parametrize("seconds", [-1, -(2**31), 2**31 - 1])
def test_stamps_of_ros_that_have_no_answer_are_left_out(monkeypatch, seconds):
    bench = Bench(monkeypatch)
    bench.fly()
    for _ in range(30):
        for topic in ("/drone_0/odom", "/drone_1/odom", "/payload/odom"):
            bad = odometry(bench, topic)
            bad.header.stamp.sec = seconds
            bench.wire.queues[topic].append(bad)
        bench.pass_by(silent=("*",))
    assert bench.node.mode == HOLDING
    assert sum(bench.wire.reader.left_out.values()) == 90


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1.1e6])
@pytest.mark.parametrize("part", ["position", "linear", "angular", "orientation"])
def test_numbers_that_nothing_measures_are_left_out(part, value):
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7})
    message = dict(FlightMessages(vec, Wire.store).messages(0))["/payload/odom"]
    time_ns, motion = read_measurement(read_odometry, message)
    assert time_ns == 0
    np.testing.assert_allclose(motion[0], vec.world.state.payload_position[0])
    inside = message.pose.pose if part in ("position", "orientation") else message.twist.twist
    getattr(inside, part).y = value
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="a number is"):
        read_measurement(read_odometry, message)


def test_an_axis_that_is_not_controlled_leaves_the_others_alone():
    nan = np.nan
    asked = PX4Setpoint(np.array([nan, nan, 3.0]), np.array([1.0, 2.0, nan]), np.array([nan, 5.0, 6.0]), nan)
    message = trajectory_setpoint(Wire.store, 0, asked)
    setpoint = read_trajectory(message)
    np.testing.assert_array_equal(setpoint.position, [nan, nan, 3.0])
    np.testing.assert_array_equal(setpoint.velocity, [1.0, 2.0, nan])
    np.testing.assert_array_equal(setpoint.acceleration, [nan, 5.0, 6.0])
    message.yaw = np.inf
    with pytest.raises(ValueError, match="a number is inf"):
        read_trajectory(message)


def test_a_target_that_is_too_far_away_is_not_said_for_each_message(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    for _ in range(50):
        bench.tell("/target", [0.0, 0.0, 40.0])
        bench.pass_by(silent=("/target",))
    assert sum("is not taken" in text for text in bench.said) == 1


def test_bytes_of_others_cross_dds_and_the_flight_goes_on():
    """A peer whose text is no text, on the same topic as one that is sound."""
    here, there = Node(domain=DOMAIN), Node(domain=DOMAIN)
    topic = Topic("/payload/odom", ODOMETRY)
    take = here.subscription(topic)
    kind = dds._carrier(there._distribution, ODOMETRY)
    peer = there._participant
    writer = DataWriter(peer, DdsTopic(peer, "rt/payload/odom", kind), there._quality(topic))
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7})
    good = dict(FlightMessages(vec, there.store).messages(0))["/payload/odom"]
    carrier, heard = kind(), []
    end = time.monotonic() + 20
    sound = bytes(there.store.serialize_cdr(good, ODOMETRY))
    while (len(heard) < 3 or here.reader.left_out["/payload/odom"] < 3) and time.monotonic() < end:
        for data in (sound.replace(b"world", NO_TEXT), sound):  # Cyclone DDS itself keeps back what is too short
            carrier.data = data
            writer.write(carrier)
        time.sleep(0.005)
        heard += take()
    assert len(heard) >= 3 and here.reader.left_out["/payload/odom"] >= 3
    assert {message.header.frame_id for message in heard} == {"world"}


def test_the_command_says_in_the_end_how_many_were_left_out(capsys):
    wire = Wire()
    command._report_left_out(wire)
    assert capsys.readouterr().out == ""
    wire.reader.read(Topic("/b", ODOMETRY), lambda message: message, [b"", b"\x00"])
    wire.reader.read(Topic("/a", BOOL), lambda message: message, [b"\x00\x01"])
    command._report_left_out(wire)
    assert capsys.readouterr().out == "messages that could not be read: 1 on /a, 2 on /b\n"


# Ten thousand messages: 3,000 to either kind of policy node, 1,000 to either kind of simulation, the rest in
# test_malformed_mavlink.py


def good_messages(bench: Bench) -> dict[str, bytes]:
    """Return the bytes of what the node should hear, by topic."""
    heard = {name: message for name, message in bench.messages.messages(bench.time_ns) if name in bench.wire.topics}
    heard["/fly"] = bench.wire.store.types[BOOL](data=True)
    return {name: bench.wire.encode(name, message) for name, message in heard.items()}


@pytest.mark.parametrize("names", NAMES)
def test_no_message_ends_the_policy_node(monkeypatch, names):
    rng, sent, flown, benches = np.random.default_rng(0), 0, 0, []
    with np.errstate(all="raise", under="ignore"):
        while sent < 3000:
            if not benches or benches[-1].node.mode == LANDING:  # what is damaged may say so, and that is for good
                benches.append(Bench(monkeypatch, names=names))
                benches[-1].fly()
            bench = benches[-1]
            for name, data in good_messages(bench).items():
                count = 20 if name != "/fly" else int(rng.random() < 0.2)
                bench.wire.queues[name] += [mutate(rng, data) for _ in range(count)]
                sent += count
            for _ in range(10):
                bench.pass_by()
                assert np.isfinite(places_of(bench)).all() and np.abs(places_of(bench)).max() < 1e6
            assert bench.node.mode in (FLYING, LANDING)
            flown += bench.node.mode == FLYING
    left_out = sum(sum(bench.wire.reader.left_out.values()) for bench in benches)
    assert 500 < left_out < 2500 and flown > 20


def places_of(bench: Bench) -> np.ndarray:
    """Return the places of the last set-points of both drones."""
    names = bench.node._names
    if names.setpoints == FULL_STATE:
        sent = [bench.wire.sent[f"/cf{n}/cmd_full_state"][-1] for n in (1, 2)]
        return np.array([read_pose(message.pose)[0] for message in sent])
    if not names.is_report:
        return bench.places()
    return np.array([bench.wire.sent[f"{px4_namespace(n)}/in/trajectory_setpoint"][-1].position for n in range(2)])


def test_no_message_ends_the_simulation_of_places():
    fuzz_simulation("multilift", {f"/drone_{n}/setpoint": place_message for n in range(2)})


def test_no_message_ends_the_simulation_of_px4s():
    fuzz_simulation(
        "report",
        {f"{px4_namespace(n)}/in/trajectory_setpoint": motion_message for n in range(2)}
        | {f"{px4_namespace(n)}/in/vehicle_attitude_setpoint_v1": attitude_message for n in range(2)},
    )


def place_message(position):
    return pose_stamped(Wire.store, 0, position, np.eye(3))


def motion_message(position):
    return trajectory_setpoint(Wire.store, 0, PX4Setpoint(position, np.zeros(3), np.array([0.0, 0.0, 3.0]), 0.3))


def attitude_message(position):
    kind = Wire.store.types[ATTITUDE]
    return kind(
        timestamp=0, yaw_sp_move_rate=0.0, q_d=np.array([1, 0, 0, 0], np.float32),
        thrust_body=np.array([0, 0, -0.4], np.float32),
    )  # fmt: skip


def fuzz_simulation(names: str, make: dict) -> None:
    """Fly a team by damaged set-points, episode after episode; its state stays finite, and it hears sound ones."""
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7})
    wire, rng, sent = Wire(), np.random.default_rng(0), 0
    live = LiveFlight(vec, wire, names)
    with np.errstate(all="raise", under="ignore"):
        live.begin(3)
        while sent < 1000:
            for n, (name, message) in enumerate(make.items()):
                data = wire.encode(name, message(vec.task.goal.slots[0, n % 2]))
                wire.queues[name] += [mutate(rng, data) for _ in range(5)]
                sent += 5
            live.step()
            assert not vec.world.diverged.any()
            assert all(np.isfinite(array).all() for array in vec.world.state)
    assert 100 < sum(wire.reader.left_out.values()) < 900
    live.begin(3)
    for _ in range(100):
        for n, (name, message) in enumerate(make.items()):
            if "attitude" not in name:
                wire.queues[name].append(message(vec.task.goal.slots[0, n]))
        live.step()
    assert (live.answers.age < HOLD_AFTER).all()
    np.testing.assert_allclose(vec.world.state.drone_position[0], vec.task.goal.slots[0], atol=0.3)
