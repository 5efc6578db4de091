"""What policies of one's own may do beside acting: report metrics, and begin with their episodes."""

from __future__ import annotations

import json

import pytest
from conftest import make, refusal

from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import MEASURED, run_episodes
from multilift_marl.evaluation.shortfalls import is_shortfall
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.tasks import register_task
from multilift_marl.tasks.hover import Hover
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

class Known(Told):
    def metrics(self):
        return {NAME: np.ones(len(self.count))}

class Later(Told):
    def metrics(self):
        return {"late": self.count} if self.count.any() else {}

class Gone(Told):
    def metrics(self):
        return {} if self.count.any() else {"gone": self.count}
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


@pytest.mark.parametrize(
    "name",
    ["success_rate", "energy_j", "payload_rmse_m", "return", "failure_tilt_rate", "payload_rmse_m_held",
     "excess:x", "min_clearance_m"],
)  # fmt: skip
def test_a_metric_of_a_name_that_evaluation_has_is_refused(folder, name):
    (folder / "told.py").write_text(POLICIES.replace("NAME", repr(name)))
    scene = {"scene.obstacles": [{"shape": "sphere", "size": [0.1], "position": [9.0, 9.0, 1.0]}]}
    config = load_config("hover", {"env.num_threads": 1, **scene})
    said = refusal(run_episodes, config, lambda vec: make_scripted("told.py:Known", vec), 2, 0)
    assert said.startswith(f"metrics() of the policy reports '{name}', which evaluation has itself; give it another")


def test_so_is_one_of_a_task_of_ones_own(registries):
    class Own(Hover):
        name = "own_energy"

        def metrics(self):
            return {"energy_j": self.time}

    register_task(Own)
    config = load_config("own_energy", {"env.num_threads": 1})
    said = refusal(run_episodes, config, lambda vec: make_scripted("formation", vec), 2, 0)
    assert said.startswith("metrics() of task own_energy reports 'energy_j', which evaluation has itself")


@pytest.mark.parametrize(("name", "metric"), [("Later", "late"), ("Gone", "gone")])
def test_a_metric_that_is_not_always_reported_is_refused(folder, name, metric):
    config = load_config("hover", {"env.num_threads": 1, "env.episode_seconds": 0.1})
    said = refusal(run_episodes, config, lambda vec: make_scripted(f"told.py:{name}", vec), 2, 0)
    assert (
        said == f"metrics() must report the same names at all times, NaN where there is no number, but not '{metric}'"
    )


def test_what_evaluation_measures_is_what_it_says(registries):
    config = load_config("hover", {"env.num_threads": 1, "env.episode_seconds": 0.1})
    flown = run_episodes(config, lambda vec: make_scripted("formation", vec), 2, 0)
    assert {name for name in flown if not is_shortfall(name)} == set(MEASURED)


def test_the_viewer_begins_a_policys_episodes(folder):
    make_session({"policy": "told.py:Told"})[0].step()
