"""Plans of a team that converge within hard limits: an augmented Lagrangian over Newton steps.

With a multiplier z ≥ 0 of each limit g ≥ 0, each of them adds (max(z − ρ g, 0)² − z²)/(2 ρ) to the cost (Rockafellar,
Math. Program. 5, 1973). A step on the inputs (`newton.py`) is shortened until this sum falls; where a whole step has
almost reached its minimum, multipliers become max(z − ρ g, 0). Where the cost is not convex along the inputs they are
damped (Levenberg-Marquardt), far from a minimum second derivatives are left out (Gauss-Newton).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.newton import find_step, follow
from multilift_marl.planning.riccati import find_gains

STATUS = ("converged", "infeasible", "stopped", "stalled", "not finite")
CONVERGED, INFEASIBLE, STOPPED, STALLED, NOT_FINITE = range(len(STATUS))
EXCEEDED = 1e-3  # tolerances beyond a limit, from which a plan that has not converged counts as infeasible
PENALTY, LARGEST_PENALTY = 0.25, 8.0  # ρ, for limits and costs in tolerances
NEAR = 0.2  # by which a whole step was to lower the cost at most, for multipliers to be updated
EARLY = 5  # iterations at first, in which a cost that is not convex is taken without its second derivatives at once
DAMPING, DAMPING_FACTOR, DAMPING_TRIALS = 1.0, 5.0, 3
SHORTEST = 1e-4  # of a step


class Report(NamedTuple):
    """How the plans of E teams ended."""

    status: np.ndarray
    """(E,) int64, an index into STATUS."""
    iterations: np.ndarray
    """(E,) int64."""
    residual: np.ndarray
    """(E, 3) largest derivative of the Lagrangian by an input, in tolerances of inputs; largest excess over a limit, in
    tolerances of limits; largest product of a limit and its multiplier."""

    @classmethod
    def of(cls, num_envs: int) -> Report:
        """Return a report of nothing."""
        return cls(np.zeros(num_envs, np.int64), np.zeros(num_envs, np.int64), np.zeros((num_envs, 3)))


@kernel
def solve_team(start, path, task, m, settings, w, residual):
    """Solve for the plan of a team; return its status, an index into STATUS, and the number of iterations.

    Args:
        start: (12 + 7 N,) present state.
        path: Trajectory, a guess, overwritten: the result follows the model exactly.
        task: LimitedProblem.
        m: Multipliers, a guess of `dual`, overwritten.
        settings: largest KKT residual, and largest number of iterations.
        w: NewtonWork.
        residual: (3,) see `Report`, written.
    """
    tolerance, most = settings
    residual[0], residual[1], residual[2] = np.inf, np.inf, np.inf
    cost = _begin(start, path, task, m, w)
    _take_trial(path, m, w)
    rho, damped, excess = PENALTY, 0.0, np.inf
    status, iterations = STOPPED if np.isfinite(cost) else NOT_FINITE, 0
    while status == STOPPED:
        merit = cost + set_push(rho, m)
        # The step of Newton's method for these multipliers, undamped if it can be.
        exact, damping, steepest, slope = _find_convex_step(iterations < EARLY, damped, path, task, m, w)
        if damping > 0.0:
            damped = damping
        residual[0] = steepest
        residual[1], residual[2] = _exceed(m)
        if max(residual[0], residual[1], residual[2]) <= tolerance:
            status = CONVERGED
            break
        if iterations == most:
            break
        iterations += 1
        length, cost = _search(start, path, (merit, slope, rho), task, m, w)
        if length < SHORTEST and exact:  # second derivatives lead astray
            _, _, slope = find_step(path, task, m, False, DAMPING, w)
            length, cost = _search(start, path, (merit, slope, rho), task, m, w)
        if length < SHORTEST:
            status = STALLED
            break
        _take_trial(path, m, w)
        # Near the minimum for these multipliers; earlier updates would chase a plan that is still far from it.
        if length == 1.0 and -slope < NEAR:
            _update(rho, m)
            last, excess = excess, _exceed(m)[0]
            # Multipliers alone should halve what is exceeded; where they do not, limits get stiffer.
            if 0.5 * last < excess < 0.01:
                rho = min(4.0 * rho, LARGEST_PENALTY)
    if (status == STOPPED or status == STALLED) and residual[1] > EXCEEDED:
        status = INFEASIBLE
    return status, iterations


@kernel
def _begin(start, path, task, m, w):
    """Write a trajectory that follows the model to the trial, and return its cost.

    It is led by an iteration of `riccati.py` about the guess, or has the thrusts stay as they are, whichever is better.
    """
    cost = _hold(start, path, task, w)
    held = cost + penalty(w.values, m.dual, PENALTY)
    find_gains(path.states, path.inputs, task.problem, 0.0, w.iteration)
    cost = follow(start, path, 1.0, task, w)
    led = cost + penalty(w.values, m.dual, PENALTY)
    if not np.isfinite(led) or held < led:
        cost = _hold(start, path, task, w)
    return cost


@kernel
def _hold(start, path, task, w):
    """Write the trajectory of steady thrusts to the trial, and return its cost."""
    inputs = path.inputs
    # `follow` adds gains and changes to the inputs of the path: these cancel them.
    w.iteration.gain[:] = 0.0
    for k in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            w.iteration.change[k, i] = -inputs[k, i]
    return follow(start, path, 1.0, task, w)


@kernel
def _find_convex_step(early, damped, path, task, m, w):
    """Return whether second derivatives count, the damping, and what `find_step` returns."""
    convex, steepest, slope = find_step(path, task, m, True, 0.0, w)
    if convex:
        return True, 0.0, steepest, slope
    # Less than what was enough before, so that damping falls again where less will do.
    damping = max(DAMPING, 0.3 * damped)
    for _ in range(0 if early else DAMPING_TRIALS):
        convex, steepest, slope = find_step(path, task, m, True, damping, w)
        if convex:
            return True, damping, steepest, slope
        damping *= DAMPING_FACTOR
    convex, steepest, slope = find_step(path, task, m, False, 0.0, w)
    return False, 0.0, steepest, slope


@kernel
def _search(start, path, line, task, m, w):
    """Shorten a step until it lowers the merit (Armijo); return its length and the cost.

    `line` holds the merit, its slope along the step, and the penalty ρ.
    """
    merit, slope, rho = line
    length = 1.0
    while length >= SHORTEST:
        cost = follow(start, path, length, task, w)
        # The last part is round-off, which near a minimum exceeds what a step can gain.
        if cost + penalty(w.values, m.dual, rho) <= merit + 1e-4 * length * slope + 1e-12 * abs(merit):
            return length, cost
        length *= 0.5
    return 0.0, cost


@kernel
def _take_trial(path, m, w):
    states, inputs = path
    for k in range(inputs.shape[0]):
        for i in range(inputs.shape[1]):
            inputs[k, i] = w.inputs[k, i]
        for i in range(states.shape[1]):
            states[k, i] = w.states[k, i]
            states[k + 1, i] = w.states[k + 1, i]
        for i in range(m.values.shape[1]):
            m.values[k, i] = w.values[k, i]


@kernel
def set_push(rho, m):
    """Write push and stiffness of the limits; return what they add to the cost."""
    for k in range(m.values.shape[0]):
        for i in range(m.values.shape[1]):
            push = m.dual[k, i] - rho * m.values[k, i]
            m.push[k, i] = max(push, 0.0)
            m.stiffness[k, i] = rho if push > 0.0 else 0.0
    return penalty(m.values, m.dual, rho)


@kernel
def penalty(values, dual, rho):
    """Return what limits of these values add to the cost."""
    total = 0.0
    for k in range(values.shape[0]):
        for i in range(values.shape[1]):
            z = dual[k, i]
            total += max(z - rho * values[k, i], 0.0) ** 2 - z * z
    return 0.5 * total / rho


@kernel
def _update(rho, m):
    for k in range(m.values.shape[0]):
        for i in range(m.values.shape[1]):
            m.dual[k, i] = max(m.dual[k, i] - rho * m.values[k, i], 0.0)


@kernel
def _exceed(m):
    """Return the largest excess over a limit, and the largest product of a limit and its push."""
    excess, product = 0.0, 0.0
    for k in range(m.values.shape[0]):
        for i in range(m.values.shape[1]):
            excess = max(excess, -m.values[k, i])
            product = max(product, m.push[k, i] * m.values[k, i])
    return excess, product
