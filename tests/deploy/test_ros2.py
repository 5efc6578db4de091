"""Real ROS 2 nodes (rclpy) against ours on the loopback, where ROS_PYTHON names a Python that has ROS 2.

ROS 2 installs by pip: ros-jazzy-rclpy, ros-jazzy-rmw-fastrtps-cpp, and the messages' packages, see `.ci/run`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
PYTHON = os.environ.get("ROS_PYTHON", "")
if not PYTHON:
    pytest.skip("ROS_PYTHON names no Python with ROS 2", allow_module_level=True)

DOMAIN = 160 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
PEER = Path(__file__).parents[1] / "ros2_peer.py"
TEAM = ("config=hover", "env.num_drones=2", "payload.mass=0.7", "env.episode_seconds=60")


def meet(role: str, *nodes: tuple[str, ...]) -> dict:
    """Return what a ROS 2 node finds while nodes of ours run."""
    command = [sys.executable, "-m", "multilift_marl.ros", f"domain={DOMAIN}"]
    with ExitStack() as stack:
        running = []
        for arguments in nodes:
            process = subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True)
            stack.callback(process.kill)
            running.append(process)
        assert running[0].stdout is not None
        alarm = threading.Timer(300.0, running[0].kill)
        alarm.start()
        stack.callback(alarm.cancel)
        # what it says is what a ROS 2 node needs
        (said,) = (word for word in running[0].stdout.readline().split() if word.startswith("ROS_AUTOMATIC"))
        alarm.cancel()
        name, _, value = said.partition("=")
        peer = [PYTHON, str(PEER), role, str(DOMAIN)]
        found = subprocess.run(peer, env=os.environ | {name: value}, capture_output=True, text=True, timeout=600)
        assert found.returncode == 0, found.stderr
        return json.loads(found.stdout)


@pytest.mark.slow
def test_ros_hears_a_flight_with_its_own_types_and_qos():
    found = meet("hear", ("policy=formation", "seconds=600", *TEAM))
    assert found["complete"] and found["scenes"] == 1 and found["markers"] >= 3
    for name, seen in found["graph"].items():
        assert seen["type"] == seen["own type"], name
        assert seen["hash"] == seen["own hash"] and "RIHS01_" in seen["hash"], name
        assert (seen["reliability"], seen["durability"]) == ("RELIABLE", "VOLATILE"), name
    assert found["scene"] == "TRANSIENT_LOCAL"
    stamps = np.array(found["stamps"])
    assert (np.diff(stamps) > 0).all() and np.allclose(np.diff(stamps) / 0.02, np.round(np.diff(stamps) / 0.02))
    assert abs(found["clock"] - stamps[-1]) < 15.0  # use_sim_time: that of the flight, not of the day
    assert found["frames"] == ["world", "payload"]
    assert np.isfinite(found["places"]).all() and 0.5 < found["places"][-1][2] < 3.5
    assert np.mean(found["tensions"], axis=0).sum() > 0.7 * 9.81 * 0.7 and len(found["actions"]) == 4


@pytest.mark.slow
def test_ros_flies_a_team_by_set_points():
    found = meet("fly", ("policy=none", "seconds=600", *TEAM))
    assert found["complete"]
    for i in ("0", "1"):
        assert found["after"][i] - found["before"][i] == pytest.approx(0.3, abs=0.1)
    assert found["payload"][1] - found["payload"][0] == pytest.approx(0.3, abs=0.15)


@pytest.mark.slow
def test_ros_releases_a_policy():
    simulation, policy = (
        ("policy=none", "seconds=600", *TEAM),
        ("role=policy", "policy=formation_integral", "start=topic"),
    )
    found = meet("release", simulation, (*policy, *TEAM))
    assert found["ready"] and found["complete"], found["off"]  # it came to its target and stayed
    assert np.ptp(found["still"]) < 0.3  # before that, the drones' own places


@pytest.mark.slow
def test_ros_hears_a_pipeline_of_the_reports_names():
    """Simulation, planner, geometric control and clock: four processes of ours, and one of ROS 2."""
    found = meet(
        "pipeline",
        ("policy=none", "names=report", "sync=false", "seconds=600", *TEAM),
        ("role=trajectory_planner", "receiver=geometric_control", "policy=formation_integral", *TEAM),
        ("role=geometric_control", "control.disturbance=none", "control.position_frequency=4", *TEAM),
        ("role=clock", "patience=60", *TEAM),
    )
    assert found["complete"] and found["stages"] == [5]
    assert np.linalg.norm(found["off"]) < 0.15 and found["frame"] == "world"  # the team is where the path leads
    steps = np.diff(found["times"])
    assert (steps > 0).all() and np.median(steps) == pytest.approx(50_000, abs=10_000)
    assert abs(1e-6 * found["times"][-1] - found["stamp"]) < 20.0  # time of the simulation
    assert found["qos"] == ["BEST_EFFORT", "TRANSIENT_LOCAL"]
