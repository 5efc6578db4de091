"""Each number of the messages to and from PX4: its frame, unit and sign, by vectors of three different components."""

from __future__ import annotations

import socket
import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pymavlink")  # of the px4 extra
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from conftest import make_system
from fake_px4 import FIRST, HOST
from pymavlink.dialects.v20 import common as mavlink

from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.deploy.px4.link import SimulatorLink
from multilift_marl.deploy.px4.offboard import PX4_PORT, OffboardLink
from multilift_marl.deploy.px4.team import AutopilotTeam, Settings
from multilift_marl.math3d import mat_to_quat, quat_to_mat
from multilift_marl.sensing.sensors import SIZES
from multilift_marl.sim.earth import Site, swap_attitude
from multilift_marl.sim.state import SystemState

INDEX = FIRST + 8
FORCE, RATES, FIELD = [1.5, -2.5, 9.25], [0.5, -0.25, 0.125], [21.0, -3.0, -43.0]  # FLU: [m/s²], [rad/s], [µT]
ROTATION = np.reshape(quat_to_mat(0.9, 0.1, -0.2, 0.3), (3, 3))  # FLU to ENU
PLACE, VELOCITY = [30.0, -40.0, 5.0], [3.0, 4.0, -2.0]  # ENU: [m], [m/s]


def sent(drone: int, fresh: set[str]) -> dict:
    """Return the messages, by type, that a link sends of a drone's readings."""

    def of_drone(vector: np.ndarray) -> np.ndarray:
        return np.stack([np.full_like(vector, 7.0), vector])[None] if drone else vector[None, None]

    sensors = SimpleNamespace(
        readings=SimpleNamespace(fresh=np.array([[name in fresh for name in SIZES]])),
        specific_force=of_drone(np.array(FORCE)), body_rates=of_drone(np.array(RATES)),
        magnetic_field=of_drone(np.array(FIELD)), pressure=of_drone(np.array(95460.8)),
        position=of_drone(np.array(PLACE)), velocity=of_drone(np.array(VELOCITY)),
    )  # fmt: skip
    link = SimulatorLink(INDEX, drone, timeout=1.0)
    link._connection, px4 = socket.socketpair()
    with px4:
        link.send(1_234_000, sensors, Site())
        parser = mavlink.MAVLink(None)
        found = {message.get_type(): message for message in parser.parse_buffer(px4.recv(65536))}
    link.close()
    return found


@pytest.mark.parametrize("drone", [0, 1])
def test_sensors_are_in_px4s_frames_and_units(drone):
    told = sent(drone, set(SIZES))
    imu, gps = told["HIL_SENSOR"], told["HIL_GPS"]
    assert imu.time_usec == gps.time_usec == 1_234_000 and imu.fields_updated == 0x1FFF & ~0x400
    np.testing.assert_allclose([imu.xacc, imu.yacc, imu.zacc], [1.5, 2.5, -9.25], rtol=1e-6)  # FRD
    np.testing.assert_allclose([imu.xgyro, imu.ygyro, imu.zgyro], [0.5, 0.25, -0.125], rtol=1e-6)
    np.testing.assert_allclose([imu.xmag, imu.ymag, imu.zmag], [0.21, 0.03, 0.43], rtol=1e-6)  # [G], 100 µT
    assert imu.abs_pressure == pytest.approx(954.608) and imu.pressure_alt == pytest.approx(500.0, abs=0.1)  # ISO 2533
    assert imu.diff_pressure == 0 and imu.temperature == 20
    # 40 m south and 30 m east, by the radii of curvature of WGS 84 at 47.397742° and 488 m
    e2, sine = 0.00669437999014, np.sin(np.radians(47.397742))
    normal = 6378137 / np.sqrt(1 - e2 * sine**2)
    meridian = normal * (1 - e2) / (1 - e2 * sine**2)
    assert gps.lat == pytest.approx(1e7 * (47.397742 - np.degrees(40 / (meridian + 488))), abs=2)
    assert gps.lon == pytest.approx(
        1e7 * (8.545594 + np.degrees(30 / ((normal + 488) * np.cos(np.radians(47.397742))))), abs=2
    )
    assert gps.alt == pytest.approx(493_000, abs=2)
    assert (gps.vn, gps.ve, gps.vd, gps.vel) == (400, 300, 200, 500)  # [cm/s]
    assert gps.cog == pytest.approx(100 * np.degrees(np.arctan2(3, 4)), abs=1)
    assert gps.fix_type >= 3 and gps.satellites_visible >= 6


def test_what_is_not_fresh_is_not_claimed():
    told = sent(0, {"accelerometer", "gyroscope"})
    assert told.keys() == {"HIL_SENSOR"} and told["HIL_SENSOR"].fields_updated == 0x3F
    assert sent(0, {"magnetometer"})["HIL_SENSOR"].fields_updated == 0x3F | 0x1C0
    assert sent(0, {"barometer"})["HIL_SENSOR"].fields_updated == 0x3F | 0x1A00


def test_set_points_are_as_they_were_asked_for():
    link = OffboardLink(INDEX)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as px4:
        px4.bind((HOST, PX4_PORT + INDEX))
        px4.settimeout(5)
        link.send_position(
            2_000_000, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), np.array([7.0, 8.0, 9.0]), 0.5
        )
        link.send_acceleration(2_020_000, np.array([-7.0, 8.0, -9.0]), -0.5)
        link.send_rates(2_040_000, np.array([0.1, -0.2, 0.3]), 0.4)
        parser = mavlink.MAVLink(None)
        place, push, rates = (parser.parse_buffer(px4.recv(65536))[0] for _ in range(3))
    link.close()
    for each in (place, push, rates):
        assert (each.target_system, each.target_component) == (INDEX + 1, 1)
    assert (place.time_boot_ms, place.coordinate_frame, place.type_mask) == (2000, 1, 2048)
    motion = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz")
    assert [getattr(place, name) for name in motion] == list(range(1, 10)) and place.yaw == 0.5
    assert (push.time_boot_ms, push.type_mask & 0xFFF) == (2020, 0x3F | 2048) and push.yaw == -0.5
    assert (push.afx, push.afy, push.afz) == (-7, 8, -9)
    assert (rates.time_boot_ms, rates.type_mask) == (2040, 128)
    found = [rates.body_roll_rate, rates.body_pitch_rate, rates.body_yaw_rate, rates.thrust]
    np.testing.assert_allclose(found, [0.1, -0.2, 0.3, 0.4], rtol=1e-6)


def test_a_teams_set_points_are_in_the_frame_of_each_autopilot():
    """PX4's local frame begins 2 m north, 1 m east and 3 m above the world's origin; what a drone carries is added."""
    team, told = AutopilotTeam.__new__(AutopilotTeam), []
    system = make_system(2, **{"payload.mass": 0.7})
    team.settings, team._time_us = Settings(), 1_000_000
    team._feedforward = LoadFeedforward(system)
    own = SimpleNamespace(
        origin=Site().to_geodetic(np.array([1.0, 2.0, 3.0])), send_position=lambda *sent: told.append(sent)
    )
    team.offboard = [None, own]
    motion = np.array([[4.0, 6.0, 9.0], [0.1, 0.2, 0.4], [0.0, 0.0, 0.0]])
    team.send(1, motion, np.array([0.5, -1.0, 2.0]), 0.25)
    ((time_us, place, velocity, acceleration, yaw),) = told
    assert time_us == 1_000_000 and yaw == pytest.approx(np.pi / 2 - 0.25)
    np.testing.assert_allclose(place, [4.0, 3.0, -6.0], rtol=0.004)  # north, east, down; PX4's sphere is no ellipsoid
    np.testing.assert_allclose(velocity, [0.2, 0.1, -0.4])
    expected = team._feedforward.acceleration(1, motion[1], motion[2], np.array([0.5, -1.0, 2.0]), 0.25)
    np.testing.assert_allclose(acceleration, expected[[1, 0, 2]] * [1, 1, -1])
    still = team._feedforward.acceleration(1, np.zeros(3), np.zeros(3), np.array([0.5, -1.0, 2.0]), 0.25)
    np.testing.assert_allclose(still, np.array([0.5, -1.0, 2.0]) / system.vehicles[1].mass)


def test_what_autopilots_report_is_what_drones_know():
    """PX4's estimate is 20 ms old, NED from a place of its own; drones know it in the world, carried on to now."""
    team = AutopilotTeam.__new__(AutopilotTeam)
    team.settings, team._time_us = Settings(), 1_020_000
    turned = np.array(swap_attitude(ROTATION))
    own = SimpleNamespace(
        origin=Site().to_geodetic(np.array([1.0, 2.0, 3.0])), position=np.array([4.0, 3.0, -6.0]), time_us=1_000_000,
        velocity=np.array([0.2, 0.1, -0.4]), attitude=turned, rates=np.array([0.3, -0.2, 0.1]),
    )  # fmt: skip
    silent = SimpleNamespace(
        origin=np.full(3, np.nan), position=np.zeros(3), velocity=np.zeros(3), attitude=turned, rates=np.zeros(3)
    )
    team.offboard = [own, silent]
    state = SystemState.zeros(1, 2)
    team.report(state)
    expected = np.array([4.0, 6.0, 9.0]) + 0.02 * np.array([0.1, 0.2, 0.4])
    np.testing.assert_allclose(state.drone_position[0, 0], expected, atol=0.02)  # PX4's sphere is no ellipsoid
    np.testing.assert_allclose(state.drone_velocity[0, 0], [0.1, 0.2, 0.4])
    np.testing.assert_allclose(state.drone_rotation[0, 0], ROTATION, atol=1e-12)
    np.testing.assert_allclose(state.drone_body_rates[0, 0], [0.3, 0.2, -0.1])
    assert not state.drone_position[0, 1].any()  # of one that has not said anything yet


def test_attitudes_are_heard_as_px4_sends_them():
    link = OffboardLink(FIRST + 9)
    w, x, y, z = mat_to_quat(tuple(np.ravel(swap_attitude(ROTATION))))
    try:
        link._take(mavlink.MAVLink_attitude_quaternion_message(7, w, x, y, z, 0.3, -0.2, 0.1))
        np.testing.assert_allclose(swap_attitude(link.attitude), ROTATION, atol=1e-6)
        np.testing.assert_allclose(link.rates, [0.3, -0.2, 0.1])
        for wrong in ((2.0, 0, 0, 0, 1, 1, 1), (1.0, 0, 0, 0, np.nan, 0, 0), (np.nan, 0, 0, 0, 1, 1, 1)):
            link._take(mavlink.MAVLink_attitude_quaternion_message(8, *wrong))
        np.testing.assert_allclose(link.rates, [0.3, -0.2, 0.1])  # what cannot be is left out
    finally:
        link.close()
