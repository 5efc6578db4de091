"""A smooth transition from where the payload is to where its target goes, when an episode starts or the target leaps.

The distance from the target is a polynomial of degree five that starts with the present one and its rate of change
and ends at rest; the angle ends with it. It lasts as long as `ACCELERATION` and `ANGULAR_ACCELERATION` allow.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.control.formation import wrap
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    add,
    matmul,
    matrow,
    norm,
    put,
    rotation_vector,
    row,
    scale,
    sub,
    tmul,
    transpose,
    turn_by,
)
from multilift_marl.planning.flatness import euler_angles

ACCELERATION = 3.0  # [m/s²] about, of the payload beside its target
ANGULAR_ACCELERATION = 6.0  # [rad/s²] about
SHORTEST = 0.3  # [s]
LEAP = 0.2  # [m] of a target from where it was to be by now, from which on it has leapt
LEAP_ANGLE = 0.2  # [rad]


class Approach(NamedTuple):
    """The transitions of E teams."""

    begin: np.ndarray
    """(E,) [s]."""
    seconds: np.ndarray
    """(E,) how long it takes."""
    position: np.ndarray
    """(E, 3) from the target at first [m]."""
    velocity: np.ndarray
    """(E, 3) relative to it [m/s]."""
    angle: np.ndarray
    """(E, 3) rotation vector from it [rad]."""
    target: np.ndarray
    """(E, 12) where the target was last, and its attitude."""

    @classmethod
    def zeros(cls, num_envs: int) -> Approach:
        """Return transitions of no length."""
        e = num_envs
        return cls(np.zeros(e), np.full(e, SHORTEST), *(np.zeros((e, size)) for size in (3, 3, 3, 12)))


@kernel
def begin_approaches(time, dt, states, rotations, targets, fresh, approach):
    """Let transitions begin at time (E,) where teams are fresh or their targets have leapt.

    Args:
        time: (E,) [s].
        dt: policy step [s].
        states: (E, 12 + 7 N) of the teams, see `team_model.py`.
        rotations: (E, 3, 3) of the payload.
        targets: places (E, 2, 3) and attitudes (E, 2, 3, 3) of the targets now and `dt` later; and (E, 1, ...) at the
            last time, for which `approach.target` holds, previewed again.
        fresh: (E,) bool.
        approach: written.
    """
    (position, attitude), (was, was_attitude) = targets
    for e in range(time.shape[0]):
        target = approach.target[e]
        leap = norm(sub(row(was[e], 0), (target[0], target[1], target[2])))
        old = (
            target[3], target[4], target[5], target[6], target[7], target[8], target[9], target[10], target[11],
        )  # fmt: skip
        turned = norm(rotation_vector(matmul(matrow(was_attitude[e], 0), transpose(old))))
        if fresh[e] or leap > LEAP or turned > LEAP_ANGLE:
            q = 6 + 2 * ((states.shape[1] - 12) // 7)
            away = sub((states[e, 0], states[e, 1], states[e, 2]), row(position[e], 0))
            drift = scale(1.0 / dt, sub(row(position[e], 1), row(position[e], 0)))
            fast = sub((states[e, q], states[e, q + 1], states[e, q + 2]), drift)
            angle = rotation_vector(matmul(matrow(rotations, e), transpose(matrow(attitude[e], 0))))
            put(approach.position[e], away)
            put(approach.velocity[e], fast)
            put(approach.angle[e], angle)
            approach.begin[e] = time[e]
            longest = max(sqrt(6.0 * norm(away) / ACCELERATION), 2.5 * norm(fast) / ACCELERATION)
            approach.seconds[e] = max(longest, sqrt(6.0 * norm(angle) / ANGULAR_ACCELERATION), SHORTEST)
        for i in range(3):
            target[i] = position[e, 0, i]
            for k in range(3):
                target[3 + 3 * i + k] = attitude[e, 0, i, k]


@kernel
def write_approaches(times, rotation, approach, offsets):
    """Write what is left of the transitions, (E, K, 12), beside targets with attitudes (E, K, 3, 3) at times (E, K).

    Offsets are those of place, of roll, pitch and yaw, of velocity, and of body rates. The rest of a target state stays
    that of the target's own motion: the thrust that would fly them exactly is not asked for.
    """
    for e in range(times.shape[0]):
        seconds = approach.seconds[e]
        for k in range(times.shape[1]):
            offset = offsets[e, k]
            offset[:] = 0.0
            s = max((times[e, k] - approach.begin[e]) / seconds, 0.0)
            if s >= 1.0:
                continue
            # quintics with position 1, then velocity 1, at their start, at rest at their end; their rates of change
            left, falling = 1.0 - s**3 * (10.0 - 15.0 * s + 6.0 * s**2), -30.0 * s**2 * (1.0 - s) ** 2 / seconds
            drifting = seconds * s * (1.0 - s) ** 3 * (1.0 + 3.0 * s)
            slowing = (1.0 - s) ** 2 * (1.0 + 2.0 * s - 15.0 * s**2)
            away, fast, angle = row(approach.position, e), row(approach.velocity, e), row(approach.angle, e)
            put(offset[0:3], add(scale(left, away), scale(drifting, fast)))
            put(offset[6:9], add(scale(falling, away), scale(slowing, fast)))
            target = matrow(rotation[e], k)
            turned = turn_by(scale(left, angle), target)
            roll, pitch, yaw = euler_angles(turned)
            roll_0, pitch_0, yaw_0 = euler_angles(target)
            put(offset[3:6], (wrap(roll - roll_0), pitch - pitch_0, wrap(yaw - yaw_0)))
            put(offset[9:12], tmul(turned, scale(falling, angle)))
