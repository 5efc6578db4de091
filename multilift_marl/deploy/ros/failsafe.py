"""What is done about set-points and measurements that do not come: hold, then land."""

from __future__ import annotations

import numpy as np

HOLD_AFTER = 0.25  # [s] without anything new, after which the last place is held
LAND_AFTER = 2.0  # [s] after which a drone sinks
SINK = 0.4  # [m/s]


def is_landing(age: np.ndarray) -> np.ndarray:
    """Return which drones have heard nothing for so long that they land; those that never did (infinite) do not."""
    return np.isfinite(age) & (age > LAND_AFTER)


def sink(places: np.ndarray, late: np.ndarray | bool, seconds: float) -> None:
    """Let the places (N, 3) [m] of drones that are `late` (N,) sink for some seconds, to the ground at most."""
    lower = np.maximum(places[:, 2] - SINK * seconds, np.minimum(places[:, 2], 0.0))
    places[:, 2] = np.where(late, lower, places[:, 2])
