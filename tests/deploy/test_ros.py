"""Bags: read back by another library's reader, in the formats of every distribution, and compared with the flight."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.cli import evaluate
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("rosbags")  # of the ros extra
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability

from multilift_marl.deploy.ros.bag import DISTRIBUTIONS, BagWriter
from multilift_marl.deploy.ros.messages import FlightMessages
from multilift_marl.deploy.ros.types import typestore


def rotation(q) -> np.ndarray:
    x, y, z, w = q.x, q.y, q.z, q.w
    assert x * x + y * y + z * z + w * w == pytest.approx(1)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def place(p) -> np.ndarray:
    return np.array([p.x, p.y, p.z])


def fly(folder: Path, steps: int = 20, distribution: str = "jazzy", names: str = "multilift", **overrides):
    """Write a bag, and return the states that it should hold by time [ns]."""
    vec = ml.make_vec("hover", num_envs=2, num_threads=1, num_drones=3, seed=3, **overrides)
    policy, states = make_scripted("formation", vec), {}
    observation, _ = vec.reset()

    def note(step: int) -> None:
        state = {name: array[0].copy() for name, array in vec.world.state._asdict().items()}
        state |= {"target": vec.task.goal.position[0].copy(), "reference": vec.reference.position[0].copy()}
        states[round(step * vec.task.dt * 1e9)] = state

    note(0)
    with BagWriter(folder, vec, distribution, names) as bag:
        for step in range(steps):
            observation, *_ = vec.step(policy.act(observation))
            bag.write((step + 1) * vec.task.dt)
            note(step + 1)
    return vec, states


def read(folder: Path) -> dict[str, list]:
    """Return all messages by topic, each with its time [ns]."""
    messages: dict[str, list] = {}
    with AnyReader([folder]) as reader:
        for connection, time, data in reader.messages():
            messages.setdefault(connection.topic, []).append((time, reader.deserialize(data, connection.msgtype), data))
    return messages


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_a_bag_holds_the_flight(distribution, tmp_path):
    _, states = fly(tmp_path / "bag", distribution=distribution)
    assert list((tmp_path / "bag").glob("*.db3" if distribution == "humble" else "*.mcap"))
    heard = read(tmp_path / "bag")
    once = {"/scene": 1} | {f"/drone_{n}/action": 20 for n in range(3)}
    assert {topic: len(messages) for topic, messages in heard.items()} == dict.fromkeys(heard, 21) | once
    for k, (time, state) in enumerate(states.items()):
        stamp, clock, _ = heard["/clock"][k]
        assert stamp == time == clock.clock.sec * 10**9 + clock.clock.nanosec
        bodies = [
            ("payload", *(state[f"payload_{part}"] for part in ("position", "rotation", "velocity", "body_rates")))
        ]
        for n in range(3):
            parts = ("position", "rotation", "velocity", "body_rates")
            bodies.append((f"drone_{n}", *(state[f"drone_{part}"][n] for part in parts)))
        transforms = heard["/tf"][k][1].transforms
        assert [each.child_frame_id for each in transforms] == [body[0] for body in bodies]
        for (frame, position, attitude, velocity, rates), transform in zip(bodies, transforms, strict=True):
            odometry = heard[f"/{frame}/odom"][k][1]
            assert (odometry.header.frame_id, odometry.child_frame_id) == ("world", frame)
            assert odometry.header.stamp.sec * 10**9 + odometry.header.stamp.nanosec == time
            np.testing.assert_array_equal(place(odometry.pose.pose.position), position)
            np.testing.assert_array_equal(place(transform.transform.translation), position)
            np.testing.assert_allclose(rotation(odometry.pose.pose.orientation), attitude, atol=1e-12)
            np.testing.assert_allclose(rotation(transform.transform.rotation), attitude, atol=1e-12)
            np.testing.assert_allclose(attitude @ place(odometry.twist.twist.linear), velocity, atol=1e-12)
            np.testing.assert_array_equal(place(odometry.twist.twist.angular), rates)
        np.testing.assert_array_equal(heard["/cables"][k][1].effort, state["cable_tension"])
        assert heard["/cables"][k][1].name == ["cable_0", "cable_1", "cable_2"]
        np.testing.assert_array_equal(place(heard["/target"][k][1].pose.position), state["target"])
        for n in range(3):
            pose = heard[f"/drone_{n}/reference"][k][1].pose
            np.testing.assert_array_equal(place(pose.position), state["reference"][n])
        (lines,) = heard["/markers"][k][1].markers
        assert len(lines.points) == 6
        assert all(0 <= getattr(m.color, part) <= 1 for m in [lines, *heard["/scene"][0][1].markers] for part in "rgba")


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_what_is_read_is_byte_for_byte_what_was_published(distribution, tmp_path):
    vec, states = fly(tmp_path / "bag", steps=1, distribution=distribution)
    store = typestore(DISTRIBUTIONS[distribution][0])
    messages = FlightMessages(vec, store)
    kinds = {topic.name: topic.kind for topic in messages.topics()}
    heard = read(tmp_path / "bag")
    for topic, message in messages.messages(max(states)):
        if topic != "/scene":  # of the start
            assert bytes(heard[topic][-1][2]) == bytes(store.serialize_cdr(message, kinds[topic]))


def test_the_reports_names_types_and_qualities_of_service(tmp_path):
    vec, _ = fly(tmp_path / "bag", names="report")
    heard = read(tmp_path / "bag")
    for i in range(1, 4):
        pose = heard[f"/simulation/position_drone_{i}"][-1][1]
        np.testing.assert_array_equal(place(pose.pose.position), vec.world.state.drone_position[0, i - 1])
    np.testing.assert_array_equal(
        place(heard["/payload_odom"][-1][1].pose.pose.position), vec.world.state.payload_position[0]
    )
    times = [message.data for _, message, _ in heard["/sync_time"]]  # [us], 20 Hz
    assert len(times) == 9 and min(np.diff(times)) >= 40_000 and times == sorted(times)
    with AnyReader([tmp_path / "bag"]) as reader:
        quality = {each.topic: each.ext.offered_qos_profiles[0] for each in reader.connections}
    assert quality["/payload_odom"].reliability == QosReliability.BEST_EFFORT and quality["/payload_odom"].depth == 1
    assert quality["/sync_time"].durability == QosDurability.TRANSIENT_LOCAL
    assert quality["/tf"].reliability == QosReliability.RELIABLE


@pytest.mark.parametrize("overrides", [{"payload.shape": "point"}, {"cable.model": "chain"}], ids=["point", "chain"])
def test_other_rigs_have_bags_too(overrides, tmp_path):
    vec, _ = fly(tmp_path / "bag", steps=3, **overrides)
    lines = read(tmp_path / "bag")["/markers"][-1][1].markers[-1]
    segments = 10 if "cable.model" in overrides else 1
    assert len(lines.points) == 2 * 3 * segments
    ends = np.array([place(point) for point in lines.points])
    length = np.linalg.norm(ends[1::2] - ends[::2], axis=1).reshape(3, segments).sum(axis=1)
    np.testing.assert_allclose(length, vec.world.parameters.cable_length[0], rtol=0.01)


def test_a_bag_is_never_overwritten(tmp_path):
    (tmp_path / "bag").mkdir()
    vec = ml.make_vec("hover", num_envs=1, num_threads=1)
    with pytest.raises(ConfigError, match=r"bag=.* is there already; give a folder that is not"):
        BagWriter(tmp_path / "bag", vec)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_bag_that_is_not_finished_is_kept_apart(tmp_path, error):
    vec = ml.make_vec("hover", num_envs=1, num_threads=1)
    for steps in (2, 1):
        with pytest.raises(error), BagWriter(tmp_path / "bag", vec) as bag:
            for k in range(steps):
                bag.write(0.02 * (k + 1))
            raise error
        assert [path.name for path in tmp_path.iterdir()] == ["bag_partial"]
        times = [time for time, *_ in read(tmp_path / "bag_partial")["/payload/odom"]]
        assert times == [20_000_000 * k for k in range(steps + 1)]
    with BagWriter(tmp_path / "bag", vec):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag", "bag_partial"]
    assert sorted(path.name for path in (tmp_path / "bag").iterdir()) == ["bag.mcap", "metadata.yaml"]


def test_the_command_writes_one(tmp_path, capsys):
    arguments = ["policy=formation", "config=hover", "episodes=1", "baseline=none", "env.episode_seconds=0.5"]
    assert evaluate.main([*arguments, f"out={tmp_path / 'out'}", f"bag={tmp_path / 'bag'}", "ros=humble"]) == 0
    assert f"wrote {tmp_path / 'bag'}" in capsys.readouterr().out
    times = [time for time, *_ in read(tmp_path / "bag")["/payload/odom"]]
    assert times == [20_000_000 * k for k in range(26)]  # the start, and 25 steps
    assert evaluate.main([*arguments, f"out={tmp_path / 'again'}", f"bag={tmp_path / 'bag'}"]) == 2
    assert "is there already" in capsys.readouterr().err and not (tmp_path / "again").exists()


def test_without_rosbags_the_command_says_what_to_install(tmp_path, capsys, monkeypatch):
    for name in [
        name for name in sys.modules if name.startswith(("rosbags", "multilift_marl.deploy.ros", "multilift_marl.ros"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    arguments = ["policy=formation", "config=hover", f"out={tmp_path / 'out'}", f"bag={tmp_path / 'bag'}"]
    assert evaluate.main(arguments) == 2
    error = capsys.readouterr().err
    assert "rosbags is missing" in error and '".[ros]"' in error
    assert not (tmp_path / "out").exists()
