"""Trainings that diverge end in a sentence, and leave the last sound state."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from conftest import make_trainer, refusal, slow

import multilift_marl as ml
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.trainer import Trainer, resume_run
from multilift_marl.cli.train import main as train

FAR = 1e39  # a step of Adam leaves the range of single precision
PPO = {
    "env.num_envs": 4, "env.num_threads": 1, "train.horizon": 16, "train.hidden": [8], "train.warmup": 0,
    "eval.episodes": 2, "eval.every": 1000, "env.episode_seconds": 1.0,
    "train.frames": 20 * 64,
}  # fmt: skip
DAGGER = PPO | {"train.algorithm": "dagger", "train.dagger.teacher": "payload_geometric", "train.overrides": {}}
DIFFMPC = {"train.horizon": 45, "train.overrides": {}, "train.hidden": [8], "env.num_drones": 3, "env.num_envs": 2}


@pytest.mark.parametrize("every", [1, 1000])
def test_a_training_that_diverges_is_a_sentence_and_keeps_its_last_sound_state(tmp_path, monkeypatch, capsys, every):
    monkeypatch.chdir(tmp_path)
    keys = PPO | {"train.checkpoint_every": every, "train.learning_rate": 100}
    assert train(["config=hover", *(f"{key}={value}" for key, value in keys.items())]) == 2
    shown = capsys.readouterr().err.splitlines()[-1]
    assert "lower train.learning_rate" in shown
    iteration = int(re.match(r"error: training diverged in iteration (\d+): ", shown)[1])
    (path,) = tmp_path.glob("runs/*/checkpoints/last.pt")
    last = load_checkpoint(path)
    assert last["iteration"] == iteration - 1
    for network in ("actor", "critic"):
        assert all(torch.isfinite(each).all() for each in last[network].values())
    assert resume_run(path.parents[1], {}).iteration == iteration - 1


@pytest.mark.parametrize(
    "kind",
    [{}, {"train.algorithm": "ippo"}, {"train.gru": 8, "train.sequence": 8}, {"train.critic_learning_rate": FAR}],
)
def test_the_networks_are_looked_at_after_each_iteration(tmp_path, kind):
    rate = {} if "train.critic_learning_rate" in kind else {"train.learning_rate": FAR}
    trainer = make_trainer(tmp_path, **{"train.warmup": 0} | kind | rate)
    assert "training diverged in iteration 1" in refusal(trainer.step)
    assert trainer.iteration == 0


@pytest.mark.parametrize(("config", "keys"), [("hover", DAGGER), slow("track_weights", DIFFMPC)])
def test_so_are_those_of_other_algorithms(config, keys):
    trainer = Trainer(ml.load_config(config, keys | {"train.learning_rate": FAR}), Path("unused"))
    assert "training diverged in iteration 1" in refusal(trainer.step)
