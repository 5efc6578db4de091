"""What all wrappers of the core share: fresh entropy, copies in mid-episode; and libraries that wrap them in turn."""

import copy
import multiprocessing
import pickle
import warnings

import gymnasium
import numpy as np
import pettingzoo
import pytest
import torch
from conftest import mixed_actions, refusal, same
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeAwareObservation
from gymnasium.wrappers.vector import FlattenObservation, NormalizeObservation, RecordEpisodeStatistics
from pettingzoo.test import api_test
from tensordict import TensorDict
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import EnvBase, GymEnv, ParallelEnv, PettingZooWrapper, SerialEnv
from torchrl.envs.utils import check_env_specs

import multilift_marl as ml
from multilift_marl.config.load import build_config
from multilift_marl.envs import multilift_v0
from multilift_marl.envs.gymnasium_env import MultiliftGymnasiumEnv, MultiliftVectorEnv
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.envs.wrapper_utils import RENDER_MODES

SHORT = {"env.episode_seconds": 0.2}  # 10 steps
BATCH = {"num_envs": 2, "num_threads": 1}
BATCH_KEYS = {f"env.{key}": value for key, value in BATCH.items()}
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
    if isinstance(env, EnvBase) and seed is not None:
        env.set_seed(seed)
        seed = None
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


@of_wrappers(WRAPPERS | TORCHRL)
def test_without_a_seed_every_environment_flies_episodes_of_its_own(make):
    first, second = make(), make()
    copied = pickle.loads(pickle.dumps(first))
    starts = [start(env) for env in (first, second, copied, first)]
    assert not any(same(starts[i], starts[j]) for i in range(4) for j in range(i))


@of_wrappers(WRAPPERS | TORCHRL)
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


@of_wrappers(CORE)
def test_the_batched_core_starts_with_the_configured_seed(make):
    assert same(start(make()), start(make(seed=0)))
    assert same(start(make()), start(make(ml.load_config("hover"))))


def test_training_starts_with_the_configured_seed():
    environment = build_config(ml.load_config("hover", BATCH_KEYS).model_dump())  # as `Trainer` makes it
    assert same(start(MultiliftEnv(environment)), start(ml.make_vec(environment)))


def one():
    return ml.torchrl_env(num_envs=1, num_threads=1)


def one_team():
    return ml.parallel_env()


def differs(observation):
    """Return whether the environments of a batch (2, ...) start apart."""
    return not bool((observation[0] == observation[1]).all())


def test_torchrls_batches_of_ours_fly_episodes_of_their_own():
    envs = SerialEnv(2, one)
    assert differs(envs.reset()["agents", "observation"])
    starts = []
    for _ in range(2):
        envs.set_seed(3)
        starts.append(envs.reset()["agents", "observation"])
    assert same(*(observation.numpy() for observation in starts)) and differs(starts[0])
    envs.close()


@pytest.mark.slow
def test_so_do_processes_of_torchrl_and_its_collectors():
    envs = ParallelEnv(2, one)
    assert differs(envs.reset()["agents", "observation"])
    envs.set_seed(3)
    serial = SerialEnv(2, one)
    serial.set_seed(3)
    assert same(*(each.reset()["agents", "observation"].numpy() for each in (envs, serial)))
    envs.close(), serial.close()
    collector = MultiSyncCollector([one, one], policy=None, frames_per_batch=8, total_frames=8, cat_results="stack")
    (data,) = list(collector)
    collector.shutdown()
    assert differs(data["agents", "observation"][:, 0, 0])


def observe_in_worker(make, pipe):
    pipe.send(start(make()))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
@of_wrappers({"pettingzoo": one_team, "torchrl": one})
def test_forked_workers_fly_episodes_of_their_own(make):
    context, starts = multiprocessing.get_context("fork"), []
    for _ in range(2):
        ours, theirs = context.Pipe()
        worker = context.Process(target=observe_in_worker, args=(make, theirs))
        worker.start()
        assert ours.poll(300)
        starts.append(ours.recv())
        worker.join()
    assert not same(*starts)


# Closing


@of_wrappers({"vector": WRAPPERS["vector"]} | TORCHRL)
def test_closed_environments_refuse_to_go_on(make):
    env = make(seed=0)
    start(env)
    env.close()
    for go_on in (lambda: start(env), lambda: fly(env, 1)):
        with pytest.raises(RuntimeError, match=r"^these environments are closed and cannot go on; make new ones$"):
            go_on()


# Conventions of Gymnasium and PettingZoo


def test_the_time_limit_is_stated_and_can_be_given_as_gymnasium_does():
    single = gymnasium.make("multilift_marl/Hover-v0", **{"env.episode_seconds": 2.0})
    assert single.spec.max_episode_steps == 100 and gymnasium.make("multilift_marl/Hover-v0").spec.kwargs == {
        "task": "hover"
    }
    assert gymnasium.make("multilift_marl/Hover-v0", max_episode_steps=7).spec.max_episode_steps == 7
    envs = gymnasium.make_vec("multilift_marl/Hover-v0", **BATCH, max_episode_steps=7)
    again = gymnasium.make_vec(envs.spec)
    for each in (envs, again):
        each.reset(seed=0)
        ends = [each.step(np.zeros(each.action_space.shape, np.float32))[3].all() for _ in range(7)]
        assert each.spec.max_episode_steps == each.unwrapped.vec.max_steps == 7 and ends == [False] * 6 + [True]
    assert gymnasium.make_vec("multilift_marl/Hover-v0", **BATCH, max_episode_steps=-1).spec.max_episode_steps == 400
    assert TimeAwareObservation(gymnasium.make("multilift_marl/Hover-v0")).max_timesteps == 400
    for wrong, words in ((0, "must be a number of policy steps, 1 or more, but is 0"), (7.5, "1 or more, but is 7.5")):
        assert words in refusal(MultiliftVectorEnv, max_episode_steps=wrong)
    both = {"max_episode_steps": 7, "env.episode_seconds": 2.0}
    assert "were both given; leave out one" in refusal(MultiliftVectorEnv, **both)
    assert MultiliftVectorEnv(num_envs=1, max_episode_steps=100, **{"env.episode_seconds": 2.0}).vec.max_steps == 100


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_infos_become_tensors(mode):
    pytest.importorskip("array_api_compat")
    from gymnasium.wrappers.vector import NumpyToTorch

    envs = NumpyToTorch(gymnasium.make_vec("multilift_marl/Hover-v0", **BATCH, autoreset_mode=mode, **SHORT))
    _, info = envs.reset(seed=0)
    assert info["failure_cause"].dtype == torch.int64 and info["failure_cause"].tolist() == [0, 0]
    for _ in range(10):
        observation, _, _, truncated, info = envs.step(torch.zeros(envs.action_space.shape))
    assert truncated.all() and isinstance(observation, torch.Tensor) and isinstance(info["success"], torch.Tensor)
    assert all(isinstance(term, torch.Tensor) for term in info["reward_terms"].values())


def test_a_seed_of_a_vector_environment_seeds_its_own_generator():
    envs = MultiliftVectorEnv(**BATCH)
    envs.reset(seed=3)
    assert envs.np_random_seed == 3


def test_a_mask_may_be_a_list_and_must_be_of_booleans():
    envs = MultiliftVectorEnv(**BATCH)
    envs.reset(seed=3)
    before = envs.vec.current()[0]
    _, info = envs.reset(options={"reset_mask": [False, True]})
    assert info["_success"].tolist() == [False, True]
    assert same(envs.vec.current()[0][0], before[0]) and not same(envs.vec.current()[0][1], before[1])
    for wrong in ([1, 0], np.array([1, 0]), [True], "yes"):
        with pytest.raises(ValueError, match="mask has shape"):
            envs.reset(options={"reset_mask": wrong})


def test_pettingzoo_has_an_aec_environment():
    env = multilift_v0.env(num_drones=2, seed=0, max_cycles=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        api_test(env, num_cycles=10)
    env.reset(seed=0)
    parallel = ml.parallel_env(num_drones=2, max_cycles=3)
    observations, _ = parallel.reset(seed=0)
    assert same(env.observe("drone_1"), observations["drone_1"]) and same(env.state(), parallel.state())
    for agent in env.agent_iter(4):
        env.step(np.full(4, 0.1, np.float32) if agent else None)
    actions = dict.fromkeys(parallel.possible_agents, np.full(4, 0.1, np.float32))
    for _ in range(2):
        observations, *_ = parallel.step(actions)
    assert same(env.observe("drone_0"), observations["drone_0"])


@pytest.mark.skipif(not hasattr(pettingzoo, "parallel_registry"), reason="PettingZoo before 1.27 has no registry")
def test_pettingzoos_registry_takes_its_own_time_limit():
    for kind in ("parallel", "aec"):
        env = pettingzoo.make(kind, "multilift_marl/hover-v0", max_cycles=5)
        assert env.unwrapped.vec.max_steps == 5
    assert pettingzoo.make("parallel", "multilift_marl/hover-v0", max_cycles=-1).vec.max_steps == 400
    assert "max_cycles must be a number" in refusal(multilift_v0.parallel_env, max_cycles=0)


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
