"""Thrust allocation: from total thrust and body torque to the thrust of each rotor (report eqs 5-11)."""

from __future__ import annotations

from multilift_marl._jit import kernel
from multilift_marl.math3d import clip


@kernel
def allocate(thrust, torque, inverse, low, high):
    """Return the four rotor thrusts [N] for a thrust and a torque.

    Thrust, roll and pitch go first: the yaw torque is scaled down until every rotor is within its limits, and only
    what even then lies outside is clipped.

    Args:
        thrust: total thrust [N].
        torque: body torque, a tuple of 3 [N m].
        inverse: inverse of `Vehicle.allocation` (4, 4).
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
