"""Random numbers within kernels, each environment's own.

They come by SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), one word of state, and depend on its seed and how many
were drawn before, so results do not depend on how many environments are computed together.
"""

from __future__ import annotations

from math import cos, log, pi, sin, sqrt

import numpy as np

from multilift_marl.kernels.jit import kernel

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # constants of SplitMix64
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_30 = np.uint64(30)
_27 = np.uint64(27)
_31 = np.uint64(31)
_11 = np.uint64(11)


@kernel
def uniform(e, air):
    """Return the next number of environment e, uniform in (0, 1]."""
    air.generator[e] += _GOLDEN
    z = air.generator[e]
    z = (z ^ (z >> _30)) * _FIRST
    z = (z ^ (z >> _27)) * _SECOND
    z = z ^ (z >> _31)
    # The upper 53 bits, as many as a double has. Plus one: never 0, of which Box and Muller would take the logarithm.
    return (float(z >> _11) + 1.0) * 2.0**-53


@kernel
def normal_pair(e, air):
    """Return two independent standard normal numbers of environment e (Box and Muller 1958)."""
    radius = sqrt(-2.0 * log(uniform(e, air)))
    angle = 2.0 * pi * uniform(e, air)
    return radius * cos(angle), radius * sin(angle)


@kernel
def normal_vector(e, air):
    """Return three independent standard normal numbers of environment e."""
    (a, b), (c, _) = normal_pair(e, air), normal_pair(e, air)
    return (a, b, c)
