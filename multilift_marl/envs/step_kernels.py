"""What a policy step does around its stages: it takes actions, finds episodes that end, and sums up rewards."""

from __future__ import annotations

from math import isfinite
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.mdp.failures import DIVERGED

TAKEN, ENDED, NOT_FINITE = range(3)  # what becomes of actions


class Outcome(NamedTuple):
    """What the last step of E environments led to, nothing where it was a reset; live arrays."""

    observation: np.ndarray
    """(E, N, D) float32."""
    terms: np.ndarray
    """(E, T) weighted reward terms."""
    reward: np.ndarray
    """(E, N) float32, of the drones."""
    flags: np.ndarray
    """(5, E) bool: terminated, truncated, a success, a failure, diverged."""
    cause: np.ndarray
    """(E,) int64 causes of failures, 0 without one."""

    @staticmethod
    def of(observation: np.ndarray, terms: np.ndarray) -> Outcome:
        """Return that of environments that were never stepped, from the live arrays of their task."""
        e, n = observation.shape[:2]
        return Outcome(observation, terms, np.zeros((e, n), np.float32), np.zeros((5, e), bool), np.zeros(e, np.int64))

    def clear(self, mask: np.ndarray) -> None:
        """Forget the last step of the environments in `mask` (E,)."""
        self.flags[:, mask] = False
        self.cause[mask] = 0
        self.reward[mask] = 0.0


@kernel
def take_actions(given, ended, action, previous):
    """Clip the actions of all environments to [-1, 1], or take none of them.

    Args:
        given: (E, N, A).
        ended: (E,) bool, environments that cannot go on.
        action: written, (E, N, A).
        previous: written, the actions before (E, N, A).

    Returns:
        TAKEN, or why none was: ENDED, or else NOT_FINITE.
    """
    # All are looked at before any is taken: a step that is refused changes nothing.
    for e in range(ended.shape[0]):
        if ended[e]:
            return ENDED
    for e in range(given.shape[0]):
        for n in range(given.shape[1]):
            for k in range(given.shape[2]):
                if not isfinite(given[e, n, k]):
                    return NOT_FINITE
    for e in range(given.shape[0]):
        for n in range(given.shape[1]):
            for k in range(given.shape[2]):
                previous[e, n, k] = action[e, n, k]
                action[e, n, k] = min(max(given[e, n, k], -1.0), 1.0)
    return TAKEN


@kernel
def end_step(diverged, cause, num_causes, steps, max_steps, ended, outcome):
    """Count a step of all environments, find those whose episodes end, and sum up their rewards.

    Args:
        diverged: (E,) bool; such a step has no reward.
        cause: (E,) int64, of failures; written where the simulation has diverged.
        num_causes: of failures, none among them.
        steps: policy steps so far (E,); one more.
        max_steps: of an episode.
        ended: written, (E,) bool.
        outcome: Outcome, written; whether time limits are successes is for the task to say.

    Returns:
        How many episodes have reached their time limit, and an environment whose reward is not finite, or whose cause
        is none, or -1.
    """
    flags = outcome.flags
    terms = outcome.terms
    out_of_time, bad = 0, -1
    for e in range(steps.shape[0]):
        steps[e] += 1
        if diverged[e]:
            cause[e] = DIVERGED
            terms[e] = 0.0
        terminated = cause[e] > 0
        truncated = steps[e] >= max_steps and not terminated
        ended[e] = terminated or truncated
        out_of_time += truncated
        flags[0, e] = flags[3, e] = terminated
        flags[1, e] = truncated
        flags[2, e] = False
        flags[4, e] = diverged[e]
        outcome.cause[e] = cause[e]
        reward = _sum(terms[e])
        if not isfinite(reward) or cause[e] < 0 or cause[e] >= num_causes:
            bad = e
        for n in range(outcome.reward.shape[1]):
            outcome.reward[e, n] = reward
    return out_of_time, bad


@kernel
def _sum(terms):
    """Return the sum of terms (T,), in NumPy's order, which is this one for up to 128 terms."""
    total = 0.0
    first = 0
    if terms.shape[0] >= 8:
        a, b, c, d = terms[0], terms[1], terms[2], terms[3]
        p, q, r, s = terms[4], terms[5], terms[6], terms[7]
        for i in range(8, terms.shape[0] - 7, 8):
            a, b, c, d = a + terms[i], b + terms[i + 1], c + terms[i + 2], d + terms[i + 3]
            p, q, r, s = p + terms[i + 4], q + terms[i + 5], r + terms[i + 6], s + terms[i + 7]
        total = ((a + b) + (c + d)) + ((p + q) + (r + s))
        first = terms.shape[0] // 8 * 8
    for i in range(first, terms.shape[0]):
        total += terms[i]
    return total
