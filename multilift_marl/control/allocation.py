"""Thrust allocation: from total thrust and body torque to the thrust of each rotor (report eqs 5-11).

Rotors that saturate cannot give both. The order of priority is roll and pitch torque, then total thrust, then yaw
torque (Brescianini and D'Andrea, "Tilt-Prioritized Quadrocopter Attitude Control", TCST 2018; so does PX4's sequential
desaturation): thrust is of no use to a drone that cannot turn it upward. Each comes as near to what is commanded as
those before it leave. The share of roll and pitch is found without yaw, which could raise it where rotors that turn
alike are not opposite: by 2 % with arms that differ by 30 %.
"""

from __future__ import annotations

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import clip


@kernel
def allocate(thrust, torque, inverse, low, high):
    """Return the four rotor thrusts [N] for a thrust and a torque, by priority where rotors saturate.

    Args:
        thrust: total thrust [N].
        torque: body torque, a tuple of 3 [N m].
        inverse: inverse of `Vehicle.allocation` (4, 4); its first column must be positive.
        low, high: limits of one rotor [N].
    """
    # All of thrust, roll and pitch, with as much yaw as that leaves: the rule, and always where the rotors can do it.
    roll, pitch, total = torque[0], torque[1], thrust
    least, most = _yaw_range(total, roll, pitch, torque[2], inverse, low, high)
    if least > most:
        # Roll and pitch: the largest share of them that some total thrust leaves within the limits of all rotors.
        # Rotor k bounds that thrust by (low - share t_k)/a_k and (high - share t_k)/a_k; no lower bound may exceed an
        # upper one.
        share = 1.0
        for k in range(4):
            a = inverse[k, 0]
            tilt = inverse[k, 1] * torque[0] + inverse[k, 2] * torque[1]
            for j in range(4):
                b = inverse[j, 0]
                need = (inverse[j, 1] * torque[0] + inverse[j, 2] * torque[1]) / b - tilt / a
                room = high / b - low / a
                if need > room:
                    share = min(share, max(room, 0.0) / need)
        roll, pitch = share * torque[0], share * torque[1]

        # Thrust: as near to the commanded one as that leaves, and what it leaves of yaw.
        least, most = _thrust_range(roll, pitch, torque[2], inverse, low, high)
        total = min(max(thrust, least), most)
        least, most = _yaw_range(total, roll, pitch, torque[2], inverse, low, high)
    wrench = (total, roll, pitch, max(most, 0.0) * torque[2])
    f0 = _rotor(0, wrench, inverse, low, high)
    f1 = _rotor(1, wrench, inverse, low, high)
    f2 = _rotor(2, wrench, inverse, low, high)
    f3 = _rotor(3, wrench, inverse, low, high)
    return (f0, f1, f2, f3)


@kernel
def _thrust_range(roll, pitch, yaw, inverse, low, high):
    """Return the least and the largest total thrust that some share of a yaw torque, from 0 to 1, makes possible [N].

    Limits of rotors and share are ten half planes, `a y + b T <= c`; of two of which one bounds the share y from above
    and one from below, their sum in which it cancels bounds the thrust T (Fourier and Motzkin's elimination).
    """
    least, most = -1e30, 1e30
    for i in range(10):
        a, b, c = _half_plane(i, roll, pitch, yaw, inverse, low, high)
        if a == 0.0 and b != 0.0:
            least, most = (least, min(most, c / b)) if b > 0.0 else (max(least, c / b), most)
        if not a > 0.0:
            continue
        for j in range(10):
            below, slope, bound = _half_plane(j, roll, pitch, yaw, inverse, low, high)
            if not below < 0.0:
                continue
            first, second = -below * b, a * slope
            # Rotors that turn alike leave the thrust out, but for round-off.
            if abs(first + second) > 1e-9 * (abs(first) + abs(second)):
                limit = (-below * c + a * bound) / (first + second)
                least, most = (least, min(most, limit)) if first + second > 0.0 else (max(least, limit), most)
    return least, most


@kernel
def _half_plane(i, roll, pitch, yaw, inverse, low, high):
    """Return a, b, c of limit i on a share of a yaw torque and the thrust: of a rotor 0 to 7, of the share 8 and 9."""
    if i > 7:
        return (1.0, 0.0, 1.0) if i == 8 else (-1.0, 0.0, 0.0)
    k = i // 2
    tilt = inverse[k, 1] * roll + inverse[k, 2] * pitch
    if i % 2 == 0:
        return inverse[k, 3] * yaw, inverse[k, 0], high - tilt
    return -inverse[k, 3] * yaw, -inverse[k, 0], tilt - low


@kernel
def _yaw_range(thrust, roll, pitch, yaw, inverse, low, high):
    """Return the least and the largest share of a yaw torque, from 0 to 1, with which all rotors keep their limits.

    There is none where the least exceeds the largest.
    """
    least, most = 0.0, 1.0
    for k in range(4):
        base = inverse[k, 0] * thrust + inverse[k, 1] * roll + inverse[k, 2] * pitch
        change = inverse[k, 3] * yaw
        # A rotor that yaw does not load decides by its limits alone; the quotients would be infinite.
        if abs(change) > 1e-12:
            first, second = (low - base) / change, (high - base) / change
            least, most = max(least, min(first, second)), min(most, max(first, second))
        elif base < low or base > high:
            least, most = 1.0, 0.0
    return least, most


@kernel
def _rotor(k, wrench, inverse, low, high):
    thrust, roll, pitch, yaw = wrench
    thrust = inverse[k, 0] * thrust + inverse[k, 1] * roll + inverse[k, 2] * pitch + inverse[k, 3] * yaw
    return clip(thrust, low, high)  # it is within the limits, but for round-off
