"""Massless cables: a pull-only Kelvin-Voigt element on a MuJoCo tendon limit.

With direct solref (-A, -B) and constant impedance I, a stretched limit's row wants the acceleration
-(A r + B v)/I for stretch r and stretch rate v, softened by the regulariser R = (1 - I)/I · tendon_invweight0. For
small I its force is (A r + B v)/(I R), the Kelvin-Voigt law k r + c v if A = k I R and B = c I R, and the force of a
limit never pushes. See "Solver parameters" in MuJoCo's computation chapter. At rest the law is exact; in motion the
softening acts like a little extra mass along the cable, about 1 % of what the cable couples.
"""

from __future__ import annotations

import numpy as np

IMPEDANCE = 0.01


def limit_solref(stiffness: np.ndarray, damping: np.ndarray, tendon_invweight0: np.ndarray) -> np.ndarray:
    """Return `tendon_solref_lim` that makes tendon limits cables.

    It must be computed anew whenever masses change, because tendon_invweight0 does.

    Args:
        stiffness: k (N,) [N/m].
        damping: c (N,) [N s/m].
        tendon_invweight0: (..., N) [1/kg].

    Returns:
        (..., N, 2).
    """
    regulariser = (1 - IMPEDANCE) / IMPEDANCE * tendon_invweight0
    return -np.stack([stiffness * regulariser * IMPEDANCE, damping * regulariser * IMPEDANCE], axis=-1)
