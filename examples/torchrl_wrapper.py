"""IPPO with TorchRL through its own PettingZooWrapper: parameters shared by the drones, losses and collector TorchRL's.

Needs the package's `train` extra, or examples/requirements/torchrl_wrapper.txt. Run: python examples/torchrl_wrapper.py
`ml.torchrl_env` is the native, batched API and many times faster; this shows that TorchRL's general wrapper works, too.
"""

import sys
import warnings
from functools import partial

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torch.nn.utils import clip_grad_norm_, parameters_to_vector
from torchrl.collectors import Collector
from torchrl.envs import PettingZooWrapper, SerialEnv
from torchrl.modules import IndependentNormal, MultiAgentMLP, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from multilift_marl.envs import multilift_v0

warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested using")
EPOCHS, MINIBATCHES = 4, 8
KEYS = {name: ("drone", name) for name in ("observation", "action", "loc", "scale", "reward", "done", "terminated")}
LOG_PROB, VALUE = ("drone", "log_prob"), ("drone", "state_value")


def make(seed: int, **overrides) -> PettingZooWrapper:
    """Return one environment; the agents drone_0 ... form TorchRL's group "drone"."""
    return PettingZooWrapper(multilift_v0.parallel_env("hover", seed=seed, **overrides))


def network(env: SerialEnv, outputs: int, **keywords) -> MultiAgentMLP:
    """Return an MLP of each drone's own observation, its parameters shared by the team."""
    inputs, team = env.observation_spec[KEYS["observation"]].shape[-1], env.full_action_spec[KEYS["action"]].shape[-2]
    sizes = {"n_agent_inputs": inputs, "n_agent_outputs": outputs, "n_agents": team, "num_cells": [128, 128]}
    return MultiAgentMLP(**sizes, centralized=False, share_params=True, activation_class=nn.Tanh, **keywords)


def train(iterations: int = 60, num_envs: int = 8, horizon: int = 128, seed: int = 0, **overrides):
    """Train on `hover` and return the policy's weights before and after, as flat tensors."""
    # 1. Environments, one after another in this process, each with its own seed.
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    env = SerialEnv(num_envs, [partial(make, seed + e, **overrides) for e in range(num_envs)])
    size = env.full_action_spec[KEYS["action"]].shape[-1]

    # 2. The policy, a Gaussian about the formation (zero action), and the critic.
    mean = network(env, size)
    scale = AddStateIndependentNormalScale(size, scale_mapping="exp", init_value=-1.2)
    policy = ProbabilisticActor(
        TensorDictModule(nn.Sequential(mean, scale), [KEYS["observation"]], [KEYS["loc"], KEYS["scale"]]),
        in_keys=[KEYS["loc"], KEYS["scale"]], out_keys=[KEYS["action"]],
        distribution_class=IndependentNormal, return_log_prob=True, log_prob_key=LOG_PROB,
    )  # fmt: skip
    critic = TensorDictModule(network(env, 1), [KEYS["observation"]], [VALUE])
    before = parameters_to_vector(policy.parameters()).detach().clone()

    # 3. PPO's loss and the advantages. Only `terminated` ends a return: time limits are bootstrapped.
    loss = ClipPPOLoss(policy, critic, entropy_bonus=False, critic_coeff=0.5, normalize_advantage=False)
    keys = {"value": VALUE, "reward": KEYS["reward"], "done": KEYS["done"], "terminated": KEYS["terminated"]}
    loss.set_keys(**keys, action=KEYS["action"], sample_log_prob=LOG_PROB)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    gae.set_keys(**keys)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, eps=1e-5)

    # 4. Collect, learn, repeat.
    frames = num_envs * horizon
    sizes = {"frames_per_batch": frames, "total_frames": iterations * frames}
    for iteration, batch in enumerate(Collector(env, policy, **sizes, auto_register_policy_transforms=True), start=1):
        with torch.no_grad():
            gae(batch)
        data = batch.reshape(-1)
        data["advantage"] = (data["advantage"] - data["advantage"].mean()) / data["advantage"].std()
        for _ in range(EPOCHS):
            for chosen in torch.randperm(frames).chunk(MINIBATCHES):
                losses = loss(data[chosen])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
        print(f"iteration {iteration}: reward {batch['next', *KEYS['reward']].mean():.3f} a step", flush=True)
    return before, parameters_to_vector(policy.parameters()).detach()


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
