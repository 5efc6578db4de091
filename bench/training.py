"""Computing time of the parts of a training iteration.

    python bench/training.py [repeats=15] [any configuration key of hover]

Of each iteration of `python train.py config=hover` these are timed: physics, control, observation and reward, in the
threads that step the shards; the actor during rollouts; starts of episodes. The arithmetic of learning is
timed without TorchRL's losses and estimators on copies of the networks, alternating with the iterations. The rest is
TorchRL, TensorDict and Python, the package's own included: collecting, packing, checking, losses, diagnostics.
"""

from __future__ import annotations

import copy
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchrl.modules import IndependentNormal

from multilift_marl.agents.mappo import update
from multilift_marl.agents.trainer import Trainer
from multilift_marl.config.load import load_config, parse_overrides
from multilift_marl.errors import ConfigError

PARTS = {
    "core": "physics, control, observation, reward",
    "actor": "actor in rollouts",
    "learning": "arithmetic of learning",
    "starts": "starts of episodes",
    "other": "TorchRL, TensorDict, Python",
}


def timed(function: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """Return `function`, whose time [s] adds up in `spent[name]`."""

    def call(*arguments: Any, **named: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            spent[name] = spent.get(name, 0.0) + time.perf_counter() - start

    return call


class Arithmetic:
    """The arithmetic of `agents.mappo.update` (MAPPO, no entropy bonus) without TensorDicts, on copied networks."""

    def __init__(self, trainer: Trainer):
        self.config = trainer.config.train
        if self.config.algorithm != "mappo" or self.config.entropy > 0:
            raise ConfigError("bench/training.py supports train.algorithm=mappo with train.entropy=0 only; set these")
        learner = trainer.learner
        self.actor = copy.deepcopy(learner.actor)
        self.critic = copy.deepcopy(learner.critic)
        groups = [{"params": list(network.parameters())} for network in (self.actor, self.critic)]
        self.optimizer = torch.optim.Adam(groups, lr=1e-6, eps=1e-5, fused=True)

    def seconds(self, batch: Any) -> float:
        """Return how long it takes for a batch of rollouts [E, T]."""
        start = time.perf_counter()
        config = self.config
        norm = self.critic.value_norm
        after = batch["next"]
        observation = batch["agents", "observation"]
        state = batch["state"]
        with torch.no_grad():
            value = self.critic(state)
            advantage = self._advantage(
                value,
                self.critic(after["state"]),
                after["agents", "reward"],
                after["terminated"],
                after["done"],
            )
            target = advantage + value
            advantage = (advantage - advantage.mean()) / advantage.std()
        columns = [observation, batch["agents", "action"], batch["agents", "action_log_prob"], state, advantage, target]
        columns = [column.flatten(0, 1) for column in columns]
        for _ in range(config.epochs):
            for chunk in torch.randperm(len(columns[0])).chunk(config.minibatches):
                seen, action, before, known, gain, aim = (column.index_select(0, chunk) for column in columns)
                ratio = (IndependentNormal(*self.actor(seen)).log_prob(action) - before).exp().unsqueeze(-1)
                clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
                policy = -torch.min(ratio * gain, clipped * gain).mean()
                guess = self.critic(known)
                norm.update(aim)  # after the guess, as TorchRL's loss does
                error = norm.normalize(guess) - norm.normalize(aim)
                self.optimizer.zero_grad(set_to_none=True)
                (policy + config.value_weight * error.square().mean()).backward()
                for group in self.optimizer.param_groups:
                    nn.utils.clip_grad_norm_(group["params"], config.max_grad_norm)
                self.optimizer.step()
        self.actor.normalizer.update(observation)
        self.critic.normalizer.update(state)
        return time.perf_counter() - start

    def _advantage(
        self,
        value: torch.Tensor,
        following: torch.Tensor,
        reward: torch.Tensor,
        terminated: torch.Tensor,
        done: torch.Tensor,
    ) -> torch.Tensor:
        """Return generalised advantage estimates (E, T, N, 1)."""
        config = self.config
        delta = reward + config.gamma * following * ~terminated.unsqueeze(-2) - value
        decay = config.gamma * config.gae_lambda * ~done.unsqueeze(-2)
        result = torch.empty_like(delta)
        last = torch.zeros_like(delta[:, 0])
        for t in reversed(range(delta.shape[1])):
            result[:, t] = last = delta[:, t] + decay[:, t] * last
        return result


def main(arguments: list[str]) -> dict:
    """Measure, print a table, and return the numbers."""
    values = parse_overrides(arguments)
    repeats = int(values.pop("repeats", 15))
    trainer = Trainer(load_config("hover", {"train.target_kl": 1e3} | values), Path("runs"))  # nothing is written there
    spent: dict[str, float] = {}
    vec = trainer.env.vec
    network = trainer.learner.policy.network
    vec.world.run = timed(vec.world.run, "core", spent)
    vec.reset = timed(vec.reset, "starts", spent)
    network.forward = timed(network.forward, "actor", spent)
    arithmetic = Arithmetic(trainer)
    batches = iter(trainer.collector)
    iterations = []
    for i in range(repeats + 2):
        spent.clear()
        start = time.perf_counter()
        batch = next(batches)
        torch.set_num_threads(trainer.config.train.threads)
        update(trainer.learner, batch)
        spent["total"] = time.perf_counter() - start
        spent["learning"] = arithmetic.seconds(batch)
        torch.set_num_threads(1)
        if i >= 2:
            iterations.append(dict(spent))
    for found in iterations:
        found["other"] = found["total"] - sum(found.get(name, 0.0) for name in PARTS if name != "other")
    result = {}
    print(f"{trainer.frames_per_batch} steps in an iteration; medians of {repeats}")
    print("| part | time [ms] | share (least - largest) |")
    print("|---|---|---|")
    for name, title in PARTS.items():
        shares = [100 * found.get(name, 0.0) / found["total"] for found in iterations]
        taken = statistics.median(found.get(name, 0.0) for found in iterations)
        share = statistics.median(shares)
        result[name] = {"seconds": taken, "percent": share}
        print(f"| {title} | {1e3 * taken:.0f} | {share:.1f} % ({min(shares):.1f} - {max(shares):.1f}) |")
    return result


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
