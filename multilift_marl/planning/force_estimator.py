"""What acts on a team that the reduced model does not know.

On the payload that is a force, a moment and mass beside the nominal one; on each drone a force: wind, its own mass,
rotors that give more or less than their speeds say.

Between two states that are measured one after the other, the model's accelerations in their middle lack r of the
measured ones. A Kalman filter explains r by the unknowns, whose effects H are differences of the model's accelerations,
and by priors of how large each is and how fast it wanders: these decide where the motion does not tell two apart.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.control.formation import wrap
from multilift_marl.kernels.jit import kernel
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.team_model import ModelWork, TeamModel, accelerations

MASS = 0.3, 0.02  # of the payload's: standard deviation of the mass at first, and by which it wanders in a second
FORCE = 0.05, 0.35  # of its weight, likewise
MOMENT = 0.02, 0.35  # of its weight times the mean distance of its anchors
DRONE = 0.1, 0.5  # of a drone's weight and share of the load; with twice the drift late sensors make it swing
LARGEST = 0.6  # of these, that estimates are at most
PAYLOAD = 7  # unknowns of the payload, see `team_model.accelerations`
UNSEEN = 1e12  # [m²/s⁴] variance of accelerations that nobody measures
_STEP = 1e-3  # of differences, over the unknown's scale


class ForceEstimate(NamedTuple):
    """What is estimated of E teams."""

    unknowns: np.ndarray
    """(E, 7 + 3 N) force [N], moment [N m] and mass [kg] of the payload, force on each drone, world frame [N]."""
    covariance: np.ndarray
    """(E, 7 + 3 N, 7 + 3 N)."""
    before: np.ndarray
    """(E, 12 + 7 N) the last states."""
    fresh: np.ndarray
    """(E,) bool, teams of which nothing is known."""
    stale: np.ndarray
    """(E,) bool, teams whose last state is older than a step, or missing."""


class Priors(NamedTuple):
    """What is thought of unknowns beforehand, (P, 7 + 3 N) each, and of what is measured; team e by row e modulo P."""

    scale: np.ndarray
    """Of each unknown, which bounds it and sets the steps of differences."""
    first: np.ndarray
    """Variance at first."""
    drift: np.ndarray
    """Variance that a second adds."""
    noise: np.ndarray
    """(P, 6 + 2 N) variance of measured accelerations."""


def make_priors(model: TeamModel, noise: float, apart: bool = False) -> Priors:
    """Return the priors of a team.

    Args:
        model: nominal.
        noise: of measured accelerations, over gravity.
        apart: as each drone has them, which measures but the payload and itself (P = N); else one of all (P = 1).
    """
    n = len(model.anchors)
    # A point has no arms; what is thought of moments on it has no effect.
    mass, arm = model.payload_mass, float(np.linalg.norm(model.anchors, axis=1).mean() or model.length.mean())
    weight = mass * GRAVITY
    own = (model.drone_mass + mass / n) * GRAVITY
    parts = [(weight, 3, FORCE), (weight * arm, 3, MOMENT), (mass, 1, MASS), *((each, 3, DRONE) for each in own)]
    scale, first, drift = (
        np.concatenate([np.full(count, size * factor) for size, count, factor in each])
        for each in (
            [(size, count, 1.0) for size, count, _ in parts],
            [(size, count, share[0]) for size, count, share in parts],
            [(size, count, share[1]) for size, count, share in parts],
        )
    )
    shaken = noise * GRAVITY / np.concatenate([np.ones(3), np.full(3, arm), np.repeat(model.length, 2)])
    priors = Priors(*(np.tile(each, (n if apart else 1, 1)) for each in (scale, first**2, drift**2, shaken**2)))
    if apart:
        others = ~np.eye(n, dtype=bool)
        priors.first[:, PAYLOAD:][np.repeat(others, 3, axis=1)] = 0.0
        priors.drift[:, PAYLOAD:][np.repeat(others, 3, axis=1)] = 0.0
        priors.noise[:, 6:][np.repeat(others, 2, axis=1)] = UNSEEN
    return priors


class ForceEstimator:
    """Estimates of E teams.

    Args:
        model: nominal.
        num_envs: E.
        noise: of measured accelerations, over gravity [-].
        apart: see `make_priors`.

    Attributes:
        estimate: ForceEstimate, live.
        priors: Priors.
    """

    def __init__(self, model: TeamModel, num_envs: int, noise: float, apart: bool = False):
        n = len(model.anchors)
        size, count, e = 12 + 7 * n, PAYLOAD + 3 * n, num_envs
        self._model, self.priors = model, make_priors(model, noise, apart)
        self._work = EstimatorWork(
            ModelWork.of(n), np.zeros(size), np.zeros(PAYLOAD), np.zeros(6 + 2 * n), np.zeros((6 + 2 * n, count)),
            np.zeros(count),
        )  # fmt: skip
        self.estimate = ForceEstimate(
            np.zeros((e, count)), np.zeros((e, count, count)), np.zeros((e, size)), np.ones(e, bool), np.ones(e, bool)
        )

    @property
    def loads(self) -> np.ndarray:
        """(E, 7) of the payload, see `team_model.accelerations`, live."""
        return self.estimate.unknowns[:, :PAYLOAD]

    @property
    def forces(self) -> np.ndarray:
        """(E, 3 N) on the drones, world frame [N], live."""
        return self.estimate.unknowns[:, PAYLOAD:]

    def update(self, states: np.ndarray, dt: float, known: np.ndarray) -> None:
        """Estimate by states (E, 12 + 7 N), measured `dt` [s] after the last, whose thrust vectors hold `forces`.

        Estimates of teams whose states are not `known` (E,) stay as they are.
        """
        update_forces(states, dt, known, self._model, self.priors, self.estimate, self._work)


class EstimatorWork(NamedTuple):
    """Arrays that estimates are made in."""

    model: ModelWork
    middle: np.ndarray
    load: np.ndarray
    missing: np.ndarray
    effect: np.ndarray
    """H."""
    gain: np.ndarray


@kernel
def update_forces(states, dt, known, model, priors, estimate, work):
    """See `ForceEstimator.update`."""
    for e in range(states.shape[0]):
        x, before, p = states[e], estimate.before[e], estimate.covariance[e]
        row = e % priors.scale.shape[0]
        own = Priors(priors.scale[row], priors.first[row], priors.drift[row], priors.noise[row])
        if estimate.fresh[e]:
            estimate.fresh[e], estimate.stale[e] = False, True
            estimate.unknowns[e] = 0.0
            p[:] = 0.0  # what is first thought of one unknown says nothing of the others
            for i in range(p.shape[0]):
                p[i, i] = own.first[i]
        if not estimate.stale[e] and known[e]:
            _find_effects(x, before, dt, estimate.unknowns[e], model, own, work)
            for i in range(p.shape[0]):
                p[i, i] += dt * own.drift[i]
            _correct(estimate.unknowns[e], p, own, work)
        estimate.stale[e] = not known[e]
        for i in range(x.shape[0]):
            before[i] = x[i]


@kernel
def _find_effects(x, before, dt, unknowns, model, priors, work):
    """Write the accelerations that the model lacks between two states, and what each unknown would add to them."""
    q = 6 + 2 * model.anchors.shape[0]
    middle, w, load, missing, effect = work.middle, work.model, work.load, work.missing, work.effect
    for i in range(x.shape[0]):
        middle[i] = 0.5 * (x[i] + before[i])
    middle[5] = before[5] + 0.5 * wrap(x[5] - before[5])
    for i in range(PAYLOAD):
        load[i] = unknowns[i]
    accelerations(middle, model, load, w)
    for i in range(q):
        missing[i] = w.acceleration[i]
    # Accelerations are almost linear in the unknowns: one-sided differences will do.
    for k in range(unknowns.shape[0]):
        step = _STEP * priors.scale[k]
        changed, at = (load, k) if k < PAYLOAD else (middle, 2 * q + k - PAYLOAD)
        kept = changed[at]
        changed[at] = kept + step
        accelerations(middle, model, load, w)
        changed[at] = kept
        for i in range(q):
            effect[i, k] = (w.acceleration[i] - missing[i]) / step
    for i in range(q):
        missing[i] = (x[q + i] - before[q + i]) / dt - missing[i]


@kernel
def _correct(unknowns, p, priors, work):
    """Correct unknowns and their covariance by one acceleration after the other: their noise is independent."""
    count, gain = unknowns.shape[0], work.gain
    for m in range(work.missing.shape[0]):
        h, wrong, total = work.effect[m], work.missing[m], priors.noise[m]
        # Kalman's update by a scalar: gain P h / (hᵀ P h + r), then P - P h hᵀ P / (hᵀ P h + r).
        for k in range(count):
            gain[k] = 0.0
            for j in range(count):
                gain[k] += p[k, j] * h[j]
            total += h[k] * gain[k]
        for k in range(count):
            change = gain[k] / total * wrong
            bound = LARGEST * priors.scale[k]
            after = min(max(unknowns[k] + change, -bound), bound)
            # what has been explained is no longer missing
            for i in range(m + 1, work.missing.shape[0]):
                work.missing[i] -= work.effect[i, k] * (after - unknowns[k])
            unknowns[k] = after
            for j in range(k + 1):
                p[k, j] = p[j, k] = p[k, j] - gain[k] * gain[j] / total
