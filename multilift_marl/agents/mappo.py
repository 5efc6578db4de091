"""PPO for teams: MAPPO with a critic of the global state, IPPO with a critic of each drone's own observation."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.modules import IndependentNormal, PopArtValueNorm, ProbabilisticActor
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.value import MultiAgentGAE

from multilift_marl.agents.networks import Actor, CentralCritic, LocalCritic, TeamNet, draw_action
from multilift_marl.config.schema import TrainConfig
from multilift_marl.control.scripted import residual_matrix
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.tasks.observations import drone_numbers


class KeyedNetwork(TensorDictModuleBase):
    """A network whose input and outputs are keys of a TensorDict.

    TensorDict's own module does the same with bookkeeping that costs as much as a small network.
    """

    def __init__(self, network: nn.Module, source: NestedKey, targets: list[NestedKey]):
        super().__init__()
        self.in_keys, self.out_keys = [source], targets
        self.network = network

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the network returns."""
        values = self.network(tensordict.get(self.in_keys[0]))
        for key, value in zip(self.out_keys, values if isinstance(values, tuple) else (values,), strict=True):
            tensordict.set(key, value)
        return tensordict


class StochasticPolicy(nn.Module):
    """What flies the rollouts: observations to actions drawn from the actor's Gaussian, and their log-probabilities."""

    def __init__(self, actor: Actor):
        super().__init__()
        self.actor = actor

    @torch.no_grad()
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (..., N, A) and log-probabilities (..., N)."""
        return draw_action(self.actor(observation)[0], self.actor.log_std.exp())


@dataclass
class Learner:
    """What learns: networks, loss, advantage estimator, optimiser."""

    config: TrainConfig
    actor: Actor
    critic: CentralCritic | LocalCritic
    policy: KeyedNetwork
    loss: MAPPOLoss
    advantage: MultiAgentGAE
    optimizer: torch.optim.Adam


def make_learner(config: TrainConfig, env: MultiliftEnv) -> Learner:
    """Return an untrained learner for `env`.

    Raises:
        ConfigError: networks that cannot be.
    """
    if config.algorithm == "ippo" and config.critic != "flat":
        raise ConfigError(f"train.critic={config.critic} is of mappo; set train.algorithm=mappo or leave it out")
    if "attention" in (config.actor, config.critic) and config.hidden[-1] % TeamNet.HEADS:
        raise ConfigError(f"the last of train.hidden must be a multiple of {TeamNet.HEADS}, the heads of attention")
    # 1. The policy: own observation to a Gaussian over the own action.
    vec = env.vec
    base = torch.from_numpy(residual_matrix(config.residual, vec))
    actor = Actor(config.actor, vec.observation_size, vec.action_size, config.hidden, config.initial_std, base)
    agents = {name: ("agents", name) for name in ("observation", "action", "loc", "scale", "state_value", "reward")}
    gaussian, log_prob = [agents["loc"], agents["scale"]], ("agents", "action_log_prob")
    policy = KeyedNetwork(StochasticPolicy(actor), agents["observation"], [agents["action"], log_prob])
    mean = KeyedNetwork(actor, agents["observation"], gaussian)
    judged = ProbabilisticActor(
        mean, in_keys=gaussian, out_keys=[agents["action"]], distribution_class=IndependentNormal,
        return_log_prob=True, log_prob_key=log_prob,
    )  # fmt: skip

    # 2. The critic, in units of running statistics of the returns (Yu et al. 2022).
    value_norm = PopArtValueNorm(shape=1, beta=0.999)
    critic: CentralCritic | LocalCritic
    source: str | tuple[str, str]
    if config.algorithm == "mappo":
        drones = drone_numbers(vec.num_drones, vec.action_size)
        critic, source = CentralCritic(config.critic, vec.state_size, drones, config.hidden, value_norm), "state"
    else:
        critic, source = LocalCritic(vec.observation_size, config.hidden, value_norm), agents["observation"]
    value = KeyedNetwork(critic, source, [agents["state_value"]])

    # 3. The loss and the advantage estimator. Time-outs are bootstrapped: only `terminated` ends a return.
    keys = {"value": agents["state_value"], "reward": agents["reward"], "done": "done", "terminated": "terminated"}
    loss = (MAPPOLoss if config.algorithm == "mappo" else IPPOLoss)(
        judged, value, value_norm=value_norm, clip_epsilon=config.clip,
        entropy_bonus=config.entropy > 0, entropy_coeff=config.entropy, critic_coeff=config.value_weight,
        loss_critic_type="l2", normalize_advantage=False, functional=False,
    )  # fmt: skip
    loss.set_keys(**keys, action=agents["action"], sample_log_prob=log_prob)
    advantage = MultiAgentGAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=value)
    advantage.set_keys(**keys)
    groups = [{"params": list(actor.parameters())}, {"params": list(critic.parameters())}]  # rates of their own
    optimizer = torch.optim.Adam(groups, lr=config.learning_rate, eps=1e-5, fused=True)
    return Learner(config, actor, critic, policy, loss, advantage, optimizer)


def _rows(data: TensorDictBase, chosen: torch.Tensor) -> TensorDictBase:
    """Return some rows of `data`, in a quarter of the time of `data[chosen]`."""
    return data.apply(lambda values: values.index_select(0, chosen), batch_size=chosen.shape)


def update(learner: Learner, batch: TensorDict) -> dict[str, float]:
    """Improve policy and critic on one batch of rollouts [E, T]; return diagnostics.

    Args:
        learner: changed in place.
        batch: what the collector returned; not changed.
    """
    config, start, batch = learner.config, time.perf_counter(), batch.copy()
    # 1. Advantages, from values of the critic before the update.
    with torch.no_grad():
        learner.advantage(batch)
    residual = batch["value_target"] - batch["agents", "state_value"]
    explained = 1 - residual.var() / batch["value_target"].var().clamp(min=1e-8)
    keep = [("agents", key) for key in ("observation", "action", "action_log_prob")] + ["state", "value_target"]
    data = batch.select(*keep, "advantage").reshape(-1)
    advantage = data["advantage"]
    data["advantage"] = (advantage - advantage.mean()) / advantage.std().clamp(min=1e-6)

    # 2. Some epochs of minibatches, fewer if the policy moves too far.
    actor, critic = (group["params"] for group in learner.optimizer.param_groups)
    diagnostics, stop = [], False
    for _ in range(config.epochs):
        order = torch.randperm(data.shape[0])
        for chunk in order.chunk(config.minibatches):
            losses = learner.loss(_rows(data, chunk))
            total = losses["loss_objective"] + losses["loss_critic"]
            if config.entropy > 0:
                total = total + losses["loss_entropy"]
            learner.optimizer.zero_grad(set_to_none=True)
            total.backward()
            norm = nn.utils.clip_grad_norm_(actor, config.max_grad_norm)
            nn.utils.clip_grad_norm_(critic, config.max_grad_norm)
            learner.optimizer.step()
            values = [
                losses["kl_approx"],
                losses["clip_fraction"],
                losses["loss_objective"],
                losses["loss_critic"],
                norm,
            ]
            diagnostics.append(torch.stack([value.detach().mean() for value in values]))
        if torch.stack(diagnostics[-config.minibatches :])[:, 0].mean() > config.target_kl:
            stop = True
            break

    # 3. Statistics of the observations, for the next rollouts.
    learner.actor.normalizer.update(batch["agents", "observation"])
    source = "state" if config.algorithm == "mappo" else ("agents", "observation")
    learner.critic.normalizer.update(batch[source])

    mean = torch.stack(diagnostics).mean(0)
    names = ("approx_kl", "clip_fraction", "loss_policy", "loss_critic", "gradient_norm")
    result = dict(zip(names, mean.tolist(), strict=True))
    entropy = 0.5 * torch.log(2 * torch.pi * torch.e * learner.actor.log_std.detach().exp() ** 2).sum()
    return result | {
        "explained_variance": explained.item(),
        "entropy": entropy.item(),
        "stopped_early": float(stop),
        "learning_seconds": time.perf_counter() - start,
    }


def adapted_rate(rate: float, kl: float, desired: float) -> float:
    """Return a learning rate that brings the KL of the next update closer to what is desired (Rudin et al. 2022)."""
    if kl > 2 * desired:
        return max(rate / 1.5, 1e-5)
    return min(rate * 1.5, 1e-2) if kl < desired / 2 else rate
