"""The geometric-control node: its answers against the controller of the simulation, and when something is missing."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.control.geometric import fly
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from ros_wire import Wire

from multilift_marl.deploy.ros.__main__ import USUAL
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER
from multilift_marl.deploy.ros.geometric_node import SILENT_AFTER, DroneControl, GeometricControlNode
from multilift_marl.deploy.ros.live import LiveFlight
from multilift_marl.deploy.ros.policy_node import PolicyNode
from multilift_marl.deploy.ros.types import (
    PX4Setpoint,
    px4_namespace,
    read_attitude,
    read_rates,
    trajectory_setpoint,
    vehicle_odometry,
)

DOMAIN = 190 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
STEP = 20_000_000  # [ns]
NO_DRAG = {"vehicle.drag": [0.0, 0.0, 0.0]}


def config_of(task: str = "hover", **overrides):
    own = {"env.num_envs": 1, "env.num_threads": 1, "env.num_drones": 2, "payload.mass": 0.7}
    return ml.load_config(task, {**own, **overrides})


class Bench:
    """A node on a wire, and what it is told."""

    def __init__(self, monkeypatch, config=None, **changes):
        self.config = config or config_of()
        self.wire, self.said, self.clock = Wire(), [], 100.0
        monkeypatch.setattr("multilift_marl.deploy.ros.geometric_node.time.perf_counter", lambda: self.clock)
        self.node = GeometricControlNode(self.config, self.wire, say=self.said.append, **changes)

    def measure(self, i: int, time_ns: int, motion) -> None:
        message = vehicle_odometry(self.wire.store, time_ns, motion)
        self.wire.queues[f"{px4_namespace(i)}/out/vehicle_odometry"].append(message)

    def ask(self, i: int, time_ns: int, *motion, **more) -> None:
        message = trajectory_setpoint(self.wire.store, time_ns, PX4Setpoint(*motion, **more))
        self.wire.queues[f"/drone_{i + 1}/trajectory_setpoint"].append(message)

    def sent(self, i: int, kind: str = "vehicle_attitude_setpoint_v1") -> list:
        return self.wire.sent[f"{px4_namespace(i)}/in/{kind}"]


STILL = (np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
HERE = (np.zeros(3), np.zeros(3), np.zeros(3), 0.0)


@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_its_answers_are_the_torques_and_thrusts_of_the_simulations_controller(monkeypatch, rates, seed):
    """A team in motion: from the rotors of `fly`, by the allocation, to what must have been asked for."""
    config = config_of(**NO_DRAG, **{"env.num_drones": 3, "payload.mass": 1.0})
    vec = MultiliftVec(config, EVALUATION)
    vec.reset(seed=seed)
    rng, state, reference, goal = np.random.default_rng(seed), vec.world.state, vec.reference, vec.task.goal
    for name, size in (("position", 0.02), ("velocity", 0.1), ("acceleration", 0.3), ("jerk", 0.5)):
        getattr(reference, name)[:] += size * rng.standard_normal((1, 3, 3))
    reference.yaw_rate[:] = 0.3 * rng.standard_normal((1, 3))
    state.drone_velocity[:] = 0.1 * rng.standard_normal((1, 3, 3))
    state.drone_body_rates[:] = 0.3 * rng.standard_normal((1, 3, 3))
    gains, thrust = vec.controller.gains, np.zeros((1, 3, 4))
    fly(0, 1, state, reference, goal.cable_force, thrust, gains, None)
    bench, load = Bench(monkeypatch, config, by_rates=rates), LoadFeedforward(config.system)
    for i in range(3):
        force = goal.cable_force[0, i]
        rise = load.acceleration(i, reference.velocity[0, i], reference.acceleration[0, i], force, 0.0)
        motion = reference.position[0, i], reference.velocity[0, i], rise, reference.yaw[0, i]
        bench.ask(i, STEP, *motion, yaw_rate=reference.yaw_rate[0, i], jerk=load.jerk(i, reference.jerk[0, i]))
        bench.measure(i, STEP, tuple(array[0, i] for array in state[4:8]))
    bench.node.spin_once(0.1)
    for i, vehicle in enumerate(config.system.vehicles):
        wrench = vehicle.allocation @ thrust[0, i]
        assert ((thrust[0, i] > gains.thrust_min[i]) & (thrust[0, i] < 0.99 * gains.thrust_max[i])).all()
        full = 4 * vehicle.rotor_thrust_max
        (message,) = bench.sent(i, "vehicle_rates_setpoint" if rates else "vehicle_attitude_setpoint_v1")
        assert message.timestamp == STEP // 1000
        asked = read_rates(message) if rates else read_attitude(message, 1.0)
        assert asked.thrust * full == pytest.approx(wrench[0], rel=1e-5)
        # eq 32 without the transport term: M = Ω × J Ω - J (k_R e_R + k_w (Ω - Ω_r) + Ω × Ω_r), Ω_r = Rᵀ R_d Ω_d
        inertia, rate = np.array(vehicle.inertia), state.drone_body_rates[0, i]
        left = -(wrench[1:] - np.cross(rate, inertia * rate)) / inertia
        if rates:
            attitude = DroneControl(config, i)  # of the transport, which needs Ω_r: from the node's own numbers
            attitude.follow(tuple(array[0, i] for array in state[4:8]), self_setpoint(bench, load, vec, i), 0.0)
            turning = asked.rates + gains.k_R[i] / gains.k_w[i] * vee(attitude.desired, state.drone_rotation[0, i])
            np.testing.assert_allclose(asked.rates, rate - (left - np.cross(rate, turning)) / gains.k_w[i], atol=2e-5)
        else:
            b3 = wrench_direction(vec, i)
            np.testing.assert_allclose(asked.attitude[:, 2], b3, atol=1e-6)
            yaw = np.arctan2(-asked.attitude[0, 1], asked.attitude[1, 1])  # of eq 29
            assert yaw == pytest.approx(reference.yaw[0, i], abs=1e-6)


def self_setpoint(bench, load, vec, i) -> PX4Setpoint:
    """Return the set-point of drone i that the test says, in double precision."""
    reference, force = vec.reference, vec.task.goal.cable_force[0, i]
    rise = load.acceleration(i, reference.velocity[0, i], reference.acceleration[0, i], force, 0.0)
    return PX4Setpoint(
        reference.position[0, i].copy(), reference.velocity[0, i], rise, reference.yaw[0, i],
        reference.yaw_rate[0, i], jerk=load.jerk(i, reference.jerk[0, i]),
    )  # fmt: skip


def vee(desired, attitude) -> np.ndarray:
    error = 0.5 * (desired.T @ attitude - attitude.T @ desired)
    return np.array([error[2, 1], error[0, 2], error[1, 0]])


def wrench_direction(vec, i) -> np.ndarray:
    """Return the direction of (m + m_L) a - m (k_p e_p + k_v e_v) + P + m g e3 (eqs 25 and 26)."""
    g, state, reference = vec.controller.gains, vec.world.state, vec.reference
    error = state.drone_position[0, i] - reference.position[0, i]
    rate = state.drone_velocity[0, i] - reference.velocity[0, i]
    force = (g.mass[i] + g.load_share[i]) * reference.acceleration[0, i] + vec.task.goal.cable_force[0, i]
    force = force - g.mass[i] * (g.k_p[i] * error + g.k_v[i] * rate) + [0.0, 0.0, g.mass[i] * 9.81]
    return force / np.linalg.norm(force)


def test_set_points_move_on_by_their_velocities_to_the_odometry(monkeypatch):
    bench = Bench(monkeypatch)
    velocity = np.array([0.5, -0.25, 0.125])
    for k, late in enumerate((0, STEP, 2 * STEP)):
        bench.ask(0, 10 * STEP, 1e-9 * -late * velocity, velocity, np.zeros(3), 0.0)
        bench.measure(0, 10 * STEP + late, (np.zeros(3), np.eye(3), velocity, np.zeros(3)))
        bench.node.spin_once(0.1)
        attitude = read_attitude(bench.sent(0)[k], 1.0).attitude
        np.testing.assert_allclose(attitude, np.eye(3), atol=2e-6)  # no error is left to correct
    bench.ask(0, 10**15, np.zeros(3), velocity, np.zeros(3), 0.0)  # a clock of its own: taken as it is
    bench.measure(0, 14 * STEP, (np.zeros(3), np.eye(3), velocity, np.zeros(3)))
    bench.node.spin_once(0.1)
    np.testing.assert_allclose(read_attitude(bench.sent(0)[3], 1.0).attitude, np.eye(3), atol=2e-6)


def test_without_set_points_it_holds_then_says_nothing_and_begins_again(monkeypatch):
    bench = Bench(monkeypatch)
    bench.measure(0, STEP, STILL)
    bench.node.spin_once(0.1)
    assert not bench.sent(0)  # nobody has asked for anything
    bench.ask(0, 2 * STEP, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0)
    counts = []
    for k in range(2, 202):
        bench.measure(0, k * STEP, STILL)
        bench.node.spin_once(0.1)
        counts.append(len(bench.sent(0)))
    answered = 1 + round(SILENT_AFTER * 50)
    assert counts[-1] == pytest.approx(answered, abs=1)
    assert [word.split(",")[0] for word in bench.said] == ["drone 0: following", "drone 0: holding", "drone 0: silent"]
    held = [read_attitude(message, 1.0).thrust for message in bench.sent(0)]
    first = round(HOLD_AFTER * 50) + 2
    # then it is the place alone that counts, with the load held up
    control = DroneControl(bench.config, 0)
    place = np.array([0.0, 0.0, bench.node._drones[0].place[2]])
    assert HOLD_AFTER - 0.02 <= place[2] <= HOLD_AFTER  # it had moved on by then
    control.follow(STILL, PX4Setpoint(place, np.zeros(3), control.carried, 0.0), 0.0)
    np.testing.assert_allclose(held[first:], control.share, rtol=1e-6)
    bench.ask(0, 300 * STEP, *HERE)
    bench.measure(0, 300 * STEP, STILL)
    bench.node.spin_once(0.1)
    assert len(bench.sent(0)) == counts[-1] + 1 and bench.said[-1] == "drone 0: following"


def test_a_velocity_without_a_place_is_held_at_rest(monkeypatch):
    bench = Bench(monkeypatch)
    moving = (np.zeros(3), np.eye(3), np.array([1.0, 0.0, 0.0]), np.zeros(3))
    bench.ask(0, STEP, np.full(3, np.nan), np.array([1.0, 0.0, 0.0]), np.zeros(3), 0.0)
    tilts = []
    for k in range(1, 2 + round(1.1 * HOLD_AFTER * 50)):
        bench.measure(0, k * STEP, moving)
        bench.node.spin_once(0.1)
        tilts.append(read_attitude(bench.sent(0)[-1], 1.0).attitude[0, 2])
    np.testing.assert_allclose(tilts[0], 0.0, atol=1e-6)  # as fast as it is to be
    assert tilts[-1] < -0.1  # it brakes


def test_it_waits_for_the_set_point_that_belongs_to_an_odometry(monkeypatch):
    bench = Bench(monkeypatch, patience=0.05)
    bench.ask(0, STEP, *HERE)
    bench.measure(0, STEP, STILL)
    bench.node.spin_once(0.1)
    assert len(bench.sent(0)) == 1
    bench.measure(0, 2 * STEP, STILL)
    bench.node.spin_once(0.1)
    assert len(bench.sent(0)) == 1  # the set-point is an old one
    bench.ask(0, 2 * STEP, np.array([0.0, 0.0, 0.5]), np.zeros(3), np.zeros(3), 0.0)
    bench.node.spin_once(0.1)
    low, high = (read_attitude(message, 1.0).thrust for message in bench.sent(0))
    assert high > 1.1 * low
    bench.measure(0, 3 * STEP, STILL)
    bench.node.spin_once(0.1)
    assert len(bench.sent(0)) == 2
    bench.clock += 0.06  # patience is over
    bench.node.spin_once(0.1)
    assert len(bench.sent(0)) == 3


def test_patience_ends_while_odometry_goes_on(monkeypatch):
    """An odometry every 20 ms, patience of 0.2 s, and a planner that has gone: held, then silent."""
    bench = Bench(monkeypatch, patience=0.2)
    for k in range(1, 200):
        if k <= 20:
            bench.ask(0, k * STEP, *HERE)
        bench.measure(0, k * STEP, STILL)
        bench.clock += 0.02
        bench.node.spin_once(0.1)
    assert [word.split(",")[0] for word in bench.said] == ["drone 0: following", "drone 0: holding", "drone 0: silent"]
    # an answer after each patience (two of 11 odometries), then for each odometry while it holds
    assert len(bench.sent(0)) == pytest.approx(20 + 2 + SILENT_AFTER * 50 - 2 * 11, abs=2)


def test_what_is_far_off_is_approached_and_no_heading_is_kept():
    control = DroneControl(config_of(), 0)
    north = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    motion = (np.zeros(3), north, np.zeros(3), np.zeros(3))
    tilts = []
    for x in (0.5, 1.0, 100.0):
        control.follow(motion, PX4Setpoint(np.array([x, 0.0, 0.0]), np.zeros(3), np.zeros(3), np.nan), 0.0)
        tilts.append(np.degrees(np.arccos(control.desired[2, 2])))
        np.testing.assert_allclose(control.desired[:2, 1], [-1.0, 0.0], atol=0.6)  # it faces north still
        assert np.abs(control.rates).max() <= 4.0
    assert tilts[0] < tilts[1] < 60.0 and tilts[2] == pytest.approx(tilts[1])


def test_its_integral_is_that_of_the_position_error_and_stops_at_full_thrust():
    config = config_of(**{"control.disturbance": "integral", "control.disturbance_limit": 10.0})
    control, plain = DroneControl(config, 0), DroneControl(config_of(), 0)
    vehicle = config.system.vehicles[0]
    below = (np.array([0.0, 0.0, -0.1]), *STILL[1:])
    setpoint = PX4Setpoint(np.zeros(3), np.zeros(3), np.zeros(3), 0.0)
    plain.follow(below, setpoint, 0.0)
    control.follow(below, setpoint, 0.0)
    for _ in range(40):
        control.follow(below, setpoint, 0.02)
    gain, full = MultiliftVec(config, EVALUATION).controller._rejection.gain[0], 4 * vehicle.rotor_thrust_max
    assert control.share - plain.share == pytest.approx(gain * 0.1 * 0.8 / full, rel=1e-9)  # m k_p ω ∫ e dt
    falling = (below[0], np.eye(3), np.array([0.0, 0.0, -10.0]), np.zeros(3))
    for _ in range(500):  # after the first all rotors are at their limit
        control.follow(falling, setpoint, 0.02)
    control.follow(below, setpoint, 5.0)  # after a gap nothing is known of the error in it
    control.follow(below, setpoint, 0.0)
    assert control.share - plain.share == pytest.approx(gain * 0.1 * (0.8 + 0.02) / full, rel=1e-9)
    control.restart()
    control.follow(below, setpoint, 0.0)
    assert control.share == pytest.approx(plain.share, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("output", "script"), [("attitude", "formation"), ("rates", "formation"), ("rates", "mpc")])
def test_a_flight_by_planner_and_control_follows_the_path_of_the_policy(output, script):
    """The whole chain over DDS: a circle in the simulation, its drones flown by what two nodes say."""
    team = {"env.episode_seconds": 20, "env.num_drones": 3, "payload.mass": 1.0}
    if script == "mpc":  # fast enough for drag and jerk to matter
        team |= {"task_options.speed": 2.0, "task_options.acceleration": 2.0, "randomization.payload_mass": 0.0}
    config = config_of("track", **team)
    planned = config_of("track", **team, **USUAL["mpc_planner"]) if script == "mpc" else config
    here, there, third = (Node(domain=DOMAIN) for _ in range(3))
    vec, plain = MultiliftVec(config, EVALUATION), MultiliftVec(planned, EVALUATION)
    live = LiveFlight(vec, here, "report")
    planner = PolicyNode(
        planned, lambda team: make_scripted(script, team), there, "report", seed=3, start="stage",
        receiver="geometric_control",
    )  # fmt: skip
    control = GeometricControlNode(config, third, patience=5.0, by_rates=output == "rates")
    policy, errors = make_scripted(script, plain), []
    observation, _ = plain.reset(seed=3)
    live.begin(3)

    def answer(steps: int) -> bool:
        end = time.monotonic() + 20
        while control.steps < steps and time.monotonic() < end:
            planner.spin_once(0.005)
            control.spin_once(0.005)
            if not planner.steps:
                live._send()  # until all have found each other
        return control.steps >= steps

    assert answer(3)
    for _ in range(250):
        before = control.steps
        live.step()
        observation, *_ = plain.step(policy.act(observation))
        assert answer(before + 3)
        errors.append(np.linalg.norm(vec.world.state.payload_position[0] - plain.world.state.payload_position[0]))
    # Attitudes go out 50 times a second, and of attitudes the rates are not fed forward.
    assert max(errors) < (0.03 if output == "rates" else 0.06), max(errors)
    assert (live.answers.late <= 1).all()


@pytest.mark.parametrize(
    ("overrides", "changes", "words"),
    [
        ({}, {"names": "multilift"}, "not of names=multilift"),
        ({"control.disturbance": "indi"}, {}, "set integral or none"),
        ({}, {"drones": []}, "leaves nothing to control"),
        ({}, {"drones": [1, 1]}, "has a drone twice"),
        ({}, {"drones": [0, 2]}, r"drones=\[2\] are none of this team, which has 0 to 1"),
    ],
)
def test_what_it_cannot_do_is_refused(overrides, changes, words):
    with pytest.raises(ConfigError, match=words):
        GeometricControlNode(config_of(**overrides), Wire(), **changes)
