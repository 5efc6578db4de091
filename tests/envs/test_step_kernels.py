"""What a policy step does around its stages: actions, ends, sums of rewards, warnings, the live outcome of a step."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import bold_actions, make, mask, mixed_actions, same, zeros

from multilift_marl.envs.step_kernels import ENDED, NOT_FINITE, TAKEN, Outcome, end_step, take_actions
from multilift_marl.mdp.failures import DIVERGED, FIRST_OWN
from multilift_marl.sim.parameters import MASSES, make_inertias, nominal_parameters, update_inertias
from multilift_marl.sim.state_io import find_warnings


@pytest.mark.parametrize(
    ("value", "ended", "result"),
    [(0.5, False, TAKEN), (0.5, True, ENDED), (np.nan, True, ENDED), (np.nan, False, NOT_FINITE)],
)
def test_actions_of_all_environments_are_taken_or_none(value, ended, result):
    given = np.array([[[-3.0, 0.25]], [[value, 1.5]]])
    action, previous = np.full((2, 1, 2), 0.125), np.zeros((2, 1, 2))
    assert take_actions(given, np.array([False, ended]), action, previous) == result
    if result == TAKEN:
        assert action.tolist() == [[[-1.0, 0.25]], [[0.5, 1.0]]] and (previous == 0.125).all()
    else:
        assert (action == 0.125).all() and (previous == 0.0).all()


@pytest.mark.parametrize("count", [1, 5, 7, 8, 9, 15, 16, 19])
def test_a_reward_is_the_sum_of_its_terms_in_numpys_order(count):
    rng = np.random.default_rng(count)
    terms = rng.normal(size=(200, count)) * 10.0 ** rng.integers(-8, 8, (200, count))
    outcome = Outcome.of(np.zeros((200, 3, 2), np.float32), terms.astype(np.float64))
    still, causes, steps = np.zeros(200, bool), np.zeros(200, np.int64), np.zeros(200, np.int64)
    end_step(still, causes, 11, steps, 10, np.zeros(200, bool), outcome)
    assert same(outcome.reward, np.repeat(terms.sum(axis=1, keepdims=True), 3, axis=1).astype(np.float32))


def test_ends_by_failure_divergence_and_time():
    outcome = Outcome.of(np.zeros((4, 2, 1), np.float32), np.ones((4, 3)))
    diverged, cause, ended = mask(4, 2), np.array([0, 3, 0, 0]), np.ones(4, bool)
    steps = np.array([0, 9, 9, 9])
    assert end_step(diverged, cause, FIRST_OWN, steps, 10, ended, outcome) == (1, -1)
    assert steps.tolist() == [1, 10, 10, 10] and ended.tolist() == [False, True, True, True]
    terminated, truncated, success, failure, lost = outcome.flags.tolist()
    assert terminated == failure == [False, True, True, False]
    assert truncated == [False, False, False, True] and not any(success) and lost == [False, False, True, False]
    assert outcome.cause.tolist() == cause.tolist() == [0, 3, DIVERGED, 0]
    assert outcome.reward.tolist() == [[3.0, 3.0], [3.0, 3.0], [0.0, 0.0], [3.0, 3.0]]


def test_warnings_are_those_counted_of_its_own_environments():
    warning = np.zeros((2, 7, 2), np.int32)
    warning[0, 3] = 5, 0  # what it would be about, never counted
    warning[1, 6, 1] = 2
    diverged = mask(4, 0)
    find_warnings(2, warning, diverged)
    assert diverged.tolist() == [True, False, False, True]


@pytest.mark.parametrize(("task", "act"), [("hover", mixed_actions), ("gate", bold_actions)])
def test_the_live_outcome_is_what_step_returns_until_the_next(task, act):
    one, two = (make(task, num_envs=4, **{"env.episode_seconds": 0.4}) for _ in range(2))
    one.reset(seed=2)
    two.reset(seed=2)
    for step in range(20):
        observation, reward, terminated, truncated, info = one.step(act(one, step), restart=True)
        outcome = two.step_live(act(two, step), restart=True)
        assert outcome is two.outcome
        flags = terminated, truncated, info["success"], info["failure"], info["diverged"]
        assert same((outcome.observation, outcome.reward, outcome.cause), (observation, reward, info["failure_cause"]))
        assert same(outcome.flags, np.stack(flags))
        assert same(outcome.terms, np.stack(list(info["reward_terms"].values()), axis=1))
    assert truncated.any() or terminated.any()


def test_a_reset_clears_the_outcome_of_its_environments_alone():
    vec = make("hover", num_envs=3, **{"env.episode_seconds": 0.02})
    vec.reset()
    vec.step(zeros(vec))
    assert vec.outcome.flags[1].all() and (vec.outcome.reward != 0).all()
    vec.reset(mask=mask(3, 1))
    assert vec.outcome.flags[1].tolist() == [True, False, True]
    assert (vec.outcome.reward != 0).all(axis=1).tolist() == [True, False, True]


def test_inertias_of_an_environment_do_not_depend_on_which_others_change():
    system = make("hover").world.system
    parameters = nominal_parameters(system, 3)
    inertias, whole = make_inertias(system, parameters), make_inertias(system, parameters)
    before = inertias.inverse[0].copy()
    parameters.payload_mass[:] *= [1.5, 0.7, 1.3]
    parameters.vehicle_mass[:] *= 1.1
    update_inertias(inertias, system, parameters, mask(3, 1, 2), MASSES)
    update_inertias(whole, system, parameters, np.ones(3, bool), MASSES)
    for part, full in zip(inertias, whole, strict=True):
        assert same(part[1:], full[1:])
    assert same(inertias.inverse[0], before) and not same(whole.inverse[0], before)


@pytest.mark.parametrize("name", sorted(MASSES))
def test_a_parameter_that_changes_alone_brings_all_that_depends_on_it(name):
    system = make("hover").world.system
    parameters = nominal_parameters(system, 2)
    inertias = make_inertias(system, parameters)
    before = [part.copy() for part in inertias]
    getattr(parameters, name)[:] += 0.05
    update_inertias(inertias, system, parameters, np.ones(2, bool), {name})
    assert any(not same(part, old) for part, old in zip(inertias, before, strict=True))
    for part, full in zip(inertias, make_inertias(system, parameters), strict=True):
        assert same(part, full)
