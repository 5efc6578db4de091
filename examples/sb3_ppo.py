"""Stable-Baselines3's PPO, one policy for all drones, on the batched core: each drone is a row of its environments.

Needs its own environment with examples/requirements/sb3_ppo.txt. Run: python examples/sb3_ppo.py
"""

import sys

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from torch.nn.utils import parameters_to_vector

from multilift_marl.envs.sb3_vec import MultiliftSB3VecEnv


def train(iterations: int = 60, num_envs: int = 64, horizon: int = 128, seed: int = 0, **overrides):
    """Train on `hover` and return the policy's weights before and after, as flat tensors."""
    torch.set_num_threads(1)
    env = VecMonitor(MultiliftSB3VecEnv("hover", num_envs=num_envs, **overrides))
    model = PPO(
        "MlpPolicy", env, n_steps=horizon, batch_size=horizon * env.num_envs // 8, n_epochs=4, learning_rate=1e-3,
        device="cpu", verbose=1, seed=seed,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.2},  # a zero action already holds the formation
    )  # fmt: skip
    before = parameters_to_vector(model.policy.parameters()).detach().clone()
    model.learn(iterations * horizon * env.num_envs)
    env.close()
    return before, parameters_to_vector(model.policy.parameters()).detach()


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
