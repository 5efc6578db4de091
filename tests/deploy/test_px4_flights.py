"""Whole flights by fake autopilots that fly by the sensors alone: from the ground, through a task and back."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from multilift_marl.errors import FlightError
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("pymavlink")  # of the px4 extra
pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from airfield import EXACT, Airfield, config_of, make_fakes
from fake_px4 import FIRST
from rosbags.highlevel import AnyReader

from multilift_marl.agents.policy import find_policy
from multilift_marl.deploy.px4 import __main__ as command
from multilift_marl.deploy.px4.flight import Flight
from multilift_marl.deploy.px4.live import LiveTeam
from multilift_marl.deploy.px4.team import AutopilotTeam, Settings
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.messages import NAMES, ODOMETRY, Topic, pose_stamped, setpoint_topics
from multilift_marl.deploy.ros.stages import Orders
from multilift_marl.deploy.ros.types import read_pose
from multilift_marl.sensing.suite import Sensor

DOMAIN = 170 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))


MAP = {
    "env.sensing": "ideal", "env.episode_seconds": 20.0, "task_options.map": 3, "task_options.length": 4.0,
    "task_options.pillars": 3, "randomization.payload_force": 0.0,
}  # fmt: skip


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
def test_a_team_crosses_a_map_from_below_its_start_to_below_its_goal():
    """Obstacles stand in every part of the flight."""
    config, seen = config_of("navigate_px4", **MAP), {}

    def watch(vec, stage):
        seen.setdefault(vec.task.name, []).append((vec, vec.world.state.payload_position[0].copy()))

    with Airfield(config.system) as field:
        flight = Flight(config, field.team, 1000, lambda text: None, watch)
        result = flight.fly(find_policy("formation_route").bind)
    assert result.ended == "" and result.metrics["failure_cause"][0] == 0
    assert [phase.name for phase in result.phases] == [
        "take-off", "the way to the task", "navigate", "the way back", "landing"
    ]  # fmt: skip
    own, kinds = flight.vec.task.own, flight.vec.world.obstacles.kind[0]
    assert np.count_nonzero(kinds) > 0
    for vec in (part[0][0] for part in seen.values()):
        np.testing.assert_array_equal(vec.world.obstacles.kind[0], kinds)
        np.testing.assert_array_equal(vec.world.obstacles.position[0], flight.vec.world.obstacles.position[0])
    np.testing.assert_allclose(seen["takeoff"][0][1][:2], own.start[0, :2], atol=0.01)
    np.testing.assert_allclose(seen["land"][-1][1][:2], own.goal[0, :2], atol=0.1)
    assert seen["land"][-1][1][2] < 0.1 < result.trace.payload_position[-1, 2]


class Stop(Orders):
    """The end of a task after so many of its steps."""

    def __init__(self, steps: int):
        self.left = steps

    def why_to_land(self) -> str:
        self.left -= 1
        return "a reason" if self.left < 0 else ""


@pytest.mark.slow
def test_a_team_that_is_stopped_on_its_way_through_a_map_lands_there():
    config, places = config_of("navigate_px4", **MAP), []

    def watch(vec, stage):
        places.append((vec.task.name, vec.world.state.payload_position[0].copy()))

    with Airfield(config.system) as field:
        flight = Flight(config, field.team, 1000, lambda text: None, watch, Stop(round(8.0 / 0.02)))
        with pytest.raises(FlightError, match="not flown to its end: a reason"):
            flight.fly(find_policy("formation_route").bind)
    assert [phase.name for phase in flight.phases][-4:] == ["navigate", "stop", "the way back", "landing"]
    last = next(place for task, place in reversed(places) if task == "navigate")
    assert places[-1][1][2] < 0.1 < last[2]
    np.testing.assert_allclose(places[-1][1][:2], last[:2], atol=0.4)
    assert np.linalg.norm(last[:2] - flight.vec.task.own.goal[0, :2]) > 1.0


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
@pytest.mark.parametrize("drones, mass", [(2, 0.7), (1, 0.2)])
def test_the_command_reports_a_flight_that_ends_on_its_way_back(drones, mass, tmp_path, monkeypatch, capsys):
    """With a phase that has no step; of one drone, no other is at any distance."""
    rig = {"env.num_drones": drones, "payload.mass": mass}
    config = config_of("hover", **rig, **{"randomization.payload_force": 0.0, "env.episode_seconds": 1.0})
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
    assert all((phase["separation"] is None) == (drones == 1) for phase in report["px4"]["phases"])
    assert "inf" not in printed.out and (tmp_path / "errors.png").is_file()


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
