"""The batched core: what every task must keep to, and what hover promises."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import bold_actions, make, mask, same

import multilift_marl as ml
from multilift_marl.control.formation import place_formation
from multilift_marl.control.scripted import make_scripted
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.math3d import axis_angle, rot_z
from multilift_marl.sim.cables import limit_solref

INFO = {"success", "failure", "diverged", "failure_cause", "reward_terms"}


def zeros(vec: MultiliftVec) -> np.ndarray:
    return np.zeros((vec.num_envs, vec.num_drones, vec.action_size))


def play(vec: MultiliftVec, steps: int, row: int, first_step: int = 0) -> tuple[list, int]:
    """Fly boldly, resetting what has ended, and return all that environment `row` showed and how often any ended."""
    shown, ends = [], 0
    for step in range(first_step, first_step + steps):
        observation, reward, terminated, truncated, info = vec.step(bold_actions(vec, step, vec.first_env))
        terms = {name: values[row] for name, values in info["reward_terms"].items()}
        told = [info[name][row] for name in sorted(INFO - {"reward_terms"})]
        shown.append([observation[row], reward[row], terminated[row], truncated[row], vec.state()[row], terms, told])
        ended = terminated | truncated
        if ended.any():
            ends += int(ended.sum())
            observation, _ = vec.reset(mask=ended)
            if ended[row]:
                shown.append([observation[row], vec.state()[row]])
    return shown, ends


# Shapes and contract


def test_shapes_and_types(task, num_drones):
    vec = make(task, num_envs=3, num_drones=num_drones)
    observation, info = vec.reset()
    e, n, d, a, s = vec.num_envs, vec.num_drones, vec.observation_size, vec.action_size, vec.state_size
    assert (e, n) == (3, num_drones)
    assert set(info) == INFO
    assert (observation.shape, observation.dtype) == ((e, n, d), np.float32)
    observation, reward, terminated, truncated, info = vec.step(np.zeros((e, n, a), np.float32))
    assert (observation.shape, observation.dtype) == ((e, n, d), np.float32)
    assert (reward.shape, reward.dtype) == ((e, n), np.float32)
    assert (vec.state().shape, vec.state().dtype) == ((e, s), np.float32)
    for flag in (terminated, truncated, info["success"], info["failure"], info["diverged"]):
        assert (flag.shape, flag.dtype) == ((e,), bool)
    assert tuple(info["reward_terms"]) == vec.reward_terms
    assert all(values.shape == (e,) for values in info["reward_terms"].values())


def test_every_number_has_a_name(task):
    vec = make(task, num_envs=1)
    for names, size in ((vec.observation_names, vec.observation_size), (vec.action_names, vec.action_size)):
        assert len(names) == len(set(names)) == size


def test_returned_arrays_are_the_callers_own(task):
    vec = make(task, num_envs=2)
    first, _ = vec.reset()
    kept, state = first.copy(), vec.state()
    second, reward, *_, info = vec.step(zeros(vec))
    second[:], reward[:], state[:] = 9, 9, 9
    for values in info["reward_terms"].values():
        values[:] = 9
    assert same(first, kept)
    again = make(task, num_envs=2)
    again.reset()
    again.step(zeros(again))
    assert same(vec.step(zeros(vec)), again.step(zeros(again)))


# Seeds and replay


def test_same_seed_same_episodes(task, num_drones):
    first, second = (make(task, num_drones=num_drones, seed=7) for _ in range(2))
    assert same(first.reset()[0], second.reset()[0])
    assert same(play(first, 120, row=2), play(second, 120, row=2))


def test_reset_with_a_seed_starts_over(task, num_drones):
    vec = make(task, num_drones=num_drones)
    first = vec.reset(seed=3), play(vec, 60, row=1)
    again = vec.reset(seed=3), play(vec, 60, row=1)
    assert same(first, again)


def test_different_seeds_environments_episodes_and_purposes_differ(task):
    vec = make(task)
    start, _ = vec.reset(seed=3)
    following, _ = vec.reset()
    other, _ = vec.reset(seed=4)
    evaluation, _ = MultiliftVec(vec.config, EVALUATION).reset(seed=3)
    for rows in (start, *zip(start, following, strict=True), *zip(start, other, strict=True)):
        assert not same(rows[0], rows[1])
    assert not any(same(a, b) for a, b in zip(start, evaluation, strict=True))


@pytest.mark.parametrize("num_threads", [1, 2])
def test_an_environment_of_a_batch_is_replayed_alone(task, num_drones, num_threads):
    short = {"env.episode_seconds": 4.0}
    batch = make(task, num_envs=8, num_drones=num_drones, num_threads=num_threads, seed=5, **short)
    alone = make(task, num_envs=1, num_drones=num_drones, first_env=5, seed=5, **short)
    assert same(batch.reset()[0][5], alone.reset()[0][0])
    crowded, ends = play(batch, 300, row=5)
    single, own_ends = play(alone, 300, row=0)
    assert ends > own_ends > 0
    assert same(crowded, single)


def test_an_episode_depends_on_seed_environment_and_number_alone(task):
    busy, alone = make(task, num_envs=3, seed=5), make(task, num_envs=1, first_env=1, seed=5)
    for _ in range(3):
        wanted, _ = busy.reset()
    alone.reset()
    play(alone, 20, row=0)
    alone.reset(mask=mask(1, 0))
    reached, _ = alone.reset()
    assert (alone.episodes[0], busy.episodes[1]) == (2, 2)
    assert same(reached[0], wanted[1])


def test_a_seed_rewinds_the_masked_environments_only(task):
    vec = make(task, num_envs=3)
    first, _ = vec.reset(seed=8)
    second, _ = vec.reset()
    mixed, _ = vec.reset(seed=8, mask=mask(3, 1))
    assert same(mixed[1], first[1])
    assert same(mixed[[0, 2]], second[[0, 2]])
    assert same(vec.reset()[0][1], second[1])
    assert vec.episodes.tolist() == [2, 1, 2]


def test_rows_outside_the_mask_are_unchanged(task):
    vec = make(task, num_envs=4, num_threads=2)
    vec.reset(seed=1)
    for step in range(5):
        observation, *_ = vec.step(bold_actions(vec, step))
    state, saved = vec.state(), vec.state_dict()
    after, _ = vec.reset(mask=mask(4, 1, 2))
    assert same(after[[0, 3]], observation[[0, 3]])
    assert same(vec.state()[[0, 3]], state[[0, 3]])
    assert all(same(array[[0, 3]], saved[key][[0, 3]]) for key, array in vec.state_dict().items())
    assert not any(same(after[e], observation[e]) for e in (1, 2))


@pytest.mark.parametrize("threads", [(1, 1), (1, 2), (2, 1)], ids=str)
def test_a_saved_batch_continues_bit_for_bit(task, threads):
    first, second = (make(task, num_envs=5, num_threads=count, seed=5) for count in threads)
    first.reset()
    play(first, 90, row=0)
    saved = first.state_dict()
    second.load_state_dict(saved)
    (expected, ends), (continued, _) = (play(vec, 200, row=3, first_step=90) for vec in (first, second))
    assert ends > 0
    assert same(continued, expected)
    assert same(first.state_dict(), second.state_dict())


# Steps and ends


def test_time_limit_is_exact_and_a_truncation(task):
    vec = make(task, **{"env.episode_seconds": 0.5})
    vec.reset()
    assert vec.max_steps == 25
    for step in range(1, 26):
        _, _, terminated, truncated, info = vec.step(zeros(vec))
        assert not terminated.any() and not info["failure"].any()
        assert truncated.all() == truncated.any() == (step == 25)


def test_a_reset_starts_the_clock_of_its_environments_only(task):
    vec = make(task, num_envs=3, **{"env.episode_seconds": 0.5})
    vec.reset()
    for _ in range(10):
        vec.step(zeros(vec))
    vec.reset(mask=mask(3, 1))
    for _ in range(15):
        *_, truncated, _ = vec.step(zeros(vec))
    assert truncated.tolist() == [True, False, True]


def test_ends_have_one_cause(task, num_drones):
    vec = make(task, num_envs=16, num_drones=num_drones, **{"env.episode_seconds": 3.0})
    vec.reset(seed=0)
    terminations = truncations = 0
    for step in range(300):
        observation, reward, terminated, truncated, info = vec.step(bold_actions(vec, step))
        assert not (terminated & truncated).any()
        assert same(info["failure"], terminated)
        assert ((info["failure_cause"] > 0) == terminated).all()
        assert not (info["success"] & ~truncated).any()
        assert not info["diverged"].any()
        assert np.isfinite(observation).all() and np.isfinite(reward).all() and np.isfinite(vec.state()).all()
        terminations, truncations = terminations + terminated.sum(), truncations + truncated.sum()
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    assert terminations > 0 and truncations > 0


def test_an_environment_that_was_never_reset_cannot_be_stepped(task):
    vec = make(task)
    with pytest.raises(RuntimeError, match=r"environment 0 has ended or was never reset: call reset\(mask=\.\.\.\)"):
        vec.step(zeros(vec))


def test_an_ended_environment_cannot_be_stepped(task):
    vec = make(task, num_envs=3, **{"env.episode_seconds": 0.1})
    vec.reset()
    for _ in range(2):
        vec.step(zeros(vec))
    vec.reset(mask=mask(3, 0, 2))
    for _ in range(3):
        *_, truncated, _ = vec.step(zeros(vec))
    assert truncated.tolist() == [False, True, False]
    with pytest.raises(RuntimeError, match="environment 1 has ended"):
        vec.step(zeros(vec))
    vec.reset(mask=truncated)
    vec.step(zeros(vec))


def test_actions_beyond_one_are_clipped(task):
    results = []
    for size in (1.0, 1.5, 1e6):
        vec = make(task)
        vec.reset(seed=0)
        results.append([vec.step(size * bold_actions(vec, step)) for step in range(5)])
    assert same(results[0], results[1])
    assert same(results[0], results[2])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_actions_of_any_floating_type_do(task, dtype):
    vec, reference = make(task), make(task)
    vec.reset(seed=0), reference.reset(seed=0)
    action = np.full((4, 4, vec.action_size), 0.25)
    assert same(vec.step(action.astype(dtype)), reference.step(action))


# What is refused


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_action_that_is_not_finite_names_environment_drone_and_number(task, wrong):
    vec = make(task)
    vec.reset()
    action = zeros(vec)
    action[2, 1, 3] = wrong
    name = vec.action_names[3]
    with pytest.raises(ValueError, match=rf"drone_1 in environment 2 is not finite \({name}={wrong}\); look for NaN"):
        vec.step(action)
    vec.step(zeros(vec))


@pytest.mark.parametrize("shape", [(4,), (4, 4), (3, 4, 4), (4, 3, 4), (4, 4, 5), (1, 4, 4)])
def test_action_of_wrong_shape_is_refused(shape):
    vec = make("hover")
    vec.reset()
    with pytest.raises(ValueError, match=r"action has shape .*, expected \(4, 4, 4\)"):
        vec.step(np.zeros(shape))


@pytest.mark.parametrize("dtype", [int, bool, complex, object])
def test_action_of_wrong_type_is_refused(task, dtype):
    vec = make(task)
    vec.reset()
    with pytest.raises(ValueError, match=r"action has dtype .*, expected floating point numbers in \[-1, 1\]"):
        vec.step(zeros(vec).astype(dtype))


@pytest.mark.parametrize("wrong", [np.ones(4), np.ones(3, bool), np.ones((4, 1), bool), [0, 1]], ids=str)
def test_wrong_mask_is_refused(task, wrong):
    with pytest.raises(ValueError, match=r"mask has shape .*, expected bool \(4,\)"):
        make(task).reset(mask=wrong)


def test_negative_seed_is_refused(task):
    with pytest.raises(ValueError, match=r"seed must be a whole number from 0 .* but is -1"):
        make(task).reset(seed=-1)


@pytest.mark.parametrize("seed", [1.5, "3", 2**70])
def test_seed_that_is_no_whole_number_of_64_bits_is_refused(task, seed):
    with pytest.raises(ValueError, match="seed must"):
        make(task, num_envs=1).reset(seed=seed)


def test_unknown_reset_option_is_refused(task):
    with pytest.raises(ValueError, match="unknown reset option 'wind'"):
        make(task).reset(options={"wind": 1})


# Observations and rewards


@pytest.fixture(scope="module", params=ml.list_tasks())
def ensemble(request):
    """Return observations (K, D) and states (K, S) of many moments of many episodes of four drones, and the names."""
    vec = make(request.param, num_envs=64, num_drones=4)
    observation, _ = vec.reset(seed=0)
    seen, states = [observation], [vec.state()]
    for step in range(150):
        observation, _, terminated, truncated, _ = vec.step(0.6 * bold_actions(vec, step, hold=10))
        if step % 5 == 4:
            seen.append(observation)
            states.append(vec.state())
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    return np.concatenate(seen).reshape(-1, vec.observation_size).astype(float), np.concatenate(states), vec


def test_no_number_of_an_observation_is_constant(ensemble):
    observation, _, vec = ensemble
    spread = np.ptp(observation, axis=0)
    assert [name for name, width in zip(vec.observation_names, spread, strict=True) if width < 1e-3] == []


def test_no_number_of_an_observation_repeats_another(ensemble):
    observation, _, vec = ensemble
    correlation = np.abs(np.corrcoef(observation.T)) - np.eye(vec.observation_size)
    twins = [(vec.observation_names[i], vec.observation_names[j]) for i, j in np.argwhere(correlation > 0.9999)]
    assert twins == []


def test_the_state_tells_what_is_hidden_from_the_drones(task):
    vec = make(task, num_envs=64)
    observation, _ = vec.reset(seed=0)
    state, plant = vec.state(), vec.world.plant
    excess = (plant.payload_mass / vec.world.system.payload_mass - 1)[:, None]
    strength = np.linalg.norm(plant.payload_force, axis=1)[:, None]
    assert np.abs(state - excess).max(axis=0).min() < 1e-6
    assert np.abs(np.hypot(state[:, :-1], state[:, 1:]) - strength).max(axis=0).min() < 1e-6
    assert np.abs(observation - excess[..., None]).max(axis=(0, 1)).min() > 0.1


def test_reward_is_the_sum_of_its_named_terms_for_every_drone(task, num_drones):
    vec, paid = make(task, num_drones=num_drones), set()
    vec.reset(seed=0)
    for step in range(20):
        _, reward, *_, info = vec.step(0.5 * bold_actions(vec, step, hold=3))
        total = sum(info["reward_terms"].values())
        np.testing.assert_allclose(reward, np.broadcast_to(total[:, None], reward.shape), rtol=1e-6)
        paid |= {name for name, values in info["reward_terms"].items() if values.any()}
    assert paid == set(vec.reward_terms)


def test_a_weight_scales_its_term_and_no_other(task):
    def terms(**weights):
        vec = make(task, **weights)
        vec.reset(seed=0)
        for step in range(3):
            *_, info = vec.step(0.3 * bold_actions(vec, step, hold=1))
        return info["reward_terms"]

    plain = terms()
    weights = make(task, num_envs=1).task.REWARD
    for name, weight in weights.items():
        heavier = terms(**{f"reward.{name}": 3 * weight})
        for other in plain:
            factor = 3 if other == name else 1
            np.testing.assert_allclose(heavier[other], factor * plain[other], rtol=1e-12)


# Many starts


@pytest.fixture(scope="module", params=ml.list_tasks())
def starts(request):
    """Return a large batch that collects, over four resets, what ten thousand starts are like."""
    vec = make(request.param, num_envs=2500, num_drones=4)
    kept = {name: [] for name in ("cause", "stretch", "mass", "force", "position")}
    for _ in range(4):
        observation, _ = vec.reset()
        vec.task.check(0, vec.num_envs, 0.0)
        kept["cause"].append(vec.task.cause.copy())
        kept["stretch"].append(vec.world.record.stretch_max.copy())
        kept["mass"].append(vec.world.plant.payload_mass / vec.world.system.payload_mass - 1)
        kept["force"].append(vec.world.plant.payload_force.copy())
        kept["position"].append(vec.task.errors.distance.copy())
        assert np.isfinite(observation).all() and np.isfinite(vec.state()).all()
    return vec, {name: np.array(arrays) for name, arrays in kept.items()}


def test_no_start_is_a_failure(starts):
    vec, kept = starts
    assert not kept["cause"].any()
    *_, terminated, _, _ = vec.step(zeros(vec))
    assert not terminated.any()


def test_no_start_stretches_a_cable_beyond_its_load(starts):
    vec, kept = starts
    system, heavier = vec.world.system, 1 + vec.config.randomization.payload_mass
    tension = np.linalg.norm(system.formation_force, axis=1)
    at_rest = (tension / (system.cable_stiffness * system.cable_length)).max()
    assert kept["stretch"].max() <= heavier * at_rest * (1 + 1e-6)


def test_payload_mass_is_drawn_uniformly_about_the_nominal_one_every_time(starts):
    vec, kept = starts
    width, mass = vec.config.randomization.payload_mass, kept["mass"]
    assert width > 0 and np.abs(mass).max() <= width + 1e-12
    assert (np.ptp(mass, axis=1) > 1.98 * width).all()
    np.testing.assert_allclose(mass.std(axis=1), width / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(mass) - np.eye(4), 0, atol=0.08)


def test_payload_force_is_horizontal_and_uniform_in_strength_and_direction(starts):
    vec, kept = starts
    width, force = vec.config.randomization.payload_force, kept["force"].reshape(-1, 3)
    strength = np.linalg.norm(force, axis=1)
    assert width > 0 and strength.max() <= width + 1e-12
    assert (force[:, 2] == 0).all()
    np.testing.assert_allclose(np.quantile(strength, [0.25, 0.5, 0.75]), width * np.array([0.25, 0.5, 0.75]), rtol=0.05)
    np.testing.assert_allclose(force[:, :2].mean(axis=0), 0, atol=0.03 * width)


def test_inertia_and_cables_follow_the_payload_mass(starts):
    vec, _ = starts
    world, body = vec.world, vec.world.layout.payload_body
    for shard in world.shards:
        mass = world.plant.payload_mass[shard.lo : shard.hi]
        np.testing.assert_array_equal(shard.batch.expanded("body_mass")[:, body], mass)
        inertia = shard.batch.expanded("body_inertia")[:, body]
        np.testing.assert_allclose(
            inertia / mass[:, None],
            np.broadcast_to(world.system.payload_inertia, inertia.shape) / world.system.payload_mass,
        )
        inverse_weight = shard.batch.expanded("tendon_invweight0")
        expected_weight = 1 / mass[:, None] + 1 / world.system.vehicle.mass
        assert (inverse_weight > 0.99 * expected_weight).all()
        expected = limit_solref(world.system.cable_stiffness, world.system.cable_damping, inverse_weight)
        np.testing.assert_allclose(shard.batch.expanded("tendon_solref_lim"), expected)


def test_hidden_parameters_can_be_switched_off(task):
    vec = make(task, **{"randomization.payload_mass": 0, "randomization.payload_force": 0})
    vec.reset()
    assert (vec.world.plant.payload_mass == vec.world.system.payload_mass).all()
    assert (vec.world.plant.payload_force == 0).all()


# Divergence


@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_diverged_environment_ends_alone_and_soundly(task, num_threads):
    broken, sound = (make(task, num_envs=6, num_threads=num_threads, seed=3) for _ in range(2))
    for vec in (broken, sound):
        vec.reset()
    others = [0, 1, 3, 4, 5]
    for step in range(40):
        if step == 5:
            broken.world.plant.payload_force[2] = 1e9
        action = 0.2 * bold_actions(sound, step)
        expected, (observation, reward, terminated, truncated, info) = sound.step(action), broken.step(action)
        assert np.isfinite(observation).all() and np.isfinite(reward).all() and np.isfinite(broken.state()).all()
        assert same(observation[others], expected[0][others])
        assert same(reward[others], expected[1][others])
        assert not expected[2].any()
        assert info["diverged"].tolist() == terminated.tolist() == [False, False, step == 5, False, False, False]
        if terminated.any():
            assert not truncated.any() and not info["success"].any()
            assert vec.failure_causes[info["failure_cause"][2]] == "diverged"
            broken.reset(mask=terminated)


# Failures


def level(vec: MultiliftVec) -> None:
    """Put the first environment's team at rest in its formation at the target."""
    world, goal = vec.world, vec.task.goal
    goal.position[0], goal.rotation[0] = [0, 0, 1.5], np.eye(3)
    place_formation(0, goal, vec.task.rig)
    world.reset(mask(vec.num_envs, 0))


def sink(state):
    state.payload_position[0, 2] -= 1.43
    state.drone_position[0, :, 2] -= 1.43


def collide(state):
    state.drone_position[0, 1] = state.drone_position[0, 0] + [0.0, -0.3, 0.05]


def cross(state):
    state.drone_position[0, [0, 1]] = state.drone_position[0, [1, 0]]


def lean(state):
    state.drone_rotation[0, 0] = np.reshape(axis_angle((0.0, 1.0, 0.0), -1.25), (3, 3))


def tumble(state):
    state.drone_rotation[0, 0] = np.reshape(axis_angle((1.0, 0.0, 0.0), 1.45), (3, 3))


def turn_over(state):
    state.payload_rotation[0] = np.reshape(axis_angle((1.0, 0.0, 0.0), np.pi), (3, 3))


def hang(state):
    state.drone_position[0, 2, 2] = state.payload_position[0, 2] - 0.1


def stray(state):
    state.payload_position[0, 0] += 3.1
    state.drone_position[0, :, 0] += 3.1


@pytest.mark.parametrize(
    "happen, cause",
    [
        (lambda state: None, "none"),
        (sink, "ground"),
        (collide, "drone_collision"),
        (cross, "cable_crossing"),
        (lean, "cable_angle"),
        (turn_over, "cable_angle"),
        (tumble, "tilt"),
        (hang, "below_payload"),
        (stray, "out_of_range"),
    ],
)
def test_each_failure_has_its_cause(happen, cause):
    vec = make("hover", num_envs=1)
    vec.reset(seed=0)
    level(vec)
    happen(vec.world.state)
    vec.task.check(0, 1, 0.0)
    assert vec.failure_causes[vec.task.cause[0]] == cause


def test_a_failure_ends_the_episode():
    vec = make("hover", num_envs=3)
    vec.reset(seed=0)
    vec.world.plant.payload_force[1] = [0, 0, -60]
    for _ in range(100):
        _, _, terminated, _, info = vec.step(zeros(vec))
        if terminated.any():
            break
    assert terminated.tolist() == info["failure"].tolist() == [False, True, False]
    assert not info["diverged"].any()


# Hover


def test_hover_starts_are_as_documented():
    vec = make("hover", num_envs=4000)
    vec.reset(seed=0)
    goal, state, errors, system = vec.task.goal, vec.world.state, vec.task.errors, vec.world.system
    assert np.abs(goal.position[:, :2]).max() <= 1 and np.ptp(goal.position[:, :2]) > 1.99
    assert goal.position[:, 2].min() >= 1 and goal.position[:, 2].max() <= 2
    assert np.degrees(np.abs(goal.yaw).max()) <= 45 and np.degrees(np.ptp(goal.yaw)) > 89
    np.testing.assert_allclose(goal.rotation[:, 2], np.broadcast_to([0, 0, 1], (4000, 3)), atol=1e-12)
    np.testing.assert_allclose(np.quantile(errors.distance, [0.25, 0.5]), 0.5 * np.cbrt([0.25, 0.5]), rtol=0.03)
    assert errors.distance.max() <= 0.5
    assert np.degrees(errors.angle.max()) <= 10 + 1e-6 and np.degrees(errors.angle.max()) > 9.9
    speed = np.linalg.norm(state.payload_velocity, axis=1)
    assert 0.29 < speed.max() <= 0.3
    np.testing.assert_array_equal(state.drone_velocity, np.repeat(state.payload_velocity[:, None], 4, axis=1))
    expected = (
        np.linalg.norm(system.formation_force, axis=1) * (vec.world.plant.payload_mass / system.payload_mass)[:, None]
    )
    np.testing.assert_allclose(state.cable_tension, expected, rtol=1e-6)


def hover_terms(displace) -> dict[str, float]:
    """Return the reward terms of a team at rest at its target after displace(state)."""
    vec, still = make("hover", num_envs=1), np.zeros((1, 4, 4))
    vec.reset(seed=0)
    level(vec)
    displace(vec.world.state)
    vec.task.check(0, 1, 0.0)
    vec.task.scorer(0, 1, still, still)()
    return dict(zip(vec.reward_terms, vec.task.terms[0], strict=True))


def test_hover_pays_every_positive_weight_in_full_at_rest_at_the_goal():
    weights = make("hover", num_envs=1).task.REWARD
    paid = hover_terms(lambda state: None)
    assert paid == pytest.approx({name: max(weight, 0.0) for name, weight in weights.items()})


@pytest.mark.parametrize("distance, share", [(0.25, 0.5), (0.75, 0.1)])
def test_hover_pays_half_at_the_margin_and_a_tenth_at_three_margins(distance, share):
    def move(state):
        state.payload_position[0, 1] += distance

    assert hover_terms(move)["position"] == pytest.approx(share * hover_terms(lambda state: None)["position"])


def test_hover_charges_the_mean_squared_change_of_action():
    vec = make("hover")
    vec.reset(seed=0)
    last = zeros(vec)
    for step in range(5):
        action = np.random.default_rng(step).uniform(-1, 1, last.shape)
        *_, info = vec.step(action)
        expected = -0.05 * ((action - last) ** 2).mean(axis=(1, 2))
        np.testing.assert_allclose(info["reward_terms"]["action_rate"], expected, rtol=1e-9)
        last = action


def test_hover_succeeds_within_5_cm_and_5_degrees_throughout_the_last_2_s():
    vec = make("hover", num_envs=48, **{"randomization.payload_force": 0.5})
    vec.reset(seed=0)
    good = []
    for step in range(vec.max_steps):
        *_, info = vec.step(zeros(vec))
        assert step + 1 == vec.max_steps or not info["success"].any()
        good.append((vec.task.errors.distance <= 0.05) & (vec.task.errors.angle <= np.radians(5)))
    expected = np.all(good[-100:], axis=0)
    assert 0 < expected.sum() < 48
    assert same(info["success"], expected)


def test_hover_remembers_how_long_it_has_been_good_when_saved_and_not_when_reset():
    calm = {"randomization.payload_force": 0, "randomization.payload_mass": 0, "task_options.start_radius": 0.05}
    first, second = (make("hover", **calm) for _ in range(2))
    first.reset(seed=0)
    for _ in range(first.max_steps - 20):
        first.step(zeros(first))
    second.load_state_dict(first.state_dict())
    for _ in range(20):
        expected, told = (vec.step(zeros(vec))[-1]["success"] for vec in (first, second))
    assert expected.all() and told.all()
    second.reset()
    assert (second.task.good_time == 0).all()


def test_error_integrals_are_sums_over_time_within_their_limit():
    vec = make("hover", num_envs=16)
    vec.reset(seed=0)
    total = np.zeros((16, 3))
    for _ in range(300):
        vec.step(zeros(vec))
        total = np.clip(total + 0.02 * vec.task.errors.position, -0.5, 0.5)
    np.testing.assert_allclose(vec.task.errors.position_integral, total, atol=1e-12)
    assert np.abs(total).max() > 0.2


def test_observations_do_not_depend_on_place_and_heading():
    vec = make("hover", num_envs=1)
    vec.reset(seed=0)
    for step in range(30):
        vec.step(0.5 * bold_actions(vec, step, hold=7))
    task, state, reference = vec.task, vec.world.state, vec.reference
    before, hidden = vec._observation.copy(), vec._state.copy()
    turn, shift = np.reshape(rot_z(1.1), (3, 3)), np.array([5.0, -3.0, 0.0])
    for array in (task.goal.position, state.payload_position, state.drone_position, reference.position):
        array[:] = array @ turn.T + shift
    for array in (
        state.payload_velocity, state.drone_velocity, reference.velocity, vec.world.plant.payload_force,
        task.errors.position_integral, task.errors.rotation_integral,
    ):  # fmt: skip
        array[:] = array @ turn.T
    for array in (task.goal.rotation, state.payload_rotation, state.drone_rotation):
        array[:] = turn @ array
    place_formation(0, task.goal, task.rig)
    task.check(0, 1, 0.0)
    task.observe(0, 1, vec._action, vec._observation, vec._state)
    np.testing.assert_allclose(vec._observation, before, atol=2e-6)
    np.testing.assert_allclose(vec._state, hidden, atol=2e-6)


def fly_once(vec: MultiliftVec, act, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (E,) return, success and failure of one episode in every environment flown by act(observation)."""
    observation, _ = vec.reset(seed=seed)
    total, success, failure, over = np.zeros((4, vec.num_envs))
    over = over.astype(bool)
    for _ in range(vec.max_steps):
        observation, reward, terminated, truncated, info = vec.step(np.asarray(act(observation), float))
        total += np.where(over, 0, reward.mean(axis=1))
        success[~over], failure[~over] = info["success"][~over], terminated[~over]
        over |= terminated | truncated
        if over.all():
            break
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    assert over.all()
    return total, success.astype(bool), failure.astype(bool)


def test_in_return_motors_off_lose_to_holding_the_start_to_the_formation_to_its_integral():
    def score(script=None, **gains):
        vec = make("hover", num_envs=64)
        vec._gains = vec._gains._replace(**gains)
        vec._bind()
        first, _ = vec.reset(seed=0)
        at = vec.observation_names.index("slot_error_0")
        hold = zeros(vec)
        hold[..., :3] = np.clip(first[..., at : at + 3] / vec.config.control.max_offset, -1, 1)
        total, *_ = fly_once(vec, make_scripted(script, vec).act if script else lambda observation: hold)
        return total

    off = score(thrust_min=0.0, thrust_max=0.0)
    hold, formation, integral = score(), score("formation"), score("formation_integral")
    assert off.mean() < 0.1 * hold.mean()
    assert hold.mean() < 0.8 * formation.mean()
    assert formation.mean() < 0.95 * integral.mean()
    assert (formation > hold).mean() > 0.8 and (integral > formation).mean() > 0.8


OFF_CENTRE = [[0.25, 0.2, 0.08], [-0.3, 0.2, 0.08], [-0.3, -0.2, 0.08], [0.25, -0.2, 0.08]]


@pytest.mark.parametrize("shape", ["box", "point"])
@pytest.mark.parametrize("num_drones", [1, 2, 3, 6, 16])
def test_the_formation_flies_any_number_of_drones(num_drones, shape):
    vec = make("hover", num_envs=8, num_drones=num_drones, **{"payload.shape": shape})
    _, _, failure = fly_once(vec, make_scripted("formation", vec).act)
    assert not failure.any()


@pytest.mark.parametrize(
    "num_drones, overrides",
    [(4, {}), (3, {"payload.shape": "point"}), (4, {"payload.shape": "point"}), (4, {"payload.anchors": OFF_CENTRE})],
    ids=["box", "point 3", "point 4", "off-centre anchors"],
)
def test_the_integral_formation_succeeds_with_any_payload(num_drones, overrides):
    vec = make("hover", num_envs=32, num_drones=num_drones, **overrides)
    _, success, failure = fly_once(vec, make_scripted("formation_integral", vec).act)
    assert not failure.any()
    assert success.mean() >= 0.9


# Compiled kernels

HOVER = """
from multilift_marl.config.system import GRAVITY
from multilift_marl.sim.dynamics import hover_drone
from multilift_marl.sim.state import SystemState
state = SystemState.zeros(1, 1)
hover_drone(0, 0, state, (0.0, 0.0, 0.0), 0.0, 1.0, 1.0)
print((state.rotor_speed**2).sum() / GRAVITY)
"""


def test_no_compiled_kernel_outlives_a_constant_it_was_compiled_with(tmp_path):
    package = tmp_path / "multilift_marl"
    shutil.copytree(Path(ml.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))

    def weights_lifted() -> float:
        told = subprocess.run([sys.executable, "-c", HOVER], cwd=tmp_path, capture_output=True, text=True, check=True)
        return float(told.stdout)

    assert weights_lifted() == pytest.approx(1)
    constants = package / "config" / "system.py"
    constants.write_text(constants.read_text(encoding="utf-8").replace("GRAVITY = 9.81", "GRAVITY = 3.71"))
    assert weights_lifted() == pytest.approx(1)
