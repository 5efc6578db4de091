"""The batched core: observations, the state and the terms of the reward."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import CABLES, TASKS, bold_actions, make, mixed_actions, wide

from multilift_marl.tasks import find_task

UNPAID = 0.1  # a weight for terms that have none by default


def unpaid(task: str) -> dict[str, float]:
    """Return weights of the terms without, and bounds which episodes of random actions exceed."""
    exceeded = {"task_options.success_tension": 3.0} if task in ("loss", "recover") else {}
    return {f"reward.{name}": UNPAID for name, term in find_task(task).REWARD.items() if term.weight == 0} | exceeded


def flown() -> list[tuple[str, str]]:
    """Return tasks and cable models: both with `hover`, one with each other task, in turn."""
    pairs = product(enumerate(TASKS), enumerate(CABLES))
    return [(task, model) for (i, task), (j, model) in pairs if task == "hover" or (i + j) % 2]


@pytest.fixture(scope="module", params=flown(), ids="-".join)
def ensemble(request):
    """Return observations (K, D) and states (K, S) of many moments of many episodes of four drones, and the names."""
    task, model = request.param
    varied = {"task_options.path": "random"} if task == "track" else {}  # others stay at one height
    vec = make(task, num_envs=16 if model == "massless" else 5, num_drones=4, **varied, **CABLES[model])
    observation, _ = vec.reset(seed=0)
    seen, states = [observation], [vec.state()]
    for step in range(max(150, vec.max_steps)):  # all phases of an episode
        observation, _, terminated, truncated, _ = vec.step(0.6 * mixed_actions(vec, step, hold=10))
        if step % 5 == 4:
            seen.append(observation)
            states.append(vec.state())
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    return np.concatenate(seen).reshape(-1, vec.observation_size).astype(float), np.concatenate(states), vec


@pytest.mark.slow
def test_no_number_of_an_observation_is_constant(ensemble):
    observation, _, vec = ensemble
    spread = np.ptp(observation, axis=0)
    assert [name for name, width in zip(vec.observation_names, spread, strict=True) if width < 1e-3] == []


@pytest.mark.slow
def test_no_number_of_an_observation_repeats_another(ensemble):
    observation, _, vec = ensemble
    correlation = np.abs(np.corrcoef(observation.T)) - np.eye(vec.observation_size)
    twins = [(vec.observation_names[i], vec.observation_names[j]) for i, j in np.argwhere(correlation > 0.9999)]
    assert twins == []


@pytest.mark.few_tasks
def test_the_state_tells_what_is_hidden_from_the_drones(task, cables):
    vec = make(task, num_envs=64, **{"randomization.payload_mass": 0.2, "randomization.payload_force": 1.5}, **cables)
    observation, _ = vec.reset(seed=0)
    state, hidden_loads = vec.state(), vec.world.hidden_loads
    excess = (hidden_loads.payload_mass / vec.world.system.payload_mass - 1)[:, None]
    strength = np.linalg.norm(hidden_loads.payload_force, axis=1)[:, None]
    assert np.abs(state - excess).max(axis=0).min() < 1e-6
    assert np.abs(np.hypot(state[:, :-1], state[:, 1:]) - strength).max(axis=0).min() < 1e-6
    assert np.abs(observation - excess[..., None]).max(axis=(0, 1)).min() > 0.1


def test_reward_is_the_sum_of_its_named_terms_for_every_drone(task, num_drones, cables):
    vec, paid = make(task, num_drones=num_drones, **wide(task), **unpaid(task), **cables), set()
    expected = set(vec.reward_terms) - {"failure", "closeness", "spin"}  # few teams fail by such actions, or come near
    vec.reset(seed=0)
    for step in range(vec.max_steps):
        _, reward, terminated, truncated, info = vec.step(0.2 * bold_actions(vec, step, hold=3))
        total = sum(info["reward_terms"].values())
        np.testing.assert_allclose(reward, np.broadcast_to(total[:, None], reward.shape), rtol=1e-6)
        paid |= {name for name, values in info["reward_terms"].items() if values.any()}
        if step >= 20 and paid >= expected:
            break
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    assert paid >= expected


@pytest.mark.parametrize("task", [task for task in TASKS if "failure" in find_task(task).REWARD])
def test_a_failure_is_paid_for_in_the_step_in_which_a_team_fails(task):
    vec, failed = make(task, num_envs=16, num_drones=4, **{"reward.failure": -7.0}), 0
    vec.reset(seed=0)
    for step in range(200):
        _, _, terminated, truncated, info = vec.step(bold_actions(vec, step, hold=10))
        np.testing.assert_array_equal(info["reward_terms"]["failure"], np.where(terminated, -7.0, 0.0))
        failed += terminated.sum()
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    assert failed > 5


def test_a_weight_scales_its_term_and_no_other(task, cables):
    def terms(**weights):
        vec = make(task, **unpaid(task) | weights, **cables)
        vec.reset(seed=0)
        for step in range(3):
            *_, info = vec.step(0.3 * bold_actions(vec, step, hold=1))
        return info["reward_terms"]

    plain = terms()
    for name, term in find_task(task).REWARD.items():
        heavier = terms(**{f"reward.{name}": 3 * (term.weight or UNPAID)})
        for other in plain:
            factor = 3 if other == name else 1
            np.testing.assert_allclose(heavier[other], factor * plain[other], rtol=1e-12)


@pytest.mark.parametrize(("history", "ages"), [(3, (0, 1, 2)), ((0, 1, 5), (0, 1, 5))])
def test_a_history_holds_earlier_observations_and_starts_filled_with_the_first(history, ages):
    plain, told = (make("hover", num_envs=3, **{"env.history": steps}) for steps in (1, history))
    first, whole = plain.reset(seed=5)[0], told.reset(seed=5)[0]
    seen = [first] * 6
    assert whole.shape == (3, plain.num_drones, 3 * plain.observation_size)
    assert told.observation_names[: plain.observation_size] == plain.observation_names
    assert told.observation_names[-1] == f"{plain.observation_names[-1]}@-{ages[-1]}"
    for step in range(12):
        action = bold_actions(plain, step)
        observation, *_ = plain.step(action)
        whole, *_ = told.step(action)
        seen = [observation, *seen[:5]]
        np.testing.assert_array_equal(whole, np.concatenate([seen[age] for age in ages], axis=2))
    one = np.array([False, True, False])
    (observation, _), (whole, _) = plain.reset(mask=one), told.reset(mask=one)
    seen = [np.where(one[:, None, None], observation, earlier) for earlier in [observation, *seen[1:]]]
    np.testing.assert_array_equal(whole, np.concatenate([seen[age] for age in ages], axis=2))
    seen = [np.where(one[:, None, None], observation, earlier) for earlier in seen]
    for step in range(4):  # what was before the episode does not come back
        observation, *_ = plain.step(bold_actions(plain, step))
        whole, *_ = told.step(bold_actions(plain, step))
        seen = [observation, *seen[:5]]
        np.testing.assert_array_equal(whole, np.concatenate([seen[age] for age in ages], axis=2))


@pytest.mark.parametrize("history", [2, (0, 3)])
def test_a_history_is_saved_with_the_environments(history):
    one, other = (make("hover", num_envs=2, **{"env.history": history}) for _ in range(2))
    one.reset(seed=0)
    other.reset(seed=1)
    for step in range(5):
        one.step(bold_actions(one, step))
    saved = one.state_dict()
    other.load_state_dict(saved)
    for step in range(5, 9):
        np.testing.assert_array_equal(one.step(bold_actions(one, step))[0], other.step(bold_actions(one, step))[0])
    with pytest.raises(ValueError, match=r"history\.newest"):
        other.load_state_dict(saved | {"history.newest": np.array([0, 9])})
