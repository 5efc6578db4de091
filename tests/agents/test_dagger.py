"""Imitation of a teacher that knows more: it learns, goes on where it stopped, and says what it cannot do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import multilift_marl as ml
from multilift_marl.agents import dagger
from multilift_marl.agents.dagger import DaggerRollouts
from multilift_marl.agents.policy import LearnedPolicy
from multilift_marl.agents.rigs import evaluated_rigs
from multilift_marl.agents.trainer import Trainer, new_run, resume_run
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.truth import with_truth

SMALL = {
    "env.num_drones": 3, "env.num_envs": 4, "env.num_threads": 1, "env.episode_seconds": 3.0,
    "train.algorithm": "dagger",
    "train.dagger.teacher": "payload_geometric", "train.hidden": [32], "train.horizon": 25, "train.minibatches": 4,
    "train.learning_rate": 3e-3, "train.frames": 4000, "train.dagger.handover": 1000, "train.overrides": {},
    "eval.episodes": 4, "eval.every": 1000,
}  # fmt: skip


def config(**keys):
    return ml.load_config("hover", SMALL | keys)


def error_of(config, make):
    return np.mean(run_episodes(config, make, 8, 7)["payload_position_error_m"])


def policy_of(trainer):
    return LearnedPolicy(trainer._content(), "the trained one")


@pytest.mark.slow
def test_a_team_learns_to_fly_as_its_teacher_does():
    """From where it begins, beside the same training at a learning rate that moves nothing."""
    errors = []
    for rate in (1e-12, 3e-3):
        trainer = Trainer(config(**{"train.learning_rate": rate}), Path("unused"))
        losses = [trainer.step()["loss"] for _ in range(trainer.iterations)]
        errors.append((losses[-1], error_of(trainer.config, policy_of(trainer).bind)))
    (still, untrained), (learned, error) = errors
    taught = error_of(trainer.config, lambda vec: make_scripted("payload_geometric", vec))
    assert learned < 0.15 * still
    assert abs(error - taught) < 0.15 * abs(untrained - taught)


def test_the_teacher_flies_first_and_the_learner_later():
    trainer = Trainer(config(**{"train.dagger.teacher_share": 0.0}), Path("unused"))
    shares = [trainer.step()["teacher_share"] for _ in range(12)]
    assert shares[0] == 1.0 and shares[5] == pytest.approx(0.5) and shares[-1] == 0.0


def test_without_a_handover_the_learner_flies_at_once():
    trainer = Trainer(config(**{"train.dagger.handover": 0, "train.dagger.teacher_share": 0.0}), Path("unused"))
    assert trainer.step()["teacher_share"] == 0.0
    assert not trainer.rollouts.flights[0]._by_teacher.any()


def test_a_teacher_begins_with_its_episodes(tmp_path, monkeypatch):
    """As every policy that flies, also one that has nothing before."""
    (tmp_path / "teach.py").write_text(
        "import numpy as np\nclass T:\n    def __init__(self, vec): self.shape = vec.num_envs, vec.num_drones\n"
        "    def reset(self, mask): self.count = np.zeros(self.shape[0])\n"
        "    def act(self, observation):\n        self.count += 1\n        return np.zeros((*self.shape, 4))\n"
    )
    monkeypatch.chdir(tmp_path)
    trainer = Trainer(config(**{"train.dagger.teacher": "teach.py:T"}), Path("unused"))
    assert "loss" in trainer.step()
    assert (trainer.rollouts.flights[0]._teacher.policy.count == 25).any()


def test_a_training_that_is_resumed_near_its_end_learns_in_what_is_left(tmp_path):
    trainer = new_run(config(), "first", tmp_path)
    for _ in range(36):
        trainer.step()
    trainer.evaluate()
    trainer.save("last")
    again = resume_run(trainer.folder, {})
    assert ["loss" in again.step() for _ in range(4)] == [False, True, True, True]


def test_a_training_that_is_resumed_begins_episodes_at_all_times_and_counts_whole_ones(tmp_path):
    """Of those that were under way nothing is left; those that begin are cut short, as at first."""
    trainer = new_run(config(**{"env.episode_seconds": 1.0}), "first", tmp_path)
    for _ in range(3):
        trainer.step()
    assert trainer.episodes.returns.any()
    trainer.evaluate()
    trainer.save("last")
    again = resume_run(trainer.folder, {})
    assert not again.episodes.returns.any()
    assert sorted(again.rollouts.flights[0].env.vec.steps) == [0, 12, 25, 37]
    assert ["return" in again.step() for _ in range(4)] == [False, False, True, True]


def test_steps_are_kept_as_they_were_flown_and_the_oldest_make_room():
    """Of a step that only resets nothing is kept."""
    small = {"train.dagger.capacity": 150, "train.dagger.teacher_share": 1.0, "env.episode_seconds": 0.5}
    trainer = Trainer(config(**small), Path("unused"))
    assert isinstance(trainer.rollouts, DaggerRollouts)
    (rollouts,) = trainer.rollouts.flights
    trainer.step()
    # 25 steps of 4 environments whose staggered episodes of 25 steps have begun anew, but for the last step's
    assert rollouts.count == 97
    first = rollouts.observed[90].clone()
    trainer.step()
    assert rollouts.count == 193
    assert len(rollouts.observed) == 150
    assert torch.equal(rollouts.observed[90], first)
    assert not torch.equal(rollouts.observed[193 - 150 - 1], torch.zeros_like(first))


def test_numbers_that_the_network_does_not_take_are_not_kept(monkeypatch):
    """They change nothing."""
    keys = {"train.observe": ["payload_error", "payload_velocity"], "train.asinh": 10.0}
    learned, kept = [], []
    for whole in (False, True):
        if whole:
            monkeypatch.setattr(dagger, "taken_numbers", lambda learner: torch.arange(learner.actor.base.shape[1]))
        trainer = Trainer(config(**keys), Path("unused"))
        assert isinstance(trainer.rollouts, DaggerRollouts)
        learned.append([trainer.step()["loss"] for _ in range(3)])
        kept.append(trainer.rollouts.flights[0].observed.shape[2])
    assert learned[0] == learned[1]
    assert kept[0] < 20 < kept[1]


RIGS = ({"env.num_drones": 3}, {"env.num_drones": 4, "payload.mass": 1.2})


@pytest.mark.slow
def test_one_network_learns_of_teams_that_differ():
    """Each team flies better by what was learned of all than by what the training began with."""
    trainer = Trainer(config(**{"train.rigs": RIGS, "env.num_envs": 8, "train.frames": 8000}), Path("unused"))
    before = policy_of(trainer)
    assert isinstance(trainer.rollouts, DaggerRollouts)
    errors = [error_of(rig, before.bind) for rig in evaluated_rigs(trainer.config)]
    for _ in range(trainer.iterations):
        trainer.step()
    assert [flights.observed.shape[1] for flights in trainer.rollouts.flights] == [3, 4]
    assert [flights.count > 3000 for flights in trainer.rollouts.flights] == [True, True]
    for rig, error in zip(evaluated_rigs(trainer.config), errors, strict=True):
        taught = error_of(rig, lambda vec: make_scripted("payload_geometric", vec))
        assert abs(error_of(rig, policy_of(trainer).bind) - taught) < 0.4 * abs(error - taught)


def test_a_resumed_training_goes_on_with_its_networks(tmp_path):
    trainer = new_run(config(), "first", tmp_path)
    losses = [trainer.step()["loss"] for _ in range(12)]
    trainer.evaluate()
    trainer.save("last")
    again = resume_run(trainer.folder, {})
    assert again.iteration == 12
    for name, expected in trainer.learner.actor.state_dict().items():
        assert torch.equal(again.learner.actor.state_dict()[name], expected), name
    for _ in range(11):  # few steps alone would be overfitted
        assert "loss" not in again.step()
        for name, expected in trainer.learner.actor.state_dict().items():
            assert torch.equal(again.learner.actor.state_dict()[name], expected), name
    values = again.step()
    assert values["loss"] < 0.7 * losses[0], (values, losses)


def test_a_training_that_is_not_resumed_learns_from_the_first_step_on():
    """Also where many steps only reset, and less is kept than a few batches have."""
    keys = {"env.episode_seconds": 0.1, "train.dagger.capacity": 60}
    trainer = Trainer(config(**keys), Path("unused"))
    assert all("loss" in trainer.step() for _ in range(25))


RATES = {"control.action": "acc_rates", "control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("teacher", "keys"), [("payload_geometric", {}), pytest.param("mpc", RATES, marks=pytest.mark.slow)]
)
def test_a_teacher_with_the_truth_flies_as_if_nothing_disturbed_its_senses(teacher, keys):
    """Bit for bit: noise, sensors and what they cost are drawn apart from what moves the team."""
    ideal = ml.make_vec("track", seed=3, num_envs=2, **keys)
    seen = ml.make_vec("track", seed=3, num_envs=2, **keys, **{"randomization.observation_noise": 1.0})
    first, second = make_scripted(teacher, ideal), make_scripted(teacher, with_truth(seen))
    one, two = ideal.reset(seed=3)[0], seen.reset(seed=3)[0]
    for _ in range(40):
        one, two = ideal.step(first.act(one))[0], seen.step(second.act(two))[0]
    assert (ideal.world.state.payload_position == seen.world.state.payload_position).all()
    assert (one != two).any()


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"train.gru": 8}, "dagger has no train.gru"),
        ({"train.dagger.teacher": "formation_rout"}, "formation_route"),
        ({"train.dagger.teacher": "hold_ctbr"}, "control.action=ctbr"),
        (
            {"train.dagger.teacher": "formation_route"},
            "train.dagger.teacher=formation_route cannot teach here: .*navigate",
        ),
        ({"train.dagger.capacity": 10**12, "train.frames": 10**12}, "lower train.dagger.capacity"),
    ],
)
def test_what_cannot_be_learned_is_refused_in_a_sentence(own, message):
    with pytest.raises(ConfigError, match=message):
        Trainer(config(**own), Path("unused"))
