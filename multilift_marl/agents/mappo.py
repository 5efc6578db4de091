"""PPO for teams: MAPPO with a critic of the global state, IPPO with a critic of each drone's own observation."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.distributions import Independent, Normal
from torchrl.modules import PopArtValueNorm

from multilift_marl.agents.networks import (
    Actor,
    CentralCritic,
    LocalCritic,
    NoCritic,
    Normalizer,
    TeamNet,
    build_actor,
    draw_action,
)
from multilift_marl.diffmpc.sensitivity import Tape
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import base_matrix
from multilift_marl.schema.sections import EnvConfig
from multilift_marl.schema.training import TrainConfig

_OBSERVATION, _ACTION, _LOG_PROB, _MEMORY = (
    ("agents", name) for name in ("observation", "action", "action_log_prob", "memory")
)


class StochasticPolicy(TensorDictModuleBase):
    """The policy of the rollouts: actions drawn from the actor's Gaussian, and their log-probabilities.

    Reads the observation, writes ("agents", "action") and ("agents", "action_log_prob"). With a GRU it also reads the
    memory, ("agents", "memory"), and writes the next one, which the environment carries to the next step.

    Attributes:
        actor: the Gaussian.
        noise: of the steps to come, (E, N, A) each, standard normal; see `agents/rollouts.py`.
    """

    def __init__(self, actor: Actor):
        super().__init__()
        self.actor = actor
        self.noise: Iterator[torch.Tensor] = iter(())
        self.in_keys: list[NestedKey] = [_OBSERVATION]
        self.out_keys: list[NestedKey] = [_ACTION, _LOG_PROB]
        if actor.memory is not None:
            self.in_keys.append(_MEMORY)
            self.out_keys.append(("next", *_MEMORY))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act."""
        observation, memory = tensordict[_OBSERVATION], None
        if self.actor.memory is not None:
            memory = self.actor.remember(observation, tensordict[_MEMORY])
            tensordict["next", *_MEMORY] = memory
        mean = self.actor(observation, memory)[0]
        tensordict[_ACTION], tensordict[_LOG_PROB] = draw_action(mean, self.actor.log_std.exp(), next(self.noise))
        return tensordict


@dataclass
class Learner:
    """What learns: networks and their optimiser, and the policy of the rollouts for TorchRL's collector."""

    config: TrainConfig
    actor: Actor
    critic: CentralCritic | LocalCritic
    policy: StochasticPolicy
    optimizer: torch.optim.Adam

    def critic_input(self, batch: TensorDictBase) -> torch.Tensor:
        """Return what the critic sees: the global state of `mappo`, each drone's observation of `ippo`."""
        source: torch.Tensor = batch["state"] if self.config.algorithm == "mappo" else batch["agents", "observation"]
        return source


def make_actor(config: TrainConfig, vec: MultiliftVec) -> Actor:
    """Return an untrained policy for `vec`, which acts as its base policy."""
    base = torch.from_numpy(base_matrix(config.residual, vec))
    return build_actor(config, base, vec.observation_names)


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
    actor = make_actor(config, vec)

    # 2. The critic, in units of running statistics of the returns (Yu et al. 2022).
    value_norm = PopArtValueNorm(shape=1, beta=0.999)
    critic: Any
    if config.algorithm in ("diffmpc", "dagger"):
        critic = NoCritic()
    elif config.algorithm == "mappo":
        numbers = vec.task.drone_numbers
        critic = CentralCritic(config.critic, vec.state_size, numbers, config.hidden, value_norm, config.asinh)
    else:
        critic = LocalCritic(vec.observation_size, config.hidden, value_norm, config.asinh)

    # 3. The optimiser, with rates of their own.
    groups = [{"params": list(actor.parameters())}, {"params": list(critic.parameters())}]
    optimizer = torch.optim.Adam(groups, lr=config.learning_rate, eps=1e-5, fused=True)
    return Learner(config, actor, critic, StochasticPolicy(actor), optimizer)


def in_warmup(train: TrainConfig, iteration: int) -> bool:
    """Return whether the critic alone learns: by its untrained values a good actor would only get worse."""
    return train.algorithm in ("mappo", "ippo") and iteration < train.warmup


def check_communication(train: TrainConfig, env: EnvConfig) -> None:
    """Refuse, by a ConfigError, networks of a team whose drones do not all hear each other."""
    if train.actor != "local" and env.sensing in ("onboard", "blind") and env.communication != "all":
        raise ConfigError(
            f"train.actor={train.actor} lets drones know what the others' networks hold, but with env.sensing="
            f"{env.sensing} they hear of all others only by onboard and env.communication=all; set these, or "
            "train.actor=local"
        )


def check_batch(train: TrainConfig, vec: MultiliftVec, num_envs: int, rigs: int = 1) -> None:
    """Refuse, by a ConfigError, batches that cannot be divided as asked, or are larger than this machine's memory."""
    steps = num_envs * train.horizon
    rows, what = steps // rigs, "steps" if rigs == 1 else "steps of each rig"
    if train.gru:
        length = sequence_length(train)
        if train.horizon % length:
            raise ConfigError(
                f"train.horizon={train.horizon} is no multiple of train.sequence={train.sequence}, the steps that "
                "gradients of a GRU go back; change one of them"
            )
        rows, what = rows // length, what.replace("steps", "sequences")
    if train.minibatches > rows:
        raise ConfigError(
            f"train.minibatches={train.minibatches} exceeds the {rows} {what} of a batch; lower it or raise "
            "train.horizon or env.num_envs"
        )
    # float32; before and after each step observation, action and memory of each drone, and the global state.
    per_drone = 2 * (vec.observation_size + vec.action_size + train.gru) + 6
    needed = 4 * steps * (2 * vec.state_size + vec.num_drones * per_drone)
    lower = "train.horizon"
    # Beside them what the plans of the window leave for their derivatives.
    if train.algorithm == "diffmpc":
        tape = train.diffmpc.window + 1, num_envs, vec.config.planner.steps, vec.num_drones
        needed, lower = needed + Tape.nbytes(*tape), "train.diffmpc.window, planner.steps, train.horizon"
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > there:
        raise ConfigError(
            f"a batch of {steps} steps takes {needed / 1e9:.0f} GB, but this machine has {there / 1e9:.0f} GB; lower "
            f"{lower} or env.num_envs"
        )


@torch.no_grad()
def check_finite(learner: Learner, iteration: int) -> None:
    """Refuse, by a ConfigError, networks that are of no use any more after learning in an iteration, from 0."""
    # A deviation of 0, or one beyond single precision, shows before the weights do.
    deviation = learner.actor.log_std.exp().square().log()
    numbers = (deviation, *learner.actor.state_dict().values(), *learner.critic.state_dict().values())
    if not all(each.isfinite().all() for each in numbers):
        raise ConfigError(
            f"training diverged in iteration {iteration + 1}: its networks hold numbers that are not finite; lower "
            "train.learning_rate or train.critic_learning_rate and train anew"
        )


@torch.no_grad()
def estimate_advantage(learner: Learner, batch: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
    """Return generalised advantage estimates and values (E, T, N, 1) of rollouts (Schulman et al., ICLR 2016).

    Time-outs are bootstrapped: only `terminated` ends a return.
    """
    following = batch["next"]
    value: torch.Tensor = learner.critic(learner.critic_input(batch))
    # The next step's value is that of the state after this one, but where an episode ends, or the batch.
    next_value = value.roll(-1, 1)
    last_steps = following["done"].squeeze(-1).clone()
    last_steps[:, -1] = True
    next_value[last_steps] = learner.critic(learner.critic_input(following)[last_steps])
    gamma = torch.tensor(learner.config.gamma)
    discount = gamma * ~following["terminated"].unsqueeze(-2)
    # `done` also where time is up: the next step is of another episode, so errors do not flow back across it. The value
    # of the last state still counts there, by `discount`.
    decay = torch.tensor(learner.config.gae_lambda) * gamma * ~following["done"].unsqueeze(-2)
    delta = following["agents", "reward"] + discount * next_value - value
    advantage = torch.empty_like(delta)
    last = torch.zeros_like(delta[:, 0])
    for t in reversed(range(delta.shape[1])):
        last = delta[:, t] + last * decay[:, t]
        advantage[:, t] = last
    return advantage, value


def update(learner: Learner, batches: Sequence[TensorDictBase]) -> dict[str, float]:
    """Improve policy and critic on batches of rollouts [E, T]; return diagnostics.

    Args:
        learner: changed in place.
        batches: what the collectors returned, one for each rig and as many steps of each; not changed.
    """
    config, start = learner.config, time.perf_counter()

    # 0. The first statistics of the observations, or the first update would learn from inputs of another scale than all
    # others. An untrained policy acts alike by any: its last layer is zero. Its memory does not.
    statistics = learner.actor.normalizer, learner.critic.normalizer
    first = [each for each in statistics if not each.count and (each is not statistics[0] or not config.gru)]
    _update_statistics(learner, batches, first)

    # 1. Advantages, from values of the critic before the update, normalised over all batches.
    estimates = [estimate_advantage(learner, batch) for batch in batches]
    advantages = torch.cat([advantage.flatten() for advantage, _ in estimates])
    mean, deviation = advantages.mean(), advantages.std().clamp(min=1e-6)
    # A + V, the λ-return, which the critic is to fit.
    targets = torch.cat([(advantage + value).flatten() for advantage, value in estimates])
    # 1 - Var(R - V)/Var(R): the advantage is R - V.
    explained = 1 - advantages.var() / targets.var().clamp(min=1e-8)
    tables = [
        _list_columns(learner, batch, (advantage - mean) / deviation, advantage + value)
        for batch, (advantage, value) in zip(batches, estimates, strict=True)
    ]
    # Rows of teams of one size fit into one tensor, those of others do not.
    sizes: dict[tuple[torch.Size, ...], list[list[torch.Tensor]]] = {}
    for columns in tables:
        sizes.setdefault(tuple(column.shape[1:] for column in columns), []).append(columns)
    groups = [
        (len(alike), alike[0] if len(alike) == 1 else [torch.cat(each) for each in zip(*alike, strict=True)])
        for alike in sizes.values()
    ]

    # 2. Some epochs of minibatches, fewer if the policy moves too far. A minibatch has as many rows of each batch.
    actor_parameters, critic_parameters = (group["params"] for group in learner.optimizer.param_groups)
    diagnostics: list[torch.Tensor] = []
    stop = False
    for _ in range(config.epochs):
        orders = [_shuffle(count, len(columns[0]) // count).chunk(config.minibatches, 1) for count, columns in groups]
        for chunks in zip(*orders, strict=True):
            learner.optimizer.zero_grad(set_to_none=True)
            losses = torch.stack([
                count / len(tables) * _add_gradients(learner, _pick(columns, chunk), count / len(tables))
                for (count, columns), chunk in zip(groups, chunks, strict=True)
            ])  # fmt: skip
            # Each by its own norm: a large gradient of the critic does not shorten the actor's step.
            norm = nn.utils.clip_grad_norm_(actor_parameters, config.max_grad_norm)
            nn.utils.clip_grad_norm_(critic_parameters, config.max_grad_norm)
            learner.optimizer.step()
            diagnostics.append(torch.cat([losses.sum(0), norm.detach()[None]]))
        # The mean over an epoch: single minibatches are too noisy to stop by.
        if torch.stack(diagnostics[-config.minibatches :])[:, 0].mean() > config.target_kl:
            stop = True
            break
    with torch.no_grad():
        moved = torch.stack([
            count / len(tables) * _team_kl(learner, _pick(columns, chunk))
            for (count, columns), chunk in zip(groups, chunks, strict=True)
        ])  # fmt: skip

    # 3. Statistics of the observations, for the next rollouts. After the update, or old log-probabilities would be of
    # other inputs than the new ones, and the ratios not 1 at first.
    _update_statistics(learner, batches, [each for each in statistics if each not in first])

    names = ("approx_kl", "clip_fraction", "loss_policy", "loss_critic", "gradient_norm")
    result = dict(zip(names, torch.stack(diagnostics).mean(0).tolist(), strict=True))
    # ½ log 2π e σ² of each number, the same in every state.
    entropy = 0.5 * torch.log(2 * torch.pi * torch.e * learner.actor.log_std.detach().exp() ** 2).sum()
    return result | {
        "team_kl": moved.sum().item(),
        "explained_variance": explained.item(),
        "entropy": entropy.item(),
        "stopped_early": float(stop),
        "learning_seconds": time.perf_counter() - start,
    }


def _shuffle(count: int, rows: int) -> torch.Tensor:
    """Return the rows of so many batches (count, rows), each batch's in an order of its own."""
    return torch.stack([torch.randperm(rows) + batch * rows for batch in range(count)])


def _pick(columns: list[torch.Tensor], chunk: torch.Tensor) -> list[torch.Tensor]:
    """Return those rows of all columns."""
    return [column.index_select(0, chunk.flatten()) for column in columns]


def _update_statistics(learner: Learner, batches: Sequence[TensorDictBase], which: Sequence[Normalizer]) -> None:
    """Include the observations and states of rollouts in those statistics of actor and critic."""
    for batch in batches:
        if learner.actor.normalizer in which:
            learner.actor.normalizer.update(batch[_OBSERVATION])
        if learner.critic.normalizer in which:
            learner.critic.normalizer.update(learner.critic_input(batch))


def _list_columns(
    learner: Learner, batch: TensorDictBase, advantage: torch.Tensor, target: torch.Tensor
) -> list[torch.Tensor]:
    """Return what minibatches of rollouts [E, T] are drawn from, one row for each step or sequence."""
    columns = [batch[_OBSERVATION], batch[_ACTION], batch[_LOG_PROB], advantage, learner.critic_input(batch), target]
    columns += [] if learner.actor.memory is None else [mark_starts(batch)]
    length = sequence_length(learner.config)
    columns = [split_batch(column, length) for column in columns]
    return columns if learner.actor.memory is None else [*columns, batch[_MEMORY][:, ::length].flatten(0, 1)]


def _add_gradients(learner: Learner, rows: list[torch.Tensor], weight: float) -> torch.Tensor:
    """Add the gradients of the losses on rows of `_list_columns`, times `weight`; return KL, clipped share, losses."""
    config = learner.config
    policy_loss, entropy, kl, clipped = surrogate_loss(learner, *rows[:4], *rows[6:])
    critic_loss = config.value_weight * value_loss(learner, *rows[4:6])
    total = policy_loss + critic_loss
    if config.entropy > 0:
        total = total - config.entropy * entropy
    (weight * total).backward()
    return torch.stack([value.detach() for value in (kl, clipped, policy_loss, critic_loss)])


def _team_kl(learner: Learner, rows: list[torch.Tensor]) -> torch.Tensor:
    """Return the KL of a team's actions from those of the rollouts: drones draw independently, so theirs add up."""
    return rows[0].shape[-2] * surrogate_loss(learner, *rows[:4], *rows[6:])[2]


def sequence_length(train: TrainConfig) -> int:
    """Return the steps that gradients of a GRU go back, the whole of a shorter batch; 0 without one."""
    return min(train.sequence, train.horizon) if train.gru else 0


def mark_starts(batch: TensorDictBase) -> torch.Tensor:
    """Return which steps (E, T) of rollouts are the first of an episode; of a batch's first steps nothing is known."""
    done = batch["next", "done"].squeeze(-1)
    return torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1)


def split_batch(column: torch.Tensor, sequence: int) -> torch.Tensor:
    """Return rollouts (E, T, ...) as what minibatches are drawn from: steps, or sequences of so many steps."""
    return column.flatten(0, 1) if sequence == 0 else column.unflatten(1, (-1, sequence)).flatten(0, 1)


def surrogate_loss(
    learner: Learner, observation: torch.Tensor, action: torch.Tensor, log_prob: torch.Tensor, advantage: torch.Tensor,
    started: torch.Tensor | None = None, memory: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    """Return the clipped loss (Schulman et al., arXiv 1707.06347), entropy, approximate KL and clipped share.

    With a GRU all is of sequences (B, L, ...), `started` (B, L) of `Memory.unroll`, and `memory` (B, N, H) that of the
    rollouts before the first step.
    """
    clip = torch.tensor(learner.config.clip)
    if memory is not None and started is not None:
        memory = learner.actor.unroll(observation, memory, started)
    distribution = Independent(Normal(*learner.actor(observation, memory)), 1)
    log_ratio = (distribution.log_prob(action) - log_prob).unsqueeze(-1)
    # Clipping the logarithm clips the ratio, to 1 - ε and 1 + ε.
    clipped = log_ratio.clamp((-clip).log1p(), clip.log1p())
    # min(r A, clip(r) A): pessimistic, so that there is nothing to gain beyond the bounds but all to lose.
    gain = torch.stack([log_ratio.exp() * advantage, clipped.exp() * advantage], -1).min(dim=-1).values
    # KL: the mean of r - 1 - log r over what π_old drew (k3 of Schulman, "Approximating KL divergence", 2020), unbiased
    # and never negative.
    kl = (log_ratio.expm1() - log_ratio).mean()
    share = (clipped != log_ratio).float().mean()
    return (-gain).mean(), distribution.entropy().mean(), kl, share


def value_loss(learner: Learner, source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the squared error in units of the value normaliser, which learns from the targets first."""
    value, norm = learner.critic(source), learner.critic.value_norm
    norm.update(target)
    return (norm.normalize(target) - norm.normalize(value)).square().mean()


def adapted_rate(rate: float, kl: float, desired: float) -> float:
    """Return a learning rate that brings the KL of the next update closer to what is desired (Rudin et al. 2022)."""
    if kl > 2 * desired:
        return max(rate / 1.5, 1e-5)
    # Factors and bounds are those of Rudin et al.
    return min(rate * 1.5, 1e-2) if kl < desired / 2 else rate
