"""The node that flies a team which others measure: step by step like the simulation, and when something is missing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.config.load import build_config
from multilift_marl.control.scripted import make_scripted
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.errors import ConfigError

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from ros_wire import Wire

from multilift_marl.ros import __main__ as command
from multilift_marl.ros import policy_node
from multilift_marl.ros.dds import Node
from multilift_marl.ros.failsafe import HOLD_AFTER, LAND_AFTER, SINK
from multilift_marl.ros.live import LiveFlight
from multilift_marl.ros.messages import NAMES, ODOMETRY, POSE, FlightMessages, Topic, pose_stamped
from multilift_marl.ros.policy_node import FLYING, HOLDING, LANDING, WAITING, PolicyNode
from multilift_marl.ros.types import read_pose

DOMAIN = 120 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
MEASURED = ("payload_position", "payload_rotation", "payload_velocity", "payload_body_rates")
MEASURED += tuple(name.replace("payload", "drone") for name in MEASURED)


def config_of(task: str = "hover", **overrides):
    return ml.load_config(
        task, {"env.num_envs": 1, "env.num_threads": 1, "env.num_drones": 2, "payload.mass": 0.7, **overrides}
    )


def measure(vec) -> dict[str, np.ndarray]:
    return {name: getattr(vec.world.state, name)[0].copy() for name in MEASURED}


@pytest.mark.parametrize("task", ["hover", "track", "pose", "takeoff", "gate"])
def test_a_measured_team_observes_what_the_simulated_one_does(task):
    config = config_of(task, **{"env.num_drones": 3, "payload.mass": 1.0, "env.history": 2})
    vec, team = MultiliftVec(config, EVALUATION), MeasuredTeam(config)
    observation, _ = vec.reset(seed=7)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(team.begin(measure(vec), 7), observation)
    for _ in range(50):
        action = 0.3 * rng.standard_normal((1, 3, vec.action_size)).clip(-1, 1)
        team.command(action)
        observation, *_ = vec.step(action)
        np.testing.assert_allclose(team.observe(measure(vec)), observation, atol=1e-6)
        for name, array in team.reference._asdict().items():
            np.testing.assert_allclose(array, getattr(vec.reference, name), atol=1e-9, err_msg=name)


def test_a_measured_team_simulates_neither_noise_nor_delay():
    config = config_of(**{"randomization.observation_noise": 1.0, "randomization.action_delay": [2, 2]})
    vec, team = MultiliftVec(build_config(config.model_dump(), {}), EVALUATION), MeasuredTeam(config)
    vec.reset(seed=7)
    team.begin(measure(vec), 7)
    action = np.full((1, 2, 4), 0.5)
    slots = team.task.goal.slots[0]
    np.testing.assert_allclose(
        np.linalg.norm(team.command(action).command[0] - slots, axis=1),
        0.5 * config.control.max_offset * np.sqrt(3),
    )
    before = team.observation_names.index("slot_error_0")
    np.testing.assert_allclose(
        np.hypot(*team.observe(measure(vec))[0, :, before : before + 2].T),
        np.linalg.norm((vec.world.state.drone_position[0] - slots)[:, :2], axis=1),
        atol=1e-6,
    )


def fly_together(live: LiveFlight, node: PolicyNode, steps: int) -> None:
    """Step simulation and node in turn, as if both kept to the same time."""
    for _ in range(steps):
        flown, end = node.steps, time.monotonic() + 20
        while node.steps == flown and time.monotonic() < end:
            node.spin_once(0.1)
        assert node.steps == flown + 1, node.mode
        time.sleep(0.002)  # for the set-points to arrive
        live.step()


def until_heard(live: LiveFlight, node: PolicyNode) -> None:
    """Publish the start until the node hears all of it, and the simulation hears the node."""
    end = time.monotonic() + 20
    while not node.steps and time.monotonic() < end:
        live._send()
        node.spin_once(0.02)
    assert node.steps == 1


def test_a_flight_by_the_node_is_the_flight_by_the_policy():
    config = config_of(**{"env.episode_seconds": 20})
    here, there = Node(domain=DOMAIN), Node(domain=DOMAIN)
    vec, plain = MultiliftVec(config, EVALUATION), MultiliftVec(config, EVALUATION)
    live = LiveFlight(vec, here)
    node = PolicyNode(config, lambda team: make_scripted("formation_integral", team), there, seed=3)
    observation, _ = plain.reset(seed=3)
    policy = make_scripted("formation_integral", plain)
    live.begin(3)
    until_heard(live, node)
    time.sleep(0.01)
    live.step()
    fly_together(live, node, 400)
    for _ in range(401):
        observation, *_ = plain.step(policy.act(observation))
    assert node.mode == FLYING and (live.setpoints.late == 0).all()
    np.testing.assert_allclose(vec.world.state.payload_position, plain.world.state.payload_position, atol=1e-5)
    np.testing.assert_allclose(vec.world.state.drone_position, plain.world.state.drone_position, atol=1e-5)


@pytest.mark.parametrize("task", ["hover", "track"])
def test_the_node_flies_drones_that_hear_what_px4_hears(task):
    config = config_of(task, **{"env.episode_seconds": 30})
    here, there = Node(domain=DOMAIN), Node(domain=DOMAIN)
    vec = MultiliftVec(config, EVALUATION)
    live = LiveFlight(vec, here, "report")
    script = "formation_integral" if task == "hover" else "formation_lead"
    node = PolicyNode(config, lambda team: make_scripted(script, team), there, "report", seed=3)
    live.begin(3)
    until_heard(live, node)
    live.step()
    fly_together(live, node, 500)
    error = np.linalg.norm(vec.world.state.payload_position[0] - vec.task.goal.position[0])
    assert error < (0.02 if task == "hover" else 0.05) and (live.setpoints.late == 0).all()


class Bench:
    """A node on a wire, the team that it hears, and the clock on the wall."""

    def __init__(self, monkeypatch, **overrides):
        self.now, self.said, self.wire = 100.0, [], Wire()
        monkeypatch.setattr(policy_node.time, "perf_counter", lambda: self.now)
        config = config_of(**overrides)
        self.vec = MultiliftVec(config, EVALUATION)
        self.vec.reset(seed=5)
        self.node = PolicyNode(
            config, lambda team: make_scripted("formation", team), self.wire, seed=5, say=self.said.append
        )
        self.messages = FlightMessages(self.vec, self.wire.store)
        self.time_ns = 0

    def pass_by(self, seconds: float = 0.02, silent: tuple[str, ...] = ()) -> None:
        """Let time pass; publish the state but for the topics that are silent; and let the node do its part."""
        self.now += seconds
        self.time_ns += round(seconds * 1e9)
        for topic, message in self.messages.messages(self.time_ns):
            if "*" not in silent and topic not in silent:
                self.wire.queues[topic].append(message)
        self.node.spin_once(1.0)

    def places(self) -> np.ndarray:
        return np.array([read_pose(self.wire.sent[f"/drone_{n}/setpoint"][-1].pose)[0] for n in range(2)])


def test_nothing_is_published_before_all_is_heard(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(200):
        bench.pass_by(silent=("/drone_1/odom",))
    assert bench.node.mode == WAITING and not bench.wire.sent["/drone_0/setpoint"]
    bench.pass_by()
    assert bench.node.mode == FLYING
    np.testing.assert_allclose(bench.places(), bench.vec.task.goal.slots[0], atol=1e-12)


@pytest.mark.parametrize("lost", ["/payload/odom", "/drone_1/odom", "*"])
def test_what_is_lost_is_held_then_landed(monkeypatch, lost):
    bench = Bench(monkeypatch)
    for _ in range(10):
        bench.pass_by()
    flown, held = bench.node.steps, bench.places()
    for _ in range(round(HOLD_AFTER / 0.02)):
        bench.pass_by(silent=(lost,))
    assert bench.node.mode == FLYING and bench.node.steps == flown  # waits
    bench.pass_by(silent=(lost,))
    assert bench.node.mode == HOLDING
    sent = len(bench.wire.sent["/drone_0/setpoint"])
    for _ in range(50):
        bench.pass_by(silent=(lost,))
    assert len(bench.wire.sent["/drone_0/setpoint"]) == sent + 50  # autopilots go on hearing
    np.testing.assert_array_equal(bench.places(), held)
    bench.pass_by()  # and back
    assert bench.node.mode == FLYING and bench.node.steps == flown + 1
    for _ in range(round(LAND_AFTER / 0.02) + 1):
        bench.pass_by(silent=(lost,))
    assert bench.node.mode == LANDING
    for _ in range(50):
        bench.pass_by()  # heard again: it lands all the same
    assert bench.node.mode == LANDING
    np.testing.assert_allclose(bench.places()[:, 2], held[:, 2] - 1.0 * SINK, atol=0.03)
    for _ in range(1000):
        bench.pass_by()
    np.testing.assert_allclose(bench.places()[:, 2], 0.0, atol=1e-9)
    what = {"/payload/odom": "the payload", "/drone_1/odom": "drone 1", "*": "drone 0"}[lost]
    assert f"holding: nothing is heard of {what}" in bench.said


def test_drones_sink_as_fast_however_often_others_are_heard(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(10):
        bench.pass_by()
    held = bench.places()
    for _ in range(round((LAND_AFTER + 1.0) / 0.004)):
        bench.pass_by(0.004, ("/payload/odom",))
    np.testing.assert_allclose(bench.places()[:, 2], held[:, 2] - SINK * 1.0, atol=0.03)


def test_rubbish_and_old_news_do_not_count(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(10):
        bench.pass_by()
    flown = bench.node.steps
    old = dict(bench.messages.messages(bench.time_ns))["/drone_0/odom"]
    for _ in range(20):
        bench.pass_by(silent=("/drone_0/odom",))
        bad = dict(bench.messages.messages(bench.time_ns))["/drone_0/odom"]
        bad.pose.pose.orientation.w = np.nan
        far = dict(bench.messages.messages(bench.time_ns))["/drone_0/odom"]
        far.twist.twist.linear.x = np.inf
        bench.wire.queues["/drone_0/odom"] += [bad, old, far]
    assert bench.node.mode == HOLDING and bench.node.steps == flown


def test_the_rate_is_the_policys_whatever_that_of_odometry(monkeypatch):
    for period in (0.004, 1 / 120, 0.01):
        bench = Bench(monkeypatch)
        for _ in range(round(4 / period)):
            bench.pass_by(period)
        assert bench.node.steps == pytest.approx(200, abs=3)


def test_a_glitch_is_waited_out_and_a_team_put_elsewhere_begins_anew(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(10):
        bench.pass_by()
    flown = bench.node.steps
    bench.vec.world.state.drone_position[0, 0] += [0.0, 0.0, 2.0]
    bench.pass_by()
    assert bench.node.steps == flown and bench.node.mode == FLYING
    bench.vec.world.state.drone_position[0, 0] -= [0.0, 0.0, 2.0]
    bench.pass_by()
    assert bench.node.steps == flown + 1
    bench.vec.reset(seed=77)
    bench.vec.world.state.payload_position[0] += 0.2
    bench.vec.world.state.drone_position[0] += 0.2
    for _ in range(6):
        bench.pass_by()
    assert "waiting: the team has been put elsewhere" in bench.said and bench.node.mode == FLYING
    np.testing.assert_allclose(bench.node.team.reference.position[0], bench.vec.world.state.drone_position[0], atol=0.1)


def test_targets_of_others_move_the_team(monkeypatch):
    bench = Bench(monkeypatch)
    bench.pass_by()
    slots, rotation = bench.vec.task.goal.slots[0].copy(), bench.vec.task.goal.rotation[0]
    target = bench.vec.task.goal.position[0] + [0.2, -0.1, 0.1]
    for _ in range(3):
        bench.pass_by(silent=("/target",))
        bench.wire.queues["/target"].append(pose_stamped(bench.wire.store, bench.time_ns, target, rotation))
    bench.pass_by(silent=("/target",))
    np.testing.assert_allclose(bench.places(), slots + [0.2, -0.1, 0.1], atol=1e-9)


def test_a_task_that_has_failed_ends_in_landing_and_one_that_cannot_begin_waits(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(10):
        bench.pass_by()
    bench.vec.world.state.drone_rotation[0, 1] = np.diag([1.0, -1.0, -1.0])  # upside down
    bench.pass_by()
    assert bench.node.mode == LANDING and "tilt; start this node again to fly on" in bench.said[-1]

    bench = Bench(monkeypatch)
    bench.vec.world.state.drone_rotation[0, 1] = np.diag([1.0, -1.0, -1.0])
    for _ in range(10):
        bench.pass_by()
    assert bench.node.mode == WAITING and not bench.wire.sent["/drone_0/setpoint"]
    assert [text for text in bench.said if "waiting, for the task has failed where the team is: tilt" in text] == [
        bench.said[-1]
    ]
    bench.vec.world.state.drone_rotation[0, 1] = np.eye(3)
    bench.pass_by()
    assert bench.node.mode == FLYING


@pytest.mark.parametrize(
    "overrides, words",
    [
        ({"control.action": "ctbr"}, "of control.action=reference, not of ctbr"),
        ({"task": "loss", "env.num_drones": 4}, "nobody measures whose motors have stopped"),
    ],
)
def test_what_the_node_cannot_fly_is_refused(overrides, words):
    task = overrides.pop("task", "hover")
    with pytest.raises(ConfigError, match=words):
        PolicyNode(config_of(task, **overrides), lambda team: make_scripted("formation", team), Wire())


def test_the_command_needs_a_policy_and_waits_for_a_team(capsys):
    assert command.main(["role=policy", "policy=none", f"domain={DOMAIN}"]) == 2
    assert "role=policy needs a policy" in capsys.readouterr().err
    arguments = ["role=policy", "policy=formation", "seconds=0.3", "env.num_drones=2", "payload.mass=0.7"]
    assert command.main([f"domain={DOMAIN}", *arguments]) == 0
    output = capsys.readouterr().out
    assert "flying formation in domain" in output and "flew 0 steps" in output


@pytest.mark.slow
@pytest.mark.parametrize("names", ["multilift", "report"])
def test_two_processes_fly_a_team_in_real_time(names):
    """The simulation in one, the policy in the other; here the payload is heard to come to rest at its target."""
    common = ["config=hover", f"domain={DOMAIN}", f"names={names}", "env.num_drones=3", "env.episode_seconds=60"]
    run = [sys.executable, "-m", "multilift_marl.ros", *common]
    listener, heard, targets = Node(domain=DOMAIN), [], []
    take = listener.subscription(Topic(NAMES[names].payload, ODOMETRY, False))
    take_target = listener.subscription(Topic("/target", POSE, False))
    simulation = subprocess.Popen([*run, "policy=none", "seconds=30"], stdout=subprocess.PIPE, text=True)
    node = subprocess.Popen([*run, "role=policy", "policy=formation_integral"], stdout=subprocess.PIPE, text=True)
    try:
        while simulation.poll() is None:
            heard += take()
            targets += take_target()
            time.sleep(0.01)
        node.send_signal(signal.SIGINT)
        output = node.communicate(timeout=20)[0]
    finally:
        simulation.kill()
        node.kill()
    assert "flying: all bodies are heard" in output and "set-points followed odometry by" in output
    errors = [np.linalg.norm(read_pose(m.pose.pose)[0] - read_pose(targets[-1].pose)[0]) for m in heard[-50:]]
    assert np.mean(errors) < 0.05, output + simulation.stdout.read()
