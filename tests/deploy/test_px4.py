"""PX4's protocol, against a peer that flies by the sensors alone, and the real one where PX4_DIR points to a build."""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from conftest import make_system

import multilift_marl as ml
from multilift_marl.errors import FlightError
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.realtime import RealTime
from multilift_marl.sim import World
from multilift_marl.sim.earth import Site, project_local

pytest.importorskip("pymavlink")  # of the px4 extra
pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from fake_px4 import FIRST, FakePX4, are_free
from rosbags.highlevel import AnyReader

from multilift_marl.agents.policy import find_policy
from multilift_marl.deploy.px4 import __main__ as command
from multilift_marl.deploy.px4.flight import Flight, check_config
from multilift_marl.deploy.px4.launch import rig_parameters
from multilift_marl.deploy.px4.link import PORT
from multilift_marl.deploy.px4.live import LiveTeam
from multilift_marl.deploy.px4.team import AutopilotController, AutopilotTeam, Settings
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.messages import NAMES, ODOMETRY, Topic, pose_stamped, setpoint_topics
from multilift_marl.deploy.ros.types import read_pose
from multilift_marl.sensing.sensors import Sensor, SensorSuite

DT = 0.004
DOMAIN = 170 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
FAST = Sensor(250.0)
EXACT = SensorSuite(FAST, FAST, Sensor(50.0), Sensor(50.0), Sensor(50.0), Sensor(50.0))


def make_fakes(system, first: int = FIRST, **changes) -> list[FakePX4]:
    fakes = []
    for i, vehicle in enumerate(system.vehicles):
        own = {"mass": vehicle.mass, "inertia": vehicle.inertia, "thrust": vehicle.rotor_thrust_max}
        fakes.append(FakePX4(first + i, rig_parameters(system, i) | own, **changes))
        fakes[-1].start()
    return fakes


class Airfield:
    """Fake autopilots and the team that they fly; a context that ends both."""

    def __init__(self, system, timeout: float = 20.0, suite: SensorSuite = EXACT, **changes):
        self.fakes = make_fakes(system, **changes)
        try:
            self.team = AutopilotTeam(system, DT, Settings(first=FIRST, timeout=timeout, suite=suite))
        except Exception:
            self.__exit__()
            raise

    def __enter__(self) -> Airfield:
        return self

    def __exit__(self, *exception) -> None:
        if hasattr(self, "team"):
            self.team.close()
        for fake in self.fakes:
            fake.end()


def idle(team: AutopilotTeam, world: World, ticks: int) -> None:
    for _ in range(ticks):
        team.tick(world, lambda i: None)


def config_of(task: str = "hover", **overrides):
    return check_config(ml.load_config(task, {"env.num_drones": 2, "payload.mass": 0.7, **overrides}))


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
def test_a_team_flies_from_the_ground_through_a_task_and_back(tmp_path):
    config, said = config_of("hover", **{"randomization.payload_force": 0.0, "env.episode_seconds": 4.0}), []
    named = find_policy("formation_integral")
    options = command.Options(bag=str(tmp_path / "bag"))
    with Airfield(config.system) as field:
        flight = Flight(config, field.team, 1000, said.append)
        result = command._record(flight, named.bind, options)
        for fake in field.fakes:
            assert fake.complaints == []
            time.sleep(0.05)
        assert [link.faults for link in field.team.links] == [0, 0]
    assert said[-1] == "back, and landing" and len(said) == 5
    assert result.metrics["failure_cause"][0] == 0
    assert result.metrics["payload_position_error_m"][0] < 0.1
    assert result.drone_error < 0.25 and result.estimate_error < 0.05  # its controller has no integral
    assert result.trace.tension.min() > 0
    with AnyReader([tmp_path / "bag"]) as reader:
        odometry = [each for each in reader.connections if each.topic == "/payload/odom"]
        heard = [reader.deserialize(data, each.msgtype) for each, _, data in reader.messages(odometry)]
    places = np.array([[p.x, p.y, p.z] for p in (message.pose.pose.position for message in heard)])
    assert heard[0].header.stamp.nanosec == 0 and len(heard) == 201  # the start of the task, and its steps
    np.testing.assert_array_equal(places[1:], result.trace.payload_position)
    ours = flight.fly_ours(lambda vec: make_scripted("formation_integral", vec))
    np.testing.assert_allclose(ours.trace.payload_position[0], result.trace.payload_position[0], atol=0.02)
    assert ours.metrics["payload_position_error_m"][0] < 0.05


@pytest.mark.slow
def test_drones_that_miss_their_places_take_off_and_land_without_a_snatch():
    suite = replace(EXACT, position=Sensor(50.0, offset=0.03))
    config = config_of("hover", **{"randomization.payload_force": 0.0, "env.episode_seconds": 1.0})
    with Airfield(config.system, suite=suite) as field:
        result = Flight(config, field.team, 1000, lambda text: None).fly(find_policy("formation_integral").bind)
    assert max(phase.tension for phase in result.phases) < 4 * config.system.resting_tension.max()
    assert result.estimate_error > 0.02


@pytest.mark.slow
def test_others_fly_autopilots_by_topics_that_they_hear_live():
    """A node that sends each drone to its slot as soon as it has heard of it; steps wait for that."""
    nothing_hidden = {"randomization.payload_force": 0.0, "randomization.payload_mass": 0.0}
    config = config_of("hover", **nothing_hidden, **{"env.episode_seconds": 3.0})
    here, there, over = Node(domain=DOMAIN), Node(domain=DOMAIN), threading.Event()
    drones = range(2)
    stamps, slots = [], []

    def steer() -> None:
        takes = [there.subscription(Topic(f"/drone_{n}/odom", ODOMETRY)) for n in drones]
        sends = [there.publisher(setpoint_topics(NAMES["multilift"], n)[0]) for n in drones]
        clock = there.subscription(Topic("/clock", "rosgraph_msgs/msg/Clock"))
        while not over.is_set():
            there.wait(0.05)
            stamps.extend(each.clock.sec + 1e-9 * each.clock.nanosec for each in clock())
            for n in drones:
                for message in takes[n]():
                    now = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                    place = slots[0][n] if slots else read_pose(message.pose.pose)[0]
                    sends[n](pose_stamped(there.store, now, place, np.eye(3)))

    def bind(vec):
        slots.append(vec.task.goal.slots[0] + [0.2, 0.0, 0.1])
        return live.bind_others(vec)

    thread = threading.Thread(target=steer)
    thread.start()
    try:
        with Airfield(config.system) as field:
            live = LiveTeam(config, here, "multilift", field.team, others=True, waiting=(1.0, 30.0))
            flight = Flight(config, field.team, 1000, lambda text: None, live.publish, live)
            result = flight.fly(bind)
            lasted = field.team.time
    finally:
        over.set()
        thread.join()
    assert result.ended == "" and [phase.name for phase in result.phases][2] == "hover"
    assert live.answers.late.sum() == 0
    # where it was told to fly to, beside its own target
    off = result.trace.payload_position[-25:] - result.trace.target_position[-25:]
    np.testing.assert_allclose(off.mean(axis=0), [0.2, 0.0, 0.1], atol=0.05)
    np.testing.assert_allclose(result.trace.drone_position[-25:].mean(axis=0), slots[0], atol=0.07)
    # the whole flight was heard, by the time of the autopilots
    assert (np.diff(stamps) >= 0).all() and len(stamps) > 500 and stamps[-1] > lasted - 2.0
    least = min(phase.separation for phase in result.phases)
    assert 0.35 < least < 2.0 and all(phase.tilt < 45 for phase in result.phases)


@pytest.mark.slow
def test_the_command_reports_a_flight_that_ends_on_its_way_back(tmp_path, monkeypatch, capsys):
    """With a phase that has no step."""
    config = config_of("hover", **{"randomization.payload_force": 0.0, "env.episode_seconds": 1.0})
    fakes = make_fakes(config.system)
    go, settings = Flight._go, Settings(first=FIRST, timeout=20.0, suite=EXACT)

    def fail_on_the_way_back(flight, vec, begin, end, what):
        if what == "the way back":
            flight._begin(what, vec)
            raise FlightError("PX4 7 has ended")
        return go(flight, vec, begin, end, what)

    monkeypatch.setattr(Flight, "_go", fail_on_the_way_back)
    fly_fakes = partial(AutopilotTeam, settings=settings)
    monkeypatch.setattr("multilift_marl.deploy.px4.team.AutopilotTeam", lambda rig, dt, _: fly_fakes(rig, dt))
    options, bind = command.Options(domain=DOMAIN), find_policy("formation_integral").bind
    try:
        assert command._fly_and_report(config, bind, options, tmp_path, tmp_path) == 1
    finally:
        for fake in fakes:
            fake.end()
    printed, report = capsys.readouterr(), json.loads((tmp_path / "metrics.json").read_text())
    assert "the flight ended early: PX4 7 has ended" in printed.err
    assert [phase["name"] for phase in report["px4"]["phases"]] == ["take-off", "the way to the task", "hover"]
    assert "steps_without_setpoint" not in report["px4"] and report["baselines"]
    assert (tmp_path / "errors.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("task", ["takeoff", "land"])
def test_take_off_and_landing_are_tasks_too(task):
    slow = {"task_options.pace": 0.5, "env.episode_seconds": 24.0} if task == "land" else {}
    config, said = config_of(task, **{"randomization.payload_mass": 0.0} | slow), []
    with Airfield(config.system) as field:
        flight = Flight(config, field.team, 1000, said.append)
        result = flight.fly(lambda vec: make_scripted("formation_integral", vec))
        assert [fake.complaints for fake in field.fakes] == [[], []]
    assert result.metrics["failure_cause"][0] == 0
    assert len(result.trace.time) == flight.vec.max_steps
    assert (said[-1] == "back, and landing") == (task == "takeoff")
    ours = flight.fly_ours(lambda vec: make_scripted("formation_integral", vec))
    assert ours.metrics["success_rate"][0]


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
