"""Plans of E teams that converge within hard limits: targets, guesses, and the solver's call for each team."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.mdp.failures import make_limits as failure_limits
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.augmented_lagrangian import NOT_FINITE, Report, solve_team
from multilift_marl.planning.hard_limits import LimitedProblem, Limits, limit_names
from multilift_marl.planning.newton import Multipliers, NewtonWork, Trajectory
from multilift_marl.planning.riccati import Objective, Problem
from multilift_marl.planning.team_model import TeamModel
from multilift_marl.planning.team_planner import (
    PlannerWork,
    Plans,
    TeamPlanner,
    keep_targets,
    prepare_team,
    take_targets,
)
from multilift_marl.rig.system import System
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sim.obstacles import Obstacles

TOLERANCE = 1e-6  # largest KKT residual of a plan that has converged
MOST_ITERATIONS = 40
CABLE_TOLERANCE = 0.05  # [m] of their distance


class HardPlans(NamedTuple):
    """What plans within hard limits have beside `Plans`, of E teams."""

    multipliers: Multipliers
    """(E, K, L) each."""
    report: Report


class HardWork(NamedTuple):
    """Arrays that plans are made in."""

    planner: PlannerWork
    newton: NewtonWork

    @classmethod
    def of(cls, steps: int, n: int) -> HardWork:
        """Return arrays for K steps of N drones."""
        return cls(PlannerWork.of(steps, n), NewtonWork.of(steps, n, len(limit_names(n))))


def make_limits(settings: PlannerConfig, system: System, model: TeamModel, objective: Objective) -> Limits:
    """Return the hard limits of a team; what they count in are the tolerances of the soft ones."""
    rest = np.linalg.norm(system.formation_force + model.drone_mass[:, None] * [0, 0, GRAVITY], axis=1)
    return Limits(
        tension=objective.tension,
        largest=objective.thrust[:, 1].copy(),
        least=settings.least_thrust * rest,
        upright=float(np.cos(np.radians(settings.largest_tilt))),
        separation=objective.separation,
        cables=settings.cables * failure_limits(system).cables,
        tolerance=np.append(objective.weights**-0.5, CABLE_TOLERANCE),
    )


def make_hard_plans(num_envs: int, steps: int, n: int) -> HardPlans:
    """Return room for the plans of E teams of N drones."""
    shape = num_envs, steps, len(limit_names(n))
    return HardPlans(Multipliers(*(np.zeros(shape) for _ in range(4))), Report.of(num_envs))


class HardPlanner(TeamPlanner):
    """Plans of E teams within hard limits, each iterated from the last until it converges; see `TeamPlanner`.

    Obstacles do not count.

    Attributes:
        limits: of the team.
        hard: HardPlans, live.
    """

    def __init__(self, system: System, settings: PlannerConfig, num_envs: int, obstacles: Obstacles | None = None):
        super().__init__(system, settings, num_envs)
        n, steps = system.num_drones, settings.steps
        self.limits = make_limits(settings, system, self.model, self.objective)
        self.hard = make_hard_plans(num_envs, steps, n)
        self._newton = HardWork(self._work, NewtonWork.of(steps, n, len(limit_names(n))))

    def plan(
        self, states: np.ndarray, positions: np.ndarray, rotations: np.ndarray, elapsed: float,
        offsets: np.ndarray,
        loads: np.ndarray | None = None, shapes: np.ndarray | None = None,
    ) -> Plans:  # fmt: skip
        """Do as `TeamPlanner.plan`; how plans ended is in `hard.report`."""
        given = self._given(states, positions, rotations, offsets, loads, shapes)
        settings = elapsed, self.settings.step, self.settings.iterations or MOST_ITERATIONS, TOLERANCE
        team = self._flat, self.objective, self.limits, self.around
        solve_teams((0, len(states)), given, settings, team, self.plans, self.hard, self._newton)
        return self.plans


@kernel
def solve_teams(bounds, given, settings, team, plans, hard, w):
    """Solve for plans, each from its last plan or, if it is fresh, from its flat states.

    Args:
        bounds: the first of the teams, and the first after them.
        given: see `team_planner.plan_teams`.
        settings: time since the last plan [s], length of a step [s], most iterations, largest KKT residual.
        team: FlatTeam, Objective, Limits, Surroundings: none.
        plans: Plans, overwritten.
        hard: HardPlans, overwritten.
        w: HardWork.
    """
    elapsed, h, iterations, tolerance = settings
    flat, objective, limits, around = team
    starts, loads, _ = given
    all_multipliers, report = hard
    for e in range(bounds[0], bounds[1]):
        states, inputs, targets, asked = plans.states[e], plans.inputs[e], w.planner.targets, w.planner.asked
        prepare_team(e, given, (elapsed, h), flat, plans, w.planner)
        m = Multipliers(
            all_multipliers.values[e], all_multipliers.dual[e], all_multipliers.push[e], all_multipliers.stiffness[e]
        )
        _move_on(m.push, 0.0 if plans.fresh[e] else 1.0, elapsed / h, m.dual)
        task = LimitedProblem(Problem(targets, asked, h, flat.model, loads[e : e + 1], objective, around), limits)
        path, wanted = Trajectory(states, inputs), (tolerance, iterations)
        status, count = solve_team(starts[e], path, task, m, wanted, w.newton, report.residual[e])
        report.status[e], report.iterations[e] = status, count
        plans.failed[e] = report.status[e] == NOT_FINITE
        if plans.failed[e]:
            take_targets(states, inputs, targets, asked)
            m.push[:] = 0.0
        keep_targets(e, targets, plans)


@kernel
def _move_on(push, share, moved, dual):
    """Write a share of the multipliers `moved` steps later; the last ones stay."""
    steps = push.shape[0]
    for k in range(steps):
        at = min(k + moved, 1.0 * steps - 1.0)
        j = min(int(at), steps - 2)
        s = at - j
        for i in range(push.shape[1]):
            dual[k, i] = share * ((1.0 - s) * push[j, i] + s * push[j + 1, i])
