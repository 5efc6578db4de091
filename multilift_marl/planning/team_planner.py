"""Trajectories of E teams by model-predictive control: the plans, warm-started from step to step.

A plan follows the flat states of the payload's motion ahead (`flatness.py`), by Gauss-Newton iterations (`riccati.py`)
from the present state. The next plan begins with the last one's deviation from its reference, moved on in time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.flatness import (
    SAMPLES,
    STEP,
    FlatMotion,
    FlatWork,
    make_flat_team,
    set_flat_state,
    steady_shape,
)
from multilift_marl.planning.riccati import IterationWork, Objective, Problem, find_gains, take_step
from multilift_marl.planning.soft_limits import Surroundings, make_points
from multilift_marl.planning.team_model import TeamModel, make_model, state_size, step_state
from multilift_marl.rig.system import System
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sim.obstacles import Obstacles

LIMIT_TOLERANCES = 0.03, 0.1  # of thrust over the thrust at rest [-], of separation [m]


class Plans(NamedTuple):
    """The plans of E teams."""

    states: np.ndarray
    """(E, K + 1, 12 + 7 N), see `team_model.py`."""
    inputs: np.ndarray
    """(E, K, 3 N) change of the thrust vectors [N/s]."""
    targets: np.ndarray
    """(E, K + 1, 12 + 7 N) flat states that they follow."""
    fresh: np.ndarray
    """(E,) bool, teams without a plan: theirs begins as the flat states."""
    failed: np.ndarray
    """(E,) bool, teams whose last plan was not finite: it has begun anew from the flat states."""


def make_objective(settings: PlannerConfig, system: System, model: TeamModel) -> Objective:
    """Return weights and limits of a team in SI units."""
    n = system.num_drones
    rest = np.linalg.norm(system.formation_force + model.drone_mass[:, None] * [0, 0, GRAVITY], axis=1)
    each = np.repeat(rest, 3)
    tilt, swing = np.radians(settings.attitude), np.radians(settings.cable)
    tolerances = np.concatenate(
        [
            np.full(3, settings.position), np.full(3, tilt), np.full(2 * n, swing), np.full(3, settings.velocity),
            np.full(3, settings.body_rates), np.full(2 * n, settings.cable_rates), settings.thrust * each,
        ]
    )  # fmt: skip
    weights = tolerances**-2.0
    pull = np.linalg.norm(system.formation_force, axis=1)
    largest = settings.largest_thrust * np.array([4 * vehicle.rotor_thrust_max for vehicle in system.vehicles])
    thrust, apart = LIMIT_TOLERANCES
    return Objective(
        state=weights,
        end=settings.end * weights,
        rate=(settings.thrust_rate * each) ** -2.0,
        tension=settings.least_tension * pull,
        thrust=np.stack([np.zeros(n), largest], axis=1),
        separation=settings.separation * system.min_separation,
        weights=np.array([(settings.tension * pull.mean()) ** -2.0, (thrust * rest.mean()) ** -2.0, apart**-2.0]),
    )


def make_surroundings(
    settings: PlannerConfig, system: System, model: TeamModel, obstacles: Obstacles | None = None
) -> Surroundings:
    """Return what the first team is to stay clear of; None: nothing."""
    if obstacles is None:
        obstacles = Obstacles.zeros(1, 0)
    points = make_points(settings, system, model)
    return Surroundings(0, obstacles, settings.delay, points, np.zeros((settings.steps + 1, 0, 4)))


class TeamPlanner:
    """Plans of E teams.

    Args:
        system: of the teams, nominal.
        settings: section `planner` of the configuration.
        num_envs: E.
        obstacles: of the teams, live; None: none.

    Attributes:
        model, objective: of the team.
        times: (K + 1, 5) of the payload's poses that `plan` takes, from the start of a plan [s].
        plans: Plans, live.
    """

    def __init__(self, system: System, settings: PlannerConfig, num_envs: int, obstacles: Obstacles | None = None):
        self.settings, n, steps = settings, system.num_drones, settings.steps
        self.model = make_model(system)
        self.objective = make_objective(settings, system, self.model)
        self.times = settings.step * np.arange(steps + 1)[:, None] + STEP * (np.arange(SAMPLES) - SAMPLES // 2)
        size, e = state_size(n), num_envs
        self.plans = Plans(
            np.zeros((e, steps + 1, size)), np.zeros((e, steps, 3 * n)), np.zeros((e, steps + 1, size)),
            np.ones(e, bool), np.zeros(e, bool),
        )  # fmt: skip
        self._flat = make_flat_team(self.model, system)
        self._work = PlannerWork.of(steps, n)
        self._unloaded = np.zeros((e, 7))
        self.around = make_surroundings(settings, system, self.model, obstacles)
        self._steady = steady_shape(self._flat)[None, None]

    def plan(
        self, states: np.ndarray, positions: np.ndarray, rotations: np.ndarray, elapsed: float,
        offsets: np.ndarray,
        loads: np.ndarray | None = None, shapes: np.ndarray | None = None,
    ) -> Plans:  # fmt: skip
        """Plan on from the present states, and return the live plans.

        Args:
            states: (E, 12 + 7 N) where plans begin.
            positions: (E, K + 1, 5, 3) of the payload's target, at `times` from then on [m].
            rotations: (E, K + 1, 5, 3, 3) its attitude.
            elapsed: time since the last plan [s].
            offsets: (E, K + 1, 12) of the target states, see `approach.write_approaches`.
            loads: (E, 7) on the payload, see `team_model.accelerations`; None for none.
            shapes: (E, K + 1, 3, N, 3) the formation's nominal forces, see `flatness.set_flat_state`; None: as at rest.
        """
        given = self._given(states, positions, rotations, offsets, loads, shapes)
        settings = elapsed, self.settings.step, self.settings.iterations or 1
        plan_teams(given, settings, (self._flat, self.objective, self.around), self.plans, self._work)
        return self.plans

    def predict(self, states: np.ndarray, thrusts: np.ndarray, dt: float, loads: np.ndarray | None = None) -> None:
        """Move states (E, 12 + 7 N) on by the thrust vectors (T, E, 3 N) that were commanded, `dt` [s] apart."""
        loads = self._unloaded if loads is None else np.ascontiguousarray(loads)
        predict_states(states, thrusts, dt, self.model, loads, self._work)

    def _given(
        self, states: np.ndarray, positions: np.ndarray, rotations: np.ndarray, offsets: np.ndarray,
        loads: np.ndarray | None, shapes: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:  # fmt: skip
        """Return what kernels take of `plan`, in one layout: for any other they would be compiled anew, a minute."""
        loads = self._unloaded if loads is None else loads
        shapes = self._steady if shapes is None else shapes
        parts = states, loads, positions, rotations, shapes, offsets
        states, loads, *targets = (np.require(part, float, ["C", "W"]) for part in parts)
        return states, loads, tuple(targets)


class PlannerWork(NamedTuple):
    """Arrays that plans are made in."""

    iteration: IterationWork
    flat: FlatWork
    targets: np.ndarray
    asked: np.ndarray
    before: np.ndarray

    @classmethod
    def of(cls, steps: int, n: int) -> PlannerWork:
        """Return arrays for K steps of N drones."""
        shape = steps + 1, state_size(n)
        return cls(
            IterationWork.of(steps, n), FlatWork.of(n), np.zeros(shape), np.zeros((steps, 3 * n)), np.zeros(shape)
        )


@kernel
def plan_teams(given, settings, team, plans, work):
    """See `TeamPlanner.plan`.

    Args:
        given: states, loads, and positions, rotations, shapes and offsets of the motion; one shape may do for all
            steps, or for all teams.
        settings: time since the last plan [s], length of a step [s], iterations.
        team: FlatTeam, Objective, Surroundings.
        plans: Plans, overwritten.
        work: PlannerWork.
    """
    elapsed, h, iterations = settings
    flat, objective, around = team
    starts, loads, _ = given
    for e in range(starts.shape[0]):
        prepare_team(e, given, (elapsed, h), flat, plans, work)
        here = Surroundings(e, around.obstacles, around.ahead, around.points, around.others)
        problem = Problem(work.targets, work.asked, h, flat.model, loads[e : e + 1], objective, here)
        improve(e, starts[e], problem, iterations, plans, work)


@kernel
def improve(e, start, problem, iterations, plans, work):
    """Iterate on the plan of team e, after `prepare_team`."""
    states, inputs, targets, asked = plans.states[e], plans.inputs[e], work.targets, work.asked
    _iterate(start, states, inputs, problem, iterations, work)
    plans.failed[e] = not is_finite(states, inputs)
    if plans.failed[e]:  # again from the flat states; at last these themselves
        take_targets(states, inputs, targets, asked)
        _iterate(start, states, inputs, problem, 1, work)
        if not is_finite(states, inputs):
            take_targets(states, inputs, targets, asked)
    keep_targets(e, targets, plans)


@kernel
def prepare_team(e, given, times, flat, plans, work):
    """Write targets and inputs asked for to `work`, and a guess to the plan of team e: the last one, moved on."""
    starts, loads, (positions, rotations, shapes, offsets) = given
    elapsed, h = times
    states, inputs, targets, asked = plans.states[e], plans.inputs[e], work.targets, work.asked
    steps, size, nu = inputs.shape[0], states.shape[1], inputs.shape[1]
    f = size - nu
    shape = shapes[min(e, shapes.shape[0] - 1)]
    for k in range(steps + 1):
        at = min(k, shape.shape[0] - 1)
        motion = FlatMotion(positions[e, k], rotations[e, k], shape[at])
        # A goal that turns far is followed on: its yaw is near to that of the step before.
        set_flat_state(motion, targets[k - 1, 5] if k else starts[e, 5], loads[e], flat, work.flat, targets[k])
    # Numbers of a state: 6 of the payload's pose, 2 N of the cables' directions, their rates, then 3 N of thrust.
    q = 6 + 2 * (nu // 3)
    for k in range(steps + 1):
        for i in range(6):
            targets[k, i] += offsets[e, k, i]
            targets[k, q + i] += offsets[e, k, 6 + i]
    for k in range(steps):
        for i in range(nu):
            asked[k, i] = (targets[k + 1, f + i] - targets[k, f + i]) / h
    if plans.fresh[e]:
        take_targets(states, inputs, targets, asked)
        return
    # Inputs are rates of thrust: those of the guess follow from its states.
    _move_on(states, plans.targets[e], targets, elapsed / h, work.before)
    for k in range(steps):
        for i in range(nu):
            inputs[k, i] = (states[k + 1, f + i] - states[k, f + i]) / h


@kernel
def keep_targets(e, targets, plans):
    """Let the plan of team e be one that the next begins with."""
    plans.fresh[e] = False
    for k in range(targets.shape[0]):
        for i in range(targets.shape[1]):
            plans.targets[e, k, i] = targets[k, i]


@kernel
def _iterate(start, states, inputs, problem, iterations, work):
    for _ in range(iterations):
        find_gains(states, inputs, problem, 0.0, work.iteration)
        take_step(start, states, inputs, problem, work.iteration)


@kernel
def take_targets(states, inputs, targets, asked):
    """Let a plan be its targets."""
    for k in range(states.shape[0]):
        for i in range(states.shape[1]):
            states[k, i] = targets[k, i]
    for k in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            inputs[k, i] = asked[k, i]


@kernel
def is_finite(states, inputs):
    """Return whether a plan is finite."""
    # One number that is not finite makes the sum so; inputs after the first show in the states.
    total = 0.0
    for k in range(states.shape[0]):
        for i in range(states.shape[1]):
            total += states[k, i]
    for i in range(inputs.shape[1]):
        total += inputs[0, i]
    return np.isfinite(total)


@kernel
def _move_on(states, old, new, moved, before):
    """Let states deviate from new targets as from the old ones `moved` steps later; the last deviation stays."""
    steps = states.shape[0] - 1
    for k in range(steps + 1):
        for i in range(states.shape[1]):
            before[k, i] = states[k, i] - old[k, i]
    for k in range(steps + 1):
        at = min(k + moved, 1.0 * steps)
        j = min(int(at), steps - 1)
        s = at - j
        for i in range(states.shape[1]):
            states[k, i] = new[k, i] + (1.0 - s) * before[j, i] + s * before[j + 1, i]


@kernel
def predict_states(states, thrusts, dt, model, loads, work):
    """See `TeamPlanner.predict`: within each step thrust vectors go from one command to the next."""
    count = thrusts.shape[0]
    nu = thrusts.shape[2]
    f = states.shape[1] - nu
    after, rate = work.before[0], work.asked[0]
    for e in range(states.shape[0]):
        x = states[e]
        for t in range(count - 1):
            for i in range(nu):
                x[f + i] = thrusts[t, e, i]
                rate[i] = (thrusts[t + 1, e, i] - thrusts[t, e, i]) / dt
            step_state(x, rate, dt, model, loads[e], work.iteration.model, after)
            for i in range(states.shape[1]):
                x[i] = after[i]
        for i in range(nu):
            x[f + i] = thrusts[count - 1, e, i]
