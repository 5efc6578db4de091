"""PPO for teams: MAPPO with a critic of the global state, IPPO with a critic of each drone's own observation."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Independent, Normal
from torchrl.modules import PopArtValueNorm

from multilift_marl.agents.networks import Actor, CentralCritic, LocalCritic, TeamNet, draw_action
from multilift_marl.config.schema import TrainConfig
from multilift_marl.control.scripted import residual_matrix
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.tasks.observations import drone_numbers


class StochasticPolicy(nn.Module):
    """The policy of the rollouts: actions drawn from the actor's Gaussian, and their log-probabilities."""

    def __init__(self, actor: Actor):
        super().__init__()
        self.actor = actor

    @torch.no_grad()
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions (..., N, A) and log-probabilities (..., N) for observations (..., N, D)."""
        return draw_action(self.actor(observation)[0], self.actor.log_std.exp())


@dataclass
class Learner:
    """What learns: networks and their optimiser, and the policy of the rollouts for TorchRL's collector."""

    config: TrainConfig
    actor: Actor
    critic: CentralCritic | LocalCritic
    policy: TensorDictModule
    optimizer: torch.optim.Adam

    def critic_input(self, batch: TensorDictBase) -> torch.Tensor:
        """Return what the critic sees: the global state of `mappo`, each drone's observation of `ippo`."""
        source: torch.Tensor = batch["state"] if self.config.algorithm == "mappo" else batch["agents", "observation"]
        return source


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
    policy = TensorDictModule(
        StochasticPolicy(actor),
        in_keys=[("agents", "observation")],
        out_keys=[("agents", "action"), ("agents", "action_log_prob")],
    )

    # 2. The critic, in units of running statistics of the returns (Yu et al. 2022).
    value_norm = PopArtValueNorm(shape=1, beta=0.999)
    critic: CentralCritic | LocalCritic
    if config.algorithm == "mappo":
        drones = drone_numbers(vec.num_drones, vec.action_size)
        critic = CentralCritic(config.critic, vec.state_size, drones, config.hidden, value_norm)
    else:
        critic = LocalCritic(vec.observation_size, config.hidden, value_norm)

    # 3. The optimiser, with rates of their own.
    groups = [{"params": list(actor.parameters())}, {"params": list(critic.parameters())}]
    optimizer = torch.optim.Adam(groups, lr=config.learning_rate, eps=1e-5, fused=True)
    return Learner(config, actor, critic, policy, optimizer)


@torch.no_grad()
def estimate_advantage(learner: Learner, batch: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
    """Return generalised advantage estimates and values (E, T, N, 1) of rollouts (Schulman et al., ICLR 2016).

    Time-outs are bootstrapped: only `terminated` ends a return.
    """
    following = batch["next"]
    value: torch.Tensor = learner.critic(learner.critic_input(batch))
    next_value = learner.critic(learner.critic_input(following))
    gamma = torch.tensor(learner.config.gamma)
    discount = gamma * ~following["terminated"].unsqueeze(-2)
    decay = torch.tensor(learner.config.gae_lambda) * gamma * ~following["done"].unsqueeze(-2)
    delta = following["agents", "reward"] + discount * next_value - value
    advantage = torch.empty_like(delta)
    last = torch.zeros_like(delta[:, 0])
    for t in reversed(range(delta.shape[1])):
        last = delta[:, t] + last * decay[:, t]
        advantage[:, t] = last
    return advantage, value


def update(learner: Learner, batch: TensorDictBase) -> dict[str, float]:
    """Improve policy and critic on one batch of rollouts [E, T]; return diagnostics.

    Args:
        learner: changed in place.
        batch: what the collector returned; not changed.
    """
    config, start = learner.config, time.perf_counter()
    observation, critic_input = batch["agents", "observation"], learner.critic_input(batch)

    # 1. Advantages, from values of the critic before the update, normalised over the batch.
    advantage, value = estimate_advantage(learner, batch)
    target = advantage + value
    explained = 1 - (target - value).var() / target.var().clamp(min=1e-8)
    advantage = (advantage - advantage.mean()) / advantage.std().clamp(min=1e-6)
    action, log_prob = batch["agents", "action"], batch["agents", "action_log_prob"]
    columns = [each.flatten(0, 1) for each in (observation, action, log_prob, advantage, critic_input, target)]

    # 2. Some epochs of minibatches, fewer if the policy moves too far.
    actor_parameters, critic_parameters = (group["params"] for group in learner.optimizer.param_groups)
    diagnostics: list[torch.Tensor] = []
    stop = False
    for _ in range(config.epochs):
        order = torch.randperm(len(columns[0]))
        for chunk in order.chunk(config.minibatches):
            rows = [column.index_select(0, chunk) for column in columns]
            policy_loss, entropy, kl, clipped = surrogate_loss(learner, *rows[:4])
            critic_loss = config.value_weight * value_loss(learner, *rows[4:])
            total = policy_loss + critic_loss
            if config.entropy > 0:
                total = total - config.entropy * entropy
            learner.optimizer.zero_grad(set_to_none=True)
            total.backward()
            norm = nn.utils.clip_grad_norm_(actor_parameters, config.max_grad_norm)
            nn.utils.clip_grad_norm_(critic_parameters, config.max_grad_norm)
            learner.optimizer.step()
            values = [kl, clipped, policy_loss, critic_loss, norm]
            diagnostics.append(torch.stack([value.detach() for value in values]))
        if torch.stack(diagnostics[-config.minibatches :])[:, 0].mean() > config.target_kl:
            stop = True
            break

    # 3. Statistics of the observations, for the next rollouts.
    learner.actor.normalizer.update(observation)
    learner.critic.normalizer.update(critic_input)

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


def surrogate_loss(
    learner: Learner, observation: torch.Tensor, action: torch.Tensor, log_prob: torch.Tensor, advantage: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the clipped loss (Schulman et al., arXiv 1707.06347), entropy, approximate KL and clipped share."""
    clip = torch.tensor(learner.config.clip)
    distribution = Independent(Normal(*learner.actor(observation)), 1)
    log_ratio = (distribution.log_prob(action) - log_prob).unsqueeze(-1)
    clipped = log_ratio.clamp((-clip).log1p(), clip.log1p())
    gain = torch.stack([log_ratio.exp() * advantage, clipped.exp() * advantage], -1).min(dim=-1).values
    share = (clipped != log_ratio).float().mean()
    return (-gain).mean(), distribution.entropy().mean(), -log_ratio.mean(), share


def value_loss(learner: Learner, source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the squared error in units of the value normaliser, which learns from the targets first."""
    value, norm = learner.critic(source), learner.critic.value_norm
    norm.update(target)
    return (norm.normalize(target) - norm.normalize(value)).square().mean()


def adapted_rate(rate: float, kl: float, desired: float) -> float:
    """Return a learning rate that brings the KL of the next update closer to what is desired (Rudin et al. 2022)."""
    if kl > 2 * desired:
        return max(rate / 1.5, 1e-5)
    return min(rate * 1.5, 1e-2) if kl < desired / 2 else rate
