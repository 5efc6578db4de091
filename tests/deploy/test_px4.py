"""PX4's protocol, against a peer that flies by the sensors alone, and the real one where PX4_DIR points to a build."""

from __future__ import annotations

import socket
import sys
import time

import numpy as np
import pytest
from conftest import make_system

import multilift_marl as ml
from multilift_marl.errors import FlightError
from multilift_marl.realtime import RealTime
from multilift_marl.sim import World
from multilift_marl.sim.earth import Site, project_local

pytest.importorskip("pymavlink")  # of the px4 extra
pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from airfield import DT, Airfield, config_of, idle
from fake_px4 import FIRST, are_free

from multilift_marl.deploy.px4.launch import rig_parameters
from multilift_marl.deploy.px4.link import PORT
from multilift_marl.deploy.px4.team import AutopilotController, AutopilotTeam, Settings

# The rig as PX4 sees it


@pytest.mark.parametrize("preset", ["falcon", "crazyflie", "hummingbird", "iris", "x500"])
def test_rotors_are_where_ours_are_and_turn_as_ours_do(preset):
    mass = {"crazyflie": 0.01}.get(preset, 0.3)
    system = make_system(2, **{"vehicle.preset": preset, "payload.mass": mass, "randomization.payload_force": 0.0})
    vehicle, values = system.vehicles[0], rig_parameters(system, 0)
    wrench = np.zeros((4, 4))  # thrust up, and moments about forward, right, down, of a rotor's unit thrust
    for k in range(4):
        x, y, ratio = (values[f"CA_ROTOR{k}_{name}"] for name in ("PX", "PY", "KM"))
        wrench[:, k] = [1, *np.cross([x, y, 0], [0, 0, -1])[:2], ratio]
    np.testing.assert_allclose(wrench, vehicle.allocation * np.array([[1], [1], [-1], [-1]]), atol=1e-12)
    assert values["MPC_THR_HOVER"] == pytest.approx(vehicle.mass * 9.80665 / (4 * vehicle.rotor_thrust_max), rel=1e-3)
    # A set-point of 1 about an axis, by PX4's mixer: one factor for roll and pitch, the larger of the two.
    mixer = np.linalg.pinv(wrench)[:, 1:3]
    pairs = (np.abs(mixer) > 1e-9).sum(axis=0) / 2  # of rotors that turn it
    mixer /= np.sqrt((mixer**2).sum(axis=0) / pairs).max()
    for axis, name in enumerate(("ROLL", "PITCH")):
        turn = (wrench @ mixer[:, axis])[1 + axis] * vehicle.rotor_thrust_max / vehicle.inertia[axis]
        assert values[f"MC_{name}RATE_P"] * turn == pytest.approx(18.5)


def test_px4s_local_frame_is_azimuthal_and_equidistant():
    origin = np.array([47.4, 8.5, 500.0])
    for azimuth in np.radians([0, 40, 90, 200, 300]):  # a great circle of 1 km from the origin, on the sphere
        lat0, lon0, angle = np.radians(47.4), np.radians(8.5), 1000 / 6371000
        lat = np.arcsin(np.sin(lat0) * np.cos(angle) + np.cos(lat0) * np.sin(angle) * np.cos(azimuth))
        lon = lon0 + np.arctan2(
            np.sin(azimuth) * np.sin(angle) * np.cos(lat0), np.cos(angle) - np.sin(lat0) * np.sin(lat)
        )
        place = project_local(np.array([np.degrees(lat), np.degrees(lon), 498.0]), origin)
        np.testing.assert_allclose(place, [1000 * np.cos(azimuth), 1000 * np.sin(azimuth), 2.0], atol=1e-4)
    np.testing.assert_allclose(project_local(origin, origin), 0, atol=1e-9)
    here = project_local(Site().to_geodetic(np.array([3.0, 4.0, 1.0])), Site().to_geodetic(np.zeros(3)))
    np.testing.assert_allclose(here, [4, 3, -1], rtol=0.004)


# Lockstep


def test_every_message_is_answered_in_step():
    system = make_system(2)
    world = World(system, 1, 1)
    with Airfield(system) as field:
        field.team.board(world)
        idle(field.team, world, 300)
        for link, fake in zip(field.team.links, field.fakes, strict=True):
            assert link.answered and link.faults == 0
            assert np.diff(fake.times).tolist() == [4000] * (len(fake.times) - 1)
            assert len(fake.times) == 300 and fake.complaints == []
    assert are_free()


@pytest.mark.slow
@pytest.mark.parametrize("action", ["acceleration", "ctbr"])
def test_other_interfaces_have_set_points_of_their_own(action):
    config = config_of("takeoff", **{"control.action": action})
    vec = ml.make_vec(config)
    with Airfield(config.system) as field:
        vec.use_controller(AutopilotController(config, vec.world, field.team))
        vec.reset(seed=0)
        field.team.board(vec.world)
        field.team.prepare(vec.world)
        actions = np.zeros((1, 2, vec.action_size), np.float32)
        actions[..., 0], actions[..., 1] = 0.5, 0.2
        for _ in range(10):
            vec.step(actions)
        time.sleep(0.1)
        idle(field.team, vec.world, 10)
        for n, fake in enumerate(field.fakes):
            asked, vehicle = fake.setpoints[-1], config.system.vehicles[n]
            if action == "ctbr":
                force = vec.controller.gains.mass[n] * np.array([0, 0, 9.80665]) + vec.task.goal.cable_force[0, n]
                hover = np.linalg.norm(force) / (4 * vehicle.rotor_thrust_max)
                assert asked.get_type() == "SET_ATTITUDE_TARGET" and asked.type_mask == 128
                assert asked.thrust == pytest.approx(0.5 + 0.5 * hover, abs=0.01)
                rotation, slot = vec.world.state.drone_rotation[0, n], vec.task.goal.slot_frame[0, n]
                turned = np.arctan2(slot[1], slot[0]) - np.arctan2(rotation[1, 0], rotation[0, 0])
                rates = 0.2 * config.control.max_tilt_rate * np.array([np.cos(turned), -np.sin(turned), 0.0])  # FRD
                found = [asked.body_roll_rate, asked.body_pitch_rate, asked.body_yaw_rate]
                np.testing.assert_allclose(found, rates, atol=0.02)
            else:
                outward = np.append(vec.task.goal.slot_frame[0, n], 0)
                sideways = np.array([-outward[1], outward[0], 0])
                wanted = config.control.max_acceleration * (0.5 * outward + 0.2 * sideways)
                share = vec.controller.gains.load_share[n]
                wanted = wanted + (share * wanted + vec.task.goal.cable_force[0, n]) / vehicle.mass
                velocity = vec.world.state.drone_velocity[0, n]
                wanted_down = [asked.afy, asked.afx, -asked.afz]
                assert asked.type_mask & 0x3F == 0x3F
                np.testing.assert_allclose(wanted_down, wanted, atol=0.05 + 2 * np.linalg.norm(velocity))


def test_one_that_is_slow_for_its_first_answers_is_waited_for():
    system = make_system(2)
    world = World(system, 1, 1)
    with Airfield(system, slow=10) as field:
        field.team.board(world)
        idle(field.team, world, 60)
        for link, fake in zip(field.team.links, field.fakes, strict=True):
            assert link.answered and link.faults == 0 and len(fake.times) == 60


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_motor_controls_that_are_no_numbers_end_the_flight_by_name(value):
    system = make_system(2)
    world = World(system, 1, 1)
    with Airfield(system, controls=[0.1, 0.2, value, 0.3]) as field:
        field.team.board(world)
        idle(field.team, world, 20)
        field.fakes[0].armed = True
        with pytest.raises(FlightError, match=rf"PX4 {FIRST} sets motor 2 to {value} at 1\.\d+ s; see its log"):
            idle(field.team, world, 20)
    assert are_free()


def test_motor_controls_beyond_full_thrust_are_full_thrust():
    system = make_system(2)
    world = World(system, 1, 1)
    with Airfield(system, controls=[0.25, 1.5, 3e38, -2.0]) as field:
        field.team.board(world)
        idle(field.team, world, 20)
        field.fakes[0].armed = True
        idle(field.team, world, 20)
        full = system.vehicles[0].rotor_thrust_max
        np.testing.assert_allclose(world.thrust[0], full * np.array([[0.25, 1, 1, 0], [0, 0, 0, 0]]))


@pytest.mark.slow
def test_rubbish_between_answers_is_skipped():
    system = make_system(2)
    world = World(system, 1, 1)
    with Airfield(system, rubbish=b"\xfd\x00\x00noise\xfe") as field:
        field.team.board(world)
        idle(field.team, world, 100)
        assert [link.faults for link in field.team.links] == [0, 0]


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"silent_after": 0}, "did not answer within 0.5 s"),
        ({"silent_after": 30}, "did not answer within 0.5 s at 1."),
        ({"vanish_after": 30}, "has ended the connection (closed"),
        ({"stamp": -1000}, "did not answer within 0.5 s"),
        ({"stamp": 1000}, "did not answer within 5 s"),
    ],
)
def test_an_autopilot_that_fails_is_named(changes, words):
    system = make_system(2)
    world = World(system, 1, 1)
    # A closed connection is seen at once; an answer of another time must have come before patience ends.
    patience = 60.0 if "vanish_after" in changes else 5.0 if changes.get("stamp") == 1000 else 0.5
    with Airfield(system, timeout=patience, **changes) as field:
        field.team.board(world)
        with pytest.raises(FlightError) as error:
            idle(field.team, world, 200)
        assert any(f"PX4 {FIRST + i} " in str(error.value) for i in range(2)) and words in str(error.value)
        if changes.get("stamp") == 1000:
            assert field.team.links[0].faults > 0
    assert are_free()


def test_an_autopilot_that_never_connects_is_named_in_time():
    begin = time.monotonic()
    with pytest.raises(FlightError, match=f"PX4 {FIRST} did not connect to port {PORT + FIRST} within 0.3 s"):
        AutopilotTeam(make_system(2), DT, Settings(first=FIRST, timeout=0.3))
    assert time.monotonic() - begin < 5
    assert are_free()


@pytest.mark.slow
def test_one_that_does_not_arm_says_why(monkeypatch):
    monkeypatch.setattr("multilift_marl.deploy.px4.team.READY_WITHIN", 14.0)
    system = make_system(2)
    world = World(system, 1, 1)
    with Airfield(system, refuses="Preflight Fail: compass") as field:
        field.team.board(world)
        with pytest.raises(FlightError, match=rf"PX4 {FIRST} was not armed within 14 s: .*Preflight Fail: compass"):
            field.team.prepare(world)


def test_a_port_that_is_taken_is_named():
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", PORT + FIRST))
        other.listen(1)
        with pytest.raises(FlightError, match=f"port {PORT + FIRST} of PX4 {FIRST} is taken"):
            AutopilotTeam(make_system(2), DT, Settings(first=FIRST, timeout=0.3))


# Real time


def test_a_simulation_is_held_back_and_catches_up():
    clock, begin = RealTime(2.0), time.perf_counter()
    for step in range(101):
        clock.wait(0.004 * step)
        if step == 50:
            time.sleep(0.05)  # it is late, and catches up
    assert 0.2 <= time.perf_counter() - begin < 2.0
    median, _, largest = clock.lateness()
    assert 0 <= median < largest and 0.02 < largest
    assert np.isnan(RealTime(0.0).lateness()).all()


def test_a_simulation_that_is_far_too_late_goes_on_from_there():
    clock = RealTime(1.0)
    clock.wait(0.0)
    time.sleep(0.3)
    clock.wait(0.004)
    assert clock.slips == 1
    begin = time.perf_counter()
    clock.wait(0.054)
    assert time.perf_counter() - begin > 0.03
