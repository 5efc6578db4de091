"""What all wrappers of the core share: fresh entropy, copies in mid-episode; and libraries that wrap them in turn."""

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from conftest import mixed_actions, same
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import FlattenObservation, NormalizeObservation, RecordEpisodeStatistics
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymEnv, PettingZooWrapper
from torchrl.envs.utils import check_env_specs

import multilift_marl as ml
from multilift_marl.envs.gymnasium_env import MultiliftGymnasiumEnv, MultiliftVectorEnv
from multilift_marl.envs.wrapper_utils import RENDER_MODES

SHORT = {"env.episode_seconds": 0.2}  # 10 steps
BATCH = {"num_envs": 2, "num_threads": 1}
WRAPPERS = {
    "gymnasium": MultiliftGymnasiumEnv,
    "vector": lambda *arguments, **keywords: MultiliftVectorEnv(*arguments, **BATCH, **keywords),
    "pettingzoo": ml.parallel_env,
}
TORCHRL = {"torchrl": lambda *arguments, **keywords: ml.torchrl_env(*arguments, **BATCH, **keywords)}
CORE = {"core": lambda *arguments, **keywords: ml.make_vec(*arguments, **BATCH, **keywords)}


def of_wrappers(wrappers):
    return pytest.mark.parametrize("make", wrappers.values(), ids=wrappers)


def start(env, seed=None):
    """Return the observations (E, N·D) that an environment starts with."""
    env.reset(seed=seed) if seed is not None else env.reset()
    return env.vec.current()[0] if hasattr(env, "vec") else env.current()[0]


def fly(env, steps, first=0):
    """Return what the core of an environment shows over some steps, each flown through the environment itself."""
    vec, shown = getattr(env, "vec", env), []
    for step in range(first, first + steps):
        joint = mixed_actions(vec, step).astype(np.float32)
        if isinstance(env, EnvBase):
            env.step(TensorDict({("agents", "action"): torch.from_numpy(joint)}, env.batch_size))
        elif hasattr(env, "possible_agents"):
            env.step(dict(zip(env.possible_agents, joint[0], strict=True)))
        else:
            env.step(joint if env is vec else joint.reshape(env.action_space.shape))
        shown.append((vec.current(), vec.state(), vec.steps.copy(), vec.episodes.copy()))
        if vec.ended.any():
            env.reset() if vec.num_envs == 1 else vec.reset(mask=vec.ended)
    return shown


# Seeds


@of_wrappers(WRAPPERS)
def test_without_a_seed_every_environment_flies_episodes_of_its_own(make):
    first, second = make(), make()
    copied = pickle.loads(pickle.dumps(first))
    starts = [start(env) for env in (first, second, copied, first)]
    assert not any(same(starts[i], starts[j]) for i in range(4) for j in range(i))


@of_wrappers(WRAPPERS)
@pytest.mark.parametrize("stated", ["argument", "override", "config", "reset"])
def test_a_stated_seed_is_that_of_the_first_reset(make, stated):
    wanted = ml.make_vec(num_envs=2, num_threads=1, seed=5).reset()[0]
    if stated == "reset":
        found = start(make(), seed=5)
    elif stated == "config":
        found = start(make(ml.load_config("hover", {"seed": 5})))
    else:
        found = start(make(**({"seed": 5} if stated == "argument" else {"env.num_drones": 4, "seed": 5})))
    assert same(found, wanted[: len(found)])


@of_wrappers(CORE | TORCHRL)
def test_the_batched_environments_of_training_start_with_the_configured_seed(make):
    assert same(start(make()), start(make(seed=0)))
    assert same(start(make()), start(make(ml.load_config("hover"))))


# Copies


@of_wrappers(CORE | WRAPPERS | TORCHRL)
@pytest.mark.parametrize("again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_a_copy_in_mid_episode_goes_on_bit_for_bit(make, again):
    env = make(seed=3, **{"env.episode_seconds": 1.0})
    start(env)
    fly(env, 7)
    twin = again(env)
    assert getattr(twin, "vec", twin) is not getattr(env, "vec", env)
    assert same(getattr(twin, "vec", twin).current(), getattr(env, "vec", env).current())
    assert same(fly(twin, 60, first=7), fly(env, 60, first=7))


# Gymnasium's vector interface


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, "NextStep", "SameStep", "Disabled"])
def test_the_autoreset_mode_is_an_argument_an_attribute_and_in_the_metadata(mode):
    envs = gymnasium.make_vec("multilift_marl/Hover-v0", **BATCH, autoreset_mode=mode)
    assert envs.unwrapped.autoreset_mode is envs.metadata["autoreset_mode"] is AutoresetMode(mode)
    assert MultiliftVectorEnv.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_an_unknown_autoreset_mode_is_refused():
    with pytest.raises(ValueError, match=r"unknown autoreset_mode 'nextstep'; did you mean 'NextStep'\?"):
        MultiliftVectorEnv(autoreset_mode="nextstep")


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_other_modes_tell_what_gymnasiums_own_do(mode):
    """Ours against SyncVectorEnv of single environments numbered as the batch's, over failures and time limits."""
    keywords = {"env.episode_seconds": 2.0, "control.max_offset": 1.5}
    envs = MultiliftVectorEnv(num_envs=3, num_threads=1, autoreset_mode=mode, **keywords)
    singles = [MultiliftGymnasiumEnv(**keywords) for _ in range(3)]
    for number, single in enumerate(singles):
        single.vec.first_env = number
    official = SyncVectorEnv([lambda e=e: e for e in singles], autoreset_mode=mode)
    assert told(official.reset(seed=[7] * 3)) == told(envs.reset(seed=7))
    ends = np.zeros(2, int)
    for step in range(150):
        action = mixed_actions(envs.vec, step).reshape(3, -1).astype(np.float32)
        expected, got = official.step(action), envs.step(action)
        assert told(got) == told(expected), step
        ends += [got[2].sum(), got[3].sum()]
        over = got[2] | got[3]
        if mode is AutoresetMode.DISABLED and over.any():
            with pytest.raises(RuntimeError, match=r"has ended .*call reset"):
                envs.step(action)
            expected, got = (each.reset(options={"reset_mask": over}) for each in (official, envs))
            np.testing.assert_array_equal(expected[0], got[0])
    assert ends.all()


def told(results):
    """Return what a vector environment hands out as nested lists, to compare."""
    if isinstance(results, dict):
        return {key: told(value) for key, value in results.items()}
    if isinstance(results, list | tuple):
        return [told(value) for value in results]
    return told(results.tolist()) if isinstance(results, np.ndarray) else results


def test_an_environment_that_diverged_starts_anew_in_the_next_step():
    envs = MultiliftVectorEnv(**BATCH, autoreset_mode="NextStep")
    envs.reset(seed=0)
    zero = np.zeros(envs.action_space.shape, np.float32)
    envs.vec.world.state.payload_velocity[1] = 1e9
    envs.vec.world.load(np.array([False, True]))
    assert envs.step(zero)[2].tolist() == [False, True]
    observation, reward, terminated, truncated, _ = envs.step(zero)
    assert not (terminated | truncated).any() and reward[1] == 0 < reward[0]
    assert np.isfinite(observation).all() and envs.vec.steps.tolist() == [2, 0]


@pytest.mark.parametrize(
    "mode, wrapper",
    [
        *(("NextStep", wrapper) for wrapper in (NormalizeObservation, FlattenObservation, RecordEpisodeStatistics)),
        ("SameStep", RecordEpisodeStatistics),
    ],
)
def test_gymnasiums_vector_wrappers_fit(mode, wrapper):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = wrapper(gymnasium.make_vec("multilift_marl/Hover-v0", **BATCH, autoreset_mode=mode, **SHORT))
    envs.reset(seed=0)
    over = 0
    for _ in range(25):
        observation, _, terminated, truncated, info = envs.step(np.zeros(envs.action_space.shape, np.float32))
        assert np.isfinite(observation).all()
        if (terminated | truncated).any():
            over += 1
            assert wrapper is not RecordEpisodeStatistics or info["episode"]["l"].tolist() == [10, 10]
    assert over == 2


def test_without_a_display_gymnasiums_checker_tries_pictures_alone(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    env = gymnasium.make("multilift_marl/Hover-v0").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box observation space (min|max)imum value is")  # as they are
        check_env(env)
    assert env.metadata["render_modes"] == ["rgb_array"]
    monkeypatch.setenv("DISPLAY", ":0")
    assert ml.parallel_env().metadata["render_modes"] == list(RENDER_MODES)


# TorchRL's own wrappers


def test_torchrls_gym_environment_finds_ours():
    env = GymEnv("multilift_marl/Hover-v0", num_drones=3)
    check_env_specs(env)
    assert env.rollout(3)["observation"].shape == (3, env.observation_spec["observation"].shape[0])


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using")
def test_torchrls_pettingzoo_wrapper_takes_ours():
    env = PettingZooWrapper(ml.parallel_env(seed=1, **SHORT))
    check_env_specs(env)
    last = env.rollout(20)[-1]["next", "drone"]
    assert last["done"].all() and not last["info", "failure"].any()
    terms = [last["info", f"reward_terms.{name}"] for name in env._env.vec.reward_terms]
    torch.testing.assert_close(sum(terms), last["reward"].squeeze(-1))


def test_the_batched_environment_names_the_drones_of_its_group():
    env = ml.torchrl_env(num_envs=1, num_drones=3)
    assert env.group_map == {"agents": ["drone_0", "drone_1", "drone_2"]}
    assert env.reset()["agents"].batch_size == (1, 3)
