"""BenchMARL's MAPPO and MASAC on this package's batched TorchRL environment, made known to it by one class.

Needs its own environment with examples/requirements/benchmarl_task.txt. Run: python examples/benchmarl_task.py
BenchMARL's other algorithms for continuous actions (IPPO, ISAC, MADDPG, IDDPG) take the same class.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from benchmarl.algorithms import MappoConfig, MasacConfig
from benchmarl.environments import TaskClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torch import nn
from torch.nn.utils import parameters_to_vector
from torchrl.data import Composite

import multilift_marl as ml

SPREAD = "biased_softplus_0.3"  # standard deviation at the start: a zero action already holds the formation


class MultiliftTask(TaskClass):
    """A configuration of this package by its name; BenchMARL's `config` are values of it by dotted name."""

    @staticmethod
    def env_name():
        """Return the name that BenchMARL writes into its results."""
        return "multilift"

    def get_env_fun(self, num_envs, continuous_actions, seed, device):
        """Return what makes the environments, all of them one batch on the CPU."""
        return lambda: ml.torchrl_env(self.name, num_envs=num_envs, seed=seed, **self.config)

    def supports_continuous_actions(self):
        """Return that actions are continuous."""
        return True

    def supports_discrete_actions(self):
        """Return that there are no discrete ones."""
        return False

    def has_render(self, env):
        """Return that a batch has no picture."""
        return False

    def max_steps(self, env):
        """Return the steps of an episode."""
        return env.vec.max_steps

    def group_map(self, env):
        """Return the one group, whose parameters are shared."""
        return {"agents": [f"drone_{i}" for i in range(env.vec.num_drones)]}

    def observation_spec(self, env):
        """Return what a drone observes, (N, D)."""
        return Composite(agents=env.full_observation_spec_unbatched["agents"].clone())

    def state_spec(self, env):
        """Return what a critic sees, (S,)."""
        return Composite(state=env.full_observation_spec_unbatched["state"].clone())

    def action_spec(self, env):
        """Return what a drone commands, (N, A)."""
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env):
        """Return that all actions are allowed at all times."""

    def info_spec(self, env):
        """Return that no group has infos; BenchMARL logs those of the environment by itself."""


def train(iterations: int = 60, num_envs: int = 16, horizon: int = 128, seed: int = 0, **overrides):
    """Train on `hover` by each algorithm; return the policies' weights before and after, (algorithms, weights)."""
    torch.set_num_threads(1)
    Path("runs").mkdir(exist_ok=True)  # BenchMARL leaves its tables there
    frames = num_envs * horizon
    settings = replace(
        ExperimentConfig.get_from_yaml(),
        max_n_iters=iterations, max_n_frames=None, lr=3e-4,
        on_policy_n_envs_per_worker=num_envs, on_policy_collected_frames_per_batch=frames,
        on_policy_n_minibatch_iters=4, on_policy_minibatch_size=frames // 8,
        off_policy_n_envs_per_worker=num_envs, off_policy_collected_frames_per_batch=frames,
        off_policy_n_optimizer_steps=horizon, off_policy_train_batch_size=256, off_policy_memory_size=200_000,
        evaluation_interval=max(1, iterations // 4) * frames, evaluation_episodes=8,
        loggers=["csv"], save_folder="runs",
    )  # fmt: skip
    algorithms = (
        replace(MappoConfig.get_from_yaml(), scale_mapping=SPREAD),
        replace(MasacConfig.get_from_yaml(), scale_mapping=SPREAD, alpha_init=0.01),  # of a reward of 0.6 a step
    )
    network = MlpConfig(num_cells=[128, 128], layer_class=nn.Linear, activation_class=nn.Tanh)
    before, after = [], []
    for algorithm in algorithms:
        experiment = Experiment(MultiliftTask("hover", overrides), algorithm, network, seed, settings)
        before.append(parameters_to_vector(experiment.policy.parameters()).detach().clone())
        experiment.run()
        after.append(parameters_to_vector(experiment.policy.parameters()).detach())
    return torch.stack(before), torch.stack(after)


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
