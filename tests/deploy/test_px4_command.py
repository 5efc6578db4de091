"""The command that flies PX4s: what it refuses, how it ends, and PX4 itself where PX4_DIR points to a build."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time

import pytest
from conftest import make_system, slow

import multilift_marl as ml
from multilift_marl.errors import ConfigError, FlightError
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("pymavlink")  # of the px4 extra
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from fake_px4 import FIRST, WORKER, are_free

from multilift_marl.deploy.px4 import __main__ as command
from multilift_marl.deploy.px4.flight import Flight, check_config
from multilift_marl.deploy.px4.launch import PX4_PORT, Autopilots, find_px4
from multilift_marl.deploy.px4.team import AutopilotTeam, Settings

DT = 0.004


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
        (["px4=/nowhere", "config=regroup"], "PX4 cannot fly config=regroup"),
        (["px4=/nowhere", "scene.obstacles=[{size: [1, 1, 1], position: [5, 0, 1]}]"], "take task navigate, or leave"),
        (
            ["px4=/nowhere", "config=navigate", "scene.obstacles=[{size: [1, 1, 1], travel: [0, 1, 0]}]"],
            "obstacles that stand still",
        ),
        (["px4=/nowhere", "config=navigate", "policy=formation_route"], "px4=/nowhere holds no PX4"),
        (["px4=/nowhere", "config=land"], "set task_options.pace=0.5 and env.episode_seconds=24"),
        (["px4=/nowhere", "config=land", "task_options.pace=0.5"], "px4=/nowhere holds no PX4"),
        (["px4=/nowhere", "position_errors=-1"], "position_errors"),
        (["px4=/nowhere", "position_errors=11"], "position_errors"),
        (["px4=/nowhere", "position_errors=10"], "px4=/nowhere holds no PX4"),
        (["px4=/nowhere", "instance=12"], "instance"),
        (["px4=/nowhere", "policy=formations"], "unknown policy 'formations'"),
        (["px4=/nowhere", "policy=none"], "set live=true"),
        (["px4=/nowhere", "start=topic"], "waits for orders by topics; set live=true"),
        (["px4=/nowhere", "policy=none", "live=true", "control.action=ctbr"], "control.action=reference, not ctbr"),
        (["px4=/nowhere", "policy=none", "live=true"], "px4=/nowhere holds no PX4"),
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


@pytest.mark.slow
@pytest.mark.parametrize("twice", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("number", [signal.SIGTERM, *map(slow, [signal.SIGINT, signal.SIGHUP, signal.SIGKILL])])
def test_a_command_that_is_ended_leaves_nothing_behind(number, twice, tmp_path):
    stub(tmp_path, f"echo $$ >> {tmp_path}/pids; exec sleep 1000")
    process = subprocess.Popen(
        [sys.executable, "-m", "multilift_marl.px4", f"px4={tmp_path}", "env.num_drones=2", "payload.mass=0.7",
         "timeout=300", f"out={tmp_path / 'out'}", f"instance={2 + 2 * (WORKER % 4)}"],
        env={**os.environ, "TMPDIR": str(tmp_path)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    pids = tmp_path / "pids"
    end = time.monotonic() + 120
    try:
        while not (pids.exists() and len(pids.read_text().split()) == 2) and time.monotonic() < end:
            time.sleep(0.05)
        assert list(tmp_path.glob("px4-*"))
        process.send_signal(number)
        if twice:
            process.send_signal(number)
        status = process.wait(240)
    finally:
        process.kill()
    running = [int(pid) for pid in pids.read_text().split()]
    end = time.monotonic() + 10
    while any(os.path.exists(f"/proc/{pid}") for pid in running) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in running)
    if number != signal.SIGKILL and not twice:
        assert status == 130 and process.stderr.read().strip().endswith("stopped")
        assert not list(tmp_path.glob("px4-*"))


def test_a_port_that_px4_would_not_get_is_named_before_it_starts(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", PX4_PORT + FIRST))
        with pytest.raises(FlightError, match=f"port {PX4_PORT + FIRST} of PX4 {FIRST} is taken .*instance=<number>"):
            Autopilots(tmp_path, [{}], FIRST)
    assert are_free()


def test_a_flight_that_does_not_start_leaves_no_empty_folder(tmp_path, monkeypatch, capsys):
    build = tmp_path / "px4"
    for name in ("bin/px4", "etc/init.d-posix/rcS"):
        (build / name).parent.mkdir(parents=True, exist_ok=True)
        (build / name).write_text("#!/bin/sh\necho no simulator; exit 3\n")
        (build / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    instance = f"instance={WORKER % 2}"  # which no other test has
    arguments = [f"px4={build}", "config=hover", "timeout=5", "env.num_drones=1", "payload.mass=0.2", instance]
    assert command.main([*arguments, "out=flight"]) == 2
    assert "no simulator" in capsys.readouterr().err
    assert not (tmp_path / "flight").exists()


@pytest.mark.parametrize(
    ("settings", "warned"),
    [
        ({}, True),
        ({"control.position_frequency": None}, True),
        ({"control.position_frequency": 2.1}, False),
        ({"control.action": "ctbr"}, False),
        ({"control.action": "acceleration"}, False),
    ],
)
def test_policies_that_know_faster_drones_alone_are_warned_of(settings, warned, caplog):
    command._warn_of_loops("mine", None)  # baselines know no drones
    assert not caplog.records
    name = f"mine_{len(settings)}_{warned}_{settings.get('control.position_frequency', 0)}"  # warnings come once each
    command._warn_of_loops(name, ml.load_config("hover", settings))
    command._warn_of_loops("of_conditions_px4", ml.load_config("hover_px4"))
    assert [each.name for each in caplog.records] == ["multilift_marl.px4"] * warned
    assert warned == (f"policy={name} was trained with drones" in caplog.text)


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
    config = check_config(ml.load_config("hover", {"env.num_drones": 2, "payload.mass": 0.7}))
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
