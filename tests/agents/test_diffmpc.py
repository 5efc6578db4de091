"""Training through the planner: it learns, resumes bit for bit, and says what it cannot do."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import refusal

import multilift_marl as ml
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.mappo import check_batch
from multilift_marl.agents.policy import load_policy
from multilift_marl.agents.trainer import Trainer, new_run, resume_run
from multilift_marl.diffmpc.sensitivity import Tape
from multilift_marl.errors import ConfigError

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

SMALL = {
    "env.num_drones": 3, "env.num_envs": 2, "env.num_threads": 1, "train.horizon": 45, "train.overrides": {},
    "train.hidden": [16], "eval.episodes": 2, "eval.every": 100, "env.episode_seconds": 2.0,
}  # fmt: skip
POOR = {  # weights that follow badly
    "planner.position": 2.0, "planner.velocity": 2.0, "planner.thrust": 0.02, "planner.steps": 10,
    "task_options.speed": 2.0, "task_options.acceleration": 4.0,
}  # fmt: skip


def config(**keys):
    return ml.load_config("track_weights", SMALL | keys)


@pytest.mark.parametrize(
    ("rate", "own"), [(2e-2, {}), (3e-3, {"train.diffmpc.every": 1, "train.diffmpc.fresh_adam": True})]
)
def test_poor_weights_get_better(rate, own):
    """Against the same training at a learning rate that moves nothing."""
    losses = []
    own = POOR | own | {"train.horizon": 101, "train.diffmpc.window": 10, "train.frames": 2424}
    for each in (1e-12, rate):
        trainer = Trainer(config(**own, **{"train.learning_rate": each}), Path("unused"))
        losses.append([trainer.step()["loss"] for _ in range(12)])
    still, learned = (np.mean(each[-4:]) for each in losses)
    assert learned < 0.5 * still


def test_a_resumed_training_goes_on_bit_for_bit(tmp_path):
    whole = new_run(config(**{"train.frames": 360}), "whole", tmp_path)
    for _ in range(4):
        whole.step()
    halves = new_run(config(**{"train.frames": 360}), "halves", tmp_path)
    for _ in range(2):
        halves.step()
    halves.evaluate()
    halves.save("last")
    again = resume_run(halves.folder, {})
    assert again.iteration == 2
    values = [again.step() for _ in range(2)][-1]
    assert values["loss"] > 0
    for name, expected in whole.learner.actor.state_dict().items():
        assert torch.equal(again.learner.actor.state_dict()[name], expected), name


def test_a_run_is_evaluated_and_exported_as_any_other(tmp_path):
    trainer = new_run(config(**{"train.frames": 90}), "short", tmp_path)
    assert trainer.run()
    policy = load_policy(trainer.folder, "last")
    vec = ml.make_vec(policy.config, num_envs=1)
    observation, _ = vec.reset(seed=0)
    action = policy.bind(vec).act(observation)
    assert action.shape == (1, 3, vec.action_size)
    assert (trainer.folder / "metrics.csv").read_text().splitlines()[0].count("loss") == 1
    assert "critic" in load_checkpoint(trainer.folder / "checkpoints" / "last.pt")
    from multilift_marl.agents.export import export_policy

    export_policy(policy, tmp_path / "exported")
    assert load_policy(next((tmp_path / "exported").glob("*.onnx"))).act(observation) == pytest.approx(action, abs=1e-5)


@pytest.mark.parametrize("steps, expected, late", [(2, 0.04, 0), (3, 0.04, 1), (1, 0.04, 0), (2, 0.0, 2)])
def test_delay_that_plans_expect_does_not_count_as_lateness(steps, expected, late):
    own = {"randomization.action_delay": [steps, steps], "planner.delay": expected, "planner.steps": 10}
    trainer = Trainer(config(**own), Path("unused"))
    trainer.step()
    assert (trainer.rollouts._flight.tape.late == late).all()


@pytest.mark.parametrize("spoil", ["late", "unknown"])
def test_plans_that_are_not_flown_teach_nothing(spoil):
    """Those that come late, and those of a team, the second one here, whose state is unknown."""
    trainer = Trainer(config(**POOR), Path("unused"))
    mpc, tape = trainer.rollouts._commander.mpc, trainer.rollouts._flight.tape
    measure = mpc._measure

    def measured():
        found = measure()
        found[0][1] = np.nan
        return found

    if spoil == "late":
        mpc._deadline = -1.0
    else:
        mpc._measure = measured
    values = trainer.step()
    assert tape.cut[:, 1].all() and tape.cut[:, 0].all() == (spoil == "late")
    assert (values["gradient"] == 0.0) == (spoil == "late")
    assert values["cut"] == pytest.approx(1.0 if spoil == "late" else 0.5, abs=0.05)


def test_more_plans_than_memory_holds_are_refused(monkeypatch):
    """As many bytes as the window's plans take are too few: the batch comes beside them."""
    own = config(**{"train.diffmpc.window": 40})
    vec = ml.make_vec(own)
    plans = Tape.nbytes(41, 2, own.planner.steps, 3)
    for there, refused in ((plans, True), (2 * plans, False)):
        monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 1, "SC_PHYS_PAGES": there}.get)
        if refused:
            said = refusal(check_batch, own.train, vec, 2)
            assert said.endswith("lower train.diffmpc.window, planner.steps, train.horizon or env.num_envs")
        else:
            check_batch(own.train, vec, 2)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"control.action": "acc_rates"}, r"set control\.action=planner_weights"),
        ({"train.gru": 8}, r"has no train\.gru"),
        ({"train.rigs": [{"payload.mass": 1.0}, {"payload.mass": 2.0}]}, r"has no train\.rigs"),
        ({"train.horizon": 20}, r"train\.horizon=20 holds no window"),
        ({"planner.lead": 0.1}, r"leave planner\.lead out"),
        ({"train.diffmpc.loss": [1e45, 0, 0, 0, 0, 0]}, r"train\.diffmpc\.loss"),
    ],
)
def test_what_cannot_be_trained_so_is_refused(own, message):
    with pytest.raises(ConfigError, match=message):
        Trainer(config(**own), Path("unused"))
