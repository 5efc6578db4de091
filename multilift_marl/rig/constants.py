"""Numbers of a system in arrays, as compiled functions take them."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import numpy as np

from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import AIR_DENSITY, Vehicle


class RigConstants(NamedTuple):
    """The drones with their rotors and drag, and drag of the payload, all nominal."""

    timestep: float
    """[s]."""
    payload_drag: float
    """½ ρ C_d A [kg/m]."""
    mass: np.ndarray
    """(N,) of each drone [kg]."""
    hooks: np.ndarray
    """(N, 3) where the cable is tied, from the centre of mass, body frame [m]."""
    hooked: bool
    """Whether any hook is off its centre of mass."""
    allocation: np.ndarray
    """(N, 4, 4) inverse allocation matrices."""
    rotor_positions: np.ndarray
    """(N, 4, 3) [m]."""
    rotor_spin: np.ndarray
    """(N, 4) sign of the reaction torque."""
    thrust_coefficient: np.ndarray
    """(N,) b [N s²]."""
    torque_ratio: np.ndarray
    """(N,) κ [m]."""
    rotor_inertia: np.ndarray
    """(N,) [kg m²]."""
    rotor_speed: np.ndarray
    """(N, 2) lowest and highest [rad/s]."""
    lag: np.ndarray
    """(N, 2, 3) `lag_shares` of a time step, of rotors that speed up and of those that slow down."""
    drag: np.ndarray
    """(N, 3) linear drag of a drone along its axes [kg/s]."""


def make_constants(system: System) -> RigConstants:
    """Return the constants of `system`."""

    def column(field: str) -> np.ndarray:
        return np.array([getattr(vehicle, field) for vehicle in system.vehicles], float)

    return RigConstants(
        timestep=system.timestep,
        payload_drag=0.5 * AIR_DENSITY * system.payload_drag_area,
        mass=system.drone_mass,
        hooks=np.ascontiguousarray(system.hooks),
        hooked=bool(system.hooks.any()),
        allocation=np.stack([np.linalg.inv(vehicle.allocation) for vehicle in system.vehicles]),
        rotor_positions=column("rotor_positions"),
        rotor_spin=column("rotor_spin"),
        thrust_coefficient=column("thrust_coefficient"),
        torque_ratio=column("torque_ratio"),
        rotor_inertia=column("rotor_inertia"),
        rotor_speed=np.stack([column("rotor_speed_min"), column("rotor_speed_max")], axis=1),
        lag=np.array([rotor_lag(vehicle, system.timestep) for vehicle in system.vehicles]),
        drag=column("drag"),
    )


def rotor_lag(vehicle: Vehicle, timestep: float, factor: float = 1.0) -> np.ndarray:
    """Return `RigConstants.lag` (2, 3) of a vehicle whose rotor time constants are `factor` times the nominal ones."""
    times = vehicle.rotor_time_constant_up, vehicle.rotor_time_constant_down
    return np.array([lag_shares(timestep / (factor * time)) for time in times])


def lag_shares(h: float) -> tuple[float, float, float]:
    """Return exp(-h), and the means of exp(-t) and exp(-2t) over 0 to h, for a step h in time constants."""
    return exp(-h), (1 - exp(-h)) / h, (1 - exp(-2 * h)) / (2 * h)
