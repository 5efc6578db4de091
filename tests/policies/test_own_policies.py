"""What policies of one's own may do beside acting: report metrics, and begin with their episodes."""

from __future__ import annotations

import json

import pytest
from conftest import make, refusal

from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.viewer.__main__ import make_session

SHORT = ("episodes=2", "env.episode_seconds=0.1", "baseline=none")
POLICIES = """
import numpy as np

class Told:
    def __init__(self, vec):
        self.shape = vec.num_envs, vec.num_drones, vec.action_size

    def reset(self, mask):
        self.count = np.zeros(self.shape[0])

    def act(self, observation):
        self.count += 1
        return np.zeros(self.shape)

    def metrics(self):
        return {"steps_flown": self.count, "never": [np.nan] * len(self.count)}

class Wrong(Told):
    def metrics(self):
        return {"steps": 3.0}

class Nothing(Told):
    def metrics(self):
        return None
"""


@pytest.fixture
def folder(tmp_path, monkeypatch, registries):
    (tmp_path / "told.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_metrics_of_ones_own_policy_are_reported(folder):
    assert evaluate(["policy=told.py:Told", *SHORT]) == 0
    report = json.loads(next(folder.glob("runs/told.Told-hover/eval/*/metrics.json")).read_text())
    assert report["policy"]["steps_flown"]["mean"] == 5 and "never" not in report["policy"]


@pytest.mark.parametrize("name, found", [("Wrong", "{'steps': 3.0}"), ("Nothing", "None")])
def test_metrics_of_another_shape_are_refused(folder, name, found):
    policy = make_scripted(f"told.py:{name}", make(num_envs=2))
    assert f"told.py:{name}.metrics must return {{name: numbers (2,)}}, not {found}" in refusal(policy.metrics)


def test_the_viewer_begins_a_policys_episodes(folder):
    make_session({"policy": "told.py:Told"})[0].step()
