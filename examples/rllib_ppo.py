"""RLlib's PPO on its current API stack, one policy for all drones, through its ParallelPettingZooEnv.

Needs its own environment with examples/requirements/rllib_ppo.txt. Run: python examples/rllib_ppo.py
"""

import os
import sys

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env
from torch.nn.utils import parameters_to_vector

from multilift_marl.envs import multilift_v0


def make(context) -> ParallelPettingZooEnv:
    """Return one environment; RLlib gives each its own seed at its first reset."""
    return ParallelPettingZooEnv(multilift_v0.parallel_env("hover", **context))


def build(num_envs: int, horizon: int, seed: int, **overrides) -> tuple[Algorithm, torch.nn.Module]:
    """Return PPO whose environments run in this process, without workers, and the policy that it trains."""
    register_env("multilift", make)
    config = (
        PPOConfig()
        .environment("multilift", env_config=overrides)
        .env_runners(num_env_runners=0, num_envs_per_env_runner=num_envs)
        .multi_agent(policies={"team"}, policy_mapping_fn=lambda agent, episode, **_: "team")
        .rl_module(
            model_config=DefaultModelConfig(fcnet_hiddens=[128, 128], vf_share_layers=False, free_log_std=True),
        )
        .training(
            train_batch_size_per_learner=num_envs * horizon, minibatch_size=num_envs * horizon // 2, num_epochs=4,
            lr=1e-3, lambda_=0.95, gamma=0.99, vf_clip_param=float("inf"), grad_clip=0.5,
        )
        .debugging(seed=seed, log_level="ERROR")
    )  # fmt: skip
    algorithm = config.build_algo()
    policy = algorithm.learner_group._learner.module["team"]
    torch.nn.init.constant_(policy.pi.log_std, -1.2)  # RLlib starts with 0; a zero action already holds the formation
    algorithm.env_runner_group.sync_weights(from_worker_or_learner_group=algorithm.learner_group, inference_only=True)
    return algorithm, policy


def train(iterations: int = 60, num_envs: int = 8, horizon: int = 256, seed: int = 0, **overrides):
    """Train on `hover` and return the policy's weights before and after, as flat tensors."""
    torch.set_num_threads(1)
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    algorithm, policy = build(num_envs, horizon, seed, **overrides)
    before = parameters_to_vector(policy.parameters()).detach().clone()
    for iteration in range(iterations):
        mean = algorithm.train()["env_runners"].get("episode_return_mean")  # summed over the drones
        print(f"iteration {iteration + 1}: return {'of no episode yet' if mean is None else round(mean)}", flush=True)
    after = parameters_to_vector(policy.parameters()).detach().clone()
    algorithm.stop()
    ray.shutdown()
    return before, after


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
