"""The Gymnasium doors: the official checker, Gymnasium's own vector environments as reference, the core's numbers."""

import pickle
import subprocess
import sys
import warnings
from unittest.mock import MagicMock

import gymnasium
import numpy as np
import pytest
from conftest import bold_actions, refusal, same
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import multilift_marl as ml
from multilift_marl.config.load import list_configs
from multilift_marl.envs import gymnasium_env, wrapper_utils
from multilift_marl.envs.gymnasium_env import MultiliftGymnasiumEnv, MultiliftVectorEnv

SHORT = {"env.episode_seconds": 0.2}  # 10 steps
GROUPS = ("reward_terms", "randomization")


def name_of(task):
    return f"multilift_marl/{task.title().replace('_', '')}-v0"


def bold(env, step):
    """Return float32 actions (E, N·A) which make teams fail; those of environment e depend on e alone."""
    return bold_actions(env.vec, step, env.vec.first_env).reshape(env.vec.num_envs, -1).astype(np.float32)


def plain(told):
    """Return nested structures with lists in place of arrays of objects, to compare what those hold."""
    if isinstance(told, dict):
        return {key: plain(value) for key, value in told.items()}
    if isinstance(told, list | tuple):
        return [plain(value) for value in told]
    return plain(told.tolist()) if isinstance(told, np.ndarray) and told.dtype == object else told


def flat(vec, info):
    """Return the info of one environment in PettingZoo's form."""
    told = {key: info[key] for key in ("success", "failure", "diverged")}
    told["failure_cause"] = info["failure_cause"]
    return told | {f"{key}.{name}": value for key in GROUPS for name, value in info[key].items()}


@pytest.mark.few_tasks
@pytest.mark.parametrize("drawn", [False, True], ids=["", "drawn"])
def test_official_checker_finds_nothing(task, cables, drawn, monkeypatch):
    monkeypatch.setattr(wrapper_utils, "Window", MagicMock())  # it tries render_mode="human", too: see test_window.py
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box observation space (min|max)imum value is")  # as they are
        env = gymnasium.make(name_of(task), render_mode="rgb_array" if drawn else None, **cables)
        check_env(env.unwrapped, skip_render_check=not drawn)


@pytest.mark.filterwarnings("ignore:.*Box observation space")
def test_any_team_passes_the_official_checker(task, num_drones, cables):
    check_env(MultiliftGymnasiumEnv(task, num_drones=num_drones, **cables), skip_render_check=True)


def test_every_configuration_is_registered_once():
    before = dict(gymnasium.registry)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_env.register()
    assert gymnasium.registry == before
    mine = {name for name in before if name.startswith("multilift_marl/")}
    assert mine > {name_of(task) for task in ml.list_tasks()} and len(mine) == len(list_configs())
    assert {"multilift_marl/PoseEasy-v0", "multilift_marl/RigsFalcon3-v0"} < mine
    assert gymnasium.make("multilift_marl/PoseEasy-v0").unwrapped.vec.config == ml.load_config(
        "pose_easy", {"env.num_envs": 1, "env.num_threads": 1}
    )


def test_a_configuration_of_two_words_has_a_name_in_camel_case(monkeypatch):
    monkeypatch.setattr(gymnasium_env, "list_configs", lambda: ["hover", "two_words"])
    gymnasium_env.register()
    assert gymnasium.registry.pop("multilift_marl/TwoWords-v0").kwargs == {"task": "two_words"}


def test_registering_imports_no_torch_and_no_name_needs_the_package_imported():
    code = (
        "import sys, gymnasium\n"
        "env = gymnasium.make('multilift_marl:multilift_marl/Hover-v0')\n"
        "assert 'torch' not in sys.modules\n"
        "print(env.reset(seed=0)[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == str(MultiliftGymnasiumEnv().observation_space.shape), done.stderr


def test_make_passes_drones_seed_and_overrides_on(task, cables):
    keywords = {"num_drones": 3, "seed": 4, "payload.mass": 0.9, **cables}
    env = gymnasium.make(name_of(task), **keywords)
    envs = gymnasium.make_vec(name_of(task), num_envs=5, num_threads=1, **keywords)
    for face, count in ((env.unwrapped, 1), (envs.unwrapped, 5)):
        assert (face.vec.num_envs, face.vec.num_drones, face.vec.config.seed) == (count, 3, 4)
        assert face.vec.world.system.payload_mass == 0.9
    assert isinstance(envs.unwrapped, MultiliftVectorEnv)
    assert same(env.reset()[0], envs.reset()[0][0])


def test_spaces_are_the_same_objects_and_hold_what_comes(task, num_drones, cables):
    team = {"num_drones": num_drones, **cables}
    env, envs = MultiliftGymnasiumEnv(task, **team), MultiliftVectorEnv(task, num_envs=2, num_threads=1, **team)
    observed, acted = num_drones * env.vec.observation_size, num_drones * env.vec.action_size
    for name in ("observation_space", "action_space"):
        assert getattr(env, name) is getattr(env, name)
        for each in (name, f"single_{name}"):
            assert getattr(envs, each) is getattr(envs, each)
    assert env.observation_space == envs.single_observation_space == Box(-np.inf, np.inf, (observed,), np.float32)
    assert env.action_space == envs.single_action_space == Box(-1.0, 1.0, (acted,), np.float32)
    assert envs.observation_space.shape == (2, observed) and envs.action_space.shape == (2, acted)
    assert env.observation_space.contains(env.reset()[0])
    assert envs.observation_space.contains(envs.reset()[0])
    assert envs.observation_space.contains(envs.step(envs.action_space.sample())[0])


@pytest.mark.few_tasks
def test_same_numbers_as_the_core_and_the_pettingzoo_door(task, num_drones, cables):
    team = {"num_drones": num_drones, **cables}
    env, zoo = MultiliftGymnasiumEnv(task, **team), ml.parallel_env(task, **team)
    agents = zoo.possible_agents
    for episode in range(2):  # seed 3's first episode, then the second
        seed = 3 if episode == 0 else None
        step, (observation, info), (observations, infos) = 0, env.reset(seed=seed), zoo.reset(seed=seed)
        while zoo.agents:
            assert same(observation, np.concatenate([observations[name] for name in agents]))
            assert same(flat(env.vec, info), infos["drone_0"])
            action = bold(env, step)[0]
            observation, reward, terminated, truncated, info = env.step(action)
            parts = dict(zip(agents, action.reshape(num_drones, -1), strict=True))
            observations, rewards, terminations, truncations, infos = zoo.step(parts)
            assert {reward} == set(rewards.values())
            assert {terminated} == set(terminations.values()) and {truncated} == set(truncations.values())
            step += 1
        assert terminated or truncated


@pytest.mark.slow
def test_vector_environments_tell_exactly_what_gymnasiums_own_do(task, cables):
    """Ours against SyncVectorEnv of single environments numbered as the batch's, over failures and time-outs."""
    count, seed, keywords = 3, 7, {"env.episode_seconds": 4.0, **cables}
    envs = MultiliftVectorEnv(task, num_envs=count, num_threads=1, **keywords)
    singles = [MultiliftGymnasiumEnv(task, **keywords) for _ in range(count)]
    for number, single in enumerate(singles):
        single.vec.first_env = number
    official = SyncVectorEnv([lambda e=e: e for e in singles], autoreset_mode=AutoresetMode.SAME_STEP)
    assert official.metadata == envs.metadata | {
        "render_modes": singles[0].metadata["render_modes"]
    }  # a window shows one
    assert same(plain(official.reset(seed=[seed] * count)), plain(envs.reset(seed=seed)))
    failed = timed_out = 0
    for step in range(450):
        action = bold(envs, step) * np.float32([[1.0], [1.0], [0.0]])
        expected, got = official.step(action), envs.step(action)
        assert same(plain(got), plain(expected))
        failed, timed_out = failed + got[2].sum(), timed_out + got[3].sum()
    assert failed + timed_out >= count  # every environment was reset on its way
    assert task != "hover" or (failed and timed_out)


def test_what_ended_is_kept_and_what_began_is_returned():
    envs = MultiliftVectorEnv(num_envs=2, num_threads=1, **SHORT)
    vec = ml.make_vec(num_envs=2, num_threads=1, **SHORT)
    envs.reset(seed=1), vec.reset(seed=1)
    envs.vec.steps[1] = vec.steps[1] = 9
    action = bold(envs, 0) * np.float32(0.2)
    observation, _, terminated, truncated, info = envs.step(action)
    last, _, _, over, told = vec.step(action.reshape(2, 4, -1))
    begun, _ = vec.reset(mask=over)
    assert truncated.tolist() == [False, True] and not terminated.any()
    assert same(observation, begun.reshape(2, -1)) and not same(begun[1], last[1])
    assert info["final_obs"][0] is None and same(info["final_obs"][1], last[1].reshape(-1))
    assert info["_final_obs"].tolist() == info["_final_info"].tolist() == [False, True]
    assert info["final_info"]["failure_cause"].tolist() == [0, 0]
    assert info["final_info"]["success"].tolist() == told["success"].tolist()
    for name, value in told["reward_terms"].items():
        assert info["final_info"]["reward_terms"][name].tolist() == [0.0, value[1]]
    assert not any("final" in key for key in envs.step(action)[4])  # a step that ends no episode


def test_environment_e_of_a_batch_is_replayed_alone():
    envs, alone = MultiliftVectorEnv(num_envs=4, **SHORT), MultiliftVectorEnv(num_envs=1, first_env=2, **SHORT)
    assert same(envs.reset(seed=5)[0][2:3], alone.reset(seed=5)[0])
    for step in range(25):
        many, one = envs.step(bold(envs, step)), alone.step(bold(alone, step))
        assert all(same(many[part][2:3], one[part]) for part in range(4))


def test_a_mask_resets_only_its_environments_and_options_stay_the_callers():
    envs = MultiliftVectorEnv(num_envs=3, num_threads=1)
    first, _ = envs.reset(seed=0)
    options = {"reset_mask": np.array([False, True, False])}
    second, info = envs.reset(options=options)
    assert same(first[[0, 2]], second[[0, 2]]) and not same(first[1], second[1])
    assert info["_success"].tolist() == [False, True, False]
    assert list(options) == ["reset_mask"]
    assert envs.vec.episodes.tolist() == [0, 1, 0]
    with pytest.raises(ValueError, match="mask has shape"):
        envs.reset(options={"reset_mask": [True]})
    with pytest.raises(ValueError, match="unknown reset option 'wind'"):
        envs.reset(options={"wind": 3})


def test_nothing_handed_out_changes_later():
    envs = MultiliftVectorEnv(num_envs=3, num_threads=1, **SHORT)
    told = [envs.reset(seed=0)]
    kept = pickle.loads(pickle.dumps(told))
    for step in range(12):
        told.append(envs.step(bold(envs, step)))
        kept += pickle.loads(pickle.dumps(told[-1:]))
    assert same(plain(told), plain(kept))
    assert any("final_obs" in part[-1] for part in told)


def test_gymnasiums_statistics_see_every_episode():
    envs = RecordEpisodeStatistics(gymnasium.make_vec("multilift_marl/Hover-v0", num_envs=2, **SHORT))
    envs.reset(seed=0)
    total = np.zeros(2)
    for _ in range(10):
        _, reward, _, truncated, info = envs.step(np.zeros(envs.action_space.shape, np.float32))
        total += reward
    assert truncated.all()
    assert info["episode"]["l"].tolist() == [10, 10]
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)


def test_steps_outside_an_episode_are_refused():
    env = MultiliftGymnasiumEnv(**SHORT)
    zero = np.zeros(env.action_space.shape, np.float32)
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step\(\)"):
        env.step(zero)
    env.reset()
    while not env.step(zero)[3]:
        pass
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step\(\)"):
        env.step(zero)
    envs = MultiliftVectorEnv(num_envs=2, num_threads=1)
    with pytest.raises(RuntimeError, match=r"environment 0 has ended or was never reset"):
        envs.step(np.zeros(envs.action_space.shape))


@pytest.mark.parametrize(
    "action, message",
    [
        (np.zeros(15), r"shape \((1, )?15,?\), expected \((1, )?16,?\): 4 numbers for each of 4 drones"),
        (np.zeros((4, 4)), r"shape \((1, )?4, 4\), expected \((1, )?16,?\)"),
        (np.zeros(16, int), "dtype int64, expected floating point"),
        (np.where(np.arange(16) == 9, np.nan, 0.0), r"drone_2 in environment 0 is not finite \(sideways=nan\)"),
    ],
)
def test_a_wrong_action_is_refused(action, message):
    env, envs = MultiliftGymnasiumEnv(), MultiliftVectorEnv(num_envs=1)
    for face, wrong in ((env, action), (envs, action[None])):
        face.reset()
        with pytest.raises(ValueError, match=message):
            face.step(wrong)


def test_wrong_settings_are_refused():
    assert "did you mean 'payload.mass'" in refusal(gymnasium.make, "multilift_marl/Hover-v0", **{"payload.mas": 1.0})
    assert "no configuration named 'hove'" in refusal(MultiliftVectorEnv, "hove")
    for face, known in ((MultiliftGymnasiumEnv, "human, rgb_array"), (MultiliftVectorEnv, "rgb_array")):
        with pytest.raises(ValueError, match=f"unknown render_mode 'ascii'; known: {known}"):
            face(render_mode="ascii")


def test_pictures():
    env = gymnasium.make("multilift_marl/Hover-v0", render_mode="rgb_array")
    envs = MultiliftVectorEnv(num_envs=2, num_threads=1, render_mode="rgb_array")
    env.reset(seed=0), envs.reset(seed=0)
    frame, frames = env.render(), envs.render()
    assert frame.shape == (540, 960, 3) and frame.dtype == np.uint8
    assert len(frames) == 2 and same(frames[0], frame) and not same(frames[1], frame)
    env.close(), envs.close()
    assert envs.closed
    assert env.metadata["render_fps"] == envs.metadata["render_fps"] == 50


def test_drawing_must_be_asked_for_and_needs_an_episode():
    for face in (MultiliftGymnasiumEnv, MultiliftVectorEnv):
        env = face(**{"env.num_envs": 1})
        env.reset()
        with pytest.raises(RuntimeError, match='render_mode="rgb_array"'):
            env.render()
        with pytest.raises(RuntimeError, match=r"call reset\(\) before render\(\)"):
            face(render_mode="rgb_array", **{"env.num_envs": 1}).render()
