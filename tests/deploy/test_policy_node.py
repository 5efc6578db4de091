"""The node that flies a team which others measure: step by step like the simulation, and when something is missing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import slow

import multilift_marl as ml
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from ros_wire import Wire

from multilift_marl.deploy.ros import __main__ as command
from multilift_marl.deploy.ros import policy_node
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.live import LiveFlight
from multilift_marl.deploy.ros.messages import NAMES, ODOMETRY, POSE, Topic, pose_stamped, setpoint_topics
from multilift_marl.deploy.ros.policy_node import FLYING, PolicyNode
from multilift_marl.deploy.ros.types import VEHICLE_ODOMETRY, read_pose

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


@pytest.mark.parametrize("heard", ["next", "first", None])
def test_a_task_that_begins_anew_follows_a_simulation_to_its_next_episode(heard):
    """By the target that it publishes; without one the episode begins again."""
    config = config_of("pose_easy")
    vec, team = MultiliftVec(config, EVALUATION), MeasuredTeam(config)
    vec.reset(seed=7)
    team.begin(measure(vec), 7)
    first = vec.task.goal.position[0].copy()
    vec.reset(mask=np.ones(1, bool))
    following = vec.task.goal.position[0].copy()
    assert np.linalg.norm(following - first) > 0.3
    team.begin(measure(vec), 7, None, {"next": following, "first": first, None: None}[heard])
    np.testing.assert_array_equal(team.task.goal.position[0], following if heard == "next" else first)
    vec.reset(mask=np.ones(1, bool))
    if heard == "next":
        team.begin(measure(vec), 7, None, vec.task.goal.position[0])
        np.testing.assert_array_equal(team.task.goal.position[0], vec.task.goal.position[0])


def test_rotors_that_nobody_measures_close_their_gap_by_the_motors_lags():
    lags = {"vehicle.rotor_time_constant_up": [0.03, 0.06], "vehicle.rotor_time_constant_down": [0.05, 0.1]}
    config = config_of(**lags)
    vec, team = MultiliftVec(config, EVALUATION), MeasuredTeam(config)
    vec.reset(seed=7)
    team.begin(measure(vec), 7)
    speed, vehicles = team.world.state.rotor_speed, config.system.vehicles
    team.command(np.zeros((1, 2, 4)))
    for start in (100.0, 3000.0):  # both far from any that carries it
        speed[:] = start
        team.advance()
        for n, vehicle in enumerate(vehicles):
            asked = np.sqrt(team.world.thrust[0, n] / vehicle.thrust_coefficient)
            assert ((asked > start) == (start == 100.0)).all()
            lag = vehicle.rotor_time_constant_up if start == 100.0 else vehicle.rotor_time_constant_down
            expected = asked + (start - asked) * np.exp(-team.task.control_dt / lag)
            np.testing.assert_allclose(speed[0, n], expected, rtol=1e-12)


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


@pytest.mark.parametrize("task", ["hover", "track", "pose", slow("land"), slow("recover")])
def test_a_flight_by_the_node_is_the_flight_by_the_policy(task):
    config = config_of(task, **{"env.episode_seconds": 20})
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
    fly_together(live, node, 200)
    for _ in range(201):
        observation, *_ = plain.step(policy.act(observation))
    assert node.mode == FLYING and (live.answers.late == 0).all()
    np.testing.assert_allclose(vec.world.state.payload_position, plain.world.state.payload_position, atol=1e-12)
    np.testing.assert_allclose(vec.world.state.drone_position, plain.world.state.drone_position, atol=1e-12)


def test_peers_with_other_qualities_of_service_hear_what_is_published():
    """ROS 2's default (reliable) and that of PX4's examples (best effort, transient local)."""
    here, there = Node(domain=DOMAIN), Node(domain=DOMAIN)
    vec = MultiliftVec(config_of(), EVALUATION)
    live = LiveFlight(vec, here, "report")
    setpoints = here.publisher(setpoint_topics(NAMES["multilift"], 0)[0])
    reliable = there.subscription(Topic("/drone_0/setpoint", POSE))
    odometry = [
        there.subscription(Topic("/fmu/out/vehicle_odometry", VEHICLE_ODOMETRY, False, latched))
        for latched in (False, True)
    ]
    live.begin(3)
    heard, end = [0, 0, 0], time.monotonic() + 20
    while min(heard) == 0 and time.monotonic() < end:
        live._send()
        setpoints(pose_stamped(here.store, 0, np.zeros(3), np.eye(3)))
        time.sleep(0.01)
        heard = [n + len(take()) for n, take in zip(heard, (reliable, *odometry), strict=True)]
    assert min(heard) > 0, heard


@pytest.mark.slow
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
    assert error < (0.02 if task == "hover" else 0.05) and (live.answers.late == 0).all()


@pytest.mark.parametrize(
    "overrides, words",
    [
        ({"control.action": "ctbr"}, "of control.action=reference, not of ctbr"),
        ({"task": "loss", "env.num_drones": 4}, "nobody measures whose motors have stopped"),
        ({"task": "regroup", "env.sensing": "ideal"}, "nobody measures whose cables are attached"),
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
    assert "listening in domain" in output and "flew 0 steps" in output


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
    assert "flying: all is heard" in output and "set-points followed odometry by" in output
    errors = [np.linalg.norm(read_pose(m.pose.pose)[0] - read_pose(targets[-1].pose)[0]) for m in heard[-50:]]
    assert np.mean(errors) < 0.05, output + simulation.stdout.read()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_whatever_asks_the_command_to_end_the_team_lands(monkeypatch, capsys, number):
    landed = []

    def spin_once(node, seconds):
        if not landed:
            signal.raise_signal(number)

    def land(node, why):
        landed.append(why)
        node.mode = policy_node.READY  # as if on the ground

    monkeypatch.setattr(PolicyNode, "spin_once", spin_once)
    monkeypatch.setattr(PolicyNode, "land", land)
    assert command.main(["role=policy", "policy=formation", "env.num_drones=2", f"domain={DOMAIN}", "seconds=60"]) == 0
    assert landed == ["interrupted; once more ends this at once"] and "flew 0 steps" in capsys.readouterr().out
