"""A Newton step on the inputs of a trajectory that follows the model, by a Riccati recursion, and trials along it.

The cost is that of `riccati.py` without its soft limits; hard ones (`hard_limits.py`) push and stiffen as
`augmented_lagrangian.py` says. The second derivatives of the dynamics (`curvature.py`) are weighted by the costate, so
whole steps are those of Newton's method on the inputs (Dunn and Bertsekas, J. Optim. Theory Appl. 63, 1989).
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.curvature import CurvatureWork, set_curvature
from multilift_marl.planning.hard_limits import add_limits, evaluate_limits
from multilift_marl.planning.riccati import IterationWork, linearise, multiply_by_dynamics, pull_back
from multilift_marl.planning.team_model import solve_factorised, state_size, step_state


class Trajectory(NamedTuple):
    """States, and the inputs that lead from one to the next."""

    states: np.ndarray
    """(K + 1, 12 + 7 N), see `team_model.py`."""
    inputs: np.ndarray
    """(K, 3 N) change of the thrust vectors [N/s]."""


class Multipliers(NamedTuple):
    """The limits of a trajectory and what they do to it."""

    values: np.ndarray
    """(K, L) of the limits, in tolerances."""
    dual: np.ndarray
    """(K, L) multipliers z ≥ 0, in costs by tolerances."""
    push: np.ndarray
    """(K, L) by which each limit's gradient counts, the multipliers when those are updated."""
    stiffness: np.ndarray
    """(K, L) by which the square of its gradient counts, 0 where `push` is."""

    @classmethod
    def of(cls, steps: int, num_limits: int) -> Multipliers:
        """Return none."""
        return cls(*(np.zeros((steps, num_limits)) for _ in range(4)))


class NewtonWork(NamedTuple):
    """Arrays that a step is made in, and a trial along it."""

    iteration: IterationWork
    curvature: CurvatureWork
    costate: np.ndarray
    pulled: np.ndarray
    pull: np.ndarray
    states: np.ndarray
    """(K + 1, 12 + 7 N) of the trial."""
    inputs: np.ndarray
    """(K, 3 N)."""
    values: np.ndarray
    """(K, L)."""

    @classmethod
    def of(cls, steps: int, n: int, num_limits: int) -> NewtonWork:
        """Return arrays for K steps of N drones."""
        size = state_size(n)
        shapes = (size,), (size,), (n,), (steps + 1, size), (steps, 3 * n), (steps, num_limits)
        return cls(IterationWork.of(steps, n), CurvatureWork.of(n), *(np.zeros(shape) for shape in shapes))


@kernel
def find_step(path, task, m, exact, damping, w):
    """Write gains and changes of the inputs.

    Args:
        path: Trajectory that follows the model.
        task: LimitedProblem.
        m: Multipliers.
        exact: whether second derivatives of dynamics and limits count (Newton), or not (Gauss-Newton).
        damping: of the curvature of the inputs, over that of their cost [-].
        w: NewtonWork, whose `iteration.gain` and `iteration.change` are written.

    Returns:
        Whether the quadratic model is convex; the largest derivative of the whole cost by an input, in tolerances
        of the input; and that cost's derivative along the step.
    """
    (states, inputs), problem = path, task.problem
    steps, size = inputs.shape[0], states.shape[1]
    it, objective = w.iteration, problem.objective
    it.value[:] = 0.0
    for i in range(size):
        it.value[i, i] = objective.end[i]
        it.linear[i] = objective.end[i] * (states[steps, i] - problem.targets[steps, i])
        w.costate[i] = it.linear[i]
    steepest, slope = 0.0, 0.0
    for k in range(steps - 1, -1, -1):
        add_limits(states[k + 1], m.push[k], m.stiffness[k], exact, task, it, w.costate)
        linearise(k, states, inputs, problem, it)
        _set_middle(k, states[k], m, exact, task, w)
        convex, steep, along = _recur(k, path, problem, damping, w)
        if not convex:
            return False, steepest, slope
        steepest = max(steepest, steep)
        slope += along
    return True, steepest, slope


@kernel
def _set_middle(k, x, m, exact, task, w):
    """Write what tensions, and with `exact` the dynamics too, add by the state in the middle of step k.

    Second derivatives go to the lower triangle of `curvature.hessian`, slopes to `iteration.force`.
    """
    problem, limits = task
    it, hessian, slope = w.iteration, w.curvature.hessian, w.iteration.force
    unit = 1.0 / limits.tolerance[0]
    for n in range(limits.tension.shape[0]):
        w.pull[n] = unit * m.push[k, n]
    if exact:
        set_curvature(k, x, w.costate, w.pull, problem, it, w.curvature)
    else:
        hessian[:] = 0.0
    slope[:] = 0.0
    for n in range(limits.tension.shape[0]):
        by, stiff = it.tension_slope[k, n], unit * unit * m.stiffness[k, n]
        if stiff == 0.0:
            continue
        for i in range(3, by.shape[0]):
            slope[i] -= w.pull[n] * by[i]
            part = stiff * by[i]
            for j in range(3, i + 1):
                hessian[i, j] += part * by[j]


@kernel
def _recur(k, path, problem, damping, w):
    """Move value function and costate from the end of step k to its start; see `find_step` for what is returned."""
    states, inputs = path
    h, objective, it = problem.step, problem.objective, w.iteration
    count = problem.model.anchors.shape[0]
    q, nu = 6 + 2 * count, 3 * count
    size, f, half = 2 * q + nu, 2 * q, 0.5 * h
    value, moved, quadratic, linear, middle = it.value, it.moved, it.quadratic, it.linear, it.force
    right, curvature, hessian = it.right, it.input, w.curvature.hessian
    multiply_by_dynamics(k, q, size, h, it)

    # derivative by the inputs, by the costate
    pull_back(k, w.costate, w.pulled, q, size, h, it)
    steep = 0.0
    for i in range(nu):
        own = h * objective.rate[i] * (inputs[k, i] - problem.asked[k, i])
        slope = own + half * (w.pulled[f + i] + w.costate[f + i] + middle[f + i])
        steep = max(steep, abs(slope) / sqrt(objective.rate[i]))
    for i in range(size):
        cost = h * objective.state[i] * (states[k, i] - problem.targets[k, i])
        w.costate[i] = w.pulled[i] + middle[i] + cost

    # the same by the value function's slope, and curvatures
    pull_back(k, linear, w.pulled, q, size, h, it)
    for i in range(nu):
        own = h * objective.rate[i] * (inputs[k, i] - problem.asked[k, i])
        right[i, size] = own + half * (linear[f + i] + w.pulled[f + i] + middle[f + i])
        for j in range(size):
            bent = hessian[f + i, j] if j <= f + i else hessian[j, f + i]
            right[i, j] = half * (quadratic[f + i, j] + moved[f + i, j] + bent)
        for j in range(i + 1):
            both = moved[f + j, f + i] + value[f + i, f + j]
            curvature[i, j] = half * (right[i, f + j] + half * both)
        curvature[i, i] += h * objective.rate[i] * (1.0 + damping)
    for i in range(size):
        linear[i] = w.pulled[i] + middle[i] + h * objective.state[i] * (states[k, i] - problem.targets[k, i])
        quadratic[i, i] += h * objective.state[i]
        for j in range(i + 1):
            quadratic[i, j] += hessian[i, j]
    if not _factorise(curvature, nu):
        return False, steep, 0.0

    # gain and change, and the value function at the start
    gain, change, along = it.gain[k], it.change[k], 0.0
    for i in range(nu):
        for j in range(size):
            gain[i, j] = right[i, j]
        change[i] = right[i, size]
    solve_factorised(curvature, right, nu, size + 1)
    for i in range(nu):
        along -= change[i] * right[i, size]
        for j in range(size):
            part = gain[i, j]
            for c in range(j + 1):
                quadratic[j, c] -= part * right[i, c]
            linear[j] -= part * right[i, size]
    for i in range(nu):
        for j in range(size):
            gain[i, j] = -right[i, j]
        change[i] = -right[i, size]
    for i in range(size):
        for j in range(i + 1):
            value[i, j] = value[j, i] = quadratic[i, j]
    return True, steep, along


@kernel
def _factorise(matrix, size):
    """Do as `team_model.factorise`; return whether the matrix is positive definite."""
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not rest > 0.0:
                    return False
                matrix[i, i] = sqrt(rest)
            else:
                matrix[i, j] = rest / matrix[j, j]
    return True


@kernel
def follow(start, path, length, task, w):
    """Write the trajectory that the inputs, changed by `length` of a step and its gains, lead to; return its cost.

    Args:
        start: (12 + 7 N,).
        path: Trajectory that changes count from.
        length: [-].
        task: LimitedProblem.
        w: NewtonWork, whose `states`, `inputs` and `values` are written.
    """
    (states, inputs), (problem, limits) = path, task
    objective, it, h, steps = problem.objective, w.iteration, problem.step, inputs.shape[0]
    size, nu, count = states.shape[1], inputs.shape[1], limits.tension.shape[0]
    cost = 0.0
    for i in range(size):
        w.states[0, i] = start[i]
    for k in range(steps):
        x, u, gain = w.states[k], w.inputs[k], it.gain[k]
        for i in range(size):
            it.force[i] = x[i] - states[k, i]
            cost += 0.5 * h * objective.state[i] * (x[i] - problem.targets[k, i]) ** 2
        for i in range(nu):
            change = length * it.change[k, i]
            for j in range(size):
                change += gain[i, j] * it.force[j]
            u[i] = inputs[k, i] + change
            cost += 0.5 * h * objective.rate[i] * (u[i] - problem.asked[k, i]) ** 2
        step_state(x, u, h, problem.model, problem.loads[min(k, problem.loads.shape[0] - 1)], it.model, w.states[k + 1])
        for n in range(count):
            w.values[k, n] = (it.model.tension[n] - limits.tension[n]) / limits.tolerance[0]
        evaluate_limits(w.states[k + 1], task, it, w.values[k])
    for i in range(size):
        cost += 0.5 * objective.end[i] * (w.states[steps, i] - problem.targets[steps, i]) ** 2
    return cost
