"""Training with several rigs at once: one network for teams of different sizes."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from conftest import make_trainer, refusal

from multilift_marl.agents import mappo
from multilift_marl.agents.policy import LearnedPolicy
from multilift_marl.agents.rigs import evaluated_rigs
from multilift_marl.agents.trainer import resume_run
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import TRAINING_EVALUATION
from multilift_marl.evaluation.rollout import run_episodes

RIGS = [{"env.num_drones": 3, "cable.length": 0.7}, {"env.num_drones": 5}]
TWO = {"train.rigs": RIGS, "train.algorithm": "ippo", "env.units": "cable"}


def weights(trainer) -> torch.Tensor:
    """Return all weights of policy and critic."""
    networks = (trainer.learner.actor, trainer.learner.critic)
    return torch.cat([tensor.flatten().double() for net in networks for tensor in net.state_dict().values()])


def test_one_rig_that_differs_in_nothing_is_none(tmp_path):
    learned = []
    for rigs in ([], [{}]):
        trainer = make_trainer(tmp_path, **{"train.rigs": rigs})
        for _ in range(2):
            trainer.step()
        learned.append(weights(trainer))
    assert torch.equal(*learned)


def test_teams_of_different_sizes_learn_together(tmp_path):
    trainer = make_trainer(tmp_path, **TWO)
    before = weights(trainer)
    values = trainer.step()
    batches = trainer.rollouts.collect(1)
    assert [batch["agents", "observation"].shape[2] for batch in batches] == [3, 5]
    assert [len(batch) for batch in batches] == [trainer.config.env.num_envs // 2] * 2
    assert not torch.equal(weights(trainer), before)
    assert np.isfinite(list(values.values())).all()


ONE_STEP = {"train.epochs": 1, "train.minibatches": 1, "train.warmup": 0}


def test_each_rig_counts_as_much_whatever_its_size(tmp_path):
    rigs = {"train.rigs": [{"env.num_drones": 3}, {"env.num_drones": 5}, {"env.num_drones": 3, "cable.length": 0.7}]}
    trainer = make_trainer(tmp_path, **TWO | ONE_STEP | rigs, **{"env.num_envs": 6})
    batches = trainer.rollouts.collect(0)
    advantages = [mappo.estimate_advantage(trainer.learner, batch)[0] for batch in batches]
    every = torch.cat([each.flatten() for each in advantages])
    values = mappo.update(trainer.learner, batches)  # the first ratios are 1: the loss is minus the advantage
    expected = torch.stack([-((each - every.mean()) / every.std()).mean() for each in advantages]).mean()
    assert abs(expected) > 1e-4  # of all drones alike it would be 0
    assert values["loss_policy"] == pytest.approx(expected.item(), rel=0.01)


def test_rigs_of_one_size_learn_as_one_batch_of_all(tmp_path):
    trainer = make_trainer(tmp_path, **TWO | ONE_STEP | {"train.rigs": [{}, {"cable.length": 0.7}]})
    batches, learner = trainer.rollouts.collect(0), trainer.learner
    other = copy.deepcopy(learner)
    mappo.update(learner, batches)
    mappo.update(other, [torch.cat(batches)])
    before, after = (torch.nn.utils.parameters_to_vector(each.actor.parameters()) for each in (other, learner))
    torch.testing.assert_close(after, before, rtol=0, atol=1e-5)


@pytest.mark.parametrize("rigs", [[], [{"env.num_drones": 3}, {"env.num_drones": 5}]])
def test_a_teams_kl_is_the_sum_of_its_drones_after_the_update(tmp_path, rigs):
    trainer = make_trainer(tmp_path, **TWO | ONE_STEP | {"train.rigs": rigs, "train.learning_rate": 2e-3})
    batches = trainer.rollouts.collect(0)
    seen = [batch["agents", "observation"] for batch in batches]
    actor = trainer.learner.actor
    actor.normalizer.update(torch.cat([rows.flatten(0, -2) for rows in seen]))
    with torch.no_grad():
        before = [torch.distributions.Normal(*actor(rows)) for rows in seen]
    for batch, policy in zip(batches, before, strict=True):
        batch["agents", "action_log_prob"] = policy.log_prob(batch["agents", "action"]).sum(-1)
    known = copy.deepcopy(actor.normalizer)
    values = mappo.update(trainer.learner, batches)
    actor.normalizer = known  # which the update moves last
    expected = []
    for batch, rows, old in zip(batches, seen, before, strict=True):
        with torch.no_grad():
            new = torch.distributions.Normal(*actor(rows))
        ratio = new.log_prob(batch["agents", "action"]).sum(-1) - batch["agents", "action_log_prob"]
        expected.append((ratio.expm1() - ratio).sum(-1).mean())
        exact = torch.distributions.kl_divergence(old, new).sum((-1, -2)).mean()  # over all actions that may be drawn
        assert 0.5 < expected[-1] / exact < 2
    assert values["team_kl"] == pytest.approx(torch.stack(expected).mean().item(), rel=1e-3)
    assert values["team_kl"] > 0.05


def test_rigs_may_fly_episodes_of_their_own_length(tmp_path):
    rigs = [{"env.episode_seconds": 0.2}, {"env.episode_seconds": 0.8}]  # 10 and 40 steps
    trainer = make_trainer(tmp_path, **{"train.rigs": rigs})
    told, ends = [], []
    for iteration in range(6):  # of 16 steps
        batches = trainer.rollouts.collect(iteration)
        ends.append([int(batch["next", "done"].sum()) for batch in batches])
        told.append("return" in trainer.episodes.read(batches, iteration))
    assert told[:2] == [False, False] and any(told[2:4])  # after the longest
    short, long = np.sum(ends[3:], axis=0)
    assert short > long > 0
    assert [rig.env.episode_seconds for rig in evaluated_rigs(trainer.config)] == [0.2, 0.8]


@pytest.mark.parametrize("algorithm", ["mappo", "dagger"])
def test_each_rig_begins_at_all_phases_of_an_episode(tmp_path, algorithm):
    """Together they are spread as evenly as as many environments of one rig."""
    keys = {"train.algorithm": algorithm, "train.dagger.teacher": "payload_geometric", "env.num_envs": 12}
    trainer = make_trainer(tmp_path, **keys, **{"train.rigs": [{}, {}, {}]})
    trainer.rollouts.get_state()  # they begin
    parts = trainer.rollouts._parts if algorithm == "mappo" else trainer.rollouts.flights
    vecs = [part.env.vec for part in parts]
    assert all(np.ptp(vec.steps) > 0.5 * vec.max_steps for vec in vecs)
    assert sorted(np.concatenate([vec.steps for vec in vecs])) == [i * vecs[0].max_steps // 12 for i in range(12)]


@pytest.mark.slow
def test_rigs_resume_bit_for_bit(tmp_path):
    whole = make_trainer(tmp_path, **TWO)
    for _ in range(4):
        whole.step()
    halted = make_trainer(tmp_path, **TWO)
    for _ in range(2):
        halted.step()
    halted.save("last")
    resumed = resume_run(halted.folder, {})
    for _ in range(2):
        resumed.step()
    assert torch.equal(weights(resumed), weights(whole))


def test_evaluations_fly_every_rig(tmp_path):
    trainer = make_trainer(tmp_path, **TWO, **{"eval.episodes": 4})
    values = trainer.evaluate()
    policy = LearnedPolicy(trainer._content(), "the run")
    config = trainer.config
    returns = []
    for k, rig in enumerate(RIGS):
        flown = build_config(config.model_dump(), rig)
        found = run_episodes(flown, policy.bind, 2, config.seed, TRAINING_EVALUATION, first=2 * k)
        returns.append(found["return"])
    assert values["eval/return"] == pytest.approx(np.concatenate(returns).mean(), rel=1e-12)


def test_rigs_that_are_equal_are_evaluated_in_different_episodes(tmp_path):
    trainer = make_trainer(tmp_path, **{"train.rigs": [{}, {}], "eval.episodes": 4})
    evaluator, whole = trainer.evaluator, make_trainer(tmp_path, **{"eval.episodes": 4}).evaluator
    policy = LearnedPolicy(trainer._content(), "the run")
    twice, once = (each._fly(policy.bind, 3)["return"] for each in (evaluator, whole))
    assert len(np.unique(twice)) == 4 and np.array_equal(twice, once)


def test_a_score_of_rigs_in_the_same_episodes_is_measured_anew(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path, **{"train.rigs": [{}, {}], "eval.episodes": 2})
    trainer.evaluate()
    best = trainer.evaluator.best
    score = best["score"]
    best |= {"score": [2.0, 0.0]}
    trainer.evaluate()
    assert best["score"] == [2.0, 0.0]
    del best["rigs"]  # as before
    trainer.evaluate()
    assert best["score"] == score


@pytest.mark.parametrize(
    "overrides, said",
    [
        ({**TWO, "train.algorithm": "mappo"}, "need train.algorithm=ippo"),
        ({**TWO, "train.workers": 2}, "train.rigs and train.workers do not go together"),
        ({**TWO, "env.num_envs": 3}, "cannot be shared by the 2 of train.rigs"),
        ({**TWO, "train.rigs": [{"task": "gate"}]}, "train.rigs cannot hold 'task'"),
        ({**TWO, "train.rigs": [{}, {"control.action": "velocity"}]}, "differ in what drones observe or act by"),
        ({**TWO, "train.rigs": [{"env.drones": 3}]}, "env.drones"),
    ],
)
def test_rigs_that_cannot_be_trained_together_are_refused(tmp_path, overrides, said):
    assert said in refusal(make_trainer, tmp_path, **overrides)
