"""What drones that plan for themselves tell each other: their cables and thrusts ahead, and the load as they see it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.rng import uniform

SAID = 7  # numbers that a drone says of each step: its cable 4, its thrust vector 3
BYTES = 4  # of each


class Post(NamedTuple):
    """What drones have said in the last policy steps."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers that decide which messages are lost."""
    steps: np.ndarray
    """(E,) policy steps of the episode."""
    sent: np.ndarray
    """(E, D + 1, N, K + 1, 7) of the last steps, at their number modulo D + 1."""
    sent_loads: np.ndarray
    """(E, D + 1, N, 7) what each estimated of the load then."""
    loads: np.ndarray
    """(E, N, N, 7) what the first last heard of the second's estimate."""
    has_loads: np.ndarray
    """(E, N, N) bool, whether it has."""
    in_range: np.ndarray
    """(E, N, N) bool, whether the radio of the second reaches the first now."""


@kernel
def said_at(i, n, q):
    """Return where the i-th of the numbers that drone n says is in a team's vector."""
    if i < 2:
        return 6 + 2 * n + i
    if i < 4:
        return q + 6 + 2 * n + i - 2
    return 2 * q + 3 * n + i - 4


@kernel
def believe(m, said, later, states, inputs, h):
    """Write what drone m said into a plan of the team, `later` [steps] after it did; its last step stays."""
    steps = inputs.shape[0]
    q = 6 + 2 * (inputs.shape[1] // 3)
    for k in range(steps + 1):
        at = min(k + later, 1.0 * steps)
        j = min(int(at), steps - 1)
        s = at - j
        for i in range(SAID):
            states[k, said_at(i, m, q)] = (1.0 - s) * said[j, i] + s * said[j + 1, i]
    for k in range(steps):
        for i in range(3):
            at = 2 * q + 3 * m + i
            inputs[k, 3 * m + i] = (states[k + 1, at] - states[k, at]) / h


@kernel
def _is_sound(said):
    """Return whether all that was said is finite."""
    total = 0.0  # one number that is not makes the sum so
    for k in range(said.shape[0]):
        for i in range(SAID):
            total += said[k, i]
    return np.isfinite(total)


@kernel
def hear(e, slot, later, links, post, plans, h):
    """Let the drones of team e believe what those have said whom they hear, `later` [steps] ago.

    A plan that was not finite is not believed: all that hear of it would fail in turn.
    """
    said = post.sent[e, slot]
    count = said.shape[0]
    for n in range(count):
        for m in range(count):
            # A loss is drawn in any case: the draws of others stay the same.
            arrives = links.partners[n, m] and uniform(e, post) > links.loss and post.in_range[e, n, m]
            if arrives and _is_sound(said[m]):
                t = e * count + n
                believe(m, said[m], later, plans.states[t], plans.inputs[t], h)
                post.has_loads[e, n, m] = True
                for i in range(7):
                    post.loads[e, n, m, i] = post.sent_loads[e, slot, m, i]


@kernel
def seed_of(start):
    """Return a seed that belongs to a team's first state, whatever environments it is planned with."""
    total = np.uint64(0)
    for i in range(start.shape[0]):
        total = total * np.uint64(6364136223846793005) + np.uint64(int(abs(start[i]) * 1e9))
    return total
