"""Derivatives that plans within hard limits are found by, against differences: of dynamics, limits, whole plans."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.planning.augmented_lagrangian import penalty, set_push
from multilift_marl.planning.curvature import CurvatureWork, set_curvature
from multilift_marl.planning.expert import TeamExpert
from multilift_marl.planning.hard_limits import LimitedProblem, Limits, limit_names
from multilift_marl.planning.newton import Multipliers, NewtonWork, Trajectory, find_step, follow
from multilift_marl.planning.riccati import IterationWork, Problem, linearise, pull_back
from multilift_marl.planning.team_model import ModelWork, step_state

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

N, STEPS, STEP = 3, 4, 0.05
SIZE, Q, NU = 12 + 7 * N, 6 + 2 * N, 3 * N
LOAD = np.array([0.1, 0.2, -0.3, 0.01, 0.0, -0.01, 0.1])


@pytest.fixture(scope="module")
def expert():
    return TeamExpert(ml.load_config("hover", {"env.num_drones": N}))


def test_second_derivatives_of_a_step_are_differences_of_first_ones(expert):
    rng = np.random.default_rng(0)
    model = expert.model._replace(drag=0.3)
    x = expert.rest_states(np.array([0.0, 0.0, 1.0]))[0] + 0.2 * rng.normal(size=SIZE)
    inputs, costate, pull = rng.normal(size=(1, NU)), rng.normal(size=SIZE), rng.normal(size=N)
    problem = Problem(np.tile(x, (2, 1)), inputs, STEP, model, LOAD[None], expert.objective, expert.around)
    w, c = IterationWork.of(1, N), CurvatureWork.of(N)

    def slope(x):
        linearise(0, np.stack([x, x]), inputs, problem, w)
        pulled = np.zeros(SIZE)
        pull_back(0, costate, pulled, Q, SIZE, STEP, w)
        return pulled - pull @ w.tension_slope[0]

    def value(x):
        after, m = np.zeros(SIZE), ModelWork.of(N)
        step_state(x, inputs[0], STEP, model, LOAD, m, after)
        return costate @ after - pull @ m.tension

    h = 1e-5
    assert slope(x) == pytest.approx([(value(x + e) - value(x - e)) / (2 * h) for e in h * np.eye(SIZE)], abs=1e-6)
    expected = np.array([(slope(x + e) - slope(x - e)) / (2 * h) for e in h * np.eye(SIZE)])
    slope(x)
    set_curvature(0, x, costate, pull, problem, w, c)
    assert abs(expected).max() > 10
    assert c.hessian == pytest.approx(expected, abs=1e-8 * abs(expected).max())


@pytest.mark.parametrize("exact", [True, False])
def test_a_step_is_newtons_on_the_cost_with_limits_of_every_kind(expert, exact):
    """Against the gradient and, with second derivatives, the Hessian of cost and limits by inputs, by differences."""
    rng = np.random.default_rng(1)
    rest = expert.rest_states(np.array([0.0, 0.0, 1.0]))[0]
    start = rest + 0.03 * rng.normal(size=SIZE)
    start[2 * Q :] = rest[2 * Q :] + 0.5 * rng.normal(size=NU)
    targets, inputs = np.tile(rest, (STEPS + 1, 1)), 2.0 * rng.normal(size=(STEPS, NU))
    objective = expert.objective._replace(rate=1000.0 * expert.objective.rate)  # convex all the same
    problem = Problem(targets, np.zeros_like(inputs), STEP, expert.model, LOAD[None], objective, expert.around)
    tension = np.linalg.norm(rest[2 * Q : 2 * Q + 3])
    limits = Limits(
        np.full(N, tension),
        np.full(N, 0.9 * tension),
        np.full(N, 1.3 * tension),
        0.98,
        np.full((N, N), 2.0),
        np.full((N, N), 1.0),
        np.ones(4),
    )
    count = len(limit_names(N))
    w, m, rho = NewtonWork.of(STEPS, N, count), Multipliers.of(STEPS, count), 0.3
    m.dual[:] = rng.uniform(0.5, 1.0, m.dual.shape)
    states, task = np.zeros((STEPS + 1, SIZE)), LimitedProblem(problem, limits)
    path = Trajectory(states, inputs)

    def cost(change):
        w.iteration.gain[:] = 0.0
        return follow(start, Trajectory(states, inputs + change), 0.0, task, w) + penalty(w.values, m.dual, rho)

    def differences(function, h):
        shape = inputs.shape
        return np.array([(function(e) - function(-e)) / (2 * h) for e in h * np.eye(inputs.size).reshape(-1, *shape)])

    def gradient(change):
        return differences(lambda more: cost(change + more), 1e-3)

    slope, hessian = gradient(np.zeros_like(inputs)), differences(gradient, 1e-2)
    cost(np.zeros_like(inputs))
    states[:], m.values[:] = w.states, w.values
    set_push(rho, m)
    assert (m.push > 0).any(axis=0).all() and (m.values < 0).any(axis=0)[:N].all()
    convex, steepest, along = find_step(path, task, m, exact, 0.0, w)
    assert convex
    tolerance = np.tile(objective.rate**-0.5, STEPS)
    assert steepest == pytest.approx(abs(slope * tolerance).max(), rel=1e-5)
    small = 1e-5
    follow(start, path, small, task, w)
    step = (w.inputs - inputs).ravel() / small
    assert along == pytest.approx(slope @ step, rel=1e-3)
    missing = abs(hessian @ step + slope).max() / abs(slope).max()
    assert missing < 1e-3 if exact else missing > 1e-3
