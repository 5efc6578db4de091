"""Set-points below the position: how an action interface moves the references that `geometric.fly` follows.

A reference whose position is the drone's own leaves the velocity to be followed, one whose velocity is the drone's own,
too, the acceleration. Body rates and total thrust go to `geometric.fly_rates`; rotor thrusts need no controller.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.control.formation import smooth_yaw
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, put, scale, sub, vec


class Setpoint(NamedTuple):
    """What drones are to do beside or below a position, until the next action."""

    velocity: np.ndarray
    """(E, N, 3) world frame [m/s]."""
    rates: np.ndarray
    """(E, N, 3) body rates [rad/s]."""
    thrust: np.ndarray
    """(E, N) total thrust [N]."""
    full_state: np.ndarray
    """(E, N, 16) motion and cable force beside the slot's, see `full_state.py`."""
    cable_force: np.ndarray
    """(E, N, 3) force on each cable, where an interface commands it, world frame [N]."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> Setpoint:
        """Return set-points of zero."""
        e, n = num_envs, num_drones
        return cls(*(np.zeros(shape) for shape in ((e, n, 3), (e, n, 3), (e, n), (e, n, 16), (e, n, 3))))


@kernel
def smooth_velocity(lo, hi, state, reference, setpoint, frequency, dt):
    """Move the reference velocities of environments lo to hi one control step towards their set-points.

    The filter is critically damped, (s/ω + 1)², so that acceleration and jerk can be fed forward. The yaw moves at
    its rate; the reference position is the drone's own.
    """
    w = frequency
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            v, a = vec(reference.velocity, e, n), vec(reference.acceleration, e, n)
            jerk = sub(scale(w * w, sub(vec(setpoint.velocity, e, n), v)), scale(2.0 * w, a))
            a = add(a, scale(dt, jerk))
            put(reference.velocity[e, n], add(v, scale(dt, a)))
            put(reference.acceleration[e, n], a)
            put(reference.jerk[e, n], jerk)
            put(reference.position[e, n], vec(state.drone_position, e, n))
            reference.yaw[e, n] += dt * reference.yaw_rate[e, n]


@kernel
def track_own_state(lo, hi, state, reference, dt):
    """Let reference positions and velocities of environments lo to hi be the drones' own; the yaw moves at its rate."""
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            put(reference.position[e, n], vec(state.drone_position, e, n))
            put(reference.velocity[e, n], vec(state.drone_velocity, e, n))
            reference.yaw[e, n] += dt * reference.yaw_rate[e, n]


@kernel
def track_own_state_to_yaw(lo, hi, state, reference, frequency, dt):
    """Do as `track_own_state`, but move the yaw towards the commanded one."""
    track_own_state(lo, hi, state, reference, 0.0)
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            smooth_yaw(e, n, reference, frequency, dt)
