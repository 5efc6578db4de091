"""Numbers of a system in arrays, as compiled functions take them."""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import numpy as np

from multilift_marl.physical import AIR_DENSITY, GRAVITY
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicle import Vehicle


class RigArrays(NamedTuple):
    """A team at rest in its nominal formation: what is tied where, what it weighs and which forces hold it.

    It is the one home of these numbers. Compiled loops of a control or physics step that need few of them have records
    of their own which refer to the same arrays (`Gains`, `Cables`, `RotorArrays`), because each call of a bound kernel
    takes 90 ns for every array in its arguments.
    """

    anchors: np.ndarray
    """(N, 3) of the cables on the payload, from its centre of mass, payload frame [m]."""
    hooks: np.ndarray
    """(N, 3) where the cable is tied, from the drone's centre of mass, body frame [m]."""
    hooked: bool
    """Whether any hook is off its centre of mass."""
    is_point: bool
    """Whether all cables end at the payload's centre of mass: it has no attitude to speak of."""
    slots: np.ndarray
    """(N, 3) of the resting drones, payload frame [m]."""
    azimuth: np.ndarray
    """(N,) of the slots from the payload [rad]."""
    heading: np.ndarray
    """(N,) of each drone, from the team's [rad]."""
    force: np.ndarray
    """(N, 3) of each resting drone on its cable, payload frame [N]."""
    mass: np.ndarray
    """(N,) of each drone [kg]."""
    allocation: np.ndarray
    """(N, 4, 4) inverse allocation matrices."""
    thrust_coefficient: np.ndarray
    """(N,) b [N s²]."""
    rotor_strength: np.ndarray
    """(N, 4) thrust of each rotor over that by b [-]: 1, unless these are the true numbers of an environment."""
    cable_length: np.ndarray
    """(N,) [m]."""
    cable_stiffness: np.ndarray
    """(N,) [N/m]."""
    cable_weight: np.ndarray
    """(N,) [N]."""
    cable_segments: np.ndarray
    """(N,) links of each cable; 1 if massless."""
    payload_mass: float
    """[kg]."""
    load: float
    """True mass of the payload over the nominal one: 1, unless these are the true numbers of an environment."""


class RotorArrays(NamedTuple):
    """Rotors and drag of the drones, and drag of the payload, all nominal: what a physics step takes."""

    timestep: float
    """[s]."""
    payload_drag: float
    """½ ρ C_d A [kg/m]."""
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


def make_rig(system: System) -> RigArrays:
    """Return the nominal team of `system`."""
    return RigArrays(
        anchors=np.ascontiguousarray(system.anchors),
        hooks=np.ascontiguousarray(system.hooks),
        hooked=bool(system.hooks.any()),
        is_point=not system.anchors.any(),
        slots=system.slots,
        azimuth=system.slot_azimuth,
        heading=system.heading,
        force=system.hook_force,
        mass=system.drone_mass,
        allocation=np.stack([np.linalg.inv(vehicle.allocation) for vehicle in system.vehicles]),
        thrust_coefficient=_column(system, "thrust_coefficient"),
        rotor_strength=np.ones((system.num_drones, 4)),
        cable_length=system.cable_length,
        cable_stiffness=system.cable_stiffness,
        cable_weight=system.cable_mass * GRAVITY,
        cable_segments=system.cable_segments,
        payload_mass=system.payload_mass,
        load=1.0,
    )


def make_rotors(system: System) -> RotorArrays:
    """Return rotors and drag of `system`."""
    return RotorArrays(
        timestep=system.timestep,
        payload_drag=0.5 * AIR_DENSITY * system.payload_drag_area,
        rotor_positions=_column(system, "rotor_positions"),
        rotor_spin=_column(system, "rotor_spin"),
        thrust_coefficient=_column(system, "thrust_coefficient"),
        torque_ratio=_column(system, "torque_ratio"),
        rotor_inertia=_column(system, "rotor_inertia"),
        rotor_speed=np.stack([_column(system, "rotor_speed_min"), _column(system, "rotor_speed_max")], axis=1),
        lag=np.array([rotor_lag(vehicle, system.timestep) for vehicle in system.vehicles]),
        drag=_column(system, "drag"),
    )


def _column(system: System, field: str) -> np.ndarray:
    """Return a field of all vehicles, drone first."""
    return np.array([getattr(vehicle, field) for vehicle in system.vehicles], float)


def rotor_lag(vehicle: Vehicle, timestep: float, factor: float = 1.0) -> np.ndarray:
    """Return `RotorArrays.lag` (2, 3) of a vehicle whose rotor time constants are `factor` times the nominal ones."""
    times = vehicle.rotor_time_constant_up, vehicle.rotor_time_constant_down
    return np.array([lag_shares(timestep / (factor * time)) for time in times])


def lag_shares(h: float) -> tuple[float, float, float]:
    """Return exp(-h), and the means of exp(-t) and exp(-2t) over 0 to h, for a step h in time constants."""
    return exp(-h), (1 - exp(-h)) / h, (1 - exp(-2 * h)) / (2 * h)
