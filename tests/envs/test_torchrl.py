"""The TorchRL door: specs, masked resets, terminal observations, equality with the core."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

import multilift_marl as ml
from multilift_marl.envs.core import MultiliftVec


def test_specs_hold(task, num_drones, cables):
    check_env_specs(ml.torchrl_env(task, num_envs=3, num_drones=num_drones, **cables))


def test_keys_and_shapes():
    env = ml.torchrl_env("hover", num_envs=5)
    step = env.rand_step(env.reset())
    assert step["agents", "observation"].shape == (5, 4, env.vec.observation_size)
    assert step["agents", "action"].shape == (5, 4, 4)
    assert step["next", "agents", "reward"].shape == (5, 4, 1)
    assert step["next", "state"].shape == (5, env.vec.state_size)
    for key in ("done", "terminated", "truncated"):
        assert step["next", key].shape == (5, 1)


def test_same_numbers_as_the_core():
    env, vec = ml.torchrl_env("hover", num_envs=4, seed=3), ml.make_vec("hover", num_envs=4, seed=3)
    carried, (observation, _) = env.reset(), vec.reset()
    rng = np.random.default_rng(0)
    for _ in range(30):
        np.testing.assert_array_equal(carried["agents", "observation"].numpy(), observation)
        action = rng.uniform(-0.3, 0.3, (4, 4, 4)).astype(np.float32)
        carried["agents", "action"] = torch.from_numpy(action)
        stepped = env.step(carried)["next"]
        observation, reward, terminated, truncated, _ = vec.step(action)
        np.testing.assert_array_equal(stepped["agents", "reward"].squeeze(-1).numpy(), reward)
        np.testing.assert_array_equal(stepped["state"].numpy(), vec.state())
        assert not (terminated | truncated).any()
        carried = stepped.select(("agents", "observation"))


def test_partial_reset_touches_only_its_rows_and_keeps_the_terminal_observation():
    env = ml.torchrl_env("hover", num_envs=4, **{"env.episode_seconds": 0.1})
    carried = env.reset()
    for _ in range(2):
        _, carried = env.step_and_maybe_reset(env.rand_action(carried))
    env.vec.steps[1] = 4  # one step before its time limit
    stepped, carried = env.step_and_maybe_reset(env.rand_action(carried))
    assert stepped["next", "truncated"].squeeze(-1).tolist() == [False, True, False, False]
    assert not stepped["next", "terminated"].any()
    last, begun = stepped["next", "agents", "observation"], carried["agents", "observation"]
    assert torch.equal(last[[0, 2, 3]], begun[[0, 2, 3]])
    assert not torch.equal(last[1], begun[1])
    assert env.vec.episodes.tolist() == [0, 1, 0, 0]
    assert env.vec.steps.tolist() == [3, 0, 3, 3]


@pytest.mark.parametrize("num_envs", [1, 5])
def test_rollouts_go_on_as_with_torchrls_own_steps_and_resets(num_envs):
    ours, theirs = (
        ml.torchrl_env("hover", num_envs=num_envs, seed=2, **{"env.episode_seconds": 0.2, "control.max_offset": 1.5})
        for _ in range(2)
    )
    theirs.maybe_reset = lambda tensordict: EnvBase.maybe_reset(theirs, tensordict)
    theirs._step_proc_data = lambda tensordict: EnvBase._step_proc_data(theirs, tensordict)
    ours_now, theirs_now = ours.reset(), theirs.reset()
    ours.vec.stagger()
    theirs.vec.stagger()
    generator, ended = torch.Generator().manual_seed(0), 0
    for _ in range(25):
        action = 2 * torch.rand((num_envs, 4, 4), generator=generator) - 1
        for now in (ours_now, theirs_now):
            now["agents", "action"], now["memory"] = action.clone(), torch.ones(num_envs, 2)
        ours_stepped, ours_now = ours.step_and_maybe_reset(ours_now)
        theirs_stepped, theirs_now = theirs.step_and_maybe_reset(theirs_now)
        assert set(ours_now.keys(True, True)) == set(theirs_now.keys(True, True))
        assert bool((ours_stepped == theirs_stepped).all())
        if ours_stepped["next", "done"].all():  # where EnvBase keeps what a policy has added
            assert not ours_now.pop("memory").any() and theirs_now.pop("memory").all()
            assert not ours_now["agents"].pop("action").any() and theirs_now["agents"].pop("action").any()
        assert bool((ours_now == theirs_now).all())
        ended += int(ours_stepped["next", "done"].sum())
    assert ended > num_envs


def test_set_seed_starts_episode_zero_of_that_seed():
    env, vec = ml.torchrl_env("hover", num_envs=2, seed=5), ml.make_vec("hover", num_envs=2)
    env.reset()
    env.set_seed(11)
    np.testing.assert_array_equal(env.reset()["agents", "observation"].numpy(), vec.reset(seed=11)[0])


def test_restored_environment_goes_on_bit_for_bit():
    env = ml.torchrl_env("hover", num_envs=3, num_threads=1, seed=2)
    carried = env.reset()
    for _ in range(10):
        _, carried = env.step_and_maybe_reset(env.rand_action(carried))
    saved = {key: tensor.clone() for key, tensor in env.get_state().items()}
    other = ml.torchrl_env("hover", num_envs=3, num_threads=2, seed=77)
    other.set_state(saved)
    again = other.reset()
    assert torch.equal(again["agents", "observation"], carried["agents", "observation"])
    for _ in range(20):
        action = torch.rand(3, 4, 4) - 0.5
        for tensordict in (carried, again):
            tensordict["agents", "action"] = action
        (one, carried), (two, again) = env.step_and_maybe_reset(carried), other.step_and_maybe_reset(again)
        assert torch.equal(one["next", "agents", "observation"], two["next", "agents", "observation"])
        assert torch.equal(one["next", "agents", "reward"], two["next", "agents", "reward"])


def test_reset_takes_the_cores_seed_and_options_and_nothing_else():
    config = ml.load_config("hover", {"env.num_envs": 2})
    env, vec = ml.torchrl_env(config), MultiliftVec(config)
    options = {"randomization": {"payload_mass": 0.9}}
    expected = vec.reset(7, options=options)[0]
    np.testing.assert_array_equal(env.reset(seed=7, options=options)["agents", "observation"], expected)
    mask = np.array([True, False])
    expected = vec.reset(8, mask)[0]
    partly = env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]), seed=8)
    np.testing.assert_array_equal(partly["agents", "observation"][0], expected[0])
    with pytest.raises(TypeError, match="reset takes no 'sed'; did you mean 'seed'"):
        env.reset(sed=7)
    with pytest.raises(ValueError, match="seed must be a whole number"):
        env.reset(seed=-1)
