"""A live simulation on DDS, between two processes on the loopback: what arrives, set-points, lost ones."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.errors import ConfigError

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")

from multilift_marl.deploy.ros import __main__ as command
from multilift_marl.deploy.ros.answers import Waiting
from multilift_marl.deploy.ros.bag import DISTRIBUTIONS
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER, LAND_AFTER
from multilift_marl.deploy.ros.live import LiveFlight, SetPoints, read_stamped
from multilift_marl.deploy.ros.messages import FlightMessages, Topic
from multilift_marl.deploy.ros.types import read_place, typestore

DOMAIN = 100 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
ODOMETRY = Topic("/payload/odom", "nav_msgs/msg/Odometry")
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock")


def start(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "multilift_marl.ros", f"domain={DOMAIN}", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def setpoint(store, place, time_ns: int = 0):
    new = store.types
    header = new["std_msgs/msg/Header"](
        stamp=new["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9), frame_id="world"
    )
    pose = new["geometry_msgs/msg/Pose"](
        position=new["geometry_msgs/msg/Point"](*(float(x) for x in place)),
        orientation=new["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    return new["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)


def until(condition, seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.005)
    return False


@pytest.mark.slow
def test_another_process_hears_the_flight_as_it_was():
    node = Node(domain=DOMAIN)
    take, clock = node.subscription(ODOMETRY), node.subscription(CLOCK)
    heard, times = [], []
    process = start("config=hover", "policy=formation", "seconds=7", "env.num_drones=2", "payload.mass=0.7")
    try:
        assert until(lambda: (heard.extend(take()), times.extend(clock()), process.poll() is not None)[2])
        heard += take()
    finally:
        process.kill()
    output, error = process.communicate()
    assert process.returncode == 0, error
    assert "for this machine alone" in output and "steps began late by" in output
    assert len(heard) > 20 and len(times) > 20  # the first are lost until the two have found each other
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in heard]
    assert stamps == sorted(stamps) and (np.diff(stamps) % 20_000_000 == 0).all()

    from multilift_marl.envs.core import EVALUATION, MultiliftVec
    from multilift_marl.policies.baselines import make_scripted

    config = ml.load_config(
        "hover", {"env.num_envs": 1, "env.num_threads": 1, "env.num_drones": 2, "payload.mass": 0.7}
    )
    vec = MultiliftVec(config, EVALUATION)
    observation, _ = vec.reset(seed=1000)
    policy, expected = make_scripted("formation", vec), {0: vec.world.state.payload_position[0].copy()}
    for step in range(1, 351):
        observation, *_ = vec.step(policy.act(observation))
        expected[step * 20_000_000] = vec.world.state.payload_position[0].copy()
    for stamp, message in zip(stamps, heard, strict=True):
        place = message.pose.pose.position
        np.testing.assert_array_equal([place.x, place.y, place.z], expected[stamp])


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_dds_carries_the_bytes_of_the_bags(distribution):
    types = DISTRIBUTIONS[distribution][0]
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=3)
    vec.reset(seed=0)
    sender, receiver = Node(types, DOMAIN), Node(types, DOMAIN)
    messages = FlightMessages(vec, sender.store)
    topics = messages.topics()
    takes = {topic.name: receiver.subscription(topic) for topic in topics}
    publish = {topic.name: sender.publisher(topic) for topic in topics}
    kinds, store, heard = {topic.name: topic.kind for topic in topics}, typestore(types), {}
    sent = dict(messages.messages(1_020_000_000))

    def exchange() -> bool:
        for name, message in sent.items():
            if name not in heard:
                publish[name](message)
        for name, take in takes.items():
            for message in take():
                heard[name] = message
        return len(heard) == len(sent)

    assert until(exchange, 20), set(sent) - set(heard)
    for name, message in heard.items():
        assert bytes(store.serialize_cdr(message, kinds[name])) == bytes(store.serialize_cdr(sent[name], kinds[name]))


@pytest.mark.slow
def test_others_fly_the_team_by_set_points():
    vec = ml.make_vec(
        "hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7, "env.episode_seconds": 20}
    )
    here, there = Node(domain=DOMAIN), Node(domain=DOMAIN)
    flight = LiveFlight(vec, here)
    flight.begin(3)
    topics = [Topic(f"/drone_{n}/setpoint", "geometry_msgs/msg/PoseStamped", False) for n in range(2)]
    publish = [there.publisher(topic) for topic in topics]
    places = vec.task.goal.slots[0] + [0.2, 0.1, 0.15]

    def fly() -> bool:
        for n in range(2):
            publish[n](setpoint(there.store, places[n], flight.time_ns))
        time.sleep(0.002)
        flight.step()
        return flight.time_ns > 8e9

    assert until(fly)
    np.testing.assert_allclose(vec.world.state.drone_position[0], places, atol=0.15)
    assert np.linalg.norm(vec.world.state.drone_position[0] - vec.task.goal.slots[0], axis=1).min() > 0.15
    assert flight.answers.age.max() < HOLD_AFTER


def test_lost_set_points_are_held_and_then_the_team_sinks():
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7})
    vec.reset(seed=3)
    store = typestore(DISTRIBUTIONS["jazzy"][0])
    start_places = vec.world.state.drone_position[0].copy()
    queue = [[], []]

    def taker(n: int):
        return lambda: [read_stamped(queue[n].pop())] if queue[n] else []

    points = SetPoints(vec, [taker(0), taker(1)])
    points.reset()
    points.act(None)
    np.testing.assert_allclose(points._place, start_places)  # before the first: where it is
    wanted = start_places + [0.1, 0.0, 0.0]
    for n in range(2):
        queue[n].append(setpoint(store, wanted[n]))
    points.act(None)
    np.testing.assert_allclose(points._place, wanted)
    steps = round(LAND_AFTER / vec.task.dt)
    for _ in range(steps - 1):
        points.act(None)
    np.testing.assert_allclose(points._place, wanted)  # held
    for _ in range(51):
        points.act(None)
    np.testing.assert_allclose(points._place[:, 2], wanted[:, 2] - 0.4, atol=0.01)  # one second at 0.4 m/s
    assert points.answers.late.min() >= steps - round(HOLD_AFTER / vec.task.dt)
    with pytest.raises(ValueError, match="a number is nan"):  # rubbish is no set-point
        read_place(setpoint(store, [np.nan, 0, 0]))


class Others:
    """Answers of others, which come while a step waits: lists of (drone, stamp, x) for each call of `wait`."""

    def __init__(self, *arriving):
        self.arriving, self.queue, self.waited = list(arriving), [[], []], []

    def take(self, n):
        def taken():
            came, self.queue[n] = self.queue[n], []
            return came

        return taken

    def wait(self, seconds):
        self.waited.append(seconds)
        if not self.arriving:
            return False
        for n, stamp, x in self.arriving.pop(0):
            self.queue[n].append((stamp, (np.array([x, 0.0, 1.0]), np.eye(3))))
        return True


def test_a_step_waits_for_the_answers_to_its_state():
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7})
    vec.reset(seed=3)
    # the first ones are waited for; then an old answer, which does not do, and the new ones; then those without a stamp
    new = [(0, 10, 2.0), (1, 20, 3.0)], [(0, 25, 3.0)], [(0, 0, 4.0), (1, 0, 4.0)]
    others = Others([(1, 10, 1.0)], *new)
    asked = [10]
    points = SetPoints(vec, [others.take(n) for n in range(2)], Waiting(others.wait, lambda: asked[0], 5.0, 60.0))
    here = np.array([1.0, 0.0, 1.0])
    others.queue[0] += [
        (5, (np.zeros(3), np.eye(3))),
        (10, (here, np.eye(3))),
    ]  # of an earlier phase; an answer
    others.queue[1] += [(5, (np.zeros(3), np.eye(3)))]
    points.reset()
    for stamp, x, left in ((10, 1.0, 3), (20, 3.0, 1), (30, 4.0, 0)):
        asked[0] = stamp
        points.act(None)
        assert points._place[:, 0].tolist() == [x, x] and len(others.arriving) == left
        assert (points.answers.age == 0).all() and not points.answers.late.any()
    assert others.waited[0] > 50 and max(others.waited[1:]) <= 5.0
    points.act(None)  # nobody answers: it goes on when the time is over
    assert len(others.waited) == 5 and (points.answers.age > 0).all()


def test_nobody_is_waited_for_who_has_been_silent():
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7})
    vec.reset(seed=3)
    others = Others()
    points = SetPoints(vec, [others.take(n) for n in range(2)], Waiting(others.wait, lambda: 0, 5.0, 60.0))
    points.reset()
    for _ in range(3):
        points.act(None)
    assert len(others.waited) == 1  # for the first ones, once
    for n in range(2):
        others.queue[n].append((0, (np.zeros(3), np.eye(3))))
    steps = round(HOLD_AFTER / vec.task.dt)
    for _ in range(steps + 10):
        points.act(None)
    assert len(others.waited) == 1 + steps


def test_set_points_need_the_interface_of_places():
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, **{"control.action": "ctbr"})
    with pytest.raises(ConfigError, match=r"control\.action=reference, not ctbr"):
        SetPoints(vec, [])


def test_the_command_says_how_it_went(capsys):
    assert command.main(["policy=none", "seconds=0.5", "speed=0", f"domain={DOMAIN}", "env.num_drones=2"]) == 0
    output = capsys.readouterr().out
    assert "simulated 0.5 s" in output and "steps without a fresh set-point, by drone: [25, 25]" in output


@pytest.mark.parametrize("names", ["report", "crazyswarm2"])
def test_autopilots_fly_whatever_the_action_interface(names, capsys):
    wait = ["policy=none", "seconds=0.1", "speed=0", f"domain={DOMAIN}", "env.num_drones=2"]
    assert command.main([*wait, "config=hover_ctbr", f"names={names}"]) == 0
    assert "simulated 0.1 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["policy=none", "control.action=rotor", "seconds=0.1"], "control.action=reference, not rotor"),
        (["domain=300"], "domain"),
        (["policy=formations"], "unknown policy 'formations'"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(arguments, words, capsys):
    assert command.main([f"domain={DOMAIN}", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def warnings_of(node: Node, caplog, seconds: float = 20.0) -> list[str]:
    """Let a node look for other publishers until it has found some; return what it says."""

    def look() -> bool:
        node._look_at = 0.0
        node.check_publishers()
        return any("several nodes" in record.message for record in caplog.records)

    until(look, seconds)
    found = [record.message for record in caplog.records if "several nodes" in record.message]
    caplog.clear()
    return found


@pytest.mark.slow
def test_other_publishers_of_the_same_team_are_named_once(caplog):
    own, peer, listener = (Node(domain=DOMAIN + 40) for _ in range(3))
    setpoints = Topic("/drone_0/setpoint", "geometry_msgs/msg/PoseStamped")
    shared = Topic("/tf", "tf2_msgs/msg/TFMessage")
    keep = [own.publisher(setpoints), own.publisher(shared), own.publisher(CLOCK), peer.publisher(shared)]
    keep += [listener.subscription(setpoints), listener.subscription(shared)]
    assert warnings_of(own, caplog, 1.0) == warnings_of(listener, caplog, 1.0) == []
    keep.append(peer.publisher(setpoints))  # a second policy
    for node in (own, peer, listener):
        (said,) = warnings_of(node, caplog)
        assert "publish /drone_0/setpoint, so that two may fly one team; end one" in said
        assert warnings_of(node, caplog, 0.2) == []


@pytest.mark.slow
def test_a_node_that_takes_the_place_of_another_is_no_second_one(caplog):
    listener, first = Node(domain=DOMAIN + 41), Node(domain=DOMAIN + 41)
    take = listener.subscription(ODOMETRY)
    keep = [first.publisher(ODOMETRY), take]
    assert warnings_of(listener, caplog, 0.5) == []
    assert until(lambda: len(listener._publishers.read(100, listener._alive)) == 1, 20)
    del keep[0], first
    gc.collect()
    assert until(lambda: not listener._publishers.read(100, listener._alive), 20)
    second = Node(domain=DOMAIN + 41)
    keep.append(second.publisher(ODOMETRY))
    assert until(lambda: len(listener._publishers.read(100, listener._alive)) == 1, 20)
    assert warnings_of(listener, caplog, 0.5) == []
