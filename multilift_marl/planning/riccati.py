"""One Gauss-Newton iteration on a team's trajectory by a Riccati recursion, with soft limits.

A trajectory has K steps of h, states (K + 1, 12 + 7 N) and inputs (K, 3 N). The cost is the sum over its steps of
½ |(x − x_ref)/σ|² h + ½ |(u − u_ref)/σ_u|² h, more at its end, and of ½ w s² h for each limit that is exceeded by s.
States need not follow from one another (multiple shooting): gaps are closed by the step.

The dynamics is linearised to A = A0 + E D, with D the derivatives of the 6 + 2 N accelerations alone and A0 nearly the
identity, and B = h/2 (A I_F + I_F), I_F the columns of the thrust vectors: they move by u, and half of that counts
within the step. So what the recursion needs of B are parts of what it needs of A.
"""

from __future__ import annotations

from math import cos, sin, tan
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.model_slopes import slopes
from multilift_marl.planning.soft_limits import (
    Surroundings,
    add_clearances,
    add_neighbours,
    add_separations,
    add_tensions,
    add_thrusts,
)
from multilift_marl.planning.team_model import (
    ModelWork,
    TeamModel,
    euler_rates,
    factorise,
    solve_factorised,
    state_size,
    step_state,
)


class Objective(NamedTuple):
    """What a planner minimises: squared deviations over squared tolerances, and squared excess over limits."""

    state: np.ndarray
    """(12 + 7 N,) 1/σ² of each number of a state, in each second."""
    end: np.ndarray
    """(12 + 7 N,) of the last state."""
    rate: np.ndarray
    """(3 N,) 1/σ² of Ḟ [s²/N²], in each second."""
    tension: np.ndarray
    """(N,) least tension [N]."""
    thrust: np.ndarray
    """(N, 2) least and largest thrust [N]."""
    separation: np.ndarray
    """(N, N) least distance of drones [m]."""
    weights: np.ndarray
    """(3,) 1/σ² of the excess over these three kinds of limits, in each second."""


class Problem(NamedTuple):
    """What a trajectory is to be."""

    targets: np.ndarray
    """(K + 1, 12 + 7 N) states that deviations count from."""
    asked: np.ndarray
    """(K, 3 N) inputs that they count from."""
    step: float
    """[s]."""
    model: TeamModel
    loads: np.ndarray
    """(1 or K, 7 or 49) of each step, or of all alike, see `team_model.accelerations`."""
    objective: Objective
    around: Surroundings


class IterationWork(NamedTuple):
    """The linearised trajectory, the gains that `improve` found, and arrays that it works in."""

    model: ModelWork
    slope: np.ndarray
    """(K, 6 + 2 N, 12 + 7 N) D of each step."""
    tension: np.ndarray
    """(K, N) [N] in the middle of each step."""
    tension_slope: np.ndarray
    """(K, N, 12 + 7 N)."""
    gap: np.ndarray
    """(K, 12 + 7 N) what a step leads to, less the next state."""
    euler: np.ndarray
    """(K, 15) `euler_rates`, and the derivatives of T ω by roll, pitch and yaw, row by row."""
    gain: np.ndarray
    """(K, 3 N, 12 + 7 N) of the input by the state's deviation."""
    change: np.ndarray
    """(K, 3 N) of the input."""
    value: np.ndarray
    linear: np.ndarray
    by_rates: np.ndarray
    moved: np.ndarray
    quadratic: np.ndarray
    effect: np.ndarray
    input: np.ndarray
    right: np.ndarray
    force: np.ndarray
    lever: np.ndarray
    place: np.ndarray
    place_slope: np.ndarray

    @classmethod
    def of(cls, steps: int, n: int) -> IterationWork:
        """Return arrays for K steps of N drones."""
        size, q, nu = state_size(n), 6 + 2 * n, 3 * n
        shapes = (
            (steps, q, size), (steps, n), (steps, n, size), (steps, size), (steps, 15), (steps, nu, size), (steps, nu),
            (size, size), (size,), (size, q), (size, size), (size, size), (q, size), (nu, nu), (nu, size + 1), (size,),
            (size,), (n, 3), (n, 3, 8),
        )  # fmt: skip
        return cls(ModelWork.of(n), *(np.zeros(shape) for shape in shapes))


@kernel
def set_euler(x, rates, euler):
    """Write `euler_rates` of a state, and the derivatives of T ω by its attitude at body rates `rates`."""
    t = euler_rates(x[3], x[4])
    for i in range(6):
        euler[i] = t[i]
    sr, cr, tp, cp = sin(x[3]), cos(x[3]), tan(x[4]), cos(x[4])
    turned, sunk = sr * rates[1] + cr * rates[2], cr * rates[1] - sr * rates[2]
    euler[6], euler[7], euler[8] = sunk * tp, turned / (cp * cp), 0.0
    euler[9], euler[10], euler[11] = -turned, 0.0, 0.0
    euler[12], euler[13], euler[14] = sunk / cp, turned * tp / cp, 0.0


@kernel
def linearise(k, states, inputs, problem, w):
    """Write D, tensions with their derivatives, and the gap of step k, by the state and the input at its start."""
    x, m, h, model = states[k], w.model, problem.step, problem.model
    count = model.anchors.shape[0]
    q = 6 + 2 * count
    size = 2 * q + 3 * count
    after = w.gap[k]
    step_state(x, inputs[k], h, model, problem.loads[min(k, problem.loads.shape[0] - 1)], m, after)
    for i in range(size):
        after[i] -= states[k + 1, i]
    slopes(m.middle, model, m)
    euler, a = w.euler[k], m.acceleration
    set_euler(x, (x[q + 3], x[q + 4], x[q + 5]), euler)
    for i in range(q):
        _to_start(w.slope[k, i], m.slope[i], q, size, 0.5 * h, euler)
    for n in range(count):
        _to_start(w.tension_slope[k, n], m.tension_slope[n], q, size, 0.5 * h, euler)
        w.tension[k, n] = m.tension[n]
    mean = (x[q + 3] + 0.5 * h * a[3], x[q + 4] + 0.5 * h * a[4], x[q + 5] + 0.5 * h * a[5])
    set_euler(x, mean, euler)


@kernel
def _to_start(row, middle, q, size, half, euler):
    """Write derivatives by the state at the start of a step, from those by the state in its middle."""
    for i in range(size):
        row[i] = middle[i]
    # The middle is half a step of the velocities on: x + h/2 v, and for the angles h/2 T ω.
    for i in range(q):
        row[q + i] += half * middle[i]
    e0, e1, e2 = middle[3], middle[4], middle[5]
    row[q + 4] = middle[q + 4] + half * (e0 * euler[0] + e1 * euler[2] + e2 * euler[4])
    row[q + 5] = middle[q + 5] + half * (e0 * euler[1] + e1 * euler[3] + e2 * euler[5])
    for j in range(3):
        row[3 + j] += half * (e0 * euler[6 + j] + e1 * euler[9 + j] + e2 * euler[12 + j])


@kernel
def recur(k, states, inputs, problem, damping, w):
    """Move the value function from the end of step k to its start, and write gain and change of its input.

    Args:
        k: the step.
        states, inputs: of the trajectory.
        problem: Problem.
        damping: added to the diagonal of the inputs' curvature.
        w: IterationWork, after `linearise`; its `value` (V_xx) and `linear` (V_x) are overwritten.
    """
    h, objective = problem.step, problem.objective
    count = problem.model.anchors.shape[0]
    q, nu = 6 + 2 * count, 3 * count
    size, f = 2 * q + nu, 2 * q
    value, moved, quadratic = w.value, w.moved, w.quadratic
    multiply_by_dynamics(k, q, size, h, w)

    # V_x at the gap, and its part by the inputs, before the step's own cost is added
    force, linear = w.force, w.linear
    for i in range(size):
        total = linear[i]
        for j in range(size):
            total += value[i, j] * w.gap[k, j]
        force[i] = total
    pull_back(k, force, linear, q, size, h, w)
    right, curvature = w.right, w.input
    for i in range(nu):
        # An input adds h to its thrust at the end and, on average, half of that within the step: B is h times the mean
        # of A's columns by thrust and of unit vectors.
        right[i, size] = 0.5 * h * (linear[f + i] + force[f + i])
        for j in range(size):
            right[i, j] = 0.5 * h * (quadratic[f + i, j] + moved[f + i, j])
        for j in range(nu):
            both = moved[f + j, f + i] + value[f + i, f + j]
            curvature[i, j] = 0.5 * h * (right[i, f + j] + 0.5 * h * both)

    # the step's cost
    targets, asked = problem.targets, problem.asked
    for i in range(size):
        quadratic[i, i] += h * objective.state[i]
        linear[i] += h * objective.state[i] * (states[k, i] - targets[k, i])
    for i in range(nu):
        curvature[i, i] += h * objective.rate[i] + damping
        right[i, size] += h * objective.rate[i] * (inputs[k, i] - asked[k, i])
    add_tensions(k, q, size, h, objective, w)
    add_thrusts(states[k], q, h, objective, quadratic, linear)
    add_separations(states[k], q, problem, w)
    add_neighbours(k, q, problem, w)
    add_clearances(k, states[k], q, problem, w)

    # V ← Q_xx - Q_ux' Q_uu⁻¹ Q_ux, whose parts are kept while `right` becomes Q_uu⁻¹ (Q_ux, Q_u).
    factorise(curvature, nu)
    for i in range(nu):
        for j in range(size):
            w.gain[k, i, j] = right[i, j]
        w.change[k, i] = right[i, size]
    solve_factorised(curvature, right, nu, size + 1)
    for i in range(nu):
        for j in range(size):
            part = w.gain[k, i, j]
            for c in range(j + 1):
                quadratic[j, c] -= part * right[i, c]
            linear[j] -= part * right[i, size]
    for i in range(nu):
        for j in range(size):
            w.gain[k, i, j] = -right[i, j]
        w.change[k, i] = -right[i, size]
    for i in range(size):
        for j in range(i + 1):
            value[i, j] = value[j, i] = quadratic[i, j]


@kernel
def multiply_by_dynamics(k, q, size, h, w):
    """Write V_xx A to `moved`, and the lower triangle of Aᵀ V_xx A, with its last rows whole, to `quadratic`."""
    value, moved, quadratic, by_rates, effect = w.value, w.moved, w.quadratic, w.by_rates, w.effect
    euler, slope, half = w.euler[k], w.slope[k], 0.5 * h * h
    for i in range(size):
        v = value[i]
        for j in range(q):
            moved[i, j] = v[j]
            turned = v[j]
            if j == 4:
                turned = v[3] * euler[0] + v[4] * euler[2] + v[5] * euler[4]
            elif j == 5:
                turned = v[3] * euler[1] + v[4] * euler[3] + v[5] * euler[5]
            moved[i, q + j] = h * turned + v[q + j]
            by_rates[i, j] = half * turned + h * v[q + j]
        for j in range(3):
            moved[i, 3 + j] += h * (v[3] * euler[6 + j] + v[4] * euler[9 + j] + v[5] * euler[12 + j])
        for j in range(2 * q, size):
            moved[i, j] = v[j]
        for m in range(q):
            part = by_rates[i, m]
            for j in range(3, size):  # accelerations do not depend on the place
                moved[i, j] += part * slope[m, j]
    for i in range(q):
        a, b, c = 0.0, 0.0, 0.0  # by which rows 3 to 5 make row i of T' V_xx A
        if i == 4:
            a, b, c = euler[0], euler[2], euler[4]
        elif i == 5:
            a, b, c = euler[1], euler[3], euler[5]
        first, last = moved[i], moved[q + i]
        for j in range(size):
            turned = first[j]
            if i == 4 or i == 5:
                turned = a * moved[3, j] + b * moved[4, j] + c * moved[5, j]
            quadratic[i, j] = first[j]
            quadratic[q + i, j] = h * turned + last[j]
            effect[i, j] = half * turned + h * last[j]
    for i in range(3):
        a, b, c = h * euler[6 + i], h * euler[9 + i], h * euler[12 + i]
        for j in range(size):
            quadratic[3 + i, j] += a * moved[3, j] + b * moved[4, j] + c * moved[5, j]
    for i in range(2 * q, size):
        for j in range(size):
            quadratic[i, j] = moved[i, j]
    for m in range(q):
        for i in range(3, size):
            part = slope[m, i]
            if part != 0.0:
                last = size if i >= 2 * q else i + 1
                for j in range(last):
                    quadratic[i, j] += part * effect[m, j]


@kernel
def pull_back(k, force, linear, q, size, h, w):
    """Write Aᵀ `force` to `linear`."""
    euler, slope, half = w.euler[k], w.slope[k], 0.5 * h * h
    f3, f4, f5 = force[3], force[4], force[5]
    for i in range(size):
        linear[i] = force[i]
    for i in range(3):
        linear[3 + i] += h * (f3 * euler[6 + i] + f4 * euler[9 + i] + f5 * euler[12 + i])
    for i in range(q):
        turned = force[i]
        if i == 4:
            turned = f3 * euler[0] + f4 * euler[2] + f5 * euler[4]
        elif i == 5:
            turned = f3 * euler[1] + f4 * euler[3] + f5 * euler[5]
        linear[q + i] += h * turned
        part = half * turned + h * force[q + i]
        for j in range(size):
            linear[j] += part * slope[i, j]


@kernel
def find_gains(states, inputs, problem, damping, w):
    """Linearise a trajectory and write the gains and changes of its inputs; see `recur`."""
    steps = inputs.shape[0]
    for k in range(steps):
        linearise(k, states, inputs, problem, w)
    targets, objective = problem.targets, problem.objective
    w.value[:] = 0.0
    for i in range(states.shape[1]):
        w.value[i, i] = objective.end[i]
        w.linear[i] = objective.end[i] * (states[steps, i] - targets[steps, i])
    for k in range(steps - 1, -1, -1):
        recur(k, states, inputs, problem, damping, w)


@kernel
def take_step(start, states, inputs, problem, w):
    """Move a trajectory by what `find_gains` found, from where the team is, by the linearised dynamics.

    Args:
        start: (12 + 7 N,) present state.
        states, inputs: of the trajectory, overwritten.
        problem, w: see `recur`.
    """
    # The gap between what the model's own step leads to and the next state of the guess closes along the way.
    size, moved = states.shape[1], w.force  # deviation of the present state
    for i in range(size):
        moved[i] = start[i] - states[0, i]
    for k in range(inputs.shape[0]):
        change = w.change[k]
        for i in range(inputs.shape[1]):
            for j in range(size):
                change[i] += w.gain[k, i, j] * moved[j]
            inputs[k, i] += change[i]
        for i in range(size):
            states[k, i] += moved[i]
        advance(w.slope[k], w.euler[k], change, problem.step, w.lever, moved)
        for i in range(size):
            moved[i] += w.gap[k, i]
    for i in range(size):
        states[inputs.shape[0], i] += moved[i]


@kernel
def advance(slope, euler, change, h, rates, moved):
    """Move the deviation of a state (12 + 7 N,) on by a linearised step, with the change (3 N,) of its input.

    Args:
        slope, euler: of the step, see `IterationWork`.
        change: of the input.
        h: [s].
        rates: (6 + 2 N,) worked in.
        moved: the deviation, overwritten.
    """
    q, nu = slope.shape[0], change.shape[0]
    size, half = 2 * q + nu, 0.5 * h * h
    for i in range(q):  # of the accelerations
        total = 0.0
        for j in range(size):
            total += slope[i, j] * moved[j]
        for j in range(nu):
            total += slope[i, 2 * q + j] * 0.5 * h * change[j]
        rates[i] = total
    e0, e1, e2 = moved[3], moved[4], moved[5]
    t = (h * moved[q + 3] + half * rates[3], h * moved[q + 4] + half * rates[4], h * moved[q + 5] + half * rates[5])
    for i in range(q):
        moved[i] += h * moved[q + i] + half * rates[i]
        moved[q + i] += h * rates[i]
    moved[3] = e0 + t[0] + euler[0] * t[1] + euler[1] * t[2]
    moved[4] = e1 + euler[2] * t[1] + euler[3] * t[2]
    moved[5] = e2 + euler[4] * t[1] + euler[5] * t[2]
    for i in range(3):
        moved[3 + i] += h * (e0 * euler[6 + 3 * i] + e1 * euler[7 + 3 * i] + e2 * euler[8 + 3 * i])
    for i in range(nu):
        moved[2 * q + i] += h * change[i]
