"""Massless cables: a pull-only Kelvin-Voigt element on a MuJoCo tendon limit.

With direct solref (-A, -B) and constant impedance I, a stretched limit's row wants the acceleration
-(A r + B v)/I for stretch r and stretch rate v, softened by the regulariser R = (1 - I)/I · tendon_invweight0. For
small I its force is (A r + B v)/(I R), the Kelvin-Voigt law k r + c v if A = k I R and B = c I R, and the force of a
limit never pushes. See "Solver parameters" in MuJoCo's computation chapter. At rest the law is exact; in motion the
softening acts like a little extra mass along the cable, about 1 % of what the cable couples.
"""

from __future__ import annotations

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, norm, scale

IMPEDANCE = 0.01


def limit_solref(stiffness: np.ndarray, damping: np.ndarray, tendon_invweight0: np.ndarray) -> np.ndarray:
    """Return `tendon_solref_lim` that makes tendon limits cables.

    It must be computed anew whenever masses change, because tendon_invweight0 does.

    Args:
        stiffness: k (..., N) [N/m].
        damping: c (..., N) [N s/m].
        tendon_invweight0: (..., N) [1/kg]; each of the three may lack the axes before the last.

    Returns:
        (..., N, 2).
    """
    regulariser = (1 - IMPEDANCE) / IMPEDANCE * tendon_invweight0
    law = np.broadcast_arrays(stiffness * regulariser * IMPEDANCE, damping * regulariser * IMPEDANCE)
    return -np.stack(law, axis=-1)


@kernel
def cable_end(direction, tension, length, stiffness, segments, weight):
    """Return the drone's end of a hanging cable at rest, from its anchor [m].

    Args:
        direction, tension: unit vector and magnitude [N] of the force in its middle.
        length, stiffness: of the whole cable [m], [N/m].
        segments: of a chain, whose mass is that of the nodes between them.
        weight: of the whole cable [N]; 0 if massless.
    """
    if weight == 0.0:
        return scale(length + tension / stiffness, direction)
    end = (0.0, 0.0, 0.0)
    for j in range(segments):
        force = add(scale(tension, direction), (0.0, 0.0, weight * (j / (segments - 1) - 0.5)))
        size = norm(force)
        end = add(end, scale((length / size + 1.0 / stiffness) / segments, force))
    return end
