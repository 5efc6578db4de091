"""Set-points that calm the swing of a payload on two cables (`control.swing_shift`).

Two cables do not hold a payload about the line of their anchors: it swings, and little brings it to rest. Here both
drones move aside, against the side to which its bottom swings, in proportion to the angle. References follow commands
late, so that the shift acts as damping.

Cables and payload swing in two ways, and cables pass no tilt on at once: what damps one way takes from the other. The
best value depends on the rig. A push of 0.8 rad/s on `hover`'s payload below two falcons leaves 0.35 rad/s after 15 s,
with 0.06 m/rad 0.12, with 0.3 m/rad 0.88; on cables of 0.5 m, where it dies sooner, 0.06 m/rad prolongs it
(tests/control/test_swing.py). A payload that hangs tilted moves its drones aside for good. Drones that do not measure
its attitude (`env.sensing=onboard`) take it for what is planned: there it has no effect.
"""

from __future__ import annotations

from math import hypot

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, column, dot, mat, mul, put, vec

FLAT = 1e-6
"""Spread of anchors, over the largest, that is none."""


def anchor_line(anchors: np.ndarray) -> np.ndarray:
    """Return the direction (3,) of the line on which anchors (N, 3) [m] lie, payload frame; else zero.

    It points along +x, or +y across that, or up.
    """
    _, sizes, directions = np.linalg.svd(anchors - anchors.mean(axis=0), full_matrices=False)
    if sizes[0] == 0.0 or (sizes[1:] > FLAT * sizes[0]).any():
        return np.zeros(3)
    line = directions[0]
    return line * np.sign(line[np.flatnonzero(np.abs(line) > FLAT)[0]])


@kernel
def shift_with_swing(lo, hi, team, shift):
    """Move commanded positions of environments lo to hi against the swing of their payload.

    Args:
        lo, hi: the environments.
        team: ControlContext with surroundings.
        shift: [m] for a sine of 1 of the angle by which it is turned about the line of its anchors.
    """
    around, command = team.around, team.reference.command
    for e in range(lo, hi):
        for n in range(command.shape[1]):
            turned = mat(around.payload_rotation, e, min(n, around.payload_rotation.shape[1] - 1))
            line = mul(turned, (around.anchor_line[0], around.anchor_line[1], around.anchor_line[2]))
            level = hypot(line[0], line[1])
            if level > 0.0:
                up = column(turned, 2)
                tilt = dot((-up[1], up[0], 0.0), line)  # sine of the angle, where the line is level
                aside = shift * tilt / level
                put(command[e, n], add(vec(command, e, n), (aside * line[1], -aside * line[0], 0.0)))
