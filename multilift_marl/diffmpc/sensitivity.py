"""Derivatives of plans, and of flights by plans, by weights, targets and limits: adjoints of a planner's iteration.

The iteration minimises a quadratic cost along linearised dynamics. By the implicit function theorem the derivative of
v·u, u the first input, by a number θ of that cost is −p·∂²L/∂z∂θ, with p what the iteration would change all states
and inputs z by, if −v were the slope of the cost by u: as slopes of later steps are zero, p follows the gains that the
recursion has found, from Q⁻¹ v on (Amos et al., NeurIPS 2018; Jin et al., NeurIPS 2020). Derivatives by the present
state are the first gain. Limits that are exceeded count as in the iteration. What an iteration owes to its guess is
left out: it vanishes as plans converge.

A flight moves by the reduced model; the adjoint of its states runs back through the model's Jacobians and the gains.
Plans begin at the thrust vectors F commanded last, which stand for the present ones. They command F + lead u, which
rotors approach by a share `response` in a policy step, perhaps some steps late: where none are, and response · lead is
a policy step, u is the model's input.
"""

from __future__ import annotations

from math import prod, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.newton import find_step
from multilift_marl.planning.riccati import IterationWork, Problem, advance, linearise, pull_back
from multilift_marl.planning.team_model import solve_factorised, state_size

ACTIVE = 1e-9  # multiplier from which a limit counts as active, in costs by tolerances
STIFF = 1e4  # by which the square of an active limit counts, in tolerances


class Tape(NamedTuple):
    """What plans of E teams in T policy steps leave for their derivatives."""

    gain: np.ndarray
    """(T, E, K, 3 N, 12 + 7 N), and the next three, see `riccati.IterationWork`."""
    slope: np.ndarray
    euler: np.ndarray
    tension_slope: np.ndarray
    factor: np.ndarray
    """(T, E, 3 N, 3 N) Cholesky factor of the curvature of the first input."""
    off: np.ndarray
    """(T, E, K + 1, 12 + 7 N) states beside their targets."""
    input_off: np.ndarray
    """(T, E, K, 3 N) inputs beside those asked for."""
    pushing: np.ndarray
    """(T, E, K, N) by which the square of an active limit of tension counts [1/N²], 0 of others."""
    beyond: np.ndarray
    """(T, E, K + 1, N, 3) the same of largest thrusts, times their directions."""
    states: np.ndarray
    """(E, T + 1, 12 + 7 N) of the flight."""
    inputs: np.ndarray
    """(E, T, 3 N) it moved by."""
    loads: np.ndarray
    """(E, T, 7), see `team_model.accelerations`."""
    late: np.ndarray
    """(T, E) int64, after how many further policy steps what a plan commands reaches the rotors."""
    cut: np.ndarray
    """(T, E) bool, steps after which an episode ended, or whose plan was not flown: nothing goes back through them."""

    @classmethod
    def of(cls, steps: int, num_envs: int, horizon: int, n: int) -> Tape:
        """Return a tape for T policy steps of E teams of N drones that plan K steps."""
        arrays = [np.zeros(shape) for shape in cls._shapes(steps, num_envs, horizon, n)]
        return cls(*arrays, *(np.zeros((steps, num_envs), kind) for kind in (np.int64, bool)))

    @classmethod
    def nbytes(cls, steps: int, num_envs: int, horizon: int, n: int) -> int:
        """Return how many bytes such a tape takes."""
        return 8 * sum(prod(shape) for shape in cls._shapes(steps, num_envs, horizon, n)) + 9 * steps * num_envs

    @staticmethod
    def _shapes(steps: int, num_envs: int, horizon: int, n: int) -> tuple[tuple[int, ...], ...]:
        """Return those of all arrays but the last two."""
        size, q, nu, te = state_size(n), 6 + 2 * n, 3 * n, (steps, num_envs)
        return (
            (*te, horizon, nu, size), (*te, horizon, q, size), (*te, horizon, 15), (*te, horizon, n, size),
            (*te, nu, nu), (*te, horizon + 1, size), (*te, horizon, nu), (*te, horizon, n), (*te, horizon + 1, n, 3),
            (num_envs, steps + 1, size), (num_envs, steps, nu), (num_envs, steps, 7),
        )  # fmt: skip


class Gradient(NamedTuple):
    """Derivatives by what each plan of a flight was to minimise."""

    state: np.ndarray
    """(T, E, 12 + 7 N), and the next two, of the weights in an `Objective`."""
    end: np.ndarray
    rate: np.ndarray
    """(T, E, 3 N)."""
    tension: np.ndarray
    """(T, E, N) of least tensions."""
    thrust: np.ndarray
    """(T, E, N) of largest thrusts."""
    targets: np.ndarray
    """(T, E, K + 1, 12 + 7 N) of the states that deviations count from."""
    asked: np.ndarray
    """(T, E, K, 3 N) of the inputs."""
    starts: np.ndarray
    """(E, 12 + 7 N) of where flights began."""
    by_input: np.ndarray
    """(T, 3 N) of the last team, by how its thrust vectors changed."""

    @classmethod
    def of(cls, steps: int, num_envs: int, horizon: int, n: int) -> Gradient:
        """Return zeros for a tape of this size."""
        size, nu, te = state_size(n), 3 * n, (steps, num_envs)
        shapes = (
            (*te, size), (*te, size), (*te, nu), (*te, n), (*te, n), (*te, horizon + 1, size), (*te, horizon, nu),
            (num_envs, size), (steps, nu),
        )  # fmt: skip
        return cls(*(np.zeros(shape) for shape in shapes))


class Adjoint(NamedTuple):
    """What costs go back by: what the plans have left, arrays to work in, and the gradient that this gives."""

    tape: Tape
    work: IterationWork
    """Of a plan of as many steps, or more."""
    gradient: Gradient


@kernel
def record(t, e, states, inputs, problem, w, tape):
    """Write to a tape what the last iteration on a plan within soft limits has found, or on any without active ones.

    Args:
        t, e: policy step and team.
        states, inputs: of the plan after it.
        problem: Problem.
        w: IterationWork.
        tape: Tape; `beyond` is left to `record_thrusts`.
    """
    steps, size, nu = inputs.shape[0], states.shape[1], inputs.shape[1]
    objective, q = problem.objective, 6 + 2 * (nu // 3)
    for k in range(steps):
        for i in range(nu):
            tape.input_off[t, e, k, i] = inputs[k, i] - problem.asked[k, i]
            for j in range(size):
                tape.gain[t, e, k, i, j] = w.gain[k, i, j]
        for i in range(q):
            for j in range(size):
                tape.slope[t, e, k, i, j] = w.slope[k, i, j]
        for i in range(15):
            tape.euler[t, e, k, i] = w.euler[k, i]
        for n in range(nu // 3):
            short = objective.tension[n] > w.tension[k, n]
            tape.pushing[t, e, k, n] = problem.step * objective.weights[0] if short else 0.0
            for j in range(size):
                tape.tension_slope[t, e, k, n, j] = w.tension_slope[k, n, j]
    for k in range(steps + 1):
        for i in range(size):
            tape.off[t, e, k, i] = states[k, i] - problem.targets[k, i]
    for i in range(nu):
        for j in range(i + 1):
            tape.factor[t, e, i, j] = w.input[i, j]  # the recursion ends with the first step


@kernel
def record_thrusts(t, e, states, problem, tape):
    """Write to a tape which thrusts exceed their soft limits in a plan, before its last iteration."""
    objective = problem.objective
    f = 12 + 4 * objective.thrust.shape[0]
    tape.beyond[t, e] = 0.0
    for k in range(states.shape[0] - 1):
        for n in range(objective.thrust.shape[0]):
            at = f + 3 * n
            thrust = sqrt(states[k, at] ** 2 + states[k, at + 1] ** 2 + states[k, at + 2] ** 2) + 1e-12
            if thrust > objective.thrust[n, 1]:
                for i in range(3):
                    tape.beyond[t, e, k, n, i] = problem.step * objective.weights[1] * states[k, at + i] / thrust


@kernel
def record_converged(t, e, path, task, m, w, tape):
    """Write to a tape what plans within hard limits owe to theirs, see `record`: active ones are kept exactly.

    Args:
        t, e: policy step and team.
        path: Trajectory, converged.
        task: LimitedProblem.
        m: Multipliers, whose stiffness is overwritten.
        w: NewtonWork.
        tape: Tape.

    Returns:
        Whether the plan is a strict minimum, so that it has derivatives.
    """
    limits, count = task.limits, task.limits.tension.shape[0]
    for k in range(m.push.shape[0]):
        for i in range(m.push.shape[1]):
            m.stiffness[k, i] = STIFF if m.push[k, i] > ACTIVE else 0.0
    convex, _, _ = find_step(path, task, m, True, 0.0, w)
    record(t, e, path.states, path.inputs, task.problem, w.iteration, tape)
    tape.beyond[t, e] = 0.0
    f = 12 + 4 * count
    for k in range(m.push.shape[0]):
        for n in range(count):
            tape.pushing[t, e, k, n] = m.stiffness[k, n] / limits.tolerance[0] ** 2
            x, at = path.states[k + 1], f + 3 * n
            thrust = sqrt(x[at] ** 2 + x[at + 1] ** 2 + x[at + 2] ** 2) + 1e-12
            for i in range(3):
                stiff = m.stiffness[k, count + n] / limits.tolerance[1] ** 2
                tape.beyond[t, e, k + 1, n, i] = stiff * x[at + i] / thrust
    return convex


@kernel
def pull_plan_back(t, e, slope, h, objective, adjoint):
    """Add to the gradient what slope·u gains by a plan's cost, u its first input.

    Args:
        t, e: policy step and team.
        slope: (3 N,); overwritten.
        h: step of the plan [s].
        objective: state, end and rate: the weights (12 + 7 N,), (12 + 7 N,), (3 N,) of this plan.
        adjoint: Adjoint, whose gradient is added to.
    """
    tape, w, gradient = adjoint
    weights, end, rate = objective
    nu, size, steps = slope.shape[0], weights.shape[0], tape.gain.shape[2]
    f, factor, moved = size - nu, tape.factor[t, e], w.force
    # By the implicit function theorem the plan answers to its cost as the linear-quadratic problem about it does: its
    # first input moves by H⁻¹ slope, with H the factorised Hessian of the first step, the others by the gains.
    solve_factorised(factor, slope.reshape((nu, 1)), nu, 1)
    moved[:] = 0.0
    for k in range(steps):
        if k > 0:
            for i in range(nu):
                slope[i] = 0.0
                for j in range(size):
                    slope[i] += tape.gain[t, e, k, i, j] * moved[j]
        for i in range(size):
            gradient.state[t, e, i] -= h * moved[i] * tape.off[t, e, k, i]
            gradient.targets[t, e, k, i] = h * weights[i] * moved[i]
        for i in range(nu):
            gradient.rate[t, e, i] -= h * slope[i] * tape.input_off[t, e, k, i]
            gradient.asked[t, e, k, i] = h * rate[i] * slope[i]
        _add_thrusts(t, e, k, f, tape, moved, gradient)
        for n in range(nu // 3):
            pushing = tape.pushing[t, e, k, n]
            if pushing > 0.0:
                by, gained = tape.tension_slope[t, e, k, n], 0.0
                for i in range(size):
                    gained += by[i] * moved[i]
                # A tension counts in the middle of its step, where half of the change of thrust has come.
                for i in range(nu):
                    gained += 0.5 * h * by[f + i] * slope[i]
                gradient.tension[t, e, n] += pushing * gained
        advance(tape.slope[t, e, k], tape.euler[t, e, k], slope, h, w.lever, moved)
    _add_thrusts(t, e, steps, f, tape, moved, gradient)
    for i in range(size):
        gradient.end[t, e, i] -= moved[i] * tape.off[t, e, steps, i]
        gradient.targets[t, e, steps, i] = end[i] * moved[i]


@kernel
def _add_thrusts(t, e, k, f, tape, moved, gradient):
    """Add what largest thrusts in step k of a plan gain."""
    for n in range(gradient.thrust.shape[2]):
        for i in range(3):
            gradient.thrust[t, e, n] += tape.beyond[t, e, k, n, i] * moved[f + 3 * n + i]


@kernel
def pull_flight_back(costs, times, weights, model, surroundings, adjoint):
    """Write the gradient of a flight's cost.

    Args:
        costs: (E, T + 1, 12 + 7 N) its derivatives by the states of the flight.
        times: policy step, step of the plans [s], response [-] and lead [s], see above.
        weights: state and end (T, E, 12 + 7 N), and rate (T, E, 3 N) of the plans.
        model: TeamModel.
        surroundings: Objective and Surroundings, which do not count.
        adjoint: Adjoint, whose gradient is overwritten.
    """
    tape, w, gradient = adjoint
    dt, h, response, lead = times
    stiff = response / dt
    state, end, rate = weights
    objective, around = surroundings
    envs, steps, nu = tape.inputs.shape
    size = tape.states.shape[2]
    f, q = size - nu, 6 + 2 * (nu // 3)
    gradient.state[:] = 0.0
    gradient.end[:] = 0.0
    gradient.rate[:] = 0.0
    gradient.tension[:] = 0.0
    gradient.thrust[:] = 0.0
    gradient.targets[:] = 0.0
    gradient.asked[:] = 0.0
    costate, before, slope, by_input = w.effect[0], w.effect[1], w.change[0], gradient.by_input
    for e in range(envs):
        by_input[:] = 0.0
        for i in range(size):
            costate[i] = costs[e, steps, i]
        for t in range(steps - 1, -1, -1):
            # An episode has ended here, or a plan was not flown: what comes after owes nothing to what was before.
            if tape.cut[t, e]:
                by_input[:] = 0.0
                for i in range(size):
                    costate[i] = costs[e, t, i]
                continue
            states, inputs = tape.states[e, t : t + 2], tape.inputs[e, t : t + 1]
            one = Problem(states, inputs, dt, model, tape.loads[e, t : t + 1], objective, around)
            linearise(0, states, inputs, one, w)
            pull_back(0, costate, before, q, size, dt, w)
            # A command arrives some steps late; what it changes is known, as the flight is gone through backwards.
            arrives = t + tape.late[t, e]
            for i in range(nu):
                by_input[t, i] = 0.5 * dt * (before[f + i] + costate[f + i])
                later = by_input[arrives, i] if arrives < steps else 0.0
                before[f + i] += stiff * (later - by_input[t, i])
                slope[i] = stiff * lead * later
            for i in range(size):
                for j in range(nu):
                    before[i] += tape.gain[t, e, 0, j, i] * slope[j]
                costate[i] = before[i] + costs[e, t, i]
            pull_plan_back(t, e, slope, h, (state[t, e], end[t, e], rate[t, e]), adjoint)
        for i in range(size):
            gradient.starts[e, i] = costate[i]
