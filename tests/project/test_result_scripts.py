"""Scripts in results/: wrong arguments are a sentence, and what is kept is what was asked for."""

import importlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.errors import CheckpointError, ConfigError

ROOT = Path(__file__).parents[2]
if not (ROOT / "results").is_dir():
    pytest.skip("an sdist holds no results", allow_module_level=True)
sys.path.insert(0, str(ROOT / "results"))
pytest.importorskip("cma")
import planner_weights  # noqa: E402
import twin  # noqa: E402
from script import run_script  # noqa: E402


@pytest.fixture
def kept(tmp_path, monkeypatch):
    monkeypatch.setattr(planner_weights, "HERE", tmp_path)
    return tmp_path


def test_a_training_that_is_stopped_is_not_kept(kept, monkeypatch):
    monkeypatch.setattr(planner_weights.Trainer, "run", lambda trainer: False)
    config = ml.load_config("track_weights", {"train.algorithm": "mappo", "train.overrides": {}})
    with pytest.raises(SystemExit, match="stopped"):
        planner_weights.find(config, "mappo", 100, 0)
    assert not list(kept.glob("*.pt"))


def test_what_is_kept_of_other_frames_or_episodes_is_refused(kept):
    (kept / "cma_0.json").write_text(json.dumps({"frames": 10, "action": [0.0] * 13}))
    config = ml.load_config("track_weights")
    assert "cma_0.json is kept of frames=10" in refusal(planner_weights.find, config, "cma", 20, 0)
    planner_weights.find(config, "cma", 10, 0)
    for number in range(3):
        np.savez(kept / f"hand_path{number}.npz", success_rate=np.ones(4, bool), payload_rmse_m=np.ones(4))
    assert len(planner_weights.fly(config, "hand", None, 4)) == 3
    assert "hand_path0.npz is kept of episodes=4" in refusal(planner_weights.fly, config, "hand", None, 8)


def test_a_policy_that_is_kept_of_other_frames_is_refused(kept):
    source = ROOT / "results" / "planner_weights" / "mappo_0.pt"
    (kept / "mappo_0.pt").write_bytes(source.read_bytes())
    config = ml.load_config("track_weights")
    assert "mappo_0.pt is kept of frames=96000" in refusal(planner_weights.find, config, "mappo", 100, 0)
    planner_weights.find(config, "mappo", 96000, 0)


def test_changes_are_over_seeds_and_episodes():
    """Of one seed in three, far off, nothing is known; nor of three that differ from three others by chance."""
    rng = np.random.default_rng(0)
    errors, one = rng.normal(0, 0.1, (3, 48)), np.zeros((1, 48))
    errors[0] += 3.0
    assert planner_weights.change(errors, one)[0] < 0.2
    assert planner_weights.change(errors + 3.0, one)[0] > 2.5
    assert planner_weights.change(errors, errors[:2]) == (0.0, 0.0)


def test_the_table_is_that_of_what_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(planner_weights, "TABLE", tmp_path / "table.csv")
    planner_weights.main(["seeds=0"])
    assert (tmp_path / "table.csv").read_bytes() == (ROOT / "docs" / "data" / "planner_weights.csv").read_bytes()


@pytest.mark.parametrize(
    ("script", "arguments", "said"),
    [
        ("reproduce", "evaluate nosuch", "unknown flight 'nosuch'; known: "),
        ("reproduce", "evaluate hover/typo", "unknown team of hover 'typo'; known: "),
        ("reproduce", "evaluate hover worker=2", "unknown key 'worker'; did you mean 'workers'?"),
        ("reproduce", "evaluate hover workers=0", "workers must be a whole number of at least 1, but is '0'"),
        ("reproduce", "train hover one", "seeds must be whole numbers, but one is 'one'"),
        ("reproduce", "train nosuch", "no configuration named 'nosuch'"),
        ("reproduce", "keep hover nowhere", "no checkpoint nowhere"),
        ("reproduce", "ship nosuch", "nosuch/seed0/policy.pt; train it first"),
        ("shifts", "nosuch", "unknown flight 'nosuch'"),
        ("shifts", "hover foo=1", "unknown key 'foo'; known: episodes"),
        ("shifts", "hover episodes=many", "episodes must be a whole number of at least 1, but is 'many'"),
        ("planner_weights", "methods=cmaes", "unknown method 'cmaes'"),
        ("planner_weights", "seeds", "'seeds' is not of the form key=value; keys: seeds, frames"),
        ("navigate", "rows=nosuch", "unknown row 'nosuch'"),
        ("navigate", "policies=mpc_rout", "unknown policy 'mpc_rout'; did you mean 'mpc_route'?"),
        ("planner_consensus", "drones=3,x", "drones must be whole numbers, 3,4,6 say, but one is 'x'"),
        ("tune_navigate", "fly policies=nosuch", "unknown policy 'nosuch'"),
        ("tune_rules", "policy=formation", "unknown rule 'formation'"),
        ("unseen_rigs", "episodes=0", "episodes must be a whole number of at least 1"),
        ("px4_flights", "rows=hover", "px4= is missing"),
        ("px4_flights", "px4=. rows=nosuch out=unused.csv", "unknown row 'nosuch'"),
    ],
)
def test_wrong_arguments_are_one_sentence(tmp_path, monkeypatch, capsys, script, arguments, said):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [script, *arguments.split()])
    with pytest.raises(SystemExit) as ended:
        run_script(importlib.import_module(script).main)
    shown = capsys.readouterr().err
    assert ended.value.code == 2
    assert shown.startswith("error: ") and shown.count("\n") == 1 and said in shown


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "policy= is missing; give the learned team"),
        ({"policy": "hover", "others": "formatio"}, "others names no baseline 'formatio'; did you mean 'formation'?"),
        ({"policy": "hover", "episodes": "many"}, "episodes must be a whole number"),
        ({"policy": "nosuch"}, "no run folder nosuch"),
    ],
)
def test_wrong_arguments_of_twins_are_refused(given, said):
    with pytest.raises((ConfigError, CheckpointError), match=re.escape(said)):
        twin.main(given)
