"""PPO in a single file, in the manner of CleanRL, on the Gymnasium vector environment: the whole team is one agent.

Needs the package's `train` extra, or examples/requirements/cleanrl_ppo.txt. Run: python examples/cleanrl_ppo.py
"""

import sys

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal
from torch.nn.utils import parameters_to_vector

import multilift_marl  # noqa: F401 - registers the environments with Gymnasium

GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES, LEARNING_RATE = 0.99, 0.95, 0.2, 4, 8, 1e-3


class Agent(nn.Module):
    """A Gaussian policy and a critic of the joint observation."""

    def __init__(self, observation_size: int, action_size: int, hidden: int = 128):
        super().__init__()

        def network(outputs: int, gain: float) -> nn.Sequential:
            last = nn.Linear(hidden, outputs)
            nn.init.orthogonal_(last.weight, gain)
            nn.init.zeros_(last.bias)
            first = nn.Linear(observation_size, hidden)
            return nn.Sequential(first, nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh(), last)

        self.policy, self.critic = network(action_size, 0.01), network(1, 1.0)
        self.log_std = nn.Parameter(torch.full((action_size,), -1.2))  # a zero action already holds the formation

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the values (...,) of observations (..., N·D)."""
        return self.critic(observation).squeeze(-1)

    def distribution(self, observation: torch.Tensor) -> Normal:
        """Return the distribution of actions (..., N·A)."""
        return Normal(self.policy(observation), self.log_std.exp())


def train(iterations: int = 200, num_envs: int = 64, horizon: int = 64, seed: int = 0, **overrides):
    """Train on `hover` and return the policy's weights before and after, as flat tensors."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    envs = gymnasium.make_vec("multilift_marl/Hover-v0", num_envs=num_envs, seed=seed, **overrides)
    sizes = (envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    agent = Agent(*sizes)
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    before = parameters_to_vector(agent.policy.parameters()).detach().clone()
    observations, actions = (torch.zeros(horizon, num_envs, size) for size in sizes)
    log_probs, rewards, values, ended = (torch.zeros(horizon, num_envs) for _ in range(4))
    observation = torch.from_numpy(envs.reset()[0])

    for iteration in range(iterations):
        # 1. Rollouts. The environments reset themselves in the step that ends an episode.
        total, ends, successes = 0.0, 0, 0
        for t in range(horizon):
            with torch.no_grad():
                distribution = agent.distribution(observation)
                actions[t] = distribution.sample()
                log_probs[t] = distribution.log_prob(actions[t]).sum(-1)
                values[t] = agent.value(observation)
            observations[t] = observation
            step, reward, terminated, truncated, info = envs.step(actions[t].numpy())
            observation, over = torch.from_numpy(step), terminated | truncated
            total += reward.mean()
            if truncated.any():  # out of time is no failure: what would have followed still counts
                last = torch.from_numpy(np.stack(info["final_obs"][truncated]))
                with torch.no_grad():
                    reward[truncated] += GAMMA * agent.value(last).numpy()
            if over.any():
                ends, successes = ends + over.sum(), successes + info["final_info"]["success"].sum()
            rewards[t], ended[t] = torch.from_numpy(reward), torch.from_numpy(over)

        # 2. Advantages (GAE) and returns.
        advantages, following, advantage = torch.zeros_like(rewards), agent.value(observation).detach(), 0.0
        for t in reversed(range(horizon)):
            delta = rewards[t] + GAMMA * (1 - ended[t]) * following - values[t]
            advantage = advantages[t] = delta + GAMMA * LAMBDA * (1 - ended[t]) * advantage
            following = values[t]
        batch = [part.flatten(0, 1) for part in (observations, actions, log_probs, advantages, advantages + values)]

        # 3. Some epochs of minibatches on the clipped objective.
        for _ in range(EPOCHS):
            for chosen in torch.randperm(horizon * num_envs).chunk(MINIBATCHES):
                seen, acted, log_prob, advantage, target = (part[chosen] for part in batch)
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                ratio = (agent.distribution(seen).log_prob(acted).sum(-1) - log_prob).exp()
                objective = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
                loss = 0.5 * (agent.value(seen) - target).square().mean() - objective
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        success = f", {successes / ends:.0%} of {ends} episodes succeeded" if ends else ""
        print(f"iteration {iteration + 1}: reward {total / horizon:.3f} a step{success}", flush=True)

    envs.close()
    return before, parameters_to_vector(agent.policy.parameters()).detach()


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
