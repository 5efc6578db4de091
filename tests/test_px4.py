"""PX4's protocol, against a peer that flies by the sensors alone, and the real one where PX4_DIR points to a build."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import make_system

import multilift_marl as ml
from multilift_marl.control.scripted import make_scripted
from multilift_marl.errors import ConfigError, FlightError
from multilift_marl.realtime import RealTime
from multilift_marl.sim import World
from multilift_marl.sim.earth import Site, project_local

pytest.importorskip("pymavlink")  # of the px4 extra
from fake_px4 import FakePX4

from multilift_marl.px4 import __main__ as command
from multilift_marl.px4.flight import Flight, check_config
from multilift_marl.px4.launch import find_px4, rig_parameters
from multilift_marl.px4.link import PORT
from multilift_marl.px4.mavlink import MAVLink, Splitter, mavlink
from multilift_marl.px4.team import AutopilotController, AutopilotTeam, Settings
from multilift_marl.sim.sensors import Sensor, SensorSuite

WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
FIRST = 100 + 20 * WORKER  # instances of this process, each with ports of its own
DT = 0.004
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

    def __init__(self, system, timeout: float = 20.0, **changes):
        self.fakes = make_fakes(system, **changes)
        try:
            self.team = AutopilotTeam(system, DT, Settings(first=FIRST, timeout=timeout, suite=EXACT))
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


def are_free(first: int = FIRST, count: int = 2) -> bool:
    """Return whether the ports can be listened to again."""
    for i in range(count):
        with socket.socket() as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            server.bind(("127.0.0.1", PORT + first + i))
    return True


# Bytes


def test_a_stream_is_cut_into_messages_wherever_it_is_split():
    sender = MAVLink(1, 1)
    sent = [sender.hil_actuator_controls_encode(k, [0.1 * k] * 16, 128, 1) for k in range(5)]
    other = sender.heartbeat_encode(2, 12, 0, 0, 4)
    stream = b"rubbish" + b"".join(message.pack(sender) + other.pack(sender) for message in sent) + b"\xfd\x03"
    wanted = {mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS}
    for size in (1, 2, 7, 50, 1000):
        splitter = Splitter(wanted)
        heard = [m for k in range(0, len(stream), size) for m in splitter.split(stream[k : k + size])]
        assert [message.time_usec for message in heard] == list(range(5))
        assert splitter.skipped == 7


def test_what_is_damaged_is_skipped_and_no_more():
    sender, rng = MAVLink(1, 1), np.random.default_rng(0)
    messages = [sender.hil_actuator_controls_encode(k, [0.5] * 16, 128, 1).pack(sender) for k in range(50)]
    damaged = set(rng.choice(50, 20, replace=False).tolist())
    for k in damaged:
        data = bytearray(messages[k])
        data[rng.integers(12, len(data))] ^= 1 << int(rng.integers(8))
        messages[k] = bytes(data)
    splitter = Splitter({mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS})
    heard = {message.time_usec for message in splitter.split(b"".join(messages) + bytes(400))}
    assert heard == set(range(50)) - damaged


def test_random_bytes_neither_hang_nor_raise():
    rng = np.random.default_rng(0)
    splitter = Splitter({mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS})
    for _ in range(200):
        data = rng.integers(0, 256, rng.integers(0, 600)).astype(np.uint8)
        data[rng.random(len(data)) < 0.1] = 0xFD
        assert splitter.split(data.tobytes()) == []


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


def test_a_team_flies_from_the_ground_through_a_task_and_back():
    config, said = config_of("hover", **{"randomization.payload_force": 0.0, "env.episode_seconds": 4.0}), []
    with Airfield(config.system) as field:
        flight = Flight(config, field.team, 1000, said.append)
        result = flight.fly(lambda vec: make_scripted("formation_integral", vec))
        for fake in field.fakes:
            assert fake.complaints == []
            time.sleep(0.05)
        assert [link.faults for link in field.team.links] == [0, 0]
    assert said[-1] == "back, and landing" and len(said) == 5
    assert result.metrics["failure_cause"][0] == 0
    assert result.metrics["payload_position_error_m"][0] < 0.1
    assert result.drone_error < 0.25 and result.estimate_error < 0.05  # its controller has no integral
    assert result.trace.tension.min() > 0
    ours = flight.fly_ours(lambda vec: make_scripted("formation_integral", vec))
    np.testing.assert_allclose(ours.trace.payload_position[0], result.trace.payload_position[0], atol=0.02)
    assert ours.metrics["payload_position_error_m"][0] < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("task", ["takeoff", "land"])
def test_take_off_and_landing_are_tasks_too(task):
    config, said = config_of(task, **{"randomization.payload_mass": 0.0}), []
    with Airfield(config.system) as field:
        flight = Flight(config, field.team, 1000, said.append)
        result = flight.fly(lambda vec: make_scripted("formation_integral", vec))
        assert [fake.complaints for fake in field.fakes] == [[], []]
    assert result.metrics["failure_cause"][0] == 0
    assert len(result.trace.time) == flight.vec.max_steps
    assert (said[-1] == "back, and landing") == (task == "takeoff")
    ours = flight.fly_ours(lambda vec: make_scripted("formation_integral", vec))
    assert ours.metrics["success_rate"][0]


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
                assert asked.body_roll_rate == pytest.approx(0.2 * config.control.max_tilt_rate, rel=1e-5)
                assert asked.body_pitch_rate == asked.body_yaw_rate == 0
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
        ({"stamp": 1000}, "did not answer within 0.5 s"),
    ],
)
def test_an_autopilot_that_fails_is_named(changes, words):
    system = make_system(2)
    world = World(system, 1, 1)
    with Airfield(system, timeout=0.5, **changes) as field:
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


def test_one_that_does_not_arm_says_why(monkeypatch):
    monkeypatch.setattr("multilift_marl.px4.team.READY_WITHIN", 14.0)
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


# The command


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "no PX4 is given; clone PX4-Autopilot, run `make px4_sitl_default` there"),
        (["px4=/nowhere"], "px4=/nowhere holds no PX4 for simulation"),
        (
            ["px4=/nowhere", "control.action=rotor", "policy=formation"],
            "PX4 has set-points for control.action=reference and acceleration and ctbr, not for rotor",
        ),
        (["px4=/nowhere", "cable.model=chain"], "set cable.model=massless"),
        (["px4=/nowhere", "timeout=0"], "timeout"),
        (["px4=/nowhere", "parameters={mpc: 1}"], "parameters"),
        (["px4=/nowhere", "parameters={MPC_XY_P: much}"], "parameters"),
        (["px4=/nowhere", "parameters={MPC_XY_P: 1.2}"], "px4=/nowhere holds no PX4"),
        (["px4=/nowhere", "config=loss"], "PX4 cannot fly config=loss"),
        (["px4=/nowhere", "instance=12"], "instance"),
        (["px4=/nowhere", "policy=formations"], "unknown policy 'formations'"),
    ],
)
def test_what_cannot_be_flown_is_said_in_one_sentence(arguments, words, capsys, monkeypatch, tmp_path):
    monkeypatch.delenv("PX4_DIR", raising=False)
    monkeypatch.chdir(tmp_path)
    assert command.main(arguments) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_build_is_found_in_the_repository_and_by_itself(tmp_path):
    build = tmp_path / "build" / "px4_sitl_default"
    for name in ("bin/px4", "etc/init.d-posix/rcS"):
        (build / name).parent.mkdir(parents=True, exist_ok=True)
        (build / name).write_text("")
    assert find_px4(tmp_path) == find_px4(build) == build
    with pytest.raises(ConfigError, match="make px4_sitl_default"):
        find_px4(tmp_path / "build")


STUB = """#!/bin/sh
echo 'ERROR [px4] something is wrong'
{last}
"""


def stub(folder, last: str):
    build = folder / "build" / "px4_sitl_default"
    for name in ("bin/px4", "etc/init.d-posix/rcS"):
        (build / name).parent.mkdir(parents=True, exist_ok=True)
        (build / name).write_text(STUB.format(last=last))
    (build / "bin" / "px4").chmod(0o755)
    return build


def test_one_that_ends_at_once_is_named_at_once_with_its_last_words(tmp_path):
    begin = time.monotonic()
    with pytest.raises(FlightError, match=rf"PX4 {FIRST} has ended \(status 3\): ERROR \[px4\] something is wrong"):
        AutopilotTeam(make_system(2), DT, Settings(build=stub(tmp_path, "exit 3"), first=FIRST, timeout=60.0))
    assert time.monotonic() - begin < 30
    assert are_free()


@pytest.mark.parametrize("twice", [False, True])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_a_command_that_is_ended_leaves_nothing_behind(number, twice, tmp_path):
    stub(tmp_path, f"echo $$ >> {tmp_path}/pids; exec sleep 1000")
    process = subprocess.Popen(
        [sys.executable, "-m", "multilift_marl.px4", f"px4={tmp_path}", "env.num_drones=2", "payload.mass=0.7",
         "timeout=300", f"out={tmp_path / 'out'}", f"instance={2 + 2 * (WORKER % 4)}"],
        env={**os.environ, "TMPDIR": str(tmp_path)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    pids = tmp_path / "pids"
    end = time.monotonic() + 120
    while not (pids.exists() and len(pids.read_text().split()) == 2) and time.monotonic() < end:
        time.sleep(0.05)
    assert list(tmp_path.glob("px4-*"))
    process.send_signal(number)
    if twice:
        process.send_signal(number)
    status = process.wait(30)
    running = [int(pid) for pid in pids.read_text().split()]
    end = time.monotonic() + 10
    while any(os.path.exists(f"/proc/{pid}") for pid in running) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in running)
    if number != signal.SIGKILL and not twice:
        assert status == 130 and process.stderr.read().strip().endswith("stopped")
        assert not list(tmp_path.glob("px4-*"))


def test_more_drones_than_px4_has_instances_are_refused(tmp_path, capsys):
    stub(tmp_path, "exit 0")
    assert command.main([f"px4={tmp_path}", "instance=7", "env.num_drones=4", f"out={tmp_path / 'out'}"]) == 2
    assert "instance=7 and 4 drones need PX4 instances up to 10" in capsys.readouterr().err


# PX4 itself

PX4 = pytest.mark.skipif("PX4_DIR" not in os.environ, reason="PX4_DIR does not point to a build of PX4")


@PX4
@pytest.mark.slow
def test_px4_flies_two_drones(tmp_path, capsys):
    assert command.main(["config=hover", "env.num_drones=2", "payload.mass=0.7", f"out={tmp_path}"]) == 0
    assert "times real time" in capsys.readouterr().out
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert report["px4"]["lockstep_faults"] == 0 and report["px4"]["drone_error_m"] < 0.1
    assert (tmp_path / "errors.png").is_file()


@PX4
@pytest.mark.slow
def test_one_that_is_killed_in_flight_is_named_and_the_others_end():
    config = config_of()
    settings = Settings(build=find_px4(os.environ["PX4_DIR"]), timeout=5.0)
    with AutopilotTeam(config.system, DT, settings) as team:
        processes = dict(team.autopilots._processes)

        def kill(text: str) -> None:
            if text == "to the task":
                processes[1].kill()

        with pytest.raises(FlightError, match="PX4 1 has ended"):
            Flight(config, team, 1000, kill).fly(lambda vec: make_scripted("formation", vec))
    assert all(process.poll() is not None for process in processes.values())
    assert are_free(0)
