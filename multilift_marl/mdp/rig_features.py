"""What drones observe of their rig where observations are in units of the cables (`env.units=cable`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.units import unit_size
from multilift_marl.kernels.jit import inlined, kernel
from multilift_marl.mdp.observations import Component
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.system import System


@inlined
def rig_numbers(e, n, v):
    """Return what tells this rig from others."""
    r = v.rig_numbers
    return r[n, 0], r[n, 1], r[n, 2], r[n, 3], r[n, 4], r[n, 5], r[n, 6], r[n, 7]


RIG = Component(
    "rig", 8, "-", "-",
    "a quarter of the number of drones; 10 motor lags and policy steps over √(L/g); the payload's share of all mass; "
    "share of its weight over an equal one; slot, anchor, and 10 radii of gyration of the payload, over L", rig_numbers,
)  # fmt: skip


def describe_rig(system: System, dt: float) -> np.ndarray:
    """Return the numbers (N, 8) of `RIG`.

    Args:
        system: the nominal one.
        dt: policy step [s].
    """
    n, length = system.num_drones, float(np.mean(system.cable_length))
    pendulum = np.sqrt(length / GRAVITY)
    lag = np.array([vehicle.rotor_time_constant for vehicle in system.vehicles])
    mass, lift = system.payload_mass, system.formation_force[:, 2]
    gyration = np.sqrt(np.mean(system.payload_inertia) / mass)
    # Factors of 4 and 10 bring the columns to about 1.
    columns = (
        n / 4, 10 * lag / pendulum, 10 * dt / pendulum, mass / (mass + system.drone_mass.sum()), n * lift / lift.sum(),
        np.hypot(*system.slots[:, :2].T) / length, np.hypot(*system.anchors[:, :2].T) / length, 10 * gyration / length,
    )  # fmt: skip
    return np.stack([np.broadcast_to(column, n) for column in columns], axis=1)


def observed_units(config: Config, units: Sequence[str]) -> np.ndarray:
    """Return what 1 stands for in observations (D,), in the units of SI that are given."""
    known = config.env.units == "cable"
    return np.array([unit_size(unit, config.system) if known else 1.0 for unit in units])


@kernel
def scale_numbers(lo, hi, observation, factors):
    """Multiply the observations (E, N, D) of environments lo to hi by `factors` (D,)."""
    for e in range(lo, hi):
        for n in range(observation.shape[1]):
            for k in range(observation.shape[2]):
                observation[e, n, k] *= factors[k]
