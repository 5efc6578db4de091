"""Stable-Baselines3's PPO, one policy for all drones: SuperSuit makes agents the rows of an SB3 vector environment.

Needs its own environment with examples/requirements/sb3_supersuit.txt. Run: python examples/sb3_supersuit.py
"""

import sys

import supersuit
import torch
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from torch.nn.utils import parameters_to_vector

from multilift_marl.envs import multilift_v0


class TellTimeLimits(BaseParallelWrapper):
    """Marks time limits for SB3, which SuperSuit does not; SB3 would take them for failures."""

    def step(self, actions):
        """Advance one step and mark time limits in the infos."""
        observations, rewards, terminations, truncations, infos = super().step(actions)
        for agent, info in infos.items():
            info["TimeLimit.truncated"] = truncations[agent]
        return observations, rewards, terminations, truncations, infos


def make(num_envs: int, seed: int, **overrides) -> VecMonitor:
    """Return an SB3 vector environment of num_envs · N rows, one for each drone."""
    env = TellTimeLimits(multilift_v0.parallel_env("hover", **overrides))
    rows = supersuit.pettingzoo_env_to_vec_env_v1(env)
    rows = supersuit.concat_vec_envs_v1(rows, num_envs, num_cpus=0, base_class="stable_baselines3")
    rows.venv.reset(seed=seed)  # copies start from the same seed: give them seed, seed + 1, ...
    return VecMonitor(rows)


def train(iterations: int = 60, num_envs: int = 16, horizon: int = 128, seed: int = 0, **overrides):
    """Train on `hover` and return the policy's weights before and after, as flat tensors."""
    torch.manual_seed(seed)  # SB3's own argument `seed` would seed the rows, which SuperSuit's have no method for
    torch.set_num_threads(1)
    env = make(num_envs, seed, **overrides)
    model = PPO(
        "MlpPolicy", env, n_steps=horizon, batch_size=horizon * env.num_envs // 8, n_epochs=4, learning_rate=1e-3,
        device="cpu", verbose=1,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.2},  # a zero action already holds the formation
    )  # fmt: skip
    before = parameters_to_vector(model.policy.parameters()).detach().clone()
    model.learn(iterations * horizon * env.num_envs)
    env.close()
    return before, parameters_to_vector(model.policy.parameters()).detach()


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
