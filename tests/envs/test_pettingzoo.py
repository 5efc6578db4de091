"""The PettingZoo door: official API tests, whole-episode determinism, the core's numbers, errors that name a drone."""

import pickle
import warnings

import numpy as np
import pettingzoo
import pytest
from conftest import bold_actions, same
from gymnasium.spaces import Box
from pettingzoo.test import parallel_api_test, parallel_seed_test

import multilift_marl as ml
from multilift_marl.envs import multilift_v0
from multilift_marl.envs.multilift_v0 import parallel_env

SHORT = {"env.episode_seconds": 0.2}  # 10 steps
BRIEF = {"env.episode_seconds": 2.0}


def split(env, joint):
    """Return {agent: action} of joint actions (1, N, A)."""
    return {name: joint[0, n] for n, name in enumerate(env.possible_agents)}


def gentle(env, step):
    """Return float32 actions (1, N, A) that depend on the step alone."""
    rng = np.random.default_rng(step)
    return rng.uniform(-0.3, 0.3, (1, env.vec.num_drones, env.vec.action_size)).astype(np.float32)


def fly(env, seed, act=gentle):
    """Return everything that one episode hands out, to its end."""
    told = [env.reset(seed=seed), env.state()]
    while env.agents:
        told += [env.step(split(env, act(env, len(told)))), env.state()]
    return told


def test_official_api_test_passes(task, num_drones, cables):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(parallel_env(task, num_drones=num_drones, **cables), num_cycles=60)


def test_official_seed_test_passes(task, cables):
    parallel_seed_test(lambda: parallel_env(task, **cables))


def test_every_episode_is_its_seeds_alone(task, cables):
    first, second = parallel_env(task, **BRIEF, **cables), parallel_env(task, seed=8, **BRIEF, **cables)
    expected = fly(first, 7)
    fly(second, None)
    fly(second, 9)
    assert same(fly(second, 7), expected)
    assert not same(fly(second, 8), expected)
    assert not same(fly(second, None), expected)


def test_seed_starts_at_its_first_episode_and_none_goes_on():
    env, vec = parallel_env(seed=5, **SHORT), ml.make_vec(num_envs=1, seed=5)
    starts = [env.reset()[0], env.reset()[0], env.reset(seed=5)[0]]
    for start, seed in zip(starts, (None, None, 5), strict=True):
        assert same(list(start.values()), list(vec.reset(seed)[0][0]))
    assert not same(starts[0], starts[1])
    assert same(starts[0], starts[2])


@pytest.mark.few_tasks
@pytest.mark.parametrize("act", [gentle, lambda env, step: bold_actions(env.vec, step)])
def test_same_numbers_as_the_core(task, num_drones, cables, act):
    env = parallel_env(task, num_drones=num_drones, seed=3, **BRIEF, **cables)
    vec = ml.make_vec(task, num_envs=1, num_drones=num_drones, seed=3, **BRIEF, **cables)
    for got, expected in zip(env.reset()[0].values(), vec.reset()[0][0], strict=True):
        assert same(got, expected)
    step = 0
    while env.agents:
        action = act(env, step)
        observation, reward, terminated, truncated, info = vec.step(action)
        got = env.step(split(env, action))
        assert same(list(got[0].values()), list(observation[0]))
        assert list(got[1].values()) == reward[0].tolist()
        assert set(got[2].values()) == {bool(terminated[0])} and set(got[3].values()) == {bool(truncated[0])}
        for told in got[4].values():
            assert [told[key] for key in ("success", "failure", "diverged")] == [
                bool(info[key][0]) for key in ("success", "failure", "diverged")
            ]
            assert told["failure_cause"] == info["failure_cause"][0]
            assert all(told[f"reward_terms.{name}"] == value[0] for name, value in info["reward_terms"].items())
            assert not any(isinstance(value, str | dict) for value in told.values())  # TorchRL makes tensors of them
        assert same(env.state(), vec.state()[0])
        step += 1
    assert terminated[0] or truncated[0]


def test_a_failed_episode_says_why():
    env = parallel_env(seed=1)
    _, _, terminations, truncations, infos = fly(env, 1, lambda e, step: bold_actions(e.vec, step))[-2]
    assert all(terminations.values()) and not any(truncations.values())
    for info in infos.values():
        assert info["failure"] and not info["success"] and not info["diverged"]
        assert 0 < info["failure_cause"] < len(env.vec.failure_causes) - 1


def test_agents_are_gone_after_the_end_and_back_after_reset():
    env = parallel_env(**SHORT)
    told = fly(env, 0)[-2]
    assert env.agents == []
    assert all(list(part) == env.possible_agents for part in told)
    assert all(told[3].values()) and not any(told[2].values())
    assert {info["failure_cause"] for info in told[4].values()} == {0}
    with pytest.raises(RuntimeError, match=r"has ended or none was started: call reset\(\) before step\(\)"):
        env.step(split(env, gentle(env, 0)))
    env.reset()
    assert env.agents == env.possible_agents == ["drone_0", "drone_1", "drone_2", "drone_3"]


def test_stepping_before_the_first_reset_is_refused():
    env = parallel_env()
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step\(\)"):
        env.step(split(env, gentle(env, 0)))


def test_spaces_are_the_same_objects_and_hold_what_comes(task, num_drones, cables):
    env = parallel_env(task, num_drones=num_drones, **cables)
    observations, _ = env.reset(seed=0)
    for name in env.possible_agents:
        seen, acted = env.observation_space(name), env.action_space(name)
        assert seen is env.observation_space(name) and acted is env.action_space(name)
        assert seen == Box(-np.inf, np.inf, (env.vec.observation_size,), np.float32)
        assert acted == Box(-1.0, 1.0, (env.vec.action_size,), np.float32)
        assert observations[name].dtype == np.float32 and seen.contains(observations[name])
    assert env.state_space.contains(env.state()) and env.state().shape == (env.vec.state_size,)
    assert len({id(env.action_space(name)) for name in env.possible_agents}) == num_drones


def test_observations_and_states_handed_out_never_change():
    env, twin = parallel_env(), parallel_env()
    told = [env.reset(seed=0)[0], env.state()]
    kept = pickle.loads(pickle.dumps(told))
    for step in range(5):
        observations = env.step(split(env, gentle(env, step)))[0]
        told += [observations, env.state()]
        kept += pickle.loads(pickle.dumps(told[-2:]))
    assert same(told, kept)
    twin.reset(seed=0)
    for step in range(5):
        observations = twin.step(split(twin, gentle(twin, step)))[0]
        assert same(observations, kept[2 * step + 2])
        for observation in observations.values():
            observation[:] = np.nan  # what a wrapper does to its own copy is no concern of the environment


def test_infos_are_not_shared_between_agents():
    env = parallel_env()
    env.reset(seed=0)
    infos = env.step(split(env, gentle(env, 0)))[4]
    before = pickle.loads(pickle.dumps(infos["drone_1"]))
    infos["drone_0"]["mine"] = 1
    for value in infos["drone_0"].values():
        if isinstance(value, np.ndarray):
            value[...] = -1
    assert same(infos["drone_1"], before)


def test_float64_and_float32_actions_fly_alike():
    env, twin = parallel_env(), parallel_env()
    assert same(fly(env, 2), fly(twin, 2, lambda e, step: gentle(e, step).astype(np.float64)))


def without(name):
    return lambda actions: actions.pop(name)


def put(name, action):
    return lambda actions: actions.update({name: action})


@pytest.mark.parametrize(
    "spoil, message",
    [
        (without("drone_2"), "no action for drone_2"),
        (put("drone_9", np.zeros(4)), "unknown agent 'drone_9'; did you mean 'drone_"),
        (lambda actions: actions.update(dron_1=actions.pop("drone_1")), "no action for drone_1"),
        (put("drone_1", np.zeros(3)), r"action of drone_1 has shape \(3,\).*expected \(4,\)"),
        (put("drone_1", np.zeros((1, 4))), r"action of drone_1 has shape \(1, 4\)"),
        (put("drone_1", 0.5), r"action of drone_1 has shape \(\)"),
        (put("drone_3", np.zeros(4, int)), "action of drone_3 .*dtype int64, expected .*floating point"),
        (put("drone_3", None), "action of drone_3 "),
        (put("drone_0", np.array([0, np.nan, 0, 0])), r"action of drone_0 .*not finite \(sideways=nan\)"),
        (put("drone_3", np.array([0, 0, 0, np.inf])), r"action of drone_3 .*not finite \(yaw=inf\)"),
    ],
)
def test_a_wrong_action_is_refused_by_name_and_changes_nothing(spoil, message):
    env, twin = parallel_env(), parallel_env()
    for each in (env, twin):
        each.reset(seed=0)
    actions = split(env, gentle(env, 0))
    spoil(actions)
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    actions = split(env, gentle(env, 1))
    assert same(env.step(actions), twin.step(actions))


def test_names_and_overrides_reach_the_core():
    env = parallel_env("hover", num_drones=3, **{"payload.mass": 0.9, "env.policy_hz": 25, "env.num_envs": 64})
    assert env.vec.world.system.payload_mass == 0.9
    assert (env.vec.num_envs, env.num_agents, env.max_num_agents) == (1, 0, 3)
    assert env.metadata["render_fps"] == 25
    assert env.metadata["name"] == "multilift_v0" and env.metadata["is_parallelizable"]
    with pytest.raises(ml.errors.ConfigError, match=r"did you mean 'payload.mass'"):
        parallel_env("hover", **{"payload.mas": 1.0})


@pytest.mark.few_tasks
@pytest.mark.skipif(not hasattr(pettingzoo, "parallel_registry"), reason="PettingZoo before 1.27 has no registry")
def test_registered_with_pettingzoo(task, cables):
    multilift_v0.register()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        multilift_v0.register()
        env = pettingzoo.make("parallel", f"multilift_marl/{task}-v0", num_drones=3, seed=2, **cables)
    assert same(fly(env, None), fly(parallel_env(task, num_drones=3, **cables), 2))


@pytest.mark.skipif(not hasattr(pettingzoo, "parallel_registry"), reason="PettingZoo before 1.27 has no registry")
@pytest.mark.parametrize("config, name", [("pose_easy", "pose_easy-v0"), ("rigs/falcon3", "rigs_falcon3-v0")])
def test_configurations_that_are_no_tasks_are_registered_too(config, name):
    env = pettingzoo.make("parallel", f"multilift_marl/{name}")
    assert env.vec.config == parallel_env(config).vec.config


def test_pettingzoo_without_a_registry_is_left_alone(monkeypatch):
    monkeypatch.delattr(pettingzoo, "parallel_registry", raising=False)
    monkeypatch.delattr(pettingzoo, "register", raising=False)
    multilift_v0.register()


def test_rendering_must_be_asked_for():
    with pytest.raises(ValueError, match="unknown render_mode 'ascii'; known: human, rgb_array"):
        parallel_env(render_mode="ascii")
    env = parallel_env()
    env.reset()
    with pytest.raises(RuntimeError, match='render_mode="rgb_array"'):
        env.render()
    with pytest.raises(RuntimeError, match=r"call reset\(\) before render\(\)"):
        parallel_env(render_mode="rgb_array").render()
    env.close()
