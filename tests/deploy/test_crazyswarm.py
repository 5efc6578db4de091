"""Crazyswarm2's topics: messages by their published definitions, frames, and a team flown by full-state set-points."""

from __future__ import annotations

import os
import struct
import time

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.math3d import thrust_frame
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from cyclonedds.core import Policy
from cyclonedds.qos import Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from cyclonedds.util import duration
from ros_wire import Wire
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_malformed_messages import fuzz_simulation
from test_policy_node import config_of, fly_together, until_heard

from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.deploy.ros import dds
from multilift_marl.deploy.ros.bag import BagWriter
from multilift_marl.deploy.ros.crazyswarm import ServerOdometry, full_state, named_poses, server_odometry
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.live import LiveFlight
from multilift_marl.deploy.ros.messages import ODOMETRY, POSE, FlightMessages
from multilift_marl.deploy.ros.policy_node import FLYING, PolicyNode
from multilift_marl.deploy.ros.types import FULL_STATE, NAMED_POSES, PX4Setpoint, read_measurement, typestore

DOMAIN = 180 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
PUBLISHED = {  # IMRCLab/crazyswarm2 at f6154e2, IMRCLab/motion_capture_tracking at 35adc3e
    "crazyflie_interfaces/msg/FullState": (
        ("header", "std_msgs/Header"), ("pose", "geometry_msgs/Pose"), ("twist", "geometry_msgs/Twist"),
        ("acc", "geometry_msgs/Vector3"),
    ),
    "motion_capture_tracking_interfaces/msg/NamedPose": (("name", "string"), ("pose", "geometry_msgs/Pose")),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": (("header", "std_msgs/Header"), ("poses", "NamedPose[]")),
}  # fmt: skip
TWO = {"env.num_drones": 2, "payload.mass": 0.7}
ATTITUDE = np.array(thrust_frame((0.3, -0.5, 2.0), 0.7)).reshape(3, 3)
MOTION = np.array([1.0, 2.0, 3.0]), ATTITUDE, np.array([0.4, -0.5, 0.6]), np.array([0.1, 0.2, -0.3])


def make_team():
    """Return a simulation of two drones on a wire, which full states fly, after its start."""
    vec, wire = MultiliftVec(config_of(**TWO, **{"env.episode_seconds": 60}), EVALUATION), Wire()
    live = LiveFlight(vec, wire, "crazyswarm2")
    live.begin(3)
    nominal = {"payload_mass": 0.7, "payload_force": np.zeros(3)}
    vec.reset(seed=3, options={"randomization": nominal})
    return vec, wire, live


def hover(vec, wire, live, places, carried: float, yaw: float = 0.0, steps: int = 400) -> None:
    """Ask both drones to hover at places (2, 3), with a share of the nominal force on their cables in `acc`."""
    load = LoadFeedforward(vec.config.system)
    for _ in range(steps):
        for n in range(2):
            rise = carried * load.acceleration(n, np.zeros(3), np.zeros(3), vec.task.goal.cable_force[0, n], yaw)
            message = full_state(wire.store, 0, PX4Setpoint(places[n], np.zeros(3), rise, yaw, 0.0))
            wire.queues[f"/cf{n + 1}/cmd_full_state"].append(message)
        live.step()


# Messages


@pytest.mark.parametrize("distribution", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
@pytest.mark.parametrize("kind", PUBLISHED)
def test_types_are_those_that_are_published(distribution, kind):
    published = get_typestore(distribution)
    for name, fields in PUBLISHED.items():
        text = "\n".join(f"{field_type} {field}" for field, field_type in fields)
        published.register(get_types_from_msg(text, name))
    ours = typestore(distribution)
    assert ours.hash_rihs01(kind) == published.hash_rihs01(kind)
    assert ours.generate_msgdef(kind) == published.generate_msgdef(kind)


def test_bytes_are_those_of_a_full_state():
    """CDR by hand: header of 4 bytes, stamp, text with its length and final zero, then numbers of 8 bytes."""
    rise, yaw = np.array([0.7, 0.8, 0.9]), np.pi / 2
    message = full_state(Wire.store, 5_000_000_007, PX4Setpoint(MOTION[0], MOTION[2], rise, yaw, 0.25))
    data = bytes(Wire.store.serialize_cdr(message, FULL_STATE))
    assert data[:4] == b"\0\1\0\0"
    assert struct.unpack_from("<iII6s", data, 4) == (5, 7, 6, b"world\0")
    numbers = np.frombuffer(data[4 + 24 :], "<f8")  # the text ends at 18, doubles begin at a multiple of 8
    half = np.sqrt(0.5)
    expected = [1, 2, 3, 0, 0, half, half, 0.4, -0.5, 0.6, 0, 0, 0.25, 0.7, 0.8, 0.9]
    np.testing.assert_allclose(numbers, expected, atol=1e-15)


def test_bytes_are_those_of_named_poses():
    still = MOTION[0], np.eye(3), np.zeros(3), np.zeros(3)
    message = named_poses(Wire.store, 0, {"payload": still, "cf1": still})
    data = bytes(Wire.store.serialize_cdr(message, NAMED_POSES))[4:]
    assert struct.unpack_from("<I", data, 20) == (2,)
    assert struct.unpack_from("<I8s", data, 24) == (8, b"payload\0")
    assert struct.unpack_from("<7d", data, 40) == (1, 2, 3, 0, 0, 0, 1)
    assert struct.unpack_from("<I4s", data, 96) == (4, b"cf1\0")
    assert struct.unpack_from("<7d", data, 104) == (1, 2, 3, 0, 0, 0, 1) and len(data) == 160


def test_topics_are_those_of_the_server_and_of_motion_capture(tmp_path):
    vec = MultiliftVec(config_of(**TWO), EVALUATION)
    vec.reset(seed=3)
    topics = {topic.name: topic for topic in FlightMessages(vec, Wire.store, "crazyswarm2").topics()}
    kinds = {name: topic.kind for name, topic in topics.items() if topic.kind in (NAMED_POSES, ODOMETRY)}
    drones = {"/cf1/odom": ODOMETRY, "/cf2/odom": ODOMETRY}
    assert kinds == {"/poses": NAMED_POSES, "/payload/odom": ODOMETRY, **drones}
    assert topics["/cf1/pose"].kind == topics["/cf2/pose"].kind == POSE
    # rclcpp's SensorDataQoS of /poses, 10 messages, reliable, of the server's
    assert not topics["/poses"].reliable and topics["/poses"].deadline == 0.01
    assert all(topics[name].reliable for name in ("/cf1/pose", "/cf2/odom", "/payload/odom"))
    with BagWriter(tmp_path / "bag", vec, names="crazyswarm2"):
        pass
    with AnyReader([tmp_path / "bag"]) as reader:
        heard = {c.topic: reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()}
    frames = ["payload", "cf1", "cf2"]
    assert [each.child_frame_id for each in heard["/tf"].transforms] == frames
    assert [each.name for each in heard["/poses"].poses] == frames
    for n, name in enumerate(("cf1", "cf2")):
        place = vec.world.state.drone_position[0, n]
        for pose in (heard["/poses"].poses[n + 1].pose, heard[f"/{name}/pose"].pose, heard[f"/{name}/odom"].pose.pose):
            np.testing.assert_array_equal([pose.position.x, pose.position.y, pose.position.z], place)


def test_a_subscription_like_the_servers_hears_the_poses():
    """Best effort, with a deadline of 100 Hz: DDS connects it to none that offers a longer one."""
    node, peer = Node(domain=DOMAIN), Node(domain=DOMAIN)
    vec = MultiliftVec(config_of(**TWO), EVALUATION)
    live = LiveFlight(vec, node, "crazyswarm2", make_scripted("formation", vec))
    participant, kind = peer._participant, dds._carrier(peer._distribution, NAMED_POSES)
    quality = Qos(
        Policy.Reliability.BestEffort, Policy.Deadline(duration(milliseconds=10)), Policy.History.KeepLast(1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )  # fmt: skip
    reader = DataReader(participant, DdsTopic(participant, "rt/poses", kind), quality)
    live.begin(3)
    heard, end = [], time.monotonic() + 20
    while not heard and time.monotonic() < end:
        live._send()
        time.sleep(0.01)
        heard = [sample for sample in reader.take(10) if isinstance(sample, kind)]
    poses = peer.store.deserialize_cdr(heard[0].data, NAMED_POSES).poses
    assert [pose.name for pose in poses] == ["payload", "cf1", "cf2"]


def test_odometry_of_the_server_has_velocities_of_the_world_and_no_rates():
    message = server_odometry(Wire.store, 0, MOTION)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    assert [linear.x, linear.y, linear.z] == [0.4, -0.5, 0.6] and message.child_frame_id == ""
    assert [angular.x, angular.y, angular.z] == [0, 0, 0]
    time_ns, (position, rotation, velocity, rates) = read_measurement(ServerOdometry(), message)
    assert time_ns == 0
    for found, expected in zip((position, rotation, velocity, rates), (*MOTION[:3], np.zeros(3)), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-15)


def test_odometry_with_a_child_frame_is_in_that_frame():
    message = server_odometry(Wire.store, 0, MOTION)
    message.child_frame_id, message.twist.twist.angular.y = "cf1", 0.5
    _, rotation, velocity, rates = ServerOdometry()(message)
    np.testing.assert_allclose(velocity, rotation @ MOTION[2])
    np.testing.assert_array_equal(rates, [0, 0.5, 0])


def spun(rates: np.ndarray, seconds: float) -> np.ndarray:
    """Return the attitude after a turn at constant body rates, by Rodrigues' formula."""
    angle = np.linalg.norm(rates) * seconds
    x, y, z = rates / np.linalg.norm(rates)
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return ATTITUDE @ (np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across)


def test_body_rates_follow_from_attitudes():
    read, rates = ServerOdometry(), np.array([0.5, -1.0, 2.0])
    found = []
    for k in range(5):
        motion = MOTION[0], spun(rates, 0.02 * k), MOTION[2], rates
        found.append(read(server_odometry(Wire.store, 20_000_000 * k, motion))[3])
    np.testing.assert_array_equal(found[0], 0)
    np.testing.assert_allclose(found[1:], [rates] * 4, rtol=1e-3)
    late = read(server_odometry(Wire.store, 10**9, (MOTION[0], np.eye(3), *MOTION[2:])))[3]
    np.testing.assert_array_equal(late, 0)  # the last attitude is too old
    turned = server_odometry(Wire.store, 1_020_000_000, (MOTION[0], spun(rates, 0.1), *MOTION[2:]))
    turned.pose.pose.orientation.w = np.nan
    assert np.isnan(read(turned)[1]).all()
    following = server_odometry(Wire.store, 1_040_000_000, (MOTION[0], np.eye(3), *MOTION[2:]))
    np.testing.assert_array_equal(read(following)[3], 0)  # what was no attitude is not differenced


# Set-points


def test_full_states_are_flown_with_their_heading():
    vec, wire, live = make_team()
    places = vec.task.goal.slots[0] + [0.3, -0.2, 0.1]
    hover(vec, wire, live, places, 1.0, yaw=0.4)
    np.testing.assert_allclose(vec.world.state.drone_position[0], places, atol=0.05)  # the payload swings below
    rotation = vec.world.state.drone_rotation[0]
    np.testing.assert_allclose(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]), 0.4, atol=0.05)
    assert (live.answers.late == 0).all()


def test_without_the_cables_force_in_acc_drones_sink_by_what_the_loops_stiffness_gives():
    """At rest m k_p e = F: nothing but the position error holds the cable."""
    vec, wire, live = make_team()
    slots = vec.task.goal.slots[0].copy()
    hover(vec, wire, live, slots, 0.0, steps=600)
    gains, masses = vec.controller.gains, vec.config.system.drone_mass
    weight = 0.7 * 9.81 / 2
    sunk = slots[:, 2] - vec.world.state.drone_position[0, :, 2]
    np.testing.assert_allclose(sunk, weight / (masses * np.asarray(gains.k_p)), rtol=0.1)


def test_a_full_state_moves_on_and_turns_between_set_points():
    vec, wire, live = make_team()
    start, speed = vec.task.goal.slots[0].copy(), np.array([0.0, 0.1, 0.4])
    for n in range(2):
        message = full_state(wire.store, 0, PX4Setpoint(start[n], speed, np.array([0.0, 0.0, 4.0]), 0.3, 0.25))
        wire.queues[f"/cf{n + 1}/cmd_full_state"].append(message)
    for _ in range(6):
        live.step()
    reference = vec.reference
    np.testing.assert_allclose(reference.position[0], start + 0.12 * speed, atol=0.004)
    np.testing.assert_array_equal(reference.velocity[0], [speed] * 2)
    np.testing.assert_array_equal(reference.acceleration[0], [[0, 0, 4.0]] * 2)
    np.testing.assert_allclose(reference.yaw[0], 0.3)
    np.testing.assert_array_equal(reference.yaw_rate[0], 0.25)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.1e6])
@pytest.mark.parametrize("part", ["position", "orientation", "linear", "angular", "acc"])
def test_malformed_full_states_are_left_out(part, value):
    vec, wire, live = make_team()
    still = np.zeros(3), np.zeros(3), 0.0, 0.0
    good = full_state(wire.store, 0, PX4Setpoint(vec.task.goal.slots[0, 0], *still))
    bad = full_state(wire.store, 0, PX4Setpoint(np.full(3, 9.0), *still))
    inside = {"position": bad.pose, "orientation": bad.pose, "acc": bad}.get(part, bad.twist)
    getattr(inside, part).y = value
    wire.queues["/cf1/cmd_full_state"] += [good, bad, wire.encode("/cf1/cmd_full_state", good)[:-9], b""]
    live.step()
    assert wire.reader.left_out == {"/cf1/cmd_full_state": 3}
    assert np.isfinite(live.answers.age).tolist() == [True, False]
    np.testing.assert_array_equal(vec.reference.position[0, 0], vec.task.goal.slots[0, 0])


def test_no_message_ends_the_simulation_of_crazyflies():
    def ask(position):
        return full_state(Wire.store, 0, PX4Setpoint(position, np.zeros(3), np.array([0.0, 0.0, 3.0]), 0.3, 0.0))

    fuzz_simulation("crazyswarm2", {f"/cf{n}/cmd_full_state": ask for n in (1, 2)})


# The policy node


def fly(task: str, script: str, steps: int):
    """Fly drones that hear full states by a policy node, over DDS; return the simulation after some steps."""
    config = config_of(task, **{"env.episode_seconds": 30})
    here, there = Node(domain=DOMAIN), Node(domain=DOMAIN)
    vec = MultiliftVec(config, EVALUATION)
    live = LiveFlight(vec, here, "crazyswarm2")
    node = PolicyNode(config, lambda team: make_scripted(script, team), there, "crazyswarm2", seed=3)
    live.begin(3)
    until_heard(live, node)
    live.step()
    fly_together(live, node, steps)
    assert node.mode == FLYING and (live.answers.late == 0).all()
    assert not here.reader.left_out and not there.reader.left_out
    return vec


def test_the_node_holds_drones_at_their_references_by_full_states():
    vec = fly("hover", "formation_integral", 150)
    off = np.linalg.norm(vec.world.state.drone_position[0] - vec.reference.position[0], axis=1)
    assert off.max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, script, bound", [("hover", "formation_integral", 0.02), ("track", "formation_lead", 0.05)]
)
def test_the_node_flies_a_payload_by_full_states(task, script, bound):
    vec = fly(task, script, 500)
    error = np.linalg.norm(vec.world.state.payload_position[0] - vec.task.goal.position[0])
    assert error < bound


def test_what_the_node_observes_is_the_simulations_state():
    """Its body rates, by differences of attitudes, are those of half a step ago."""
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7})
    policy, read = make_scripted("formation", vec), ServerOdometry()
    observation, _ = vec.reset(seed=5)
    found, true = [], []
    for k in range(100):
        observation, *_ = vec.step(policy.act(observation))
        messages = dict(FlightMessages(vec, Wire.store, "crazyswarm2").messages(20_000_000 * k))
        position, rotation, velocity, rates = read(messages["/cf2/odom"])
        state = vec.world.state
        np.testing.assert_allclose(position, state.drone_position[0, 1], atol=1e-12)
        np.testing.assert_allclose(rotation, state.drone_rotation[0, 1], atol=1e-12)
        np.testing.assert_allclose(velocity, state.drone_velocity[0, 1], atol=1e-12)
        found.append(rates)
        true.append(state.drone_body_rates[0, 1].copy())
    middle = 0.5 * (np.array(true[1:]) + true[:-1])
    spread = np.abs(true).max()
    assert spread > 0.1 and np.abs(found[1:] - middle).max() < 0.1 * spread
