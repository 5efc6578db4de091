"""tianshou's PPO on the Gymnasium environment: the whole team is one agent.

Needs its own environment with examples/requirements/tianshou_ppo.txt. Run: python examples/tianshou_ppo.py
tianshou's own multi-agent interface asks agents one after another, which suits games; drones act at once.
"""

import sys
from functools import partial

import gymnasium
import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch import nn
from torch.distributions import Independent, Normal
from torch.nn.utils import parameters_to_vector

import multilift_marl  # noqa: F401 - registers the environments with Gymnasium


def gaussian(mean_and_std: tuple[torch.Tensor, torch.Tensor]) -> Independent:
    """Return the distribution of actions."""
    return Independent(Normal(*mean_and_std), 1)


def train(iterations: int = 60, num_envs: int = 16, horizon: int = 128, seed: int = 0, **overrides):
    """Train on `hover` and return the policy's weights before and after, as flat tensors."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    make = partial(gymnasium.make, "multilift_marl/Hover-v0", **overrides)
    envs = DummyVectorEnv([partial(make, seed=seed + e) for e in range(num_envs)])
    observed, acted = envs.observation_space[0], envs.action_space[0]

    def network() -> Net:
        return Net(state_shape=observed.shape, hidden_sizes=[128, 128], activation=nn.Tanh)

    actor = ContinuousActorProbabilistic(preprocess_net=network(), action_shape=acted.shape, unbounded=True)
    nn.init.constant_(actor.sigma_param, -1.2)  # a zero action already holds the formation
    nn.init.orthogonal_(actor.mu.model[-1].weight, 0.01)
    before = parameters_to_vector(actor.parameters()).detach().clone()
    policy = ProbabilisticActorPolicy(actor=actor, dist_fn=gaussian, action_space=acted)
    algorithm = PPO(
        policy=policy, critic=ContinuousCritic(preprocess_net=network()), optim=AdamOptimizerFactory(lr=1e-3),
        gamma=0.99, gae_lambda=0.95, ent_coef=0.0, max_grad_norm=0.5, max_batchsize=4096,
    )  # fmt: skip
    frames = num_envs * horizon
    algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=Collector[CollectStats](algorithm, envs, VectorReplayBuffer(frames, num_envs)),
            max_epochs=iterations, epoch_num_steps=frames, collection_step_num_env_steps=frames,
            batch_size=frames // 8, update_step_num_repetitions=4, show_progress=False,
        )
    )  # fmt: skip
    envs.close()
    return before, parameters_to_vector(actor.parameters()).detach()


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
