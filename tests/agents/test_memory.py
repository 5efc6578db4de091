"""Policies with a GRU: what they remember, and that learning sees the memory that the rollouts had."""

import numpy as np
import onnxruntime
import pytest
import torch
from conftest import make_trainer
from torch import nn

import multilift_marl as ml
from multilift_marl.agents.export import export_policy
from multilift_marl.agents.mappo import mark_starts
from multilift_marl.agents.networks import Actor, Memory
from multilift_marl.agents.policy import ExportedPolicy, LearnedPolicy
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation import rollout
from multilift_marl.evaluation.rollout import run_episodes

GRU = {"train.gru": 12, "train.sequence": 8, "train.warmup": 0}


def make_actor(asinh: float = 0.0) -> Actor:
    torch.manual_seed(0)
    actor = Actor("local", 11, 4, (16, 16), 0.3, torch.zeros(4, 11), gru=6, asinh=asinh)
    actor.normalizer.update(3 * torch.randn(100, 11) + 1)
    nn.init.orthogonal_(actor.team.net[-1].weight)  # as after training
    return actor


def make_policy(tmp_path, **overrides) -> LearnedPolicy:
    """Return a policy with a GRU, of weights as large as after training."""
    trainer = make_trainer(tmp_path, **GRU, **overrides)
    trainer.step()
    with torch.no_grad():
        nn.init.orthogonal_(trainer.learner.actor.team.net[-1].weight, 0.3)
    return LearnedPolicy(trainer._content(), "the test")


def test_sequences_are_those_of_torchs_own_gru():
    torch.manual_seed(1)
    memory, reference = Memory(5, 7).double(), nn.GRU(5, 7, batch_first=True).double()
    for name, weights in memory.named_parameters():
        getattr(reference, f"{name}_l0").data.copy_(weights.data)
    rows, first = torch.randn(3, 9, 4, 5).double(), torch.randn(3, 4, 7).double()
    started = torch.zeros(3, 9, dtype=torch.bool)
    started[1, 4] = started[2, 0] = started[2, 8] = True
    found = memory.unroll(rows, first, started)
    for b, n, begins in ((0, 1, [0]), (1, 2, [0, 4]), (2, 3, [0, 8])):
        for begin, end in zip(begins, [*begins[1:], 9], strict=True):
            before = first[b, n] if begin == 0 else torch.zeros(7).double()
            theirs = reference(rows[b, begin:end, n][None], before[None, None])[0][0]
            torch.testing.assert_close(found[b, begin:end, n], theirs, rtol=0, atol=1e-13)


@pytest.mark.parametrize("asinh", [0.0, 20.0])
def test_a_sequence_remembers_what_single_steps_do(asinh):
    actor, observation = make_actor(asinh), torch.randn(2, 6, 3, 11)
    memory = torch.zeros(2, 3, 6)
    unrolled = actor.unroll(observation, memory, torch.zeros(2, 6, dtype=torch.bool))
    for t in range(6):
        memory = actor.remember(observation[:, t], memory)
        torch.testing.assert_close(unrolled[:, t], memory, rtol=0, atol=1e-6)


def test_actions_depend_on_the_past_of_the_own_episode_alone():
    actor = make_actor()
    observation = torch.randn(1, 6, 2, 11, requires_grad=True)
    started = torch.tensor([[False, False, False, True, False, False]])
    memory = actor.unroll(observation, torch.zeros(1, 2, 6), started)
    (gradient,) = torch.autograd.grad(actor(observation, memory)[0][0, 5, 0].sum(), observation)
    seen = gradient[0].abs().sum(-1) > 0  # (6, 2): steps, drones
    assert seen[:, 0].tolist() == [False, False, False, True, True, True]
    assert not seen[:, 1].any()


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [{}, {"env.num_envs": 1, "train.horizon": 64}])
def test_learning_sees_the_memory_that_the_rollouts_had(tmp_path, overrides):
    """Where nothing is learned, all ratios of probabilities are 1: also after resets within a batch and between."""
    short = {"env.episode_seconds": 0.3, "train.learning_rate": 1e-30}
    trainer = make_trainer(tmp_path, **GRU, **short, **overrides)
    with torch.no_grad():
        nn.init.orthogonal_(trainer.learner.actor.team.net[-1].weight)
    ended = 0
    collect = trainer.rollouts.collect
    for i in range(4):
        [batch] = collect(i)
        trainer.rollouts.collect = lambda iteration, batch=batch: [batch]
        ended += int(mark_starts(batch).sum())
        memory = batch["agents", "memory"]
        after = batch["next", "agents", "memory"].masked_fill(batch["next", "done"][..., None], 0.0)
        assert torch.equal(after[:, :-1], memory[:, 1:])
        values = trainer.step()
        assert abs(values["approx_kl"]) < 1e-6 and values["clip_fraction"] == 0.0
    assert ended > 0 and memory.abs().max() > 0.1


@pytest.mark.slow
def test_episodes_are_the_same_in_any_batch(tmp_path, monkeypatch):
    policy = make_policy(tmp_path, **{"control.max_offset": 1.5, "env.episode_seconds": 3.0})
    together = run_episodes(policy.config, policy.bind, 6, seed=3)
    assert 0 < together["failure_cause"].astype(bool).sum() < 6  # some end early, and their places go on
    monkeypatch.setattr(rollout, "_BATCH", 2)
    apart = run_episodes(policy.config, policy.bind, 6, seed=3)
    np.testing.assert_allclose(apart["return"], together["return"], rtol=1e-5)


def test_a_reset_empties_the_memory_of_its_environments(tmp_path):
    policy = make_policy(tmp_path)
    vec = ml.make_vec(policy.config, num_envs=3)
    observation, _ = vec.reset(seed=0)
    one, two = policy.bind(vec), policy.bind(vec)
    first = one.act(observation)
    second = one.act(observation)
    assert np.abs(second - first).max() > 1e-4
    np.testing.assert_array_equal(two.act(observation), first)  # with a memory of its own
    one.reset(np.array([False, True, False]))
    third = one.act(observation)
    np.testing.assert_array_equal(third[1], first[1])
    assert (np.abs(third[[0, 2]] - first[[0, 2]]).max(axis=(1, 2)) > 1e-4).all()
    with pytest.raises(
        ValueError, match=r"remembers \(environments, drones\) \(3, 4\), but observes \(2, 4\); call res"
    ):
        one.act(observation[:2])
    one.reset()
    np.testing.assert_allclose(one.act(observation[0]), first[0], atol=1e-6)


@pytest.mark.parametrize("kind", ["local", "attention"])
@pytest.mark.slow
def test_the_exported_policy_remembers_as_the_policy_does(tmp_path, kind):
    policy = make_policy(tmp_path, **{"train.actor": kind})
    contract = export_policy(policy, tmp_path / "export")
    assert contract["network"]["memory"] == {"input": "memory", "output": "next_memory", "size": 12}
    exported = ExportedPolicy(tmp_path / "export" / "policy.onnx")
    normalizer = policy.actor.normalizer
    for teams, drones in ((1, 1), (5, 3), (2, 8)):
        policy.reset()
        exported.reset()
        for step in range(20):
            if step == 10:
                mask = np.arange(teams) % 2 == 0
                policy.reset(mask)
                exported.reset(mask)
            spread = torch.randn(teams, drones, len(policy.observation_names), generator=torch.manual_seed(step))
            observation = (normalizer.shift + 1.5 * spread / normalizer.scale).numpy()
            np.testing.assert_allclose(exported.act(observation), policy.act(observation), rtol=0, atol=1e-5)
    session = onnxruntime.InferenceSession(str(tmp_path / "export" / "policy.onnx"))
    assert [each.name for each in session.get_inputs()] == ["observation", "memory"]
    assert [each.shape for each in session.get_outputs()] == [["batch", "drones", 4], ["batch", "drones", 12]]


@pytest.mark.slow
def test_a_batch_shorter_than_a_sequence_is_one(tmp_path):
    steps = []
    for sequence in (100, 10, 5):
        short = {"train.sequence": sequence, "train.horizon": 10, "train.minibatches": 2}
        steps.append(make_trainer(tmp_path, **(GRU | short)).step())
    assert steps[0]["gradient_norm"] == steps[1]["gradient_norm"] != steps[2]["gradient_norm"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"train.horizon": 30}, r"train\.horizon=30 is no multiple of train\.sequence=8"),
        ({"train.horizon": 8, "train.minibatches": 9, "env.num_envs": 8}, r"exceeds the 8 sequences of a batch"),
    ],
)
def test_sequences_that_do_not_fit_are_refused_in_a_sentence(tmp_path, values, message):
    with pytest.raises(ConfigError, match=message):
        make_trainer(tmp_path, **GRU, **values)
