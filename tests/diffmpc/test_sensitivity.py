"""Derivatives of plans and of whole flights against differences: weights, targets, limits, starts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.diffmpc.sensitivity import Adjoint, Gradient, Tape, pull_plan_back, record, record_thrusts
from multilift_marl.diffmpc.weighted_planner import FlightGradient, WeightedHardPlanner, WeightedPlanner
from multilift_marl.planning.expert import TeamExpert
from multilift_marl.planning.riccati import IterationWork, Problem, find_gains, take_step
from multilift_marl.planning.team_model import ModelWork, state_size, step_state

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

STEPS, STEP, DT = 20, 0.05, 0.02


@pytest.fixture(scope="module")
def expert():
    return TeamExpert(ml.load_config("hover", {"env.num_drones": 3}))


class Plan(NamedTuple):
    """One iteration from a rough guess, with tensions and thrusts beyond their limits."""

    start: np.ndarray
    guess: tuple[np.ndarray, np.ndarray]
    targets: np.ndarray
    asked: np.ndarray


def rough_plan(expert):
    rng = np.random.default_rng(0)
    rest, nu = expert.rest_states(np.array([0.0, 0.0, 1.0]))[0], 9
    targets, asked = np.tile(rest, (STEPS + 1, 1)), np.zeros((STEPS, nu))
    guess = targets + 0.02 * rng.normal(size=targets.shape), 0.1 * rng.normal(size=asked.shape)
    start = rest.copy()
    start[:3] += 0.2, -0.1, 0.3
    objective = expert.objective
    tight = objective._replace(tension=20 * objective.tension, thrust=objective.thrust * [1.0, 0.4])
    return Plan(start, guess, targets, asked), tight


def iterate(expert, plan, objective, w, tape=None):
    states, inputs = (each.copy() for each in plan.guess)
    problem = Problem(plan.targets, plan.asked, STEP, expert.model, np.zeros((1, 7)), objective, expert.around)
    if tape is not None:
        record_thrusts(0, 0, states, problem, tape)
    find_gains(states, inputs, problem, 0.0, w)
    take_step(plan.start, states, inputs, problem, w)
    if tape is not None:
        record(0, 0, states, inputs, problem, w, tape)
    return inputs[0]


def test_derivatives_of_an_iteration_are_differences_of_it(expert):
    plan, objective = rough_plan(expert)
    w, tape, gradient = IterationWork.of(STEPS, 3), Tape.of(1, 1, STEPS, 3), Gradient.of(1, 1, STEPS, 3)
    iterate(expert, plan, objective, w, tape)
    assert (tape.pushing > 0).sum() > 10
    assert (abs(tape.beyond).max(axis=-1) > 0).sum() > 10
    v = np.random.default_rng(1).normal(size=9)
    weights = objective.state, objective.end, objective.rate
    pull_plan_back(0, 0, v.copy(), STEP, weights, Adjoint(tape, w, gradient))

    def change(name, at):
        values = []
        for sign in (1, -1):
            whole = getattr(objective if hasattr(objective, name) else plan, name).copy()
            step = sign * 1e-4 * max(abs(whole[at]), 1e-3)
            whole[at] += step
            own = objective._replace(**{name: whole}) if hasattr(objective, name) else objective
            mine = plan if hasattr(objective, name) else plan._replace(**{name: whole})
            values.append(v @ iterate(expert, mine, own, w))
        return (values[0] - values[1]) / (2 * abs(step))

    found = {
        "state": gradient.state[0, 0], "end": gradient.end[0, 0], "rate": gradient.rate[0, 0],
        "tension": gradient.tension[0, 0], "start": v @ tape.gain[0, 0, 0], "targets": gradient.targets[0, 0],
        "asked": gradient.asked[0, 0],
    }  # fmt: skip
    for name, got in found.items():
        places = list(np.ndindex(got.shape))[:: max(1, got.size // 40)]
        expected = np.array([change(name, at) for at in places])
        assert abs(expected).max() > 1e-3, name
        assert np.array([got[at] for at in places]) == pytest.approx(expected, abs=2e-5 * abs(expected).max()), name
    assert gradient.thrust[0, 0] == pytest.approx([change("thrust", (n, 1)) for n in range(3)], rel=1e-6)


class Flight:
    """Flights on the planner's model, by plans that follow a moving target."""

    def __init__(self, n, hard, steps=20):
        config = ml.load_config("hover", {"env.num_drones": n, "planner.limits": "hard" if hard else "soft"})
        make = WeightedHardPlanner if hard else WeightedPlanner
        self.planner, self.expert, self.steps = make(config.system, config.planner, 1), TeamExpert(config), steps
        self.size = state_size(n)
        self.start = self.expert.rest_states(np.array([0.0, 0.0, 1.0]))[0]
        self.start[:3] += 0.05, -0.03, 0.04
        self.loss = np.zeros(self.size)
        self.loss[:3], self.loss[3:6], self.loss[6 + 2 * n : 9 + 2 * n] = 100.0, 10.0, 1.0
        self.work, self.nominal = ModelWork.of(n), [each.copy() for each in self.planner.weights]

    def target(self, t):
        return np.stack([np.sin(1.5 * t), 0.4 * np.sin(3 * t), 1 + 0.2 * np.sin(t)], axis=-1)

    def fly(self, change=None, start=None, gradient=None):
        """Return the cost of a flight whose plans weigh numbers of the state by factors `change`, and its slope."""
        planner = self.planner
        for mine, nominal in zip(planner.weights, self.nominal, strict=True):
            mine[:] = nominal
        if change is not None:
            planner.weights.state[:] *= change
        planner.plans.fresh[:] = True
        x, states = (self.start if start is None else start).copy(), []
        turned, offsets = np.tile(np.eye(3), (1, *planner.times.shape, 1, 1)), np.zeros((1, STEPS + 1, 12))
        for t in range(self.steps + (gradient is not None)):
            planner.slot = t
            plans = planner.plan(x[None].copy(), self.target(DT * t + planner.times)[None], turned, DT, offsets)
            if gradient is not None:
                for kept, mine in zip(gradient.weights, planner.weights, strict=True):
                    kept[t] = mine
            after = np.zeros(self.size)
            step_state(x, plans.inputs[0, 0], DT, planner.model, np.zeros(7), self.work, after)
            x = after
            states.append(x)
        off = np.array(states)[: self.steps]
        off[:, :3] -= self.target(DT * np.arange(1, self.steps + 1))
        slopes = np.vstack([np.zeros(self.size), self.loss * off])
        return 0.5 * (self.loss * off**2).sum(), slopes

    def gradient(self):
        found = FlightGradient(self.planner, self.steps, DT)
        slopes = self.fly(gradient=found)[1]
        gradient = found.find(slopes[None])
        self.planner.tape = None
        return gradient


def test_derivatives_of_a_flight_within_hard_limits_are_exact():
    flight = Flight(3, hard=True)
    gradient = flight.gradient()
    assert not flight.planner.tape
    assert (flight.planner.hard.multipliers.dual > 1e-6).any()  # limits are active
    by_weight = (gradient.state * flight.nominal[0]).sum(axis=(0, 1))
    rng = np.random.default_rng(0)
    for _ in range(2):
        along = rng.normal(size=flight.size)
        high, low = (flight.fly(np.exp(sign * 1e-4 * along))[0] for sign in (1, -1))
        # The derivative by the weights at the end is not changed along.
        assert by_weight @ along == pytest.approx((high - low) / 2e-4, rel=1e-3)
        aside = rng.normal(size=flight.size)
        high, low = (flight.fly(start=flight.start + sign * 1e-5 * aside)[0] for sign in (1, -1))
        assert gradient.starts[0] @ aside == pytest.approx((high - low) / 2e-5, rel=1e-3)


def test_derivatives_of_a_flight_of_single_iterations_point_the_same_way():
    """What iterations owe to their guess is left out: near the targets little."""
    flight = Flight(3, hard=False)
    by_weight = (flight.gradient().state * flight.nominal[0]).sum(axis=(0, 1))
    groups = [slice(0, 3), slice(3, 6), slice(6, 12), slice(12, 15), slice(15, 18), slice(18, 24), slice(24, 33)]
    expected, found = [], []
    for group in groups:
        change = np.ones((2, flight.size))
        change[0, group], change[1, group] = np.exp(1e-3), np.exp(-1e-3)
        expected.append((flight.fly(change[0])[0] - flight.fly(change[1])[0]) / 2e-3)
        found.append(by_weight[group].sum())
    alike = np.dot(expected, found) / (np.linalg.norm(expected) * np.linalg.norm(found))
    assert alike > 0.98


def test_nothing_goes_back_through_the_end_of_an_episode():
    flight = Flight(3, hard=False)
    found = FlightGradient(flight.planner, flight.steps, DT)
    slopes = flight.fly(gradient=found)[1][None]
    slopes[0, :11] = 0.0
    found.tape.cut[9] = True  # the state after step 9 is of another episode
    gradient = found.find(slopes)
    assert not gradient.state[:10].any()
    assert not gradient.starts.any()
    assert gradient.state[10:].any()


def test_a_tape_takes_as_much_memory_as_is_said():
    assert Tape.nbytes(5, 2, 7, 3) == sum(array.nbytes for array in Tape.of(5, 2, 7, 3))
