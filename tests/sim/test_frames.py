"""Frames and units of what flight software hears and says, by vectors of three different components."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from plain_kernels import turned

from multilift_marl.math3d import mat_to_quat
from multilift_marl.sensing.sensors import SIZES
from multilift_marl.sim.earth import Site, altitude_at, project_local, swap_attitude, swap_yaw

ATTITUDE = turned([0.4, -0.7, 1.3], 0.9)  # FLU to ENU
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD = np.diag([1.0, -1.0, -1.0])
POSITION, VELOCITY, RATES = np.array([[1.0, -2.5, 4.0], [0.3, 0.7, -1.1], [0.2, -0.5, 0.9]])


def quaternion_of(rotation: np.ndarray) -> tuple[float, ...]:
    return tuple(float(number) for number in mat_to_quat(tuple(rotation.ravel())))


# PX4's topics


def px4_message(**fields):
    """Return a `VehicleOdometry` of a body with ATTITUDE, as PX4 would say it."""
    own = {
        "q": quaternion_of(NED @ ATTITUDE @ FRD), "position": NED @ POSITION, "velocity": NED @ VELOCITY,
        "angular_velocity": FRD @ RATES, "pose_frame": 1, "velocity_frame": 1,
    }  # fmt: skip
    return SimpleNamespace(**(own | fields))


@pytest.mark.parametrize("frame", ["north, east, down", "forward, right, down"])
def test_px4s_odometry_is_read_in_either_of_its_velocity_frames(frame):
    types = pytest.importorskip("multilift_marl.deploy.ros.types", exc_type=ImportError)
    message = px4_message()
    if frame.startswith("forward"):
        message = px4_message(velocity=FRD @ ATTITUDE.T @ VELOCITY, velocity_frame=3)
    for found, expected in zip(
        types.read_vehicle_odometry(message), (POSITION, ATTITUDE, VELOCITY, RATES), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_px4s_odometry_in_frames_without_north_is_not_a_number():
    types = pytest.importorskip("multilift_marl.deploy.ros.types", exc_type=ImportError)
    position, rotation, velocity, _ = types.read_vehicle_odometry(px4_message(pose_frame=2, velocity_frame=2))
    assert np.isnan(position).all() and np.isnan(velocity).all()
    np.testing.assert_allclose(rotation, ATTITUDE, atol=1e-12)
    for scale, sound in ((0.96, True), (1.04, True), (0.9, False), (1.1, False)):
        other = px4_message(q=tuple(scale * number for number in px4_message().q))
        assert np.isfinite(types.read_vehicle_odometry(other)[1]).all() == sound


def test_ros_odometry_has_its_twist_in_the_bodys_frame():
    types = pytest.importorskip("multilift_marl.deploy.ros.types", exc_type=ImportError)

    def named(names, values):
        return SimpleNamespace(**dict(zip(names, values, strict=True)))

    pose = SimpleNamespace(position=named("xyz", POSITION), orientation=named("wxyz", quaternion_of(ATTITUDE)))
    twist = SimpleNamespace(linear=named("xyz", ATTITUDE.T @ VELOCITY), angular=named("xyz", RATES))
    message = SimpleNamespace(pose=SimpleNamespace(pose=pose), twist=SimpleNamespace(twist=twist))
    for found, expected in zip(types.read_odometry(message), (POSITION, ATTITUDE, VELOCITY, RATES), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_px4s_set_points_are_read_from_north_east_down():
    types = pytest.importorskip("multilift_marl.deploy.ros.types", exc_type=ImportError)
    rise = np.array([0.6, -0.2, 1.7])
    change = np.array([-0.4, 0.9, 2.2])
    message = SimpleNamespace(
        position=NED @ POSITION, velocity=NED @ VELOCITY, acceleration=NED @ rise, jerk=NED @ change, yaw=0.3,
        yawspeed=0.7,
    )  # fmt: skip
    found = types.read_trajectory(message)
    np.testing.assert_allclose(found.jerk, change)
    assert found.yaw_rate == -0.7
    for part, expected in zip(found[:3], (POSITION, VELOCITY, rise), strict=True):
        np.testing.assert_allclose(part, expected)
    assert found.yaw == pytest.approx(np.pi / 2 - 0.3)
    attitude = SimpleNamespace(
        q_d=quaternion_of(NED @ ATTITUDE @ FRD), thrust_body=np.array([0.1, 0.2, -0.6]), yaw_sp_move_rate=0.5
    )
    asked = types.read_attitude(attitude, 30.0)
    np.testing.assert_allclose(asked.acceleration, 18.0 * ATTITUDE[:, 2] - [0, 0, 9.81], atol=1e-12)
    assert asked.yaw == pytest.approx(np.arctan2(ATTITUDE[1, 0], ATTITUDE[0, 0]))
    assert np.isnan(asked.position).all() and np.isnan(asked.velocity).all()
    assert asked.yaw_rate == -0.5 and asked.thrust == 0.6
    np.testing.assert_allclose(asked.attitude, ATTITUDE, atol=1e-12)
    turning = SimpleNamespace(roll=0.1, pitch=0.2, yaw=-0.3, thrust_body=np.array([0.0, 0.0, -0.7]))
    asked = types.read_rates(turning)
    np.testing.assert_allclose(asked.rates, [0.1, -0.2, 0.3])
    assert asked.thrust == 0.7 and asked.attitude is None


def test_what_is_said_to_px4_is_in_north_east_down():
    types = pytest.importorskip("multilift_marl.deploy.ros.types", exc_type=ImportError)
    from rosbags.typesys import Stores

    store, motion = types.typestore(Stores.ROS2_JAZZY), (POSITION, ATTITUDE, VELOCITY, RATES)
    message = types.vehicle_odometry(store, 1_234_567_000, motion)
    assert message.timestamp == message.timestamp_sample == 1_234_567 and message.pose_frame == 1
    for found, expected in (
        (message.position, NED @ POSITION), (message.velocity, NED @ VELOCITY), (message.angular_velocity, FRD @ RATES),
        (message.q, quaternion_of(NED @ ATTITUDE @ FRD)),
    ):  # fmt: skip
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    place = types.local_position(store, 5_000, motion)
    np.testing.assert_allclose([place.x, place.y, place.z], NED @ POSITION)
    np.testing.assert_allclose([place.vx, place.vy, place.vz], NED @ VELOCITY)
    assert place.heading == pytest.approx(np.pi / 2 - np.arctan2(ATTITUDE[1, 0], ATTITUDE[0, 0]))
    rise = np.array([0.6, -0.2, 1.7])
    asked = types.trajectory_setpoint(store, 7_000, types.PX4Setpoint(POSITION, VELOCITY, rise, 0.3))
    for found, expected in ((asked.position, POSITION), (asked.velocity, VELOCITY), (asked.acceleration, rise)):
        np.testing.assert_allclose(found, NED @ expected, rtol=1e-6)
    assert asked.timestamp == 7 and asked.yaw == pytest.approx(np.pi / 2 - 0.3)


# MAVLink


class Line:
    """A connection that keeps what is written to it."""

    def __init__(self):
        self.data = b""

    def settimeout(self, seconds):
        pass

    def sendall(self, data):
        self.data += data


def sensors_of(**fields):
    """Return readings of two drones, those of the second known."""
    own = {
        "specific_force": [0.4, -0.9, 9.7], "body_rates": RATES, "magnetic_field": [21.0, -7.0, -43.0],
        "pressure": 95000.0, "position": POSITION, "velocity": VELOCITY,
    }  # fmt: skip
    values = {name: np.stack([np.full(np.shape(value), 77.0), value])[None] for name, value in (own | fields).items()}
    return SimpleNamespace(readings=SimpleNamespace(fresh=np.ones((1, len(SIZES)), bool)), **values)


def said_by_link(sensors) -> dict:
    """Return the messages that a link sends to PX4, by their type."""
    pytest.importorskip("pymavlink")  # of the px4 extra
    if sys.platform == "win32":
        pytest.skip("PX4 flies on Linux and macOS alone")
    from multilift_marl.deploy.px4.link import SimulatorLink
    from multilift_marl.deploy.px4.mavlink import MAVLink, Splitter, mavlink

    link = SimulatorLink.__new__(SimulatorLink)
    link.drone, link._asked, link._timeout, link._connection = 1, 0.0, 1.0, Line()
    link._mavlink = MAVLink(1, 1)
    link.send(123_456, sensors, Site())
    numbers = {mavlink.MAVLINK_MSG_ID_HIL_SENSOR, mavlink.MAVLINK_MSG_ID_HIL_GPS}
    return {message.get_type(): message for message in Splitter(numbers).split(link._connection.data)}


def test_px4_hears_its_sensors_in_its_frames_and_units():
    message = said_by_link(sensors_of())["HIL_SENSOR"]
    assert message.time_usec == 123_456 and message.fields_updated == 0x1BFF
    np.testing.assert_allclose([message.xacc, message.yacc, message.zacc], [0.4, 0.9, -9.7], rtol=1e-6)
    np.testing.assert_allclose([message.xgyro, message.ygyro, message.zgyro], FRD @ RATES, rtol=1e-6)
    found = [message.xmag, message.ymag, message.zmag]
    np.testing.assert_allclose(found, [0.21, 0.07, 0.43], rtol=1e-6)  # a gauss is 100 µT
    assert message.abs_pressure == pytest.approx(950.0)
    assert message.pressure_alt == pytest.approx(float(altitude_at(95000.0)), rel=1e-6)


def test_px4_hears_where_it_is_in_integers():
    message = said_by_link(sensors_of())["HIL_GPS"]
    latitude, longitude, altitude = Site().to_geodetic(POSITION)
    assert (message.lat, message.lon) == (round(latitude * 1e7), round(longitude * 1e7))
    assert message.alt == round(altitude * 1e3)
    assert (message.vn, message.ve, message.vd) == (70, 30, 110)  # of 0.3 m/s east, 0.7 north, 1.1 down
    assert message.vel == round(100 * np.hypot(0.3, 0.7))
    assert message.cog == round(100 * np.degrees(np.arctan2(0.3, 0.7)))


@pytest.mark.parametrize("name, bits", [("magnetometer", 0x1C0), ("barometer", 0x1A00)])
def test_px4_hears_which_sensors_are_new(name, bits):
    sensors = sensors_of()
    new = said_by_link(sensors)["HIL_SENSOR"].fields_updated
    sensors.readings.fresh[0, list(SIZES).index(name)] = False
    assert new & ~said_by_link(sensors)["HIL_SENSOR"].fields_updated == bits
    assert new & 0x3F == 0x3F


# Places on Earth


def test_px4s_local_frame_is_the_azimuthal_projection_of_a_sphere():
    origin = np.array([47.4, 8.5, 488.0])
    for bearing, distance in ((0.3, 10.0), (2.0, 5e3), (-2.5, 1e5)):
        lat0, lon0, arc = np.radians(47.4), np.radians(8.5), distance / 6371e3
        lat = np.arcsin(np.sin(lat0) * np.cos(arc) + np.cos(lat0) * np.sin(arc) * np.cos(bearing))
        turn = np.arctan2(
            np.sin(bearing) * np.sin(arc) * np.cos(lat0), np.cos(arc) - np.sin(lat0) * np.sin(lat)
        )  # fmt: skip
        place = np.array([np.degrees(lat), np.degrees(lon0 + turn), 500.5])
        expected = [distance * np.cos(bearing), distance * np.sin(bearing), -12.5]
        np.testing.assert_allclose(project_local(place, origin), expected, rtol=1e-5, atol=1e-4)


def test_attitudes_and_headings_change_frames_together():
    np.testing.assert_allclose(swap_attitude(ATTITUDE), NED @ ATTITUDE @ FRD, atol=1e-15)
    for yaw in (-3.0, -1.0, 0.4, 2.9):
        assert np.cos(swap_yaw(yaw)) == pytest.approx(np.sin(yaw)) and np.sin(swap_yaw(yaw)) == pytest.approx(
            np.cos(yaw)
        )


def test_the_magnetic_field_has_its_declination_and_inclination():
    east, north, up = Site(declination=20.0, inclination=50.0, field=40.0).magnetic_field()
    assert np.linalg.norm([east, north, up]) == pytest.approx(40.0)
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(20.0)
    assert np.degrees(np.arcsin(-up / 40.0)) == pytest.approx(50.0)
