"""Checkpoints and policy files: they survive kills, act like what was saved, and bad ones are named."""

import os
import random
import signal
import subprocess
import time

import numpy as np
import pytest
import torch
from conftest import make_trainer

from multilift_marl.agents.checkpoint import find_run, load_checkpoint, save_checkpoint
from multilift_marl.agents.policy import load_policy, strip_checkpoint
from multilift_marl.agents.trainer import resume_run
from multilift_marl.config import build_config
from multilift_marl.errors import CheckpointError


def test_killed_while_saving_it_can_always_be_resumed(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.step()
    trainer.save("last")
    rng = random.Random(0)
    for _ in range(20):
        child = os.fork()
        if child == 0:  # save without end until killed
            while True:
                trainer.iteration = 1 + trainer.iteration % 9
                trainer.save("last")
        time.sleep(rng.uniform(0.0, 0.15))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        resumed = resume_run(trainer.folder, {})
        assert 1 <= resumed.iteration <= 9
    assert np.isfinite(resumed.step()["loss_critic"])


def test_configuration_of_a_checkpoint_is_complete(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    content = load_checkpoint(trainer.folder / "checkpoints" / "last.pt")
    assert build_config(content["config"]) == trainer.config


def test_policy_file_acts_like_the_trained_network(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.step()
    trainer.save("last")
    file = trainer.folder / "checkpoints" / "last.pt"
    strip_checkpoint(file, tmp_path / "policy.pt")
    observation = np.random.default_rng(0).normal(size=(5, 4, trainer.env.vec.observation_size)).astype(np.float32)
    with torch.no_grad():
        expected = trainer.learner.actor(torch.from_numpy(observation))[0].clamp(-1, 1).numpy()
    for source in (trainer.folder, file, tmp_path / "policy.pt"):
        np.testing.assert_array_equal(load_policy(source).act(observation), expected)
    assert load_policy(file).act(observation[0]).shape == (4, 4)
    assert (tmp_path / "policy.pt").stat().st_size < file.stat().st_size / 2


def test_loading_a_policy_costs_no_random_numbers(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    torch.manual_seed(0)
    before = torch.get_rng_state()
    load_policy(trainer.folder)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), r"no checkpoint .*last\.pt: give a run folder"),
        (
            lambda path: path.write_bytes(path.read_bytes()[:2000]),
            r"last\.pt is truncated or no checkpoint at all; use",
        ),
        (lambda path: path.write_bytes(b"something else"), r"is truncated or no checkpoint at all; use another"),
        (lambda path: torch.save({"weights": torch.zeros(3)}, path), r"was not written by multilift_marl"),
        (lambda path: torch.save({"code": subprocess.run}, path), r"holds more than tensors and numbers; use another"),
    ],
)
def test_bad_checkpoints_are_named(tmp_path, damage, message):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    damage(trainer.folder / "checkpoints" / "last.pt")
    with pytest.raises(CheckpointError, match=message):
        resume_run(trainer.folder, {})


def test_checkpoint_without_policy_is_named(tmp_path):
    save_checkpoint(tmp_path / "x.pt", {"iteration": 1})
    with pytest.raises(CheckpointError, match="holds no policy"):
        load_policy(tmp_path / "x.pt")


@pytest.mark.parametrize("name", ["latest", "runs/none"])
def test_missing_run_is_named(tmp_path, name):
    with pytest.raises(CheckpointError, match="no run"):
        find_run(name, tmp_path)


def test_observations_of_another_environment_are_refused(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    with pytest.raises(ValueError, match=r"observation has 7 numbers, the policy of .* was trained with"):
        load_policy(trainer.folder).act(np.zeros((1, 4, 7), np.float32))
