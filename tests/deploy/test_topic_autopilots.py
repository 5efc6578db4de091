"""Drones that hear PX4's set-points, and what is said in PX4's messages."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.math3d import mat_to_quat, thrust_frame

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from ros_wire import Wire

from multilift_marl.deploy.ros.autopilots import TopicAutopilots, subscribe_px4
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER, LAND_AFTER, SINK
from multilift_marl.deploy.ros.messages import FlightMessages
from multilift_marl.deploy.ros.stages import Stage
from multilift_marl.deploy.ros.types import (
    ATTITUDE,
    TRAJECTORY,
    PX4Setpoint,
    local_position,
    px4_namespace,
    read_attitude,
    read_measurement,
    read_vehicle_odometry,
    trajectory_setpoint,
    vehicle_odometry,
)
from multilift_marl.sim.earth import swap_attitude

NAN = np.full(3, np.nan)
G = 9.81


class Team:
    """Two drones that hear PX4's set-points on a wire."""

    def __init__(self):
        self.vec = ml.make_vec(
            "hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7, "env.episode_seconds": 60}
        )
        self.wire = Wire()
        self.autopilots = TopicAutopilots(
            self.vec.config, self.vec.world, subscribe_px4(self.wire, self.vec.world.system)
        )
        self.vec.use_controller(self.autopilots)
        nominal = {"payload_mass": 0.7, "payload_force": np.zeros(3)}
        self.vec.reset(seed=2, options={"randomization": nominal})
        self.state = self.vec.world.state
        self.slots = self.vec.task.goal.slots[0]
        self.load = LoadFeedforward(self.vec.config.system)

    def carried(self, n: int) -> np.ndarray:
        return self.load.acceleration(n, np.zeros(3), np.zeros(3), self.vec.task.goal.cable_force[0, n], 0.0)

    def say(self, n: int, position=NAN, velocity=NAN, acceleration=NAN, yaw=np.nan) -> None:
        message = trajectory_setpoint(self.wire.store, 0, PX4Setpoint(position, velocity, acceleration, yaw))
        self.wire.queues[f"{px4_namespace(n)}/in/trajectory_setpoint"].append(message)

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.vec.step(np.zeros((1, 2, 4)))


def test_places_are_flown_to_and_held():
    team = Team()
    places = team.slots + [0.3, -0.2, 0.1]
    for _ in range(400):
        for n in range(2):
            team.say(n, places[n], np.zeros(3), team.carried(n), 0.4)
        team.step()
    np.testing.assert_allclose(team.state.drone_position[0], places, atol=0.05)  # the payload swings below
    yaw = np.arctan2(team.state.drone_rotation[0, :, 1, 0], team.state.drone_rotation[0, :, 0, 0])
    np.testing.assert_allclose(yaw, 0.4, atol=0.05)
    assert (team.autopilots.answers.late == 0).all()


def test_a_place_alone_is_held_with_the_force_on_the_cable():
    team = Team()
    for _ in range(400):
        for n in range(2):
            team.say(n, team.slots[n])
        team.step()
    np.testing.assert_allclose(team.state.drone_position[0], team.slots, atol=0.03)


def test_velocities_are_flown_where_no_place_is_asked_for():
    team = Team()
    flown = []
    for _ in range(250):
        for n in range(2):
            team.say(n, NAN, np.array([0.0, 0.3, 0.0]), team.carried(n))
        team.step()
        flown.append(team.state.drone_velocity[0].copy())
    expected = [[0.0, 0.3, 0.0]] * 2
    np.testing.assert_allclose(np.mean(flown[-100:], axis=0), expected, atol=0.03)  # the payload swings below


def test_a_place_moves_on_with_its_velocity_between_set_points():
    team = Team()
    start, speed = team.slots.copy(), np.array([0.0, 0.0, 0.4])
    for n in range(2):
        team.say(n, start[n], speed, team.carried(n))
    team.step(6)
    np.testing.assert_allclose(team.vec.reference.position[0], start + 0.12 * speed, atol=0.004)


def test_attitudes_and_thrusts_fly_the_team_as_the_reports_own_nodes_do():
    """A position controller that hears odometry in NED and says attitude and thrust, 50 times a second."""
    team = Team()
    thrust_max = [4 * vehicle.rotor_thrust_max for vehicle in team.vec.config.system.vehicles]
    mass, sum_of = team.vec.config.system.drone_mass, np.zeros((2, 3))
    for _ in range(500):
        for n in range(2):
            own = [array[0, n] for array in (team.state.drone_position, team.state.drone_rotation,
                                             team.state.drone_velocity, team.state.drone_body_rates)]  # fmt: skip
            position, rotation, velocity, _ = read_vehicle_odometry(vehicle_odometry(team.wire.store, 0, tuple(own)))
            error = position - team.slots[n]
            sum_of[n] += 0.02 * error
            force = mass[n] * (team.carried(n) - 4 * error - 3.5 * velocity - sum_of[n] + [0, 0, G])
            attitude = np.array(thrust_frame(tuple(force), 0.0)).reshape(3, 3)
            quaternion = mat_to_quat(tuple(swap_attitude(attitude).ravel()))
            thrust = force @ rotation[:, 2] / thrust_max[n]
            topic = f"{px4_namespace(n)}/in/vehicle_attitude_setpoint_v1"
            team.wire.queues[topic].append(
                team.wire.store.types[ATTITUDE](
                    timestamp=0, yaw_sp_move_rate=0.0, q_d=np.array(quaternion, np.float32),
                    thrust_body=np.array([0, 0, -thrust], np.float32),
                )
            )  # fmt: skip
        team.step()
    np.testing.assert_allclose(team.state.drone_position[0], team.slots, atol=0.03)
    assert (team.autopilots.answers.late == 0).all()


def test_lost_set_points_are_held_then_landed():
    team = Team()
    for _ in range(100):
        for n in range(2):
            team.say(n, team.slots[n], np.array([0.0, 0.0, 0.2]), team.carried(n))
        team.step()
    team.step(round(LAND_AFTER / 0.02))
    held = team.vec.reference.position[0].copy()
    assert np.abs(held[:, :2] - team.slots[:, :2]).max() < 0.1  # the last velocity went on for 0.25 s at most
    assert (held[:, 2] - team.slots[:, 2]).max() < 0.2 * (HOLD_AFTER + 0.02) + 0.05
    team.step(50)
    np.testing.assert_allclose(team.vec.reference.position[0, :, 2], held[:, 2] - SINK, atol=0.02)
    assert (team.autopilots.answers.late > 0).all()


def test_empty_set_points_do_not_count():
    team = Team()
    for _ in range(20):
        for n in range(2):
            team.say(n)
        team.step()
    assert np.isinf(team.autopilots.answers.age).all() and (team.autopilots.answers.late == 20).all()


def test_odometry_and_attitudes_keep_their_meaning_through_px4s_frames():
    rng, store = np.random.default_rng(0), Wire.store
    for _ in range(20):
        force = rng.standard_normal(3) + [0, 0, 2]
        rotation = np.array(thrust_frame(tuple(force), rng.uniform(-3, 3))).reshape(3, 3)
        motion = rng.standard_normal(3), rotation, rng.standard_normal(3), rng.standard_normal(3)
        message = vehicle_odometry(store, 1_234_567_000, motion)
        assert message.timestamp == 1_234_567
        for found, expected in zip(read_vehicle_odometry(message), motion, strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-6)
        east, north, up = motion[0]
        np.testing.assert_allclose(message.position, [north, east, -up], rtol=1e-6)
        place = local_position(store, 0, motion)
        np.testing.assert_allclose([place.x, place.y, place.z], [north, east, -up])
        east, north, up = motion[2]
        np.testing.assert_allclose([place.vx, place.vy, place.vz], [north, east, -up])
        assert place.heading == pytest.approx(np.arctan2(rotation[0, 0], rotation[1, 0]))
        assert place.xy_valid and place.z_valid
        attitude = store.types[ATTITUDE](
            timestamp=0, yaw_sp_move_rate=0.0, q_d=message.q, thrust_body=np.array([0, 0, -0.5], np.float32)
        )
        asked = read_attitude(attitude, 30.0)
        np.testing.assert_allclose(asked.acceleration, 15.0 * rotation[:, 2] - [0, 0, G], atol=1e-5)


def test_velocities_in_the_bodys_frame_are_turned_into_the_worlds():
    """PX4's VELOCITY_FRAME_BODY_FRD: yaw of 90° (looks east), then a roll of 90° to the right."""
    half = np.sqrt(0.5)
    yaw, roll = np.array([half, 0, 0, half]), np.array([half, half, 0, 0])  # w, x, y, z; NED and FRD
    w, x, y, z = (
        yaw[0] * roll[0] - yaw[1:] @ roll[1:],
        *(yaw[0] * roll[1:] + roll[0] * yaw[1:] + np.cross(yaw[1:], roll[1:])),
    )
    motion = np.array([7.0, 8.0, 9.0]), np.eye(3), np.zeros(3), np.zeros(3)
    message = vehicle_odometry(Wire.store, 0, motion)
    message.q, message.velocity_frame = np.array([w, x, y, z], np.float32), 3
    message.velocity = np.array([1.0, 2.0, 4.0], np.float32)  # forward, right, down of the body
    message.angular_velocity = np.array([0.1, 0.2, 0.4], np.float32)
    position, rotation, velocity, rates = read_vehicle_odometry(message)
    # forward is east, the right wing points down, the belly north
    np.testing.assert_allclose(rotation[:, 0], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(rotation[:, 1], [0, 0, 1], atol=1e-6)  # the left wing
    np.testing.assert_allclose(velocity, [1.0, 4.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(position, [7, 8, 9])
    np.testing.assert_allclose(rates, [0.1, -0.2, -0.4], atol=1e-7)


@pytest.mark.parametrize("frame", [0, 2])
@pytest.mark.parametrize("field", ["pose_frame", "velocity_frame"])
def test_frames_without_north_are_no_measurement(field, frame):
    message = vehicle_odometry(Wire.store, 0, (np.ones(3), np.eye(3), np.ones(3), np.ones(3)))
    setattr(message, field, frame)
    with pytest.raises(ValueError, match="a number is nan"):
        read_measurement(read_vehicle_odometry, message)


def test_headings_are_from_north_clockwise():
    east = PX4Setpoint(np.array([1.0, 2.0, 3.0]), NAN, NAN, 0.0)
    message = trajectory_setpoint(Wire.store, 5_000, east)
    assert message.timestamp == 5 and message.yaw == pytest.approx(np.pi / 2)
    np.testing.assert_array_equal(message.position, np.array([2, 1, -3], np.float32))


def test_bytes_are_those_of_px4s_messages():
    """CDR by hand: 4 bytes of header, a time of 8 bytes, then numbers of 4 each."""
    message = trajectory_setpoint(Wire.store, 7_000, PX4Setpoint(np.array([1.0, 2.0, 3.0]), NAN, NAN, 0.0))
    data = bytes(Wire.store.serialize_cdr(message, TRAJECTORY))
    assert data[:4] == b"\0\1\0\0" and int.from_bytes(data[4:12], "little") == 7
    numbers = np.frombuffer(data[12:], "<f4")
    assert len(numbers) == 14
    np.testing.assert_allclose(numbers[:3], [2, 1, -3])
    assert np.isnan(numbers[3:12]).all() and numbers[12] == pytest.approx(np.pi / 2) and np.isnan(numbers[13])


def test_the_report_hears_of_its_state_machine():
    team = Team()
    messages = FlightMessages(team.vec, team.wire.store, "report")
    messages.stages = np.array([Stage.TRAJECTORY, Stage.LAND])
    heard = dict(messages.messages(0))
    assert heard["/state/state_drone_0"].data == Stage.TRAJECTORY and heard["/state/state_drone_1"].data == Stage.LAND
    assert {topic.name for topic in messages.topics()} == set(heard) | {"/drone_1/action", "/drone_2/action"}
    assert "/fmu/out/vehicle_odometry" in heard and "/px4_1/fmu/out/vehicle_local_position" in heard
