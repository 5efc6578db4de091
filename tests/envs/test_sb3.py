"""The vector environment of Stable-Baselines3: the core's numbers, ends, seeds, and a short training."""

import copy
import pickle

import numpy as np
import pytest
from conftest import bold_actions, make, same

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from multilift_marl.envs.sb3_vec import MultiliftSB3VecEnv, TeamPolicy
from multilift_marl.errors import ConfigError

BATCH = {"num_envs": 3, "num_threads": 1}


def rows(vec, joint, shared):
    """Return what belongs to drones (E, N, K) as that of rows."""
    return joint.reshape(vec.num_envs * (vec.num_drones if shared else 1), -1).astype(np.float32)


@pytest.mark.parametrize("shared", [True, False], ids=["drones", "teams"])
def test_rows_have_the_cores_numbers_and_the_ends_sb3_asks_for(shared):
    short = {"env.episode_seconds": 2.0, "control.max_offset": 1.5}
    envs, vec = MultiliftSB3VecEnv(**BATCH, shared=shared, **short), make(**BATCH, **short)
    assert isinstance(envs, VecEnv) and envs.num_envs == (12 if shared else 3)
    envs.seed(5)
    assert same(envs.reset(), rows(vec, vec.reset(seed=5)[0], shared))
    each, causes = (4 if shared else 1), set()
    for step in range(150):
        joint = (bold_actions(vec, step) * np.array([1.0, 0.0, 0.1])[:, None, None]).astype(np.float32)
        observation, reward, terminated, truncated, _ = vec.step(joint)
        got, rewards, dones, infos = envs.step(rows(vec, joint, shared))
        assert same(rewards, reward.reshape(-1) if shared else reward[:, 0])
        over, last = terminated | truncated, rows(vec, observation, shared)
        assert dones.tolist() == over.repeat(each).tolist()
        for row, told in enumerate(infos):
            assert bool(told) == dones[row]
            if told:
                assert same(told["terminal_observation"], last[row]) and not same(got[row], last[row])
                assert told["TimeLimit.truncated"] == truncated[row // each] and "is_success" in told
                causes.add(told["failure_cause"])
        if over.any():
            observation, _ = vec.reset(mask=over)
        assert same(got, rows(vec, observation, shared))
    assert "none" in causes and len(causes) > 1


def test_seeds_options_and_copies():
    first, second = MultiliftSB3VecEnv(**BATCH), MultiliftSB3VecEnv(**BATCH)
    assert not same(first.reset(), second.reset())
    first.seed(3), second.seed(3)
    assert same(first.reset(), second.reset()) and not same(first.reset(), second._by_row(second.vec.current()[0]))
    first.set_options({"randomization": {"payload_mass": 1.5}})
    first.reset()
    assert first.get_attr("world")[0].parameters.payload_mass.tolist() == [1.5] * 3
    twin, zero = copy.deepcopy(first), np.zeros((12, 4), np.float32)
    assert same(twin.step(zero), first.step(zero))
    with pytest.raises(ValueError, match=r"actions have shape \(3, 4\), expected \(12, 4\)"):
        first.step(zero[:3])


def test_attributes_and_methods_are_those_of_the_core_by_row():
    envs = MultiliftSB3VecEnv(**BATCH, render_mode="rgb_array")
    envs.reset()
    envs.vec.steps[:] = [7, 8, 9]
    assert envs.get_attr("steps", [0, 5, 11]) == [7, 8, 9] and envs.get_attr("num_drones", 2) == [4]
    assert same(envs.env_method("state", indices=[4])[0], envs.vec.state()[1])
    assert envs.get_attr("render_mode") == ["rgb_array"] * 12 and not envs.has_attr("action_masks")
    assert envs.env_is_wrapped(VecMonitor) == [False] * 12
    with pytest.raises(ValueError, match="leave out indices"):
        envs.set_attr("purpose", 1, [0])
    assert envs.render().shape == (1080, 1920, 3)


def test_attributes_that_sb3_reads():
    envs = MultiliftSB3VecEnv(**BATCH, render_mode="rgb_array", **{"env.policy_hz": 25.0})
    assert envs.metadata == {"render_modes": ["human", "rgb_array"], "render_fps": 25.0}  # of its recorded videos
    assert envs.get_attr("metadata", 0) == [envs.metadata] and envs.get_attr("spec", [0, 1]) == [None, None]
    assert envs.get_attr("observation_space", 0) == [envs.observation_space]
    copied = pickle.loads(pickle.dumps(envs))
    assert not same(envs.reset(), copied.reset())  # without a seed, as in processes of their own
    envs.close()
    for go_on in (envs.reset, lambda: envs.step(np.zeros((12, 4), np.float32))):
        with pytest.raises(RuntimeError, match="these environments are closed"):
            go_on()


def test_teams_are_counted_where_a_policy_of_drones_is_evaluated_as_one_of_teams():
    short = {"env.episode_seconds": 0.2}
    model = PPO("MlpPolicy", MultiliftSB3VecEnv(**BATCH, **short), n_steps=8, seed=0, device="cpu")
    teams = MultiliftSB3VecEnv(**BATCH, shared=False, **short)
    teams.seed(0)
    returns, lengths = evaluate_policy(
        TeamPolicy(model, 4), teams, n_eval_episodes=7, return_episode_rewards=True, warn=False
    )
    assert lengths == [10] * 7
    vec = make(**BATCH, **short)
    observation, _ = vec.reset(seed=0)
    total = np.zeros(3)
    for _ in range(10):
        action = np.clip(model.predict(observation.reshape(12, -1), deterministic=True)[0], -1, 1)
        observation, reward, *_ = vec.step(action.reshape(3, 4, 4))
        total += reward[:, 0]
    np.testing.assert_allclose(returns[:3], total, rtol=1e-6)
    assert len(set(returns)) == 7  # each of another episode
    with pytest.raises(ConfigError, match=r"a team of 3 observes 3 x \d+ numbers"):
        TeamPolicy(model, 3).predict(teams.reset())


@pytest.mark.parametrize("shared", [True, False], ids=["drones", "teams"])
def test_sb3s_ppo_trains(shared):
    envs = VecMonitor(MultiliftSB3VecEnv(num_envs=2, num_threads=1, shared=shared, **{"env.episode_seconds": 0.5}))
    model = PPO("MlpPolicy", envs, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(2 * 32 * envs.num_envs)
    assert model.num_timesteps == 64 * envs.num_envs
    assert envs.unwrapped.vec.seeds.tolist() == [0, 0] and {info["l"] for info in model.ep_info_buffer} == {25}
