"""A quadratic program of the planner's size for PIQP: the problem linearised at rest, for `bench/planner.py`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from multilift_marl.physical import GRAVITY
from multilift_marl.planning.expert import TeamExpert
from multilift_marl.planning.riccati import IterationWork, Problem, linearise, pull_back


def dynamics(expert: TeamExpert, rest: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A and B of a step at rest, and the derivatives (N, 12 + 7 N) of the tensions."""
    n, size = len(expert.model.anchors), len(rest)
    w, inputs, states = IterationWork.of(1, n), np.zeros((1, 3 * n)), np.tile(rest, (2, 1))
    problem = Problem(states, inputs, h, expert.model, np.zeros((1, 7)), expert.objective, expert.around)
    linearise(0, states, inputs, problem, w)
    a = np.zeros((size, size))
    for i in range(size):
        pull_back(0, np.eye(size)[i], a[i], 6 + 2 * n, size, h, w)
    thrusts = np.eye(size)[:, -3 * n :]
    return a, 0.5 * h * (a @ thrusts + thrusts), w.tension_slope[0].copy()


def time_piqp(expert: TeamExpert, starts: np.ndarray) -> np.ndarray:
    """Return the processor times [ms] of PIQP for these starts: K steps, with tensions and thrusts as hard limits.

    Raises:
        ModuleNotFoundError: PIQP or SciPy is not installed.
    """
    import piqp
    import scipy.sparse as sp

    n, steps = len(expert.model.anchors), len(expert.times) - 1
    h, rest = float(expert.times[1, 2] - expert.times[0, 2]), expert.rest_states(np.array([0.0, 0.0, 1.0]))[0]
    objective, limits = expert.objective, expert.limits
    size, nu = len(rest), 3 * n
    a, b, slope = dynamics(expert, rest, h)
    thrust = rest[-nu:].reshape(n, 3)
    lift = np.linalg.norm(thrust, axis=1)
    along = sp.hstack([sp.csr_matrix((n, size - nu)), sp.block_diag((thrust / lift[:, None])[:, None])])
    pull = np.linalg.norm(thrust - expert.model.drone_mass[:, None] * [0.0, 0.0, GRAVITY], axis=1)
    each = sp.diags(np.concatenate([h * objective.state, h * objective.rate]))
    cost = sp.block_diag([each] * steps + [sp.diags(objective.end)]).tocsc()
    total, both = cost.shape[0], size + nu
    rows, bounded = [sp.hstack([sp.eye(size), sp.csr_matrix((size, total - size))])], []
    for k in range(steps):
        before, after = sp.csr_matrix((size, k * both)), sp.csr_matrix((size, total - (k + 1) * both - size))
        rows.append(sp.hstack([before, a, b, -sp.eye(size), after]))
        here = sp.vstack([sp.csr_matrix(slope), along]) if k else sp.csr_matrix((2 * n, size))
        left, right = sp.csr_matrix((2 * n, k * both)), sp.csr_matrix((2 * n, total - k * both - size))
        bounded.append(sp.hstack([left, here, right]))
    equal, limited = sp.vstack(rows).tocsc(), sp.vstack(bounded).tocsc()
    low = np.tile(np.r_[limits.tension - pull, limits.least - lift], steps)
    high = np.tile(np.r_[np.full(n, 100.0), limits.largest - lift], steps)
    solver: Any = piqp.SparseSolver()
    solver.settings.verbose = False
    solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    times = []
    for i, start in enumerate(starts):
        right = np.concatenate([start - rest, np.zeros(steps * size)])
        if i == 0:
            solver.setup(cost, np.zeros(total), equal, right, limited, low, high)
        else:
            solver.update(b=right)
        began = time.thread_time()
        solver.solve()
        times.append(1e3 * (time.thread_time() - began))
    return np.array(times)
