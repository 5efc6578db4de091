"""The example for ROS 2's launch: that it starts what the command starts, and that launch can run it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from types import ModuleType

import psutil
import pytest
from conftest import EXAMPLES, load_script

from multilift_marl.schema.yaml_text import write_yaml

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")

from multilift_marl.deploy.sitl.pipeline import list_commands, read_options

FILE = EXAMPLES / "sitl.launch.py"
DOMAIN = 180 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
TEAM = {"config": "hover", "domain": DOMAIN, "env.num_drones": 2, "payload.mass": 0.7}
FLOWN = {"simulation": {}, "nodes": {"pilot": {"role": "policy", "policy": "formation"}}, "common": TEAM}
RUN = """
import json, sys
from launch import LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
file, arguments = sys.argv[1], json.loads(sys.argv[2])
service = LaunchService()
service.include_launch_description(
    IncludeLaunchDescription(PythonLaunchDescriptionSource(file), launch_arguments=arguments.items())
)
sys.exit(service.run())
"""


class Recorded:
    """An action or substitution that only keeps what it is made of."""

    def __init__(self, *values, **named):
        self.values, self.named = values, named

    def perform(self, context):
        return context[self.values[0]]


@pytest.fixture
def description(monkeypatch):
    """The example's description, of recorded actions in place of launch's."""
    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "ExecuteProcess", "OpaqueFunction", "Shutdown"],
        "launch.substitutions": ["LaunchConfiguration"],
    }
    for module, classes in names.items():
        made = ModuleType(module)
        for name in classes:
            setattr(made, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    return load_script("examples/sitl.launch").generate_launch_description()


def test_the_processes_are_those_of_the_command(description, tmp_path):
    *declared, start = description.values[0]
    assert [each.values[0] for each in declared] == ["file", "px4", "arguments"]
    out = tmp_path / "out of it"
    arguments = {"flight.seed": 7, "nodes.control.output": "rates", "out": str(out)}
    context = {
        "file": str(EXAMPLES / "sitl.yaml"), "px4": "PX4-Autopilot",
        "arguments": f"flight.seed=7 nodes.control.output=rates out='{out}'",
    }  # fmt: skip
    processes = [each.named for each in start.named["function"](context)]
    expected = list_commands(read_options({"file": context["file"], **arguments}), out)
    assert {each["name"]: each["cmd"] for each in processes} == expected and len(expected) == 4
    assert [each["on_exit"] is not None for each in processes] == [True, False, False, False]
    assert all(each["additional_env"]["PX4_DIR"] == "PX4-Autopilot" for each in processes)
    assert out.is_dir()


def test_without_a_folder_px4_is_that_of_the_environment(description, tmp_path):
    start = description.values[0][-1].named["function"]
    file, arguments = str(EXAMPLES / "sitl.yaml"), f"out={tmp_path / 'out'}"
    processes = start({"file": file, "px4": "", "arguments": arguments})
    assert not any("PX4_DIR" in each.named["additional_env"] for each in processes)


def launch(tmp_path, arguments: str) -> subprocess.Popen:
    """Run the example by launch, in a group of its own."""
    pytest.importorskip("launch.launch_service", reason="ROS 2's launch is not installed; it comes with ROS 2 alone")
    file = tmp_path / "sitl.yaml"
    file.write_text(write_yaml(FLOWN))
    given = json.dumps({"file": str(file), "arguments": f"out={tmp_path / 'out'} {arguments}"})
    return subprocess.Popen(
        [sys.executable, "-c", RUN, str(FILE), given], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True, env=os.environ | {"ROS_LOG_DIR": str(tmp_path / "logs")},
    )  # fmt: skip


@pytest.mark.slow
def test_launch_flies_a_simulation_and_all_ends_with_it(tmp_path):
    process = launch(tmp_path, "simulation.seconds=6")
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output
    assert "[simulation-1] simulated 6.0 s" in output and "simulation-1] was required" in output
    assert int(re.search(r"\[pilot-2\] flew (\d+) steps", output)[1]) > 50
    assert (tmp_path / "out").is_dir()


@pytest.mark.slow
def test_ctrl_c_ends_what_launch_has_started(tmp_path):
    process = launch(tmp_path, "simulation.seconds=1000")
    for line in process.stdout:
        if "flying: all is heard" in line:
            break
    children = psutil.Process(process.pid).children()
    assert len(children) == 2
    os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it
    output = process.communicate(timeout=60)[0]
    assert "[simulation-1] simulated" in output and "[pilot-2] flew" in output, output
    assert not psutil.wait_procs(children, timeout=10)[1]


@pytest.mark.slow
def test_launch_says_what_is_wrong(tmp_path):
    output = launch(tmp_path, "simulation.sed=3").communicate(timeout=60)[0]
    assert "simulation: unknown key 'sed'; did you mean 'seed'" in output
