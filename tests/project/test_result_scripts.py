"""Scripts in results/: wrong arguments are a sentence, and what is kept is what was asked for."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml

ROOT = Path(__file__).parents[2]
if not (ROOT / "results").is_dir():
    pytest.skip("an sdist holds no results", allow_module_level=True)
sys.path.insert(0, str(ROOT / "results"))
pytest.importorskip("cma")
import planner_weights  # noqa: E402


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
