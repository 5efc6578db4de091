"""States by noisy and late measurements: exact without noise, better than what is measured with it."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.planning.flatness import FlatMotion, FlatWork, make_flat_team, set_flat_state, steady_shape
from multilift_marl.planning.team_model import ModelWork, make_model, state_size, step_state
from multilift_marl.planning.team_observer import TeamObserver

N, DT, LATE = 3, 0.02, 0.008
Q = 6 + 2 * N


@pytest.fixture(scope="module")
def flown():
    """The model of a team, and 3 s of its states under thrusts that swing it."""
    system = ml.load_config("hover", {"env.num_drones": N}).system
    model, x, after = make_model(system), np.zeros(state_size(N)), np.zeros(state_size(N))
    pose = np.tile([0.0, 0.0, 1.0], (5, 1)), np.tile(np.eye(3), (5, 1, 1))
    team = make_flat_team(model, system)
    set_flat_state(FlatMotion(*pose, steady_shape(team)), 0.0, np.zeros(7), team, FlatWork.of(N), x)
    work, rest, states = ModelWork.of(N), x[2 * Q :].copy(), [x.copy()]
    for k in range(150):
        thrust = rest.copy()
        thrust[::3] += 0.5 * np.sin(0.15 * k)
        step_state(x, (thrust - x[2 * Q :]) / DT, DT, model, np.zeros(7), work, after)
        x, after = after.copy(), x
        states.append(x.copy())
    return model, np.array(states)


def observe(model, measured, late):
    observer = TeamObserver(model, 1, 0.4, late)
    return np.array([observer.update(y[None].copy(), DT, np.zeros((1, 7)))[0].copy() for y in measured])


def test_without_noise_states_are_what_is_measured(flown):
    model, states = flown
    assert observe(model, states, 0.0) == pytest.approx(states, abs=1e-9)


def test_a_late_pose_is_the_pose_of_then(flown):
    model, states = flown
    measured = states.copy()
    measured[:, :3] -= LATE * states[:, Q : Q + 3]
    assert observe(model, measured, LATE)[50:] == pytest.approx(states[50:], abs=1e-3)


def test_with_noise_places_and_velocities_are_better_than_measured(flown):
    model, states = flown
    rng = np.random.default_rng(0)
    measured = states.copy()
    measured[:, :Q] += 0.002 * rng.normal(size=(len(states), Q))
    measured[:, Q : 2 * Q] += 0.1 * rng.normal(size=(len(states), Q))
    off = np.abs(observe(model, measured, 0.0) - states)[20:]
    noise = np.abs(measured - states)[20:]
    assert off[:, :Q].mean() < 0.8 * noise[:, :Q].mean()
    assert off[:, Q : 2 * Q].mean() < 0.3 * noise[:, Q : 2 * Q].mean()
