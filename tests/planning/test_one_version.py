"""Whatever arrays planners are given, their kernels, which take a minute to compile, are compiled once."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from conftest import make_system

from multilift_marl.diffmpc import weighted_planner
from multilift_marl.planning import distributed_planner, hard_planner, team_planner
from multilift_marl.planning.team_model import state_size
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sensing.communication import Links

N = 3
LINKS = Links(~np.eye(N, dtype=bool), 0, 0.0, np.inf)


@pytest.mark.parametrize(
    ("module", "planner", "kernel", "more"),
    [
        (team_planner, "TeamPlanner", "plan_teams", ()),
        (hard_planner, "HardPlanner", "solve_teams", ()),
        (distributed_planner, "DistributedPlanner", "plan_apart", (None, LINKS)),
        (weighted_planner, "WeightedPlanner", "plan_weighted", ()),
        (weighted_planner, "WeightedHardPlanner", "solve_weighted", ()),
    ],
)
def test_slices_and_what_cannot_be_written_are_no_other_types(module, planner, kernel, more, monkeypatch):
    seen = []
    monkeypatch.setattr(module, kernel, lambda *given: seen.append([numba.typeof(each) for each in given]))
    plans = getattr(module, planner)(make_system(N), PlannerConfig(), 1, *more)
    teams, k = len(plans.plans.states), len(plans.times)
    states, loads = np.zeros((teams, state_size(N) + 9)), np.zeros((teams, 7 + 3 * N))
    home, level = np.zeros((1, 1, 1, 3)), np.eye(3)[None, None, None]
    goal = [np.broadcast_to(part, (teams, k, 5, *part.shape[3:])) for part in (home, level)]
    offsets, shapes = np.zeros((teams, 2 * k, 12)), np.zeros((teams, 2 * k, 3, N, 3))
    plans.plan(states[:, :-9], *goal, 0.02, offsets[:, ::2], loads[:, :7], shapes[:, ::2])
    plans.plan(states[:, :-9].copy(), *map(np.array, goal), 0.02, offsets[:, :k].copy(), None, shapes[:, :k].copy())
    assert len(seen) == 2 and seen[0] == seen[1]
