"""What other libraries wrap around environments fits around ours: each over episodes, with what it reads of them."""

import warnings

import gymnasium
import numpy as np
import pytest
from conftest import refusal
from gymnasium import wrappers as single
from gymnasium.wrappers import vector
from pettingzoo.utils import conversions
from pettingzoo.utils import wrappers as pettingzoo_wrappers
from torchrl.envs import InitTracker, RewardScaling, RewardSum, StepCounter, TrajCounter, TransformedEnv, VecNorm

import multilift_marl as ml
from multilift_marl.envs import multilift_v0

SHORT = {"env.episode_seconds": 0.1}  # 5 steps
BATCH = {"num_envs": 2, "num_threads": 1}


@pytest.fixture(autouse=True)
def _remarks():
    """Leave aside what the libraries say of themselves."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: single.TimeAwareObservation(env),
        lambda env: single.FrameStackObservation(env, 3),
        lambda env: single.DelayObservation(env, 2),
        lambda env: single.NormalizeObservation(env),
        lambda env: single.NormalizeReward(env),
        lambda env: single.RecordEpisodeStatistics(env),
        lambda env: single.RescaleAction(env, -2, 2),
        lambda env: single.StickyAction(env, 0.5),
        lambda env: single.MaxAndSkipObservation(env, 2),
        lambda env: single.Autoreset(env),
    ],
)
def test_gymnasiums_own(wrap):
    env = wrap(gymnasium.make("multilift_marl/Hover-v0", **SHORT))
    observation, _ = env.reset(seed=0)
    ends = 0
    for _ in range(12):
        assert observation in env.observation_space
        observation, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        if terminated or truncated:
            ends += 1
            observation, info = env.reset()
    assert ends and isinstance(info, dict) and env.spec.max_episode_steps == 5


@pytest.mark.parametrize(
    "name", ["DictInfoToList", "FlattenObservation", "NormalizeObservation", "ClipAction", "NormalizeReward"]
)
def test_gymnasiums_of_vector_environments(name):
    envs = getattr(vector, name)(
        gymnasium.make_vec("multilift_marl/Hover-v0", **BATCH, **SHORT, autoreset_mode="NextStep")
    )
    envs.reset(seed=0)
    ends = sum(envs.step(np.zeros(envs.action_space.shape, np.float32))[3].all() for _ in range(12))
    assert ends == 2 and envs.spec.max_episode_steps == 5


def team():
    return ml.parallel_env(**SHORT)


def turns():
    return multilift_v0.env(**SHORT)


@pytest.mark.parametrize(
    "make",
    [
        turns,
        lambda: pettingzoo_wrappers.ClipOutOfBoundsWrapper(turns()),
        lambda: pettingzoo_wrappers.OrderEnforcingWrapper(turns()),
        lambda: pettingzoo_wrappers.BaseParallelWrapper(team()),
        lambda: conversions.aec_to_parallel(turns()),
    ],
)
def test_pettingzoos(make):
    env, zero, steps = make(), np.zeros(4, np.float32), 0
    env.reset(seed=0)
    if hasattr(env, "agent_iter"):
        for _ in env.agent_iter():
            *_, terminated, truncated, _ = env.last()
            steps += not (terminated or truncated)
            env.step(None if terminated or truncated else zero)
    else:
        while env.agents:
            steps += len(env.agents)
            env.step(dict.fromkeys(env.agents, zero))
    assert steps == 5 * 4 and env.metadata["name"] == "multilift_v0" and env.unwrapped.vec.num_drones == 4
    env.close()


@pytest.mark.parametrize(
    "transform",
    [
        lambda: RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "episode_reward")]),
        lambda: StepCounter(max_steps=3),
        lambda: InitTracker(),
        lambda: RewardScaling(0.0, 2.0, in_keys=[("agents", "reward")]),
        lambda: VecNorm(in_keys=[("agents", "observation")]),
        lambda: TrajCounter(),
    ],
)
def test_torchrls(transform):
    env = TransformedEnv(ml.torchrl_env(**BATCH, seed=0, **SHORT), transform())
    rollout = env.rollout(12, break_when_any_done=False)
    assert rollout.shape == (2, 12) and rollout["agents", "observation"].isfinite().all()
    each = 3 if isinstance(transform(), StepCounter) else 5
    done = rollout["next", "done"][0, :, 0]
    assert done.nonzero().reshape(-1).tolist() == list(range(each - 1, 12, each))


@pytest.mark.parametrize("name", ["VecNormalize", "VecFrameStack", "VecCheckNan", "VecMonitor"])
def test_stable_baselines(name):
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    from multilift_marl.envs.sb3_vec import MultiliftSB3VecEnv

    more = {"VecFrameStack": {"n_stack": 3}, "VecCheckNan": {"raise_exception": True}}.get(name, {})
    envs = getattr(vec_env, name)(MultiliftSB3VecEnv(**BATCH, **SHORT), **more)
    envs.seed(0)
    envs.reset()
    ends = 0
    for _ in range(12):
        observation, _, dones, infos = envs.step(np.zeros((8, 4), np.float32))
        assert observation.shape == (8, *envs.observation_space.shape)
        ends += dones.all()
    assert ends == 2 and len(infos) == 8 and envs.get_attr("metadata")[0]["render_fps"] == 50
    envs.close()


@pytest.mark.parametrize(
    "name, hint",
    [
        ("max_cycles", "did you mean 'env.episode_seconds' ([s] time limit of an episode)?"),  # PettingZoo
        ("max_episode_steps", "did you mean 'env.episode_seconds' ([s] time limit of an episode)?"),  # Gymnasium
        ("agent_hz", "did you mean 'env.policy_hz' ([Hz] rate of actions and observations)?"),  # PyFlyt
        ("ctrl_freq", "did you mean 'env.policy_hz' ([Hz] rate of actions and observations)?"),  # gym-pybullet-drones
        ("pyb_freq", "did you mean 'sim.timestep' ([s] physics step)?"),
        ("n_envs", "did you mean 'num_envs'?"),  # Stable-Baselines3
    ],
)
def test_what_others_call_a_key_is_known(name, hint):
    expected = f"unknown key '{name}' (unexpected keyword argument '{name}'); {hint}"
    assert refusal(ml.make_vec, "hover", **{name: 1}) == expected
