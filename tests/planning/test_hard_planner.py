"""Plans within hard limits: their optimality, what is infeasible, warm starts; and flights with them."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.planning.augmented_lagrangian import STATUS
from multilift_marl.planning.expert import COSTS, TeamExpert
from multilift_marl.planning.goals import pose_goal
from multilift_marl.planning.hard_planner import HardPlanner
from multilift_marl.planning.team_model import ModelWork, step_state
from multilift_marl.policies.baselines import make_scripted

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

HOME = np.array([0.0, 0.0, 1.0])
N = 3


@pytest.fixture(scope="module")
def expert():
    return TeamExpert(ml.load_config("hover", {"env.num_drones": N}))


@pytest.fixture(scope="module")
def plans(expert):
    return expert.solve(expert.random_states(12), pose_goal(expert.times, HOME))


def test_plans_from_cold_starts_converge_and_follow_the_model(expert, plans):
    assert plans.converged.all() and (plans.iterations <= 40).all() and (plans.residual <= 1e-6).all()
    after, m = np.zeros(12 + 7 * N), ModelWork.of(N)
    for e in range(len(plans.states)):
        for k in range(plans.inputs.shape[1]):
            step_state(plans.states[e, k], plans.inputs[e, k], 0.05, expert.model, np.zeros(7), m, after)
            assert after == pytest.approx(plans.states[e, k + 1], abs=1e-12)
            pull = (m.tension - expert.limits.tension) / expert.limits.tolerance[0]
            assert plans.margins[e, k, :N] == pytest.approx(pull, abs=1e-9)


def test_no_limit_is_exceeded_and_several_hold_plans_back(expert, plans):
    thrust = plans.states[:, 1:, -3 * N :].reshape(12, -1, N, 3)
    size = np.linalg.norm(thrust, axis=-1)
    assert (size <= expert.limits.largest + 1e-6).all() and (size >= expert.limits.least - 1e-6).all()
    assert (thrust[..., 2] / size >= expert.limits.upright - 1e-6).all()
    assert (plans.margins >= -1e-6).all() and (plans.multipliers >= 0).all()
    kinds = {expert.limit_names[i].rsplit("_", 1)[0] for i in np.flatnonzero(plans.active.any(axis=(0, 1)))}
    assert {"tension", "largest_thrust"} <= kinds


def test_multipliers_say_what_wider_limits_are_worth(expert, plans):
    e = int(np.argmax(plans.multipliers.max(axis=(1, 2))))
    wider = TeamExpert(ml.load_config("hover", {"env.num_drones": N}))
    share = 0.01
    limits, tolerance = wider.limits, wider.limits.tolerance
    wider.limits = limits._replace(
        tension=limits.tension - share * tolerance[0], largest=limits.largest + share * tolerance[1]
    )
    other = wider.solve(plans.states[e, 0], pose_goal(expert.times, HOME))
    gained = plans.costs[e].sum() - other.costs.sum()
    worth = plans.multipliers[e, :, : 2 * N].sum() * share
    assert worth > 1e-4 and gained == pytest.approx(worth, rel=0.05)


def test_costs_are_those_of_the_objective(expert, plans):
    off, objective = plans.states - plans.targets, expert.objective
    total = 0.5 * 0.05 * (objective.state * off[:, :-1] ** 2).sum(axis=(1, 2))
    total += 0.5 * (objective.end * off[:, -1] ** 2).sum(axis=1)
    total += 0.5 * 0.05 * (objective.rate * plans.inputs**2).sum(axis=(1, 2))
    assert plans.costs.shape == (12, len(COSTS)) and plans.costs.sum(axis=1) == pytest.approx(total)


def test_warm_starts_take_fewer_iterations_to_the_same_plan(expert, plans):
    goal = pose_goal(expert.times, HOME)
    warm = expert.solve(plans.states[:, 1], goal, last=plans, elapsed=0.05)
    cold = expert.solve(plans.states[:, 1], goal)
    assert warm.converged.all() and warm.iterations.sum() < 0.7 * cold.iterations.sum()
    same = np.isclose(warm.costs.sum(axis=1), cold.costs.sum(axis=1), rtol=1e-6)
    assert same.mean() > 0.9  # a team may have another local minimum


def test_the_planner_of_flights_finds_the_experts_plans(expert, plans):
    config = ml.load_config("hover", {"env.num_drones": N})
    planner = HardPlanner(config.system, config.planner, 12)
    goal, offsets = pose_goal(expert.times, HOME), np.zeros((12, len(expert.times), 12))
    motion = (np.repeat(part, 12, axis=0) for part in goal)
    found = planner.plan(plans.states[:, 0].copy(), *motion, 0.02, offsets)
    assert np.array_equal(found.inputs, plans.inputs) and not found.failed.any()
    assert np.array_equal(planner.hard.report.iterations, plans.iterations)


def test_a_plan_that_is_not_finite_says_so_and_begins_anew(plans):
    config = ml.load_config("hover", {"env.num_drones": N})
    planner, states = HardPlanner(config.system, config.planner, 2), plans.states[:2, 0].copy()
    goal = pose_goal(planner.times, np.tile(HOME, (2, 1)))
    states[1, 0] = np.nan
    broken = planner.plan(states, *goal, 0.02, np.zeros((2, len(planner.times), 12)))
    assert broken.failed.tolist() == [False, True] and np.isfinite(broken.inputs).all()
    assert STATUS[planner.hard.report.status[1]] == "not finite" and np.isinf(planner.hard.report.residual[1]).all()
    states[1] = plans.states[1, 0]
    again = planner.plan(states, *goal, 0.02, np.zeros((2, len(planner.times), 12)))
    assert not again.failed.any() and (planner.hard.report.status == 0).all()


def test_what_is_infeasible_ends_with_that_status_and_finite_plans():
    far = {"planner.separation": 10.0, "planner.iterations": 60}  # farther apart than cables reach
    expert = TeamExpert(ml.load_config("hover", {"env.num_drones": N} | far))
    plans = expert.solve(expert.random_states(2), pose_goal(expert.times, HOME))
    assert plans.status_names == ["infeasible"] * 2 and not plans.converged.any()
    assert np.isfinite(plans.states).all() and (plans.residual[:, 1] > 1).all()


def test_few_iterations_stop_and_say_so():
    expert = TeamExpert(ml.load_config("hover", {"env.num_drones": N, "planner.iterations": 2}))
    plans = expert.solve(expert.random_states(4), pose_goal(expert.times, HOME))
    assert set(plans.status_names) <= set(STATUS[1:3]) and (plans.iterations == 2).all()


@pytest.mark.parametrize("n, count, share", [(3, 20, 0.9), (6, 8, 0.75)])
def test_plans_from_cold_starts_cost_what_ipopt_finds(n, count, share):
    """Where the costs differ both are local minima: IPOPT, started from the plan, stays there."""
    pytest.importorskip("casadi")
    from oracle import Oracle

    expert = TeamExpert(ml.load_config("hover", {"env.num_drones": n}))
    starts = expert.random_states(count)
    plans = expert.solve(starts, pose_goal(expert.times, HOME))
    oracle = Oracle(expert, expert.rest_states(HOME)[0])
    costs = plans.costs.sum(axis=1)
    found = [oracle.solve(start) for start in starts]
    same = np.array([ok and abs(cost / c - 1) < 1e-4 for (cost, ok), c in zip(found, costs, strict=True)])
    assert plans.converged.sum() >= count - 1 and same.mean() >= share
    for e in np.flatnonzero(plans.converged & ~same):
        cost, ok = oracle.stay(plans, e)
        assert ok and cost == pytest.approx(costs[e], rel=1e-4)


def test_flights_with_hard_limits_are_as_accurate():
    acting = {"control.action": "acc_rates", "control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0}
    fast = {"task_options.speed": 2.0, "task_options.acceleration": 4.0, "task_options.rmse_from": 3.0}
    config = ml.load_config(
        "track", acting | fast | {"planner.limits": "hard", "env.episode_seconds": 6.0, "env.num_threads": 1}
    )
    result = run_episodes(config, lambda vec: make_scripted("mpc", vec), 2, 77)
    assert (result["payload_rmse_m"] < 0.0025).all()
