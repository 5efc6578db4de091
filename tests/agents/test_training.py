"""Training: it learns, resumes bit for bit, and logs what a reader needs."""

import copy
import itertools
import json

import numpy as np
import pytest
import torch
from conftest import make_trainer
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict.nn import TensorDictModule
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives.multiagent import MAPPOLoss
from torchrl.objectives.value import MultiAgentGAE

from multilift_marl.agents import mappo
from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint
from multilift_marl.agents.logging import RunLog, read_metrics
from multilift_marl.agents.mappo import estimate_advantage, surrogate_loss, value_loss
from multilift_marl.agents.networks import Normalizer
from multilift_marl.agents.trainer import adapted_rate, resume_run
from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        {"train.algorithm": "mappo", "train.desired_kl": 0.01},
        {"train.algorithm": "ippo", "env.history": 2},
        {"train.actor": "attention", "train.critic": "set"},
        {"train.gru": 8, "train.sequence": 16, "env.episode_seconds": 0.5},
    ],
)
def test_ten_iterations_equal_five_a_stop_and_five_more(tmp_path, kind):
    whole = make_trainer(tmp_path, **kind)
    assert whole.run()
    half = make_trainer(tmp_path, **kind)
    step = half.step

    def stop_after_five():
        values = step()
        half._stopper.asked = half.iteration == 5  # as Ctrl-C does
        return values

    half.step = stop_after_five
    assert not half.run()
    torch.manual_seed(12345)
    resumed = resume_run(half.folder, {"env.num_threads": 2})
    assert (resumed.iteration, resumed.iterations) == (5, 10)
    assert resumed.run()
    for network in ("actor", "critic"):  # with their normalisers
        one, two = (getattr(trainer.learner, network).state_dict() for trainer in (whole, resumed))
        assert all(torch.equal(one[name], two[name]) for name in one)
    columns = ("frames", "return", "reward/total", "approx_kl", "eval/return", "eval/best_iteration",
               "final/learned_return")  # fmt: skip
    rows, again = read_metrics(whole.folder), read_metrics(half.folder)
    assert [[row[c] for c in columns] for row in rows] == [[row[c] for c in columns] for row in again]


def test_same_seed_same_weights_other_seed_others(tmp_path):
    one, two, other = (make_trainer(tmp_path, seed=seed) for seed in (1, 1, 2))
    weights = []
    for trainer in (one, two, other):
        torch.manual_seed(trainer.config.seed)
        trainer.step()
        weights.append(trainer.learner.actor.team.net[0].weight.detach().clone())
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


@pytest.mark.slow
def test_a_few_iterations_improve_the_return(tmp_path):
    trainer = make_trainer(
        tmp_path,
        **{
            "seed": 1, "env.num_envs": 64, "env.num_threads": 1, "env.episode_seconds": 4.0, "train.horizon": 128,
            "train.frames": 64 * 128 * 20, "eval.episodes": 64, "train.residual": "formation", "train.overrides": {},
            "train.initial_std": 0.5, "train.learning_rate": 3e-4, "train.critic_learning_rate": None,
            "train.epochs": 4, "train.gae_lambda": 0.97, "train.hidden": [128, 128],
        },
    )  # fmt: skip
    rewards, values = [], {}
    for _ in range(13):
        values = trainer.step()
        rewards.append(values["reward/total"])
    settled = np.mean(rewards[2:6])  # before, the episodes that were all begun at once differ
    assert np.mean(rewards[-4:]) > 1.04 * settled, rewards
    assert values["explained_variance"] > 0.2


def test_run_folder_holds_what_a_reader_needs(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.run()
    folder = trainer.folder
    assert load_config(folder / "config.yaml") == trainer.config
    versions = json.loads((folder / "versions.json").read_text())
    assert {"git_commit", "cpu", "packages"} <= set(versions)
    row = read_metrics(folder)[-1]
    for column in ("return", "success", "reward/position", "approx_kl", "clip_fraction", "explained_variance",
                   "entropy", "fps", "share_sampling", "share_learning", "eval/success_rate"):  # fmt: skip
        assert row[column] != "", column
    assert {path.name for path in (folder / "checkpoints").iterdir()} == {"best.pt", "last.pt"}
    events = EventAccumulator(str(folder), {"tensors": 0}).Reload()
    groups = {"episodes", "reward", "update", "speed", "eval", "final"}
    assert {tag.partition("/")[0] for tag in events.Tags()["scalars"]} == groups
    assert events.Tags()["images"] == ["flight"]
    (text,) = events.Tensors("configuration/text_summary")
    assert "    learning_rate: " in text.tensor_proto.string_val[0].decode()


def test_a_resumed_run_has_the_best_policy_of_its_checkpoint(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.evaluate()
    trainer.save("last")
    best = trainer.folder / "checkpoints" / "best.pt"
    kept = load_checkpoint(best)
    save_checkpoint(best, kept | {"iteration": 4})  # found after the last checkpoint, and lost with what came then
    resumed = resume_run(trainer.folder, {"train.frames": 128})
    resumed.run()
    assert resumed.evaluator.best["iteration"] == load_checkpoint(best)["iteration"] != 4


def test_time_outs_are_bootstrapped_and_failures_are_not(tmp_path):
    trainer = make_trainer(tmp_path)
    iterations = itertools.count()
    [batch] = trainer.rollouts.collect(next(iterations))
    while not batch["next", "truncated"].any():
        [batch] = trainer.rollouts.collect(next(iterations))
    gamma = trainer.config.train.gamma
    advantage, value = estimate_advantage(trainer.learner, batch)
    with torch.no_grad():
        following = trainer.learner.critic(batch["next", "state"])
    reward, done = batch["next", "agents", "reward"], batch["next", "truncated"].squeeze(-1)
    expected = reward + gamma * following - value  # nothing follows the last step of an episode
    torch.testing.assert_close(advantage[done], expected[done], rtol=1e-4, atol=1e-4)
    batch["next", "terminated"] = batch["next", "truncated"].clone()
    advantage, _ = estimate_advantage(trainer.learner, batch)
    torch.testing.assert_close(advantage[done], (reward - value)[done], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("algorithm", ["mappo", "ippo"])
def test_advantages_losses_and_gradients_are_those_of_torchrl(tmp_path, algorithm):
    trainer = make_trainer(
        tmp_path, **{"env.episode_seconds": 0.2, "train.target_kl": 1.0, "train.algorithm": algorithm}
    )
    for _ in range(2):
        trainer.step()
    ours = trainer.learner
    ours.optimizer.zero_grad(set_to_none=True)
    theirs = copy.deepcopy(ours)
    batch = trainer.rollouts.collect(2)[0].clone()
    batch["next", "terminated"][0, 3] = batch["next", "done"][0, 3] = True
    assert batch["next", "truncated"].any()

    # TorchRL's estimator and loss on copies of the networks.
    agents = {name: ("agents", name) for name in ("observation", "action", "loc", "scale", "state_value", "reward")}
    parameters = [agents["loc"], agents["scale"]]
    actor = ProbabilisticActor(
        TensorDictModule(theirs.actor, in_keys=[agents["observation"]], out_keys=parameters), in_keys=parameters,
        out_keys=[agents["action"]], distribution_class=IndependentNormal, return_log_prob=True,
    )  # fmt: skip
    source = "state" if algorithm == "mappo" else agents["observation"]
    critic = TensorDictModule(theirs.critic, in_keys=[source], out_keys=[agents["state_value"]])
    keys = {"value": agents["state_value"], "reward": agents["reward"], "done": "done", "terminated": "terminated"}
    estimator = MultiAgentGAE(gamma=theirs.config.gamma, lmbda=theirs.config.gae_lambda, value_network=critic)
    estimator.set_keys(**keys)
    loss = MAPPOLoss(
        actor, critic, value_norm=theirs.critic.value_norm, clip_epsilon=theirs.config.clip, entropy_bonus=False,
        critic_coeff=theirs.config.value_weight, loss_critic_type="l2", normalize_advantage=False, functional=False,
    )  # fmt: skip
    loss.set_keys(**keys, action=agents["action"], sample_log_prob=("agents", "action_log_prob"))
    advantage, value = estimate_advantage(ours, batch)
    with torch.no_grad():
        estimator(batch)
    torch.testing.assert_close(advantage, batch["advantage"], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(advantage + value, batch["value_target"], rtol=1e-5, atol=1e-5)
    batch["advantage"], batch["value_target"] = advantage, advantage + value  # the same to the last bit below

    rows = batch.reshape(-1)[::2]
    expected = loss(rows)
    (expected["loss_objective"] + expected["loss_critic"]).backward()
    seen = [rows["agents", name] for name in ("observation", "action", "action_log_prob")]
    policy, _, kl, clipped = surrogate_loss(ours, *seen, rows["advantage"])
    error = ours.config.value_weight * value_loss(ours, ours.critic_input(rows), rows["value_target"])
    (policy + error).backward()
    assert torch.equal(policy, expected["loss_objective"]) and torch.equal(error, expected["loss_critic"])
    assert torch.equal(clipped, expected["clip_fraction"])
    moved = torch.distributions.Normal(*theirs.actor(seen[0])).log_prob(seen[1]).sum(-1) - seen[2]
    torch.testing.assert_close(kl, (moved.exp() - 1 - moved).mean())
    for mine, its in ((ours.actor, theirs.actor), (ours.critic, theirs.critic)):
        for one, two in zip(mine.parameters(), its.parameters(), strict=True):
            assert torch.equal(one.grad, two.grad)


def test_normalizer_equals_the_statistics_of_all_batches():
    generator = torch.Generator().manual_seed(0)
    batches = [3 + 2 * torch.randn(n, 6, generator=generator) for n in (5, 100, 17)]
    normalizer = Normalizer(6)
    for batch in batches:
        normalizer.update(batch)
    everything = torch.cat(batches)
    torch.testing.assert_close(normalizer.shift, everything.mean(0))
    torch.testing.assert_close(1 / normalizer.scale, everything.std(0, correction=0))


@pytest.mark.parametrize("k", [1e-3, 20.0, 1e6])
def test_the_fine_scale_follows_each_standardised_number(k):
    """Odd, 1 at one deviation, K / asinh(K) times as steep at 0, whatever the mean; gradients stay finite."""
    normalizer = Normalizer(2, asinh=k)
    normalizer.update(torch.randn(10_000, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([2.0, 0.1]) + 5)
    deviation = 1 / normalizer.scale
    assert normalizer.outputs == 4
    plain, fine = normalizer(deviation[None]).unflatten(-1, (2, 2)).unbind(-1)
    torch.testing.assert_close(plain[0], ((deviation - normalizer.shift) / deviation).clamp(-8, 8))
    torch.testing.assert_close(fine[0], torch.ones(2))
    torch.testing.assert_close(normalizer(-deviation)[1::2], -torch.ones(2))
    x = torch.zeros(2, requires_grad=True)
    normalizer(x)[1::2].sum().backward()
    torch.testing.assert_close(x.grad, k / torch.tensor(k, dtype=torch.float64).asinh().float() / deviation)
    assert normalizer(torch.full((2,), 1e9)).isfinite().all()


def test_value_norm_keeps_999_thousandths_of_older_returns(tmp_path):
    """A batch of zeros, then one of ones, have the mean (1 - β)/(1 - β²) = 1/(1 + β)."""
    value_norm = make_trainer(tmp_path).learner.critic.value_norm
    for returns in (torch.zeros(8, 1), torch.ones(8, 1)):
        value_norm.update(returns)
    torch.testing.assert_close(value_norm.denormalize(torch.zeros(1, 1)), torch.tensor([[1 / 1.999]]))


def test_log_drops_rows_after_the_checkpoint(tmp_path):
    log = RunLog(tmp_path)
    for iteration in range(1, 6):
        log.write(
            {"iteration": iteration, "frames": 10 * iteration}, {"a": 1.0} | ({"b": 2.0} if iteration == 3 else {})
        )
    log.close()
    log = RunLog(tmp_path, iteration=3)
    log.write({"iteration": 4, "frames": 40}, {"a": 9.0})
    log.close()
    rows = read_metrics(tmp_path)
    assert [row["iteration"] for row in rows] == ["1", "2", "3", "4"]
    assert [row["b"] for row in rows] == ["", "", "2.0", ""]
    assert rows[-1]["a"] == "9.0"


def test_overrides_change_the_environment_of_training_alone(tmp_path):
    trainer = make_trainer(tmp_path, **{"train.overrides": {"env.episode_seconds": 1.0, "env.num_drones": 3}})
    assert (trainer.env.vec.max_steps, trainer.env.vec.num_drones) == (50, 3)
    assert trainer.config.env.episode_seconds != 1.0
    trainer.step()
    assert trainer.evaluate()["eval/success_rate"] >= 0.0  # flown with four, for the whole time


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"train.overrides": {"env.episode_second": 1.0}},
            r"train\.overrides: unknown key 'env\.episode_second'; did you mean",
        ),
        ({"train.overrides": {"train.frames": 5}}, r"cannot hold 'train\.frames'; set train\.frames itself"),
        ({"train.algorithm": "ippo", "train.critic": "set"}, r"train\.critic=set is of mappo"),
        ({"train.actor": "attention", "train.hidden": (16, 30)}, r"last of train\.hidden must be a multiple of 4"),
    ],
)
def test_what_cannot_be_trained_is_refused_in_a_sentence(tmp_path, values, message):
    with pytest.raises(ConfigError, match=message):
        make_trainer(tmp_path, **values)


def test_the_kl_is_that_of_the_policies_before_and_after(tmp_path):
    learner = make_trainer(tmp_path).learner
    actor, draws = learner.actor, 40_000
    observation = torch.randn(draws, 1, actor.normalizer.mean.numel())
    with torch.no_grad():
        before = torch.distributions.Normal(*actor(observation))
        action = before.sample()
        torch.nn.init.orthogonal_(actor.team.net[-1].weight, gain=0.02)
        actor.log_std += 0.1
        after = torch.distributions.Normal(*actor(observation))
        expected = torch.distributions.kl_divergence(before, after).sum(-1).mean()
        log_prob = before.log_prob(action).sum(-1)
        *_, kl, _ = surrogate_loss(learner, observation, action, log_prob, torch.zeros(draws, 1, 1))
    assert 0.005 < expected < 0.2
    torch.testing.assert_close(kl, expected, rtol=0.03, atol=0)


def test_the_first_update_learns_from_standardised_observations(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path, **{"train.warmup": 0})
    normalizer, known, estimate = trainer.learner.actor.normalizer, [], mappo.estimate_advantage
    monkeypatch.setattr(
        mappo, "estimate_advantage", lambda *args: known.append(float(normalizer.count)) or estimate(*args)
    )
    counts = [float(trainer.step() and normalizer.count) for _ in range(3)]
    rows = counts[0]
    assert counts == [rows, 2 * rows, 3 * rows] and known == [rows, rows, 2 * rows]  # then after each update


def test_a_new_critic_of_a_trained_policy_learns_from_standardised_states(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path)
    actor, critic = trainer.learner.actor.normalizer, trainer.learner.critic.normalizer
    actor.update(torch.randn(100, len(actor.mean)))
    [batch] = trainer.rollouts.collect(0)
    trainer.rollouts.collect = lambda iteration: [batch]
    known, estimate = [], mappo.estimate_advantage
    monkeypatch.setattr(mappo, "estimate_advantage", lambda *args: known.append(float(critic.count)) or estimate(*args))
    trainer.step()
    states = batch["state"].flatten(0, -2)
    assert known == [len(states)] and critic.count == len(states)
    assert actor.count == 100 + batch["agents", "observation"].flatten(0, -2).shape[0]


@pytest.mark.parametrize(("kl", "factor"), [(0.03, 1 / 1.5), (0.015, 1.0), (0.01, 1.0), (0.004, 1.5)])
def test_the_learning_rate_follows_the_desired_kl(kl, factor):
    assert adapted_rate(1e-3, kl, 0.01) == pytest.approx(factor * 1e-3)


def test_the_adapted_learning_rate_stays_within_bounds():
    assert adapted_rate(1e-5, 1.0, 0.01) == 1e-5
    assert adapted_rate(1e-2, 0.0, 0.01) == 1e-2


@pytest.mark.parametrize("desired_kl", [0.0, 0.01])
def test_in_the_warmup_the_critic_alone_learns(tmp_path, desired_kl):
    trainer = make_trainer(tmp_path, **{"train.warmup": 2, "train.desired_kl": desired_kl})
    actor, critic = trainer.learner.actor.team, trainer.learner.critic
    for iteration in range(3):
        before = [[weight.detach().clone() for weight in net.parameters()] for net in (actor, critic)]
        trainer.step()
        same = [
            all(torch.equal(a, b) for a, b in zip(old, net.parameters(), strict=True))
            for old, net in zip(before, (actor, critic), strict=True)
        ]
        assert same == [iteration < 2, False]


@pytest.mark.parametrize(
    ("algorithm", "warmup", "said"), [("mappo", 2, True), ("ippo", 3, True), ("mappo", 1, False), ("dagger", 12, False)]
)
def test_a_training_within_its_warmup_says_that_it_learns_nothing(tmp_path, capsys, algorithm, warmup, said):
    teacher = {"train.dagger.teacher": "payload_geometric"}
    keys = {"train.algorithm": algorithm, "train.warmup": warmup, "train.frames": 2 * 128, "eval.every": 100}
    trainer = make_trainer(tmp_path, **keys, **teacher)
    assert trainer.run()
    shown = capsys.readouterr().out
    assert (f"its 2 iterations are within train.warmup={warmup}" in shown) == said
    assert ("lower train.warmup or raise train.frames" in shown) == said


def test_the_critic_has_its_own_learning_rate(tmp_path):
    trainer = make_trainer(
        tmp_path, **{"train.learning_rate": 1e-4, "train.critic_learning_rate": 3e-3, "train.final_learning_rate": 0.5}
    )
    actor, critic = trainer.learner.optimizer.param_groups
    assert {id(weight) for weight in actor["params"]} == {id(weight) for weight in trainer.learner.actor.parameters()}
    for _ in range(5):
        trainer.step()
    left = 1 - 0.5 * 4 / trainer.iterations
    assert (actor["lr"], critic["lr"]) == (pytest.approx(1e-4 * left), pytest.approx(3e-3 * left))
