"""Pipelines from one file: what is started, what is refused, and that nothing is left running."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from conftest import EXAMPLES
from page_peer import PagePeer

from multilift_marl.config.load import parse_overrides
from multilift_marl.schema.yaml_text import parse_yaml, write_yaml

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
if sys.platform == "win32":
    pytest.skip("pipelines run on Linux and macOS alone", allow_module_level=True)

from multilift_marl.deploy.processes import end_together
from multilift_marl.deploy.sitl import __main__ as command
from multilift_marl.deploy.sitl.pipeline import list_commands, read_options
from multilift_marl.deploy.sitl.running import Pipeline, Process

DOMAIN = 210 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
TEAM = {"config": "hover", "domain": DOMAIN, "env.num_drones": 2, "payload.mass": 0.7}
FLOWN = {"simulation": {}, "nodes": {"pilot": {"role": "policy", "policy": "formation"}}, "common": TEAM}


def commands_of(tmp_path, content: dict, **overrides) -> dict[str, dict]:
    """Return the module and the values of each process, read as its command reads them."""
    file = tmp_path / "sitl.yaml"
    file.write_text(write_yaml(content))
    commands = list_commands(read_options({"file": str(file), **overrides}), Path("out"))
    texts = ("config", "role", "policy", "out", "bag", "px4")
    return {name: {"": words[2], **parse_overrides(words[3:], texts)} for name, words in commands.items()}


def test_the_file_gives_the_commands_and_arguments_go_over_it(tmp_path):
    content = {
        "flight": {"seed": 2000, "parameters": {"MPC_XY_P": 1.2}},
        "nodes": {"plan": {"role": "trajectory_planner", "env": {"num_drones": 3}}, "tick": {"role": "clock"}},
        "common": {"domain": 7, "env": {"num_drones": 4, "policy_hz": 50}},
        "bag": "flight bag",
    }
    found = commands_of(tmp_path, content, **{"flight.seed": 2001, "common.domain": 9, "nodes.plan.config": "track"})
    common = {"names": "report", "seed": 2001, "domain": 9, "env.policy_hz": 50}
    assert list(found) == ["flight", "plan", "tick"]
    assert found["flight"] == {
        "": "multilift_marl.px4", "policy": "none", "live": True, "out": "out/flight", "bag": "flight bag",
        "parameters": {"MPC_XY_P": 1.2}, "env.num_drones": 4, **common,
    }  # fmt: skip
    plan = {"role": "trajectory_planner", "config": "track", "env.num_drones": 3}
    assert found["plan"] == {"": "multilift_marl.ros", **plan, **common}
    assert found["tick"] == {"": "multilift_marl.ros", "role": "clock", "env.num_drones": 4, **common}


def test_a_simulation_takes_the_place_of_the_flight(tmp_path):
    found = commands_of(tmp_path, FLOWN, **{"simulation.seconds": 3, "common.seed": 5, "nodes.pilot.seed": 6})
    assert found["simulation"] == {"": "multilift_marl.ros", "policy": "none", "seconds": 3, "seed": 5, **TEAM}
    assert found["pilot"]["seed"] == 6 and "names" not in found["pilot"]


@pytest.mark.parametrize("first", [{"flight": {"parameters": {"MPC_XY_P": 1.2}}}, {"simulation": {"speed": 2.0}}])
def test_a_view_shows_the_rig_of_the_flight_on_its_topics(first, tmp_path):
    kind = next(iter(first))
    nodes = {"tick": {"role": "clock"}}
    common = {"domain": 7, "config": "track", "env": {"num_drones": 3}, "ros": "humble"}
    found = commands_of(tmp_path, first | {"nodes": nodes, "common": common, "view": {"port": 8012}})
    assert list(found) == [kind, "tick", "view"]
    rig = {"config": "track", "env.num_drones": 3}
    assert found["view"] == {
        "": "multilift_marl.view", "live": True, "names": "report", "ros": "humble", "domain": 7, "port": 8012, **rig
    }  # fmt: skip
    own = {"view": {"port": 0, "domain": 8, "env": {"num_drones": 2}}}
    found = commands_of(tmp_path, FLOWN | own)["view"]
    assert found == {"": "multilift_marl.view", "live": True, "port": 0} | TEAM | {"domain": 8, "env.num_drones": 2}


def test_a_view_has_the_rig_of_a_trained_policy(tmp_path):
    for policy, handed in (("hover", {"policy": "hover"}), ("formation", {})):
        found = commands_of(tmp_path, {"simulation": {"policy": policy, "config": None}, "view": {}})["view"]
        assert found == {"": "multilift_marl.view", "live": True, **handed}


def test_the_example_is_that_of_the_help_and_can_be_started(tmp_path, capsys):
    text = (EXAMPLES / "sitl.yaml").read_text()
    found = commands_of(tmp_path, parse_yaml(text))
    assert [each.get("role") for each in found.values()] == [None, "trajectory_planner", "geometric_control", "clock"]
    assert command.main(["--help"]) == 0
    assert text.partition("\n")[2] in capsys.readouterr().out


@pytest.mark.parametrize(
    "content, arguments, words",
    [
        ({}, [], "give either flight or simulation, the team that nodes fly"),
        ({"flight": {}, "simulation": {}}, [], "give either flight or simulation"),
        ({"fligth": {}}, [], r"unknown key 'fligth' \(in .*sitl.yaml\); did you mean 'flight'\?"),
        ({"flight": {"sed": 3}}, [], "flight: unknown key 'sed'; did you mean 'seed'"),
        ({"flight": 3}, [], "flight .*must be a section"),
        (FLOWN, ["nodes.pilot.polcy=mpc"], "nodes.pilot: unknown key 'polcy'; did you mean 'policy'"),
        (FLOWN, ["nodes.pilot.env.num_dornes=3"], "nodes.pilot: unknown key 'env.num_dornes'; did you mean"),
        (FLOWN, ["common.config=null", "nodes.pilot.env.dornes=3"], "nodes.pilot: unknown key 'env.dornes'"),
        (FLOWN, ["nodes.pilot.config=hovr"], "nodes.pilot: no configuration named 'hovr'; did you mean 'hover'"),
        (FLOWN, ["nodes.pilot.role=pilot"], "nodes.pilot: role must be .*'policy'"),
        (FLOWN, ["nodes.pilot.output=rates"], "nodes.pilot: output means nothing to role=policy, but to geometric_con"),
        (FLOWN, ["nodes.c.role=clock", "nodes.c.policy=mpc"], "nodes.c: policy means nothing to role=clock"),
        (FLOWN, ["nodes.other={}"], "nodes.other needs a role"),
        (FLOWN, ["nodes.flight.role=clock"], "nodes.flight has the name of another process"),
        (FLOWN, ["nodes.view.role=clock"], "nodes.view has the name of another process"),
        (FLOWN, ["nodes.A.role=clock"], "nodes.A"),
        (FLOWN, ["view.prot=0"], "view: unknown key 'prot'; did you mean 'port'"),
        (FLOWN, ["view.port=70000"], "view: port must be from 0 to 65535"),
        (FLOWN, ["simulation.domain=300"], "simulation: domain must be from 0 to 232"),
        (FLOWN, ["bag=flight"], "bag is of a flight"),
        (FLOWN, ["nodes=3"], "nodes .*must be a section"),
        (FLOWN, ["nodes=3", "nodes.pilot.seed=3"], "nodes.pilot.seed: 'nodes' is a value, not a section"),
    ],
)  # fmt: skip
def test_what_cannot_be_started_is_said_in_one_sentence(content, arguments, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sitl.yaml").write_text(write_yaml(content))
    assert command.main(["file=sitl.yaml", *arguments]) == 2
    error = capsys.readouterr().err
    assert re.search(words, error) and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["sitl.yaml"]


@pytest.mark.parametrize("text, words", [(None, "no file sitl.yaml"), ("a: [", "cannot read"), ("- 1", "holds list")])
def test_a_file_that_is_none_is_named(text, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if text is not None:
        Path("sitl.yaml").write_text(text)
    assert command.main(["file=sitl.yaml"]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"simulation": {"import": "theirs"}},
        {"common": {"trust": True}},
        {"nodes": {"pilot": {"role": "policy", "policy": "theirs:Policy"}}},
        {"simulation": {"train": {"residual": "theirs:Policy"}}},
        {"view": {"policy": "theirs:Policy"}},
        {"simulation": None, "flight": {"px4": "/theirs"}},
    ],
)
def test_a_file_names_no_code_unless_it_is_trusted(changes, tmp_path, capsys):
    (tmp_path / "sitl.yaml").write_text(write_yaml(FLOWN | changes))
    assert command.main([f"file={tmp_path / 'sitl.yaml'}"]) == 2
    assert "which was not run: the code that a file names may be anybody's" in capsys.readouterr().err


def test_trust_goes_to_all_processes(tmp_path):
    nodes = {"pilot": {"role": "policy", "policy": "theirs:Policy"}}
    found = commands_of(tmp_path, FLOWN | {"nodes": nodes}, trust=True)
    assert [each["trust"] for each in found.values()] == [True, True]
    assert found["pilot"]["policy"] == "theirs:Policy"


def test_who_ends_early_is_named_with_the_last_words_and_the_rest_goes_on(tmp_path, capsys):
    shell = {"flight": "sleep 0.5; echo done; exit 0", "one": "echo hello; kill -9 $$", "two": "exec sleep 1000"}
    with Pipeline({name: ["sh", "-c", text] for name, text in shell.items()}, tmp_path) as pipeline:
        assert pipeline.wait() == 1
        assert pipeline.processes[2].poll() is None
    said = capsys.readouterr().out.splitlines()
    assert said == ["one    | hello", "one has ended (signal 9)", "flight | done", "flight has ended (status 0)"]
    assert (tmp_path / "one.log").read_text() == "hello\n" and (tmp_path / "two.log").read_text() == ""
    rows = [line.split(maxsplit=3) for line in pipeline.describe().splitlines()[1:]]
    assert [(row[0], row[3]) for row in rows] == [("flight", "status 0"), ("one", "signal 9"), ("two", "signal 2")]
    assert float(rows[0][1]) >= 0.5 > float(rows[0][2])


@pytest.mark.parametrize("last, status", [("exit 3", 3), ("kill -15 $$", 143)])
def test_the_status_is_that_of_the_flight(last, status, tmp_path):
    with Pipeline({"flight": ["sh", "-c", last], "node": ["sh", "-c", "exit 0"]}, tmp_path) as pipeline:
        assert pipeline.wait() == status


def test_cpu_time_counts_those_that_a_process_waited_for():
    process = Process("busy", ["sh", "-c", f"{sys.executable} -c 'sum(range(10**7))'; true"])
    process.stdout.close()
    while process.poll() is None:
        time.sleep(0.01)
    assert 0.05 < process.cpu_seconds <= process.seconds + 0.1


@pytest.mark.slow
def test_the_flight_ends_before_the_nodes_and_what_is_deaf_is_killed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("multilift_marl.deploy.sitl.running._END_FLIGHT", ((signal.SIGINT, 0.3),))
    monkeypatch.setattr("multilift_marl.deploy.sitl.running._END_NODES", ((signal.SIGINT, 0.3), (signal.SIGINT, 1.0)))
    deaf = f"trap '' INT; echo $$ > {tmp_path}/deaf; while :; do sleep 0.1; done"
    early = f"kill -0 $(cat {tmp_path}/deaf) 2>/dev/null && echo early"
    twice = (
        f"trap 'test $n && exit 7; n=1; {early}; echo once' INT; touch {tmp_path}/twice; while :; do sleep 0.1; done"
    )
    with Pipeline({"flight": ["sh", "-c", deaf], "node": ["sh", "-c", twice]}, tmp_path) as pipeline:
        end = time.monotonic() + 10
        while not ((tmp_path / "deaf").exists() and (tmp_path / "twice").exists()) and time.monotonic() < end:
            time.sleep(0.01)
    flight, node = pipeline.processes
    assert (flight.ending, node.ending) == ("signal 9", "status 7")
    assert capsys.readouterr().out == "node   | once\n"


def test_signals_wait_until_all_have_ended():
    process = Process("slow", ["sh", "-c", "trap 'sleep 0.3; exit 5' INT; echo ready; while :; do sleep 0.05; done"])
    process.stdout.readline()
    process.stdout.close()
    subprocess.Popen(["sh", "-c", f"sleep 0.15; kill -2 {os.getpid()}"])
    with pytest.raises(KeyboardInterrupt):
        end_together([process], (signal.SIGINT, 5.0))
    assert process.returncode == 5


def start(tmp_path, *arguments: str) -> subprocess.Popen:
    (tmp_path / "sitl.yaml").write_text(write_yaml(FLOWN))
    return subprocess.Popen(
        [sys.executable, "-m", "multilift_marl.sitl", f"file={tmp_path / 'sitl.yaml'}", f"out={tmp_path / 'out'}",
         *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def until_flying(process: subprocess.Popen) -> list[psutil.Process]:
    """Return the children of the command, once the policy flies: the simulation and the policy."""
    for line in process.stdout:
        if "flying: all is heard" in line:
            return sorted(psutil.Process(process.pid).children(), key=lambda each: each.pid)
    raise AssertionError(process.stderr.read())


@pytest.mark.slow
def test_a_simulation_is_flown_and_all_ends_with_it(tmp_path):
    process = start(tmp_path, "simulation.seconds=6")
    output, error = process.communicate(timeout=120)
    assert process.returncode == 0, output + error
    assert "simulation has ended (status 0)" in output
    assert re.search(r"^simulation \| simulated 6.0 s", output, re.M)
    assert int(re.search(r"^pilot      \| flew (\d+) steps", output, re.M)[1]) > 50
    assert "flying: all is heard\n" in (tmp_path / "out" / "pilot.log").read_text()
    rows = re.findall(r"^(\w+) +([\d.]+) +([\d.]+)  status 0$", output, re.M)
    assert [row[0] for row in rows] == ["simulation", "pilot"]
    assert all(6.0 < float(row[1]) < 100.0 and 0.5 < float(row[2]) < 50.0 for row in rows)


@pytest.mark.slow
def test_a_view_is_served_while_the_simulation_flies_and_ends_with_it(tmp_path):
    pytest.importorskip("viser")
    process = start(tmp_path, "simulation.seconds=12", "view.port=0")
    address = next(line for line in process.stdout if "| watch at http" in line).split()[4]
    peer = PagePeer(address)
    before = peer.until(lambda: "tension" in peer.text()) and peer.positions()
    assert peer.until(lambda: before.shape != peer.positions().shape or np.ptp([before, peer.positions()]) > 1e-3)
    assert "heard" not in peer.text() and "live flight" in peer.text()
    peer.close()
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0 and re.search(r"^view .* status 0$", output, re.M), output
    with pytest.raises(OSError):
        PagePeer(address)


@pytest.mark.slow
def test_a_node_that_is_killed_is_named_and_the_rest_goes_on(tmp_path):
    process = start(tmp_path, "simulation.seconds=12")
    simulation, pilot = until_flying(process)
    pilot.kill()
    assert any("pilot has ended (signal 9)" in line for line in process.stdout)
    assert simulation.is_running()
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 1 and "simulation has ended (status 0)" in output


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])  # SIGTERM and SIGHUP: interrupted_by_signals
def test_a_command_that_is_ended_leaves_nothing_behind(number, tmp_path):
    process = start(tmp_path)
    children = until_flying(process)
    assert len(children) == 2
    process.send_signal(number)
    output, error = process.communicate(timeout=60)
    _, left = psutil.wait_procs(children, timeout=10)
    assert not left
    if number != signal.SIGKILL:
        assert process.returncode == 130 and error == "stopped\n"
        assert output.index("simulation | simulated") < output.index("pilot      | flew")
