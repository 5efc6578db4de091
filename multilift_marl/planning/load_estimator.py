"""What acts on a payload that the reduced model does not know: mass beside the nominal one, a force, a moment.

Between two states that are measured one after the other, the model's accelerations in the middle lack r of the measured
ones; M r, with M the 6 × 6 mass matrix of payload and cables, is the missing wrench. Its force is f − Δm (a + g e_z): a
Kalman filter with a constant Δm and a force f that wanders tells the two apart when the payload accelerates. The moment
is smoothed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.team_model import ModelWork, TeamModel, accelerations

MASS = 0.3  # of the payload's, standard deviation of Δm at first
FORCE = 0.05  # of its weight: of f at first, and by which it wanders in a second
MASS_DRIFT = 0.02  # of the payload's mass, by which Δm wanders in a second
MOMENT_SECONDS = 0.5  # in which the moment is smoothed
LARGEST = 0.6  # of the payload's mass and weight, that estimates are at most


class LoadEstimate(NamedTuple):
    """What is estimated of E teams."""

    loads: np.ndarray
    """(E, 7) force [N], moment [N m] and mass [kg], see `team_model.accelerations`."""
    covariance: np.ndarray
    """(E, 4, 4) of Δm and f."""
    before: np.ndarray
    """(E, 12 + 7 N) the last states."""
    fresh: np.ndarray
    """(E,) bool, teams without a last state."""


class LoadEstimator:
    """Estimates of E teams.

    Args:
        model: nominal.
        num_envs: E.
        noise: of a measured force, over the payload's weight [-].

    Attributes:
        estimate: LoadEstimate, live.
    """

    def __init__(self, model: TeamModel, num_envs: int, noise: float):
        n = len(model.anchors)
        size, e = 12 + 7 * n, num_envs
        self._model, self._noise = model, noise
        self._work = EstimatorWork(ModelWork.of(n), np.zeros(size), np.zeros((6, 6)), np.zeros(6))
        self.estimate = LoadEstimate(np.zeros((e, 7)), np.zeros((e, 4, 4)), np.zeros((e, size)), np.ones(e, bool))

    def update(self, states: np.ndarray, dt: float) -> np.ndarray:
        """Return the loads (E, 7), live, after states (E, 12 + 7 N) that are measured `dt` [s] after the last ones."""
        update_loads(states, dt, self._model, self._noise, self.estimate, self._work)
        return self.estimate.loads


class EstimatorWork(NamedTuple):
    """Arrays that estimates are made in."""

    model: ModelWork
    middle: np.ndarray
    mass: np.ndarray
    missing: np.ndarray


@kernel
def update_loads(states, dt, model, noise, estimate, work):
    """See `LoadEstimator.update`."""
    weight = model.payload_mass * GRAVITY
    for e in range(states.shape[0]):
        x, before, load = states[e], estimate.before[e], estimate.loads[e]
        if estimate.fresh[e]:
            estimate.fresh[e] = False
            load[:] = 0.0
            estimate.covariance[e] = 0.0
            estimate.covariance[e, 0, 0] = (MASS * model.payload_mass) ** 2
            for i in range(3):
                estimate.covariance[e, 1 + i, 1 + i] = (FORCE * weight) ** 2
        else:
            _find_missing_wrench(x, before, dt, model, work)
            _correct(e, dt, model.payload_mass, noise, estimate, work)
            for i in range(3):
                load[3 + i] += dt / MOMENT_SECONDS * (work.missing[3 + i] - load[3 + i])
        for i in range(x.shape[0]):
            before[i] = x[i]


@kernel
def _find_missing_wrench(x, before, dt, model, work):
    """Write to `missing` the wrench that the nominal model lacks between two states, and to `middle` their mean."""
    q = 6 + 2 * model.anchors.shape[0]
    middle, w, missing = work.middle, work.model, work.missing
    for i in range(x.shape[0]):
        middle[i] = 0.5 * (x[i] + before[i])
    missing[:] = 0.0
    w.nothing[:] = 0.0
    accelerations(middle, model, w.nothing, w)
    for i in range(6):  # M = L Lᵀ, whose factor is what `accelerations` leaves
        work.mass[i, 0] = (x[q + i] - before[q + i]) / dt - w.acceleration[i]
    for k in range(6):
        inner = 0.0
        for i in range(k, 6):
            inner += w.mass[i, k] * work.mass[i, 0]
        for i in range(k, 6):
            missing[i] += w.mass[i, k] * inner
    for i in range(3):
        work.mass[i, 1] = (x[q + i] - before[q + i]) / dt


@kernel
def _correct(e, dt, payload_mass, noise, estimate, work):
    """Correct Δm and f of environment e by the missing force, one axis after the other: their noise is independent."""
    p, load = estimate.covariance[e], estimate.loads[e]
    weight = payload_mass * GRAVITY
    p[0, 0] += (MASS_DRIFT * payload_mass) ** 2 * dt
    for i in range(3):
        p[1 + i, 1 + i] += (FORCE * weight) ** 2 * dt
    for i in range(3):
        by_mass = -(work.mass[i, 1] + (GRAVITY if i == 2 else 0.0))
        wrong = work.missing[i] - (by_mass * load[6] + load[i])
        g = work.middle  # the gain, whose first four are free by now
        for k in range(4):
            g[k] = by_mass * p[k, 0] + p[k, 1 + i]
        total = by_mass * g[0] + g[1 + i] + (noise * weight) ** 2
        for k in range(4):
            for j in range(k + 1):
                p[k, j] = p[j, k] = p[k, j] - g[k] * g[j] / total
        load[6] = _within(load[6] + g[0] / total * wrong, LARGEST * payload_mass)
        for k in range(3):
            load[k] = _within(load[k] + g[1 + k] / total * wrong, LARGEST * weight)


@kernel
def _within(value, bound):
    return min(max(value, -bound), bound)
