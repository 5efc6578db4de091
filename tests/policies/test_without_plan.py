"""What policy=mpc does without a plan: it flies on by the last one, then by a linear baseline, and says so."""

from __future__ import annotations

import numpy as np
import pytest
from test_mpc import BY_RATES, FAST

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.metrics import compare, summarize
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.planning.team_planner import Plans
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.last_plan import NEVER, LastPlan

pytestmark = pytest.mark.slow  # its planner takes a minute to compile


def fly(config, make, seconds=6.0, episodes=2, **overrides):
    loaded = load_config(config, BY_RATES | overrides | {"env.episode_seconds": seconds, "env.num_threads": 1})
    return run_episodes(loaded, make, episodes, 77)


def failing(first, last, spoil):
    """Return what makes mpc with `spoil` called between two times [s] of each step's plan."""

    def make(vec):
        policy = make_scripted("mpc", vec)
        measure, plan, update = policy._measure, policy.planner.plan, policy._estimator.update

        def now():
            return first <= vec.task.time[0] < last

        def measured():
            found = measure()
            if now() and spoil == "states":
                for array in found:
                    array[:] = np.nan
            return found

        def planned(*arguments):
            plans = plan(*arguments)
            if now() and spoil == "plans":
                plans.states[:] = np.nan
                plans.failed[:] = True
            return plans

        def estimated(*arguments):
            update(*arguments)
            if now() and spoil in ("unknowns", "covariance"):  # as an estimate that swings up becomes at last
                getattr(policy._estimator.estimate, spoil)[:] = np.nan

        policy._measure, policy.planner.plan, policy._estimator.update = measured, planned, estimated
        return policy

    return make


@pytest.mark.parametrize("spoil", ["plans", "states", "unknowns", "covariance"])
def test_for_a_while_it_flies_by_the_last_plan(spoil):
    result = fly("track", failing(4.0, 4.3, spoil), **FAST)
    # 0.3 of 6 s, and a first plan anew; an estimate that begins anew takes a step without one, which spoils nothing
    assert result["planner_failed"] == pytest.approx(0.027 if spoil == "covariance" else 0.05, abs=0.01)
    assert not result["planner_late"].any()
    assert (result["payload_rmse_m"] < 0.02).all()
    assert (result["failure_cause"] == 0).all()


def test_so_it_does_by_full_states():
    wide = {"max_offset": 2.0, "max_velocity": 5.0, "max_acceleration": 25.0, "max_jerk": 300.0, "max_cable_force": 5.0}
    settings = FAST | {f"control.{key}": value for key, value in wide.items()} | {"control.action": "full_state"}
    for last in (4.3, 5.5):  # by the last plan; then by the baseline
        result = fly("track", failing(4.0, last, "states"), **settings)
        assert (result["failure_cause"] == 0).all()
        assert result["planner_failed"] == pytest.approx((last - 4.0) / 6.0, abs=0.01)


def test_after_that_a_linear_baseline_flies():
    result = fly("hover", failing(2.0, 4.0, "plans"), seconds=8.0)
    assert result["planner_failed"] == pytest.approx(2 / 8, abs=0.01)
    assert result["success_rate"].all()


def test_plans_that_are_always_late_are_never_flown():
    late = fly("hover", lambda vec: make_scripted("mpc", vec), 2.0, **{"planner.deadline": 1e-4, "planner.steps": 200})
    assert (late["planner_late"] == 1.0).all()
    baseline = fly("hover", lambda vec: make_scripted("hold_acc_rates", vec), 2.0)
    assert np.array_equal(late["return"], baseline["return"])
    assert "planner_late" in summarize(late) and "planner_late" not in compare(late, baseline)


def test_a_plan_is_read_at_its_age_and_ends():
    states = np.arange(4.0)[None, :, None] ** 2 * np.ones(5)
    plans = Plans(states, np.diff(states, axis=1)[..., :3], states, np.zeros(1, bool), np.zeros(1, bool))
    last, good, bad = LastPlan(plans, 0.5, 0.25), np.zeros(1, bool), np.ones(1, bool)
    assert last.without == NEVER
    last.keep(plans, False, good)
    assert last.states()[0, 0] == 0 and last.inputs()[0, 0] == 1
    for k, (state, change) in enumerate([(0.5, 1), (1, 3), (2.5, 3), (4, 5), (6.5, 5), (9, 0), (9, 0)], 1):
        last.keep(plans, False, bad)
        assert last.states()[0, 0] == pytest.approx(state) and last.inputs()[0, 0] == change
        assert last.without[0] == pytest.approx(0.25 * k)
    assert last.metrics()["planner_failed"][0] == pytest.approx(7 / 8)
    assert last.states(-0.25)[0, 0] == pytest.approx(9)


def test_where_a_team_is_planned_to_be_next_is_where_the_plan_for_then_begins():
    """Plans that begin two steps after they are made, by the numbers of those steps."""
    shape = np.zeros((1, 4, 5))
    plans = Plans(shape, shape[:, 1:, :3], shape, np.zeros(1, bool), np.zeros(1, bool))
    last, good, bad = LastPlan(plans, 0.25, 0.25, 2), np.zeros(1, bool), np.ones(1, bool)
    for step in range(5):
        plans.states[:] = step + 2.0 + np.arange(4.0)[None, :, None]  # a state is the number of its step
        last.keep(plans, False, good)
        assert last.next()[0, 0] == max(step + 1.0, 2.0)  # the first plan tells of no earlier one
    last.keep(plans, False, bad)
    assert last.next()[0, 0] == 6.0
    last.keep(plans, False, bad)
    assert last.next()[0, 0] == 7.0  # where the last sound plan goes on
    assert LastPlan(plans, 0.25, 0.25).next()[0, 0] == 0.0
