"""skrl's MAPPO through its PettingZoo wrapper: one network for all drones, the critic sees the global state.

Needs its own environment with examples/requirements/skrl_mappo.txt. Run: python examples/skrl_mappo.py
skrl steps one PettingZoo environment at a time, so this is the slowest of the examples.
"""

import sys

import torch
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.multi_agents.torch.mappo import MAPPO, MAPPO_CFG
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn
from torch.nn.utils import parameters_to_vector

from multilift_marl.envs import multilift_v0


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Return a small MLP."""
    last = nn.Linear(128, outputs)
    nn.init.orthogonal_(last.weight, 0.01)
    return nn.Sequential(nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), last)


class Policy(GaussianMixin, Model):
    """A Gaussian over a drone's action, from its own observation."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.mean = network(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -1.2))  # a zero action already holds the formation

    def compute(self, inputs, role=""):
        """Return mean and log standard deviation."""
        return self.mean(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """The value of the global state."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.value = network(self.num_states, 1)

    def compute(self, inputs, role=""):
        """Return the value."""
        return self.value(inputs["states"]), {}


def train(iterations: int = 60, horizon: int = 2048, seed: int = 0, **overrides):
    """Train on `hover` and return the policy's weights before and after, as flat tensors."""
    set_seed(seed)
    torch.set_num_threads(1)
    env = wrap_env(multilift_v0.parallel_env("hover", seed=seed, **overrides), wrapper="pettingzoo", verbose=False)
    agents, first = env.possible_agents, env.possible_agents[0]
    spaces = {
        "observation_space": env.observation_space(first), "state_space": env.state_space(first),
        "action_space": env.action_space(first), "device": env.device,
    }  # fmt: skip
    empty = {agent: {} for agent in agents}  # skrl 2.1.1 refuses its own default, {}, for several agents
    shared = {"policy": Policy(**spaces), "value": Value(**spaces)}
    learner = MAPPO(
        possible_agents=agents,
        models=dict.fromkeys(agents, shared),
        memories={agent: RandomMemory(memory_size=horizon, num_envs=1, device=env.device) for agent in agents},
        cfg=MAPPO_CFG(
            rollouts=horizon, learning_epochs=4, mini_batches=8, learning_rate=3e-4,
            time_limit_bootstrap=True,  # a time limit is no failure
            value_clip=0.0, value_loss_scale=0.5,
            learning_rate_scheduler_kwargs=empty.copy(), observation_preprocessor_kwargs=empty.copy(),
            state_preprocessor_kwargs=empty.copy(),
            value_preprocessor=RunningStandardScaler,
            value_preprocessor_kwargs={agent: {"size": 1, "device": env.device} for agent in agents},
        ),
        observation_spaces=env.observation_spaces, state_spaces=env.state_spaces, action_spaces=env.action_spaces,
        device=env.device,
    )  # fmt: skip
    before = parameters_to_vector(shared["policy"].parameters()).detach().clone()
    settings = {"timesteps": iterations * horizon, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(cfg=settings, env=env, agents=learner).train()  # writes TensorBoard's files to runs/
    env.close()
    return before, parameters_to_vector(shared["policy"].parameters()).detach()


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
