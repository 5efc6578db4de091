"""Units of the cables (`env.units=cable`): the numbers of a similar rig whose cables are 1 m long.

A rig with cables of length L behaves as one with cables of l = 1 m whose lengths are l/L times as large and whose times
are √(l/L) times as long: gravity is the same (Froude scaling). A policy, learned or linear, that observes and acts by
the numbers of that one does the same to all rigs that are similar. What is not similar, such as motor lags and rates of
controllers, drones know from numbers of the rig (`mdp/rig_features.py`).
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from multilift_marl.rig.system import System
from multilift_marl.schema.control import ControlConfig

_POWERS = {  # of length and time in each unit
    "m": (1, 0), "m/s": (1, -1), "m/s²": (1, -2), "m/s³": (1, -3), "m s": (1, 1), "s": (0, 1), "rad/s": (0, -1),
    "rad/s²": (0, -2), "rad s": (0, 1), "rad": (0, 0), "-": (0, 0),
}  # fmt: skip
_FULL_SCALES = {
    "max_offset": "m", "max_velocity": "m/s", "max_acceleration": "m/s²", "max_tilt_rate": "rad/s",
    "max_yaw_rate": "rad/s", "max_angular_acceleration": "rad/s²", "max_jerk": "m/s³",
}  # fmt: skip


def unit_size(unit: str, system: System) -> float:
    """Return what 1 stands for in units of the cables of `system`, in a unit of SI; 1 where that is none of these."""
    length = float(np.mean(system.cable_length))
    lengths, times = _POWERS.get(unit, (0, 0))
    return length**lengths * sqrt(length) ** times


def scale_control(control: ControlConfig, system: System) -> ControlConfig:
    """Return `control` with full scales of actions in SI units, where they are given in those of the cables."""
    given = control.model_dump()
    return control.model_copy(update={key: given[key] * unit_size(unit, system) for key, unit in _FULL_SCALES.items()})
