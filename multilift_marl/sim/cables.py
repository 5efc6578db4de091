"""Massless cables: a pull-only Kelvin-Voigt element on a MuJoCo tendon limit.

A tendon limit with direct solref (-k', -d') and constant impedance d is a constraint whose unforced acceleration is
-(d' v + k' r), softened by the regulariser R = (1 - d)/d · tendon_invweight0. Its force is then
f = (k' r + d' v) d / (R d) for small d, i.e. the Kelvin-Voigt law k r + c v with k' = k R d and d' = c R d, and
as the force of a limit it never pushes. See MuJoCo's "Solver parameters" (computation, solver).
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
