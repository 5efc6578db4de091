"""Flights by PX4 that others steer: their set-points, their orders, and what happens when they fall silent."""

from __future__ import annotations

import os
import sys
import threading
from types import SimpleNamespace as record

import numpy as np
import pytest

from multilift_marl.errors import FlightError
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("pymavlink")  # of the px4 extra
pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from airfield import Airfield, config_of
from ros_wire import Wire

from multilift_marl.deploy.px4.flight import Flight
from multilift_marl.deploy.px4.forwarded import ForwardedSetpoints
from multilift_marl.deploy.px4.live import LiveTeam
from multilift_marl.deploy.ros.answers import Waiting
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.geometric_node import GeometricControlNode
from multilift_marl.deploy.ros.policy_node import PolicyNode
from multilift_marl.deploy.ros.stages import Orders, Stage
from multilift_marl.deploy.ros.types import NONE, PX4Setpoint
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.sim.earth import swap_attitude

DOMAIN = 200 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
PLAIN = {"randomization.payload_force": 0.0, "randomization.payload_mass": 0.0}


def live_team(wire, **changes) -> LiveTeam:
    return LiveTeam(
        config_of("hover"), wire, "report", record(report=lambda state: None, time=0.0), True, (0.1, 1.0), **changes
    )


def order(wire, drone: int, stage: int) -> None:
    wire.queues[f"/state/command_drone_{drone}"].append(wire.store.types["std_msgs/msg/Int32"](data=stage))


def test_stages_begin_when_all_drones_have_been_ordered_them():
    wire = Wire()
    assert live_team(wire).may_begin(Stage.TRAJECTORY)  # nobody is asked
    live = live_team(wire, ordered=True)
    assert not live.may_begin(Stage.TAKE_OFF)
    order(wire, 0, Stage.TAKE_OFF)
    assert not live.may_begin(Stage.TAKE_OFF)
    order(wire, 1, 9)  # no stage: left out
    assert not live.may_begin(Stage.TAKE_OFF)
    order(wire, 1, Stage.TRAJECTORY)
    assert live.may_begin(Stage.TAKE_OFF) and not live.may_begin(Stage.TRAJECTORY)
    order(wire, 0, Stage.TRAJECTORY)
    assert live.may_begin(Stage.TRAJECTORY) and live.why_to_land() == ""
    order(wire, 1, Stage.LAND)
    assert not live.may_begin(Stage.TRAJECTORY)
    assert live.why_to_land() == "/state/command_drone_1 orders 7"


def test_lost_set_points_are_a_reason_to_land():
    live = live_team(Wire())
    live.answers = record(age=np.array([0.1, 2.1]))
    assert live.why_to_land() == "no set-point of drone 1 has come for 2.1 s"
    live.answers.age[:] = np.inf, 0.0
    assert live.why_to_land() == "no set-point of drone 0 has come"
    live.answers.age[:] = 1.9
    assert live.why_to_land() == ""


class Recorder:
    """A team of autopilots that keeps what each of them is sent."""

    def __init__(self):
        self.sent = []

    def tick(self, world, send):
        for i in range(world.num_drones):
            send(i)

    def send_attitude(self, i, attitude, thrust, yaw_rate):
        self.sent.append(("attitude", i, attitude, thrust, yaw_rate))

    def send_rates(self, i, rates, thrust):
        self.sent.append(("rates", i, rates, thrust))

    def send_motion(self, i, position, velocity, acceleration, yaw):
        self.sent.append(("motion", i, position, velocity, acceleration, yaw))


def test_set_points_of_each_kind_are_passed_on_as_they_are():
    config, team, queues = config_of("hover"), Recorder(), [[], []]
    vec = MultiliftVec(config, EVALUATION)

    def taker(n):
        def take():
            came, queues[n] = queues[n], []
            return came

        return take

    waiting = Waiting(lambda seconds: False, lambda: 0, 0.0, 0.0)
    forwarded = ForwardedSetpoints(config, vec.world, [taker(0), taker(1)], waiting, team)
    vec.use_controller(forwarded)
    vec.reset(seed=0)
    vec.step(np.zeros((1, 2, 4)))
    places = vec.world.state.drone_position[0]
    for n in range(2):  # nobody has said anything: drones stay, and hold their cables
        kind, drone, position, velocity, acceleration, _ = team.sent[n]
        assert (kind, drone) == ("motion", n)
        np.testing.assert_allclose(position, places[n], atol=0.01)
        np.testing.assert_allclose(acceleration, vec.task.goal.cable_force[0, n] / config.system.drone_mass[n])
        assert not velocity.any()
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    queues[0].append((1, PX4Setpoint(NONE.copy(), NONE, np.zeros(3), 0.3, 0.2, tilt, 0.4)))
    queues[1].append((1, PX4Setpoint(NONE.copy(), NONE, NONE, np.nan, thrust=0.25, rates=np.array([1.0, 2.0, 3.0]))))
    team.sent.clear()
    vec.step(np.zeros((1, 2, 4)))
    kind, drone, attitude, *numbers = team.sent[0]
    assert (kind, drone, *numbers) == ("attitude", 0, 0.4, 0.2)
    np.testing.assert_array_equal(attitude, tilt)
    kind, drone, rates, thrust = team.sent[1]
    assert (kind, drone, rates.tolist()) == ("rates", 1, [1.0, 2.0, 3.0])
    assert thrust == pytest.approx(0.25 * 4 * config.system.vehicles[1].rotor_thrust_max)
    place = np.array([1.0, np.nan, 2.0])  # of an axis nothing is asked
    queues[0].append((2, PX4Setpoint(place, np.zeros(3), np.array([0.1, np.nan, 0.3]), 0.5)))
    team.sent.clear()
    vec.step(np.zeros((1, 2, 4)))
    kind, _, position, _, acceleration, yaw = team.sent[0]
    assert kind == "motion" and yaw == 0.5 and np.isnan(position[1]) and position[[0, 2]].tolist() == [1.0, 2.0]
    carried = vec.task.goal.cable_force[0, 0] / config.system.drone_mass[0]
    np.testing.assert_allclose(acceleration, [0.1, carried[1], 0.3])


def test_an_attitude_and_a_place_with_gaps_reach_the_autopilot():
    config = config_of("hover", **PLAIN)
    vec = MultiliftVec(config, EVALUATION)
    vec.reset(seed=0)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    with Airfield(config.system) as field:
        field.team.board(vec.world)
        for _ in range(60):
            field.team.tick(vec.world, lambda i: None)

        def send(i: int) -> None:
            if i == 0:
                field.team.send_attitude(0, tilt, 0.4, 0.2)
            else:
                field.team.send_motion(1, np.array([np.nan, 2.0, 3.0]), NONE, np.ones(3), np.nan)

        for _ in range(100):
            field.team.tick(vec.world, send)
        attitude, motion = (fake.setpoints[-1] for fake in field.fakes)
    assert attitude.get_type() == "SET_ATTITUDE_TARGET" and attitude.type_mask == 3
    assert (attitude.thrust, attitude.body_yaw_rate) == pytest.approx((0.4, -0.2))
    w, x, y, z = attitude.q
    about_x = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    np.testing.assert_allclose(about_x, swap_attitude(tilt)[:, 0], atol=1e-6)
    # north is y, east is x, which is not asked for; neither are velocities and the heading
    assert motion.type_mask == 0b110000111010 | 0 and (motion.afx, motion.afy, motion.afz) == (1.0, 1.0, -1.0)
    assert motion.x == pytest.approx(2.0 - vec.world.state.drone_position[0, 1, 1], abs=0.1)


class Script(Orders):
    """Orders by the count of questions."""

    def __init__(self, take_off: int = 0, begin: int = 0, land: int = 10**9):
        self.after, self.asked = {Stage.TAKE_OFF: take_off, Stage.TRAJECTORY: begin}, {}
        self.land, self.steps = land, 0

    def may_begin(self, stage):
        self.asked[stage] = self.asked.get(stage, 0) + 1
        return self.asked[stage] > self.after[stage]

    def why_to_land(self):
        self.steps += 1
        return "a reason" if self.steps > self.land else ""


@pytest.mark.slow
def test_a_flight_waits_for_its_orders_and_comes_home_when_it_is_told_to():
    config, stages, said = config_of("hover", **PLAIN, **{"env.episode_seconds": 3.0}), [], []
    orders = Script(take_off=500, begin=60, land=60 + 50)
    with Airfield(config.system) as field:
        flight = Flight(config, field.team, 1000, said.append, lambda vec, stage: stages.append(int(stage)), orders)
        with pytest.raises(FlightError, match="not flown to its end: a reason"):
            flight.fly(lambda vec: make_scripted("formation_integral", vec))
        assert [fake.armed for fake in field.fakes] == [False, False]
        assert [fake.complaints for fake in field.fakes] == [[], []]
    assert orders.asked[Stage.TAKE_OFF] == 501 and orders.asked[Stage.TRAJECTORY] == 61
    assert [phase.name for phase in flight.phases] == [
        "take-off", "the way to the task", "hover until ordered", "hover", "stop", "the way back", "landing",
    ]  # fmt: skip
    lasted = {phase.name: phase.seconds for phase in flight.phases}
    assert lasted["hover until ordered"] == pytest.approx(60 * 0.02) and lasted["hover"] == pytest.approx(1.0, abs=0.1)
    order_of = [stage for k, stage in enumerate(stages) if k == 0 or stages[k - 1] != stage]
    assert order_of == [0, 1, 2, 3, 4, 5, 4, 3, 7, 6]


@pytest.mark.slow
def test_two_nodes_fly_autopilots_and_their_silence_brings_the_team_home():
    """Planner and geometric control over DDS, until the control is lost in the middle of the task."""
    config = config_of("hover", **PLAIN, **{"env.episode_seconds": 10.0})
    here, there, third, over = (*(Node(domain=DOMAIN) for _ in range(3)), threading.Event())
    planner = PolicyNode(
        config, lambda team: make_scripted("formation", team), there, "report", start="stage", say=lambda text: None,
        receiver="geometric_control",
    )  # fmt: skip
    control = GeometricControlNode(config, third, patience=1.0, say=lambda text: None)
    places, lost = [], 350

    def work(node, until):
        while not over.is_set() and not until():
            node.spin_once(0.02)

    def watch(vec, stage):
        live.publish(vec, stage)
        if stage == Stage.TRAJECTORY:
            places.append(vec.world.state.payload_position[0] - vec.task.goal.position[0])

    threads = [
        threading.Thread(target=work, args=(planner, lambda: False)),
        threading.Thread(target=work, args=(control, lambda: len(places) > lost)),
    ]
    for thread in threads:
        thread.start()
    try:
        with Airfield(config.system) as field:
            live = LiveTeam(config, here, "report", field.team, others=True, waiting=(1.0, 30.0))
            flight = Flight(config, field.team, 1000, lambda text: None, watch, live)
            with pytest.raises(FlightError, match=r"no set-point of drone 0 has come for 2\.0"):
                flight.fly(live.bind_others)
            assert [fake.armed for fake in field.fakes] == [False, False]
    finally:
        over.set()
        for thread in threads:
            thread.join()
    assert [phase.name for phase in flight.phases][-3:] == ["stop", "the way back", "landing"]
    assert np.abs(np.array(places[200:lost])).max() < 0.06  # it was flown well before
    assert len(places) == pytest.approx(lost + 102, abs=8)
