"""The one shaped reward primitive; errors against the goal and their integrals; a payload at rest, cables that hold."""

from __future__ import annotations

from math import radians
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.control.formation import Goal
from multilift_marl.math3d import clip, matmul, matrow, norm, put, rotation_vector, row, sub, transpose
from multilift_marl.sim.state import SystemState
from multilift_marl.tasks.failures import FailureMask


@kernel
def tolerance(value: float, margin: float) -> float:
    """Return 1 at value 0, falling with a long tail: 1/2 at `margin`, 1/10 at three times the margin."""
    return 1.0 / (1.0 + (value / margin) ** 2)


@kernel
def action_rate(e: int, action: np.ndarray, previous: np.ndarray) -> float:
    """Return the mean square of how an action (E, N, A) of environment e differs from the last one."""
    change, count = 0.0, action.shape[1] * action.shape[2]
    for n in range(action.shape[1]):
        for k in range(action.shape[2]):
            change += (action[e, n, k] - previous[e, n, k]) ** 2
    return change / count


class Errors(NamedTuple):
    """How far the payload is from its goal."""

    position: np.ndarray
    """(E, 3) payload minus target, world frame [m]."""
    rotation: np.ndarray
    """(E, 3) rotation vector from target to payload attitude, world frame [rad]."""
    distance: np.ndarray
    """(E,) [m]."""
    angle: np.ndarray
    """(E,) [rad]."""
    position_integral: np.ndarray
    """(E, 3) ∫ position dt, each component clipped, of the way where one leads to the goal [m s]."""
    rotation_integral: np.ndarray
    """(E, 3) ∫ rotation dt, likewise [rad s]."""

    @classmethod
    def zeros(cls, num_envs: int) -> Errors:
        """Return zero errors."""
        e = num_envs
        return cls(*(np.zeros(shape) for shape in ((e, 3), (e, 3), (e,), (e,), (e, 3), (e, 3))))


class RestBounds(NamedTuple):
    """What counts as a payload at rest at its target."""

    distance: float
    """[m]."""
    angle: float
    """Of the rotation from the target attitude [rad]."""
    speed: float
    """[m/s]."""
    body_rate: float
    """[rad/s]."""


@kernel
def is_at_rest(e: int, state: SystemState, errors: Errors, bounds: RestBounds) -> bool:
    """Return whether the payload of environment e is at its target, in its attitude, and does not move."""
    placed = errors.distance[e] <= bounds.distance and errors.angle[e] <= bounds.angle
    speed, body_rate = norm(row(state.payload_velocity, e)), norm(row(state.payload_body_rates, e))
    return placed and speed <= bounds.speed and body_rate <= bounds.body_rate


@kernel
def update_peak_tension(e: int, state: SystemState, watch: FailureMask, resting: np.ndarray, peak: np.ndarray) -> None:
    """Raise `peak` (E,) to the largest tension of environment e over the resting tension of its cable [-].

    The tension is `state.cable_tension`, the mean over the last physics step. The cables of lost drones do not count.

    Args:
        e, state, watch: see their types.
        resting: tensions of the resting formation (N,) [N].
        peak: written.
    """
    for n in range(resting.shape[0]):
        if not watch.lost[e, n]:
            peak[e] = max(peak[e], state.cable_tension[e, n] / resting[n])


@kernel
def update_errors(lo, hi, state, goal, planned, is_planned, errors, dt, largest):
    """Update the errors of environments lo to hi and integrate them over `dt` [s], each integral within ± `largest`.

    Where the payload follows a planned trajectory, its distance from that is integrated: the distance from a goal still
    far away would only wind the integrals up.
    """
    for e in range(lo, hi):
        put(errors.position[e], sub(row(state.payload_position, e), row(goal.position, e)))
        turned = matmul(matrow(state.payload_rotation, e), transpose(matrow(goal.rotation, e)))
        put(errors.rotation[e], rotation_vector(turned))
        errors.distance[e] = norm(row(errors.position, e))
        errors.angle[e] = norm(row(errors.rotation, e))
        apart, twisted = row(errors.position, e), row(errors.rotation, e)
        if is_planned:
            apart = sub(row(state.payload_position, e), row(planned.position, e))
            twisted = rotation_vector(matmul(matrow(state.payload_rotation, e), transpose(matrow(planned.rotation, e))))
        for j in range(3):
            moved = errors.position_integral[e, j] + dt * apart[j]
            errors.position_integral[e, j] = clip(moved, -largest, largest)
            moved = errors.rotation_integral[e, j] + dt * twisted[j]
            errors.rotation_integral[e, j] = clip(moved, -largest, largest)


@kernel
def pose_reward(
    e: int, state: SystemState, goal: Goal, errors: Errors, share: float, weights: np.ndarray, terms: np.ndarray
) -> None:
    """Write the first five reward terms of environment e, those of a payload that is to be at its target.

    They are position, precision, attitude, level and stillness, each times its weight and `share`.
    """
    distance, angle = errors.distance[e], errors.angle[e]
    speed = norm(sub(row(state.payload_velocity, e), row(goal.velocity, e)))
    spin = norm(row(state.payload_body_rates, e))
    terms[e, 0] = weights[0] * tolerance(distance, 0.25) * share
    terms[e, 1] = weights[1] * tolerance(distance, 0.01) * share
    terms[e, 2] = weights[2] * tolerance(angle, radians(6.0)) * share
    terms[e, 3] = weights[3] * tolerance(angle, radians(1.0)) * share
    terms[e, 4] = weights[4] * tolerance(speed, 0.2) * tolerance(spin, 0.3) * share
