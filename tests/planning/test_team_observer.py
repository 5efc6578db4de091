"""States by noisy and late measurements: exact without noise, better than what is measured with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import multilift_marl as ml
from multilift_marl.planning.flatness import FlatMotion, FlatWork, make_flat_team, set_flat_state, steady_shape
from multilift_marl.planning.team_model import ModelWork, make_model, state_size, step_state
from multilift_marl.planning.team_observer import TeamObserver
from multilift_marl.policies.full_state_command import rotations

N, DT, LATE = 3, 0.02, 0.008
Q = 6 + 2 * N


def fly(speed=0.0):
    """Return the model of a team, and 3 s of its states from a speed [m/s] on, under thrusts that swing it."""
    system = ml.load_config("hover", {"env.num_drones": N}).system
    model, x, after = make_model(system), np.zeros(state_size(N)), np.zeros(state_size(N))
    pose = np.tile([0.0, 0.0, 1.0], (5, 1)), np.tile(np.eye(3), (5, 1, 1))
    team = make_flat_team(model, system)
    set_flat_state(FlatMotion(*pose, steady_shape(team)), 0.0, np.zeros(7), team, FlatWork.of(N), x)
    x[Q] = speed
    work, rest, states = ModelWork.of(N), x[2 * Q :].copy(), [x.copy()]
    for k in range(150):
        thrust = rest.copy()
        thrust[::3] += 0.5 * np.sin(0.15 * k)
        step_state(x, (thrust - x[2 * Q :]) / DT, DT, model, np.zeros(7), work, after)
        x, after = after.copy(), x
        states.append(x.copy())
    return model, np.array(states)


@pytest.fixture(scope="module")
def flown():
    return fly()


def observe(model, measured, late):
    observer = TeamObserver(model, 1, 0.4, late)
    return np.array([observer.update(y[None].copy(), DT, np.zeros((1, 7)))[0].copy() for y in measured])


def test_without_noise_states_are_what_is_measured(flown):
    model, states = flown
    assert observe(model, states, 0.0) == pytest.approx(states, abs=1e-9)


def seen_late(model, states):
    """Return what is measured of states where all of the payload's pose is late, and cables go from there to drones."""
    measured = states.copy()
    for x, y in zip(states, measured, strict=True):
        rotation, then = rotations(x[None, 3:6])[0], x[:6].copy()
        turned = Rotation.from_matrix(rotation) * Rotation.from_rotvec(-LATE * x[Q + 3 : Q + 6])
        then[:3] -= LATE * x[Q : Q + 3]
        then[3:6] = turned.as_euler("ZYX")[::-1]
        for n in range(N):
            c = x[6 + 2 * n : 8 + 2 * n]
            drone = x[:3] + rotation @ model.anchors[n] + model.length[n] * np.array([*c, np.sqrt(1 - c @ c)])
            cable = drone - then[:3] - turned.as_matrix() @ model.anchors[n]
            y[6 + 2 * n : 8 + 2 * n] = (cable / np.linalg.norm(cable))[:2]
        y[:6] = then
    return measured


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_a_late_pose_is_the_pose_of_then_also_for_cables(speed):
    model, states = fly(speed)
    found = observe(model, seen_late(model, states), LATE)[50:]
    assert found == pytest.approx(states[50:], abs=1e-3)
    assert found[:, 6:Q] == pytest.approx(states[50:, 6:Q], abs=1e-4)


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
