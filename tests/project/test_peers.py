"""The comparison with other simulators: its tables are those of its results, and what is missing is named."""

from __future__ import annotations

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import load_script

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "bench" / "peer_scripts").glob("fly_*.py"))
peers = load_script("bench/peers")


def test_the_tables_are_those_of_the_results(tmp_path):
    page = tmp_path / "peers.md"
    written = peers.PAGE.read_text(encoding="utf-8")
    results = json.loads(peers.RESULTS.read_text(encoding="utf-8"))
    assert peers.table(results) in written
    page.write_text(written.replace(peers.table(results), "old").replace(peers.features(results), "old"))
    assert "old" in page.read_text()
    peers.write_tables(page)
    assert page.read_text(encoding="utf-8") == written


def test_every_peer_that_is_measured_flew():
    results = json.loads(peers.RESULTS.read_text(encoding="utf-8"))
    assert {row["peer"] for row in results["rows"]} | results["missing"].keys() == peers.PEERS.keys()
    assert peers.OWN in {row["peer"] for row in results["rows"]}
    for row in results["rows"]:
        assert len(row["rates"]) == results["repeats"] >= 3
        assert row["error"] is None or row["error"] < 0.15, row["peer"]  # of a leap of 0.3 m
    few = {row["peer"]: row["error"] for row in results["rows"] if row["drones"] == 4}
    assert None not in few.values()


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_compiles_and_imports_only_its_peer(script):
    tree = ast.parse(script.read_text(encoding="utf-8"), str(script))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    roots = {name.split(".")[0] for name in imported} - {"__future__", "flight", "numpy", "jax", "torch"}
    assert [root.lower() for root in roots] == [script.stem.removeprefix("fly_")]


def test_every_peer_with_cases_has_a_script():
    named = {script.stem.removeprefix("fly_") for script in SCRIPTS}
    assert named == {name for name, peer in peers.PEERS.items() if peer.cases}


@pytest.mark.slow
@pytest.mark.parametrize("drones, policy_hz", [(4, 50.0), (8, 50.0)])
def test_our_own_script_counts_simulated_time(drones, policy_hz):
    found = peers.fly(peers.OWN, sys.executable, drones, 1, 0.1)
    assert found["worlds"] == drones // 4
    assert (found["physics_hz"], found["policy_hz"]) == (250, policy_hz)
    assert found["rate"] == pytest.approx(drones * found["simulated"] / found["wall"])
    assert found["simulated"] * policy_hz == pytest.approx(round(found["simulated"] * policy_hz))


def test_a_peer_without_its_package_is_named_in_one_sentence():
    with pytest.raises(peers.Unavailable) as refused:
        peers.fly("pyflyt", sys.executable, 4, 1, 0.1)
    assert str(refused.value) == (
        "pyflyt is not measured: its script fails (ModuleNotFoundError: No module named 'PyFlyt')."
    )


@pytest.mark.slow
def test_a_peer_that_pip_does_not_find_is_named_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(peers.PEERS, "nobody", peers.Peer((str(tmp_path / "nothing.whl"),), (), "", ""))
    with pytest.raises(peers.Unavailable, match=r"^nobody is not measured: pip cannot install it \(.+\)\.$"):
        peers.interpreter("nobody", str(tmp_path))


def test_an_environment_that_exists_is_used_again(tmp_path, monkeypatch):
    folder = tmp_path / "vmas"
    folder.mkdir()
    (folder / "requirements.json").write_text(json.dumps(peers.PEERS["vmas"].requirements))
    monkeypatch.setattr(subprocess, "run", None)
    assert peers.interpreter("vmas", str(tmp_path)) == str(folder / "bin" / "python")
    (folder / "requirements.json").write_text('["vmas<1"]')
    with pytest.raises(TypeError):
        peers.interpreter("vmas", str(tmp_path))


@pytest.mark.slow
def test_what_cannot_be_measured_is_left_out_and_named(capsys, monkeypatch):
    monkeypatch.setitem(peers.PEERS, peers.OWN, peers.PEERS[peers.OWN]._replace(cases=(peers.FEW,)))
    assert peers.main(["peers=multilift_marl,crazyflow", "repeats=1", "seconds=0.02"]) == 0
    printed, said = capsys.readouterr()
    assert "| multilift_marl | 4 | 1 | 1 |" in printed
    assert "| crazyflow" not in printed
    assert said.splitlines()[0] == "crazyflow is not measured: cache=<folder> says where to install it."
    assert said.splitlines()[0] in printed


@pytest.mark.parametrize("wrong", [["peer=vmas"], ["peers=gazebo"], ["peers=vmas", "save=true"]])
def test_a_wrong_argument_is_refused(wrong, capsys):
    before = peers.RESULTS.read_bytes()
    assert peers.main(wrong) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert peers.RESULTS.read_bytes() == before


def test_a_peer_sees_no_other_packages_and_no_gpu(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "somewhere")
    env = peers.environment()
    assert "PYTHONPATH" not in env
    assert env["CUDA_VISIBLE_DEVICES"] == ""
    assert shutil.which("python3", path=env["PATH"])
