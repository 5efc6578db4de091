"""Thrust allocation: from total thrust and body torque to the thrust of each rotor (report eqs 5-11)."""

from __future__ import annotations

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.config.vehicles import Vehicle
from multilift_marl.math3d import clip


def allocation_matrix(vehicle: Vehicle) -> np.ndarray:
    """Return A (4, 4) with (T, M_x, M_y, M_z) = A f for rotor thrusts f [N]; eq 11 for any layout and spin."""
    position = vehicle.rotor_positions
    return np.stack(
        [np.ones(4), position[:, 1], -position[:, 0], vehicle.torque_ratio * np.asarray(vehicle.rotor_spin)]
    )


@kernel
def allocate(thrust, torque, inverse, low, high):
    """Return the four rotor thrusts [N] for a thrust and a torque.

    Thrust, roll and pitch go first: the yaw torque is scaled down until every rotor is within its limits, and only
    what even then lies outside is clipped.

    Args:
        thrust: total thrust [N].
        torque: body torque, a tuple of 3 [N m].
        inverse: inverse of `allocation_matrix` (4, 4).
        low, high: limits of one rotor [N].
    """
    share = 1.0
    for k in range(4):
        base = inverse[k, 0] * thrust + inverse[k, 1] * torque[0] + inverse[k, 2] * torque[1]
        yaw = inverse[k, 3] * torque[2]
        room = (high - base) if yaw > 0.0 else (low - base)
        if abs(yaw) > 1e-12:
            share = min(share, max(room / yaw, 0.0))
    f0 = _rotor(0, thrust, torque, inverse, low, high, share)
    f1 = _rotor(1, thrust, torque, inverse, low, high, share)
    f2 = _rotor(2, thrust, torque, inverse, low, high, share)
    f3 = _rotor(3, thrust, torque, inverse, low, high, share)
    return (f0, f1, f2, f3)


@kernel
def _rotor(k, thrust, torque, inverse, low, high, share):
    base = inverse[k, 0] * thrust + inverse[k, 1] * torque[0] + inverse[k, 2] * torque[1]
    return clip(base + share * inverse[k, 3] * torque[2], low, high)
