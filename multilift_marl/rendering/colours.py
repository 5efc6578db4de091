"""Colours of tension: slack grey, blue at rest, red at twice that, in steps that look equal.

The scale is linear in OKLab (B. Ottosson, "A perceptual color space for image processing", 2020), where distance is
how different two colours look. Grey is the lightest, and blue and red stay apart for every kind of colour blindness.
"""

from __future__ import annotations

import numpy as np

_LMS = np.array(  # of linear sRGB
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB = np.array(  # of the cube root of that
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
SLACK, RESTING, DOUBLE = (0.66, 0.66, 0.66), (0.02, 0.30, 0.85), (0.80, 0.08, 0.05)  # sRGB
_STEPS = 256  # of the scale


def to_oklab(colour: np.ndarray) -> np.ndarray:
    """Return the OKLab coordinates (..., 3) of sRGB colours (..., 3) in [0, 1]."""
    colour = np.asarray(colour, float)
    linear = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear @ _LMS.T) @ _LAB.T


def from_oklab(lab: np.ndarray) -> np.ndarray:
    """Return the sRGB colours (..., 3), clipped to [0, 1], of OKLab coordinates (..., 3)."""
    linear = np.clip((np.asarray(lab) @ np.linalg.inv(_LAB).T) ** 3 @ np.linalg.inv(_LMS).T, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _make_scale() -> np.ndarray:
    ends, at = to_oklab(np.array([SLACK, RESTING, DOUBLE])), np.linspace(0.0, 2.0, _STEPS + 1)
    return from_oklab(np.stack([np.interp(at, [0.0, 1.0, 2.0], ends[:, axis]) for axis in range(3)], axis=1))


_SCALE = _make_scale()


def tension_colours(tension: np.ndarray, resting: np.ndarray) -> np.ndarray:
    """Return the colours (N, 3) of cables in [0, 1].

    Args:
        tension: (N,) [N].
        resting: tension of the resting team (N,) [N]; twice that and more is red.
    """
    ratio = np.clip(np.nan_to_num(tension / np.maximum(resting, 1e-9)), 0.0, 2.0)
    return _SCALE[np.rint(ratio * (_STEPS / 2)).astype(int)]
