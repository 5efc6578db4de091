"""Random numbers of each environment's own: SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), one word of state.

Numbers depend on the environment's seed and how many it has drawn before, on nothing else.
"""

from __future__ import annotations

from math import cos, log, pi, sin, sqrt

import numpy as np

from multilift_marl._jit import kernel

_GOLDEN, _FIRST, _SECOND = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@kernel
def uniform(e, air):
    """Return the next number of environment e, uniform in (0, 1]."""
    air.generator[e] += _GOLDEN
    z = air.generator[e]
    z = (z ^ (z >> _30)) * _FIRST
    z = (z ^ (z >> _27)) * _SECOND
    z = z ^ (z >> _31)
    return (float(z >> _11) + 1.0) * 2.0**-53


@kernel
def normal_pair(e, air):
    """Return two independent standard normal numbers of environment e (Box and Muller 1958)."""
    radius, angle = sqrt(-2.0 * log(uniform(e, air))), 2.0 * pi * uniform(e, air)
    return radius * cos(angle), radius * sin(angle)
