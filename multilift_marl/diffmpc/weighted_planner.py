"""Plans of E teams, each by weights of its own, which can be learned: plans leave what their derivatives need."""

from __future__ import annotations

from typing import Any

import numpy as np

from multilift_marl.diffmpc.sensitivity import (
    Adjoint,
    Gradient,
    Tape,
    pull_flight_back,
    record,
    record_converged,
    record_thrusts,
)
from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.augmented_lagrangian import CONVERGED
from multilift_marl.planning.hard_limits import LimitedProblem
from multilift_marl.planning.hard_planner import MOST_ITERATIONS, TOLERANCE, HardPlanner, solve_teams
from multilift_marl.planning.newton import Multipliers, Trajectory
from multilift_marl.planning.riccati import IterationWork, Problem
from multilift_marl.planning.soft_limits import Surroundings
from multilift_marl.planning.team_planner import Plans, TeamPlanner, improve, prepare_team
from multilift_marl.planning.team_weights import TeamWeights, weigh
from multilift_marl.rig.system import System
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sim.obstacles import Obstacles


class WeightedPlanner(TeamPlanner):
    """Plans of E teams within soft limits; see `TeamPlanner`.

    Attributes:
        weights: TeamWeights, live.
        tape: of the last steps, to which plans are written; None: they are not.
        slot: of the tape that the next plans are written to.
    """

    def __init__(self, system: System, settings: PlannerConfig, num_envs: int, obstacles: Obstacles | None = None):
        super().__init__(system, settings, num_envs, obstacles)
        self.weights = TeamWeights.of(self.objective, num_envs)
        self.tape: Tape | None = None
        self.slot = 0
        self._none = Tape.of(0, 0, settings.steps, system.num_drones)

    def plan(
        self, states: np.ndarray, positions: np.ndarray, rotations: np.ndarray, elapsed: float,
        offsets: np.ndarray,
        loads: np.ndarray | None = None, shapes: np.ndarray | None = None,
    ) -> Plans:  # fmt: skip
        """See `TeamPlanner.plan`."""
        given = self._given(states, positions, rotations, offsets, loads, shapes)
        tape = self._none if self.tape is None else self.tape
        self._plan(given, elapsed, (self.slot, tape))
        if self.tape is not None:
            tape.states[:, self.slot], tape.inputs[:, self.slot] = states, self.plans.inputs[:, 0]
            tape.loads[:, self.slot] = given[1]
        return self.plans

    def _plan(self, given: tuple[Any, ...], elapsed: float, recorded: tuple[int, Tape]) -> None:
        settings = elapsed, self.settings.step, self.settings.iterations or 1
        team = self._flat, self.objective, self.weights, self.around
        plan_weighted(given, settings, team, self.plans, self._work, recorded)


class WeightedHardPlanner(WeightedPlanner, HardPlanner):
    """The same within hard limits: plans converge, and derivatives are exact."""

    def _plan(self, given: tuple[Any, ...], elapsed: float, recorded: tuple[int, Tape]) -> None:
        settings = elapsed, self.settings.step, self.settings.iterations or MOST_ITERATIONS, TOLERANCE
        team = self._flat, self.objective, self.weights, self.limits, self.around
        solve_weighted(given, settings, team, self.plans, self.hard, self._newton, recorded)


@kernel
def plan_weighted(given, settings, team, plans, work, recorded):
    """See `team_planner.plan_teams`, with TeamWeights after the objective, and slot and Tape that plans are written to.

    A tape of no steps is not written to.
    """
    elapsed, h, iterations = settings
    flat, objective, weights, around = team
    starts, loads, _ = given
    t, tape = recorded
    for e in range(starts.shape[0]):
        prepare_team(e, given, (elapsed, h), flat, plans, work)
        here = Surroundings(e, around.obstacles, around.ahead, around.points, around.others)
        own = weigh(e, weights, objective)
        problem = Problem(work.targets, work.asked, h, flat.model, loads[e : e + 1], own, here)
        if tape.gain.shape[0] == 0:
            improve(e, starts[e], problem, iterations, plans, work)
            continue
        if iterations > 1:
            improve(e, starts[e], problem, iterations - 1, plans, work)
        record_thrusts(t, e, plans.states[e], problem, tape)
        improve(e, starts[e], problem, 1, plans, work)
        record(t, e, plans.states[e], plans.inputs[e], problem, work.iteration, tape)
        tape.cut[t, e] = plans.failed[e]


@kernel
def solve_weighted(given, settings, team, plans, hard, w, recorded):
    """See `hard_planner.solve_teams`, with TeamWeights after the objective; and `plan_weighted`."""
    flat, objective, weights, limits, around = team
    t, tape = recorded
    for e in range(given[0].shape[0]):
        own = weigh(e, weights, objective)
        solve_teams((e, e + 1), given, settings, (flat, own, limits, around), plans, hard, w)
        if tape.gain.shape[0] == 0:
            continue
        each = hard.multipliers
        m = Multipliers(each.values[e], each.dual[e], each.push[e], each.stiffness[e])
        problem = Problem(w.planner.targets, w.planner.asked, settings[1], flat.model, given[1][e : e + 1], own, around)
        path = Trajectory(plans.states[e], plans.inputs[e])
        convex = record_converged(t, e, path, LimitedProblem(problem, limits), m, w.newton, tape)
        tape.cut[t, e] = not convex or hard.report.status[e] != CONVERGED


class FlightGradient:
    """Derivatives of flights of E teams over T policy steps, by the weights of each of their plans.

    Args:
        planner: that plans, whose `tape` this makes, with a slot more: for where flights end.
        steps: T.
        dt: policy step [s].
        response, lead: of the rotors to what plans command, see `sensitivity.py`; None: as the model's inputs.

    Attributes:
        tape: Tape.
        weights: (T + 1, E, ...) TeamWeights of these plans, to be written.
        gradient: Gradient of the T plans.
    """

    def __init__(
        self, planner: WeightedPlanner, steps: int, dt: float, response: float = 1.0, lead: float | None = None
    ):
        num_envs, horizon = len(planner.plans.states), planner.settings.steps
        n = len(planner.model.anchors)
        self.tape = planner.tape = Tape.of(steps + 1, num_envs, horizon, n)
        self.weights = TeamWeights(*(np.zeros((steps + 1, *each.shape)) for each in planner.weights))
        self.gradient = Gradient.of(steps, num_envs, horizon, n)
        self._planner = planner
        self._times = dt, planner.settings.step, response, dt / response if lead is None else lead
        self._work = IterationWork.of(horizon, n)

    def find(self, costs: np.ndarray) -> Gradient:
        """Return the gradient, live, of a cost with derivatives (E, T + 1, 12 + 7 N) by the states of the flights."""
        tape, planner = self.tape, self._planner
        used = tape._replace(inputs=tape.inputs[:, :-1].copy())
        around = planner.objective, planner.around
        adjoint = Adjoint(used, self._work, self.gradient)
        pull_flight_back(costs, self._times, self.weights, planner.model, around, adjoint)
        return self.gradient
