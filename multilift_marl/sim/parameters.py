"""True parameters that may differ between environments and from those of the controller.

They are absolute, or factors on what the configuration says: setting them twice is the same as setting them once.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from mujoco.batch import Batch

from multilift_marl.math3d import quat_to_mat
from multilift_marl.rig.constants import rotor_lag
from multilift_marl.rig.system import System
from multilift_marl.sim.state_io import Layout


class Parameters(NamedTuple):
    """The system's parameters in which environments may differ."""

    payload_mass: np.ndarray
    """(E,) [kg]; inertia scales with it."""
    payload_inertia: np.ndarray
    """(E,) [-] over that."""
    payload_center_of_mass: np.ndarray
    """(E, 3) from the nominal one, which stays the origin of `payload_position`, payload frame [m]."""
    payload_drag: np.ndarray
    """(E,) [-] over nominal."""
    cable_length: np.ndarray
    """(E, N) [m]; a chain's mass scales with it."""
    cable_stiffness: np.ndarray
    """(E, N) [N/m]."""
    vehicle_mass: np.ndarray
    """(E, N) [kg]; inertia scales with it."""
    vehicle_thrust_coefficient: np.ndarray
    """(E, N) [-] over nominal, like the next ones; reaction torque scales with thrust."""
    vehicle_rotor_time_constant: np.ndarray
    """(E, N) [-]."""
    vehicle_drag: np.ndarray
    """(E, N) [-]."""
    rotor_thrust_coefficient: np.ndarray
    """(E, N, 4) [-] of each rotor, beside that of its drone's."""


POSITIVE = tuple(name for name in Parameters._fields if not name.endswith(("center_of_mass", "drag")))
CONFIGURED = (  # cost something in every step, so they may only differ where the configuration says that they do
    "payload_center_of_mass", "payload_drag", "vehicle_thrust_coefficient", "vehicle_rotor_time_constant",
    "vehicle_drag", "rotor_thrust_coefficient",
)  # fmt: skip
MASSES = frozenset(("payload_mass", "payload_inertia", "payload_center_of_mass", "vehicle_mass"))


class RotorVariation(NamedTuple):
    """What the loops over physics steps need of them, where centres of mass, rotors or drag vary at all."""

    payload_center_of_mass: np.ndarray
    """(E, 3) from the nominal one, payload frame [m]."""
    center_varies: bool
    """Whether that may be off the origin of the payload's free joint."""
    payload_drag: np.ndarray
    """(E,) [-] over nominal."""
    thrust: np.ndarray
    """(E, N) [-] over nominal."""
    rotor: np.ndarray
    """(E, N, 4) [-] beside that."""
    drag: np.ndarray
    """(E, N) [-] over nominal."""
    lag: np.ndarray
    """(E, N, 2, 3), see `RotorArrays`."""


class Inertias(NamedTuple):
    """Masses and moments of inertia that follow from parameters: body 0 is the payload, 1 + n drone n."""

    mass: np.ndarray
    """(E, 1 + N) [kg]."""
    inertia: np.ndarray
    """(E, 1 + N, 3, 3) about the centre of mass, body frame [kg m²]."""
    inverse: np.ndarray
    """(E, 1 + N, 3, 3) its inverse; zero of a point payload, which does not turn."""
    center: np.ndarray
    """(E, 1 + N, 3) centre of mass from the origin of the body frame [m]."""


def nominal_parameters(system: System, num_envs: int) -> Parameters:
    """Return those of the configuration for every environment."""
    e, n = num_envs, system.num_drones
    return Parameters(
        payload_mass=np.full(e, system.payload_mass),
        payload_inertia=np.ones(e),
        payload_center_of_mass=np.zeros((e, 3)),
        payload_drag=np.ones(e),
        cable_length=np.tile(system.cable_length, (e, 1)),
        cable_stiffness=np.tile(system.cable_stiffness, (e, 1)),
        vehicle_mass=np.tile(system.drone_mass, (e, 1)),
        vehicle_thrust_coefficient=np.ones((e, n)),
        vehicle_rotor_time_constant=np.ones((e, n)),
        vehicle_drag=np.ones((e, n)),
        rotor_thrust_coefficient=np.ones((e, n, 4)),
    )


def make_rotor_variation(system: System, parameters: Parameters) -> RotorVariation | None:
    """Return what the loops need, None where neither the payload's centre of mass nor rotors nor drag vary."""
    if not system.varied.intersection(CONFIGURED):
        return None
    e, n = parameters.vehicle_mass.shape
    varied = RotorVariation(
        payload_center_of_mass=parameters.payload_center_of_mass,
        center_varies="payload_center_of_mass" in system.varied,
        payload_drag=parameters.payload_drag,
        thrust=parameters.vehicle_thrust_coefficient,
        rotor=parameters.rotor_thrust_coefficient,
        drag=parameters.vehicle_drag,
        lag=np.zeros((e, n, 2, 3)),
    )
    write_lags(varied, system, parameters, np.ones(e, bool))
    return varied


def write_lags(varied: RotorVariation, system: System, parameters: Parameters, mask: np.ndarray) -> None:
    """Bring the rotors' lags of the environments in `mask` into line with their time constants."""
    for e in np.flatnonzero(mask):
        for n, vehicle in enumerate(system.vehicles):
            factor = parameters.vehicle_rotor_time_constant[e, n]
            varied.lag[e, n] = rotor_lag(vehicle, system.timestep, factor)


def make_inertias(system: System, parameters: Parameters) -> Inertias:
    """Return the inertias of `system`, those of each environment by `parameters`."""
    e, n = parameters.vehicle_mass.shape
    b = 1 + n
    inertias = Inertias(np.zeros((e, b)), np.zeros((e, b, 3, 3)), np.zeros((e, b, 3, 3)), np.zeros((e, b, 3)))
    update_inertias(inertias, system, parameters, np.ones(e, bool), MASSES)
    return inertias


def update_inertias(
    inertias: Inertias, system: System, parameters: Parameters, mask: np.ndarray, names: Collection[str]
) -> None:
    """Bring the inertias of the environments in `mask` (E,) into line with their parameters `names`, which changed."""
    if "payload_center_of_mass" in names:
        inertias.center[mask, 0] = parameters.payload_center_of_mass[mask]
    if "payload_mass" in names or "payload_inertia" in names:
        mass = parameters.payload_mass[mask]
        axes = np.reshape(quat_to_mat(*system.payload_axes.tolist()), (3, 3))
        scale = mass / system.payload_mass * parameters.payload_inertia[mask]
        # J = A diag(moments) Aᵀ, with the principal axes in the columns of A.
        payload = scale[:, None, None] * (axes * system.payload_inertia @ axes.T)
        inertias.mass[mask, 0], inertias.inertia[mask, 0] = mass, payload
        if system.payload_shape != "point":
            inertias.inverse[mask, 0] = np.linalg.inv(payload)
    if "vehicle_mass" in names:
        mass = parameters.vehicle_mass[mask]
        # A heavier drone has as much more inertia.
        own = mass / np.array([vehicle.mass for vehicle in system.vehicles])
        drones = own[:, :, None, None] * np.array([np.diag(vehicle.inertia) for vehicle in system.vehicles])
        inertias.mass[mask, 1:], inertias.inertia[mask, 1:] = mass, drones
        inertias.inverse[mask, 1:] = np.linalg.inv(drones)


def check_parameters(system: System, old: Parameters, mask: np.ndarray, values: dict[str, np.ndarray]) -> None:
    """Refuse values of the environments in `mask` (E,) that cannot be.

    Raises:
        ValueError: not finite, not positive where they must be, or of what the configuration does not vary.
    """
    for name, value in values.items():
        chosen = np.asarray(value)[mask]
        least = 0 if name.endswith("drag") else -np.inf
        if not (np.isfinite(chosen) & ((chosen > 0) if name in POSITIVE else (chosen >= least))).all():
            kind = "positive and finite" if name in POSITIVE else "finite and not negative" if least == 0 else "finite"
            raise ValueError(f"{name} must be {kind}, but is {chosen.tolist()}")
        if name in CONFIGURED and name not in system.varied and (chosen != getattr(old, name)[mask]).any():
            raise ValueError(
                f"{name} costs speed where it may differ from the configuration; set randomization.{name} above 0"
            )


def update_parameters(
    system: System, parameters: Parameters, mask: np.ndarray, values: dict[str, np.ndarray]
) -> tuple[np.ndarray, set[str]]:
    """Write values into the parameters of the environments in `mask` (E,); return which of them changed (E,), and what.

    Raises:
        ValueError: see `check_parameters`.
    """
    check_parameters(system, parameters, mask, values)
    changed = np.zeros(len(mask), bool)
    names = set()
    for name, value in values.items():
        old = getattr(parameters, name)
        new = np.asarray(value)
        differs = mask & (new != old).reshape(len(mask), -1).any(axis=1)
        if differs.any():
            changed |= differs
            names.add(name)
            old[differs] = new[differs]
    return changed, names


def write_masses(
    batch: Batch, layout: Layout, system: System, parameters: Parameters, mask: np.ndarray, names: set[str]
) -> None:
    """Write masses, inertias and centres of mass into a batch's models, with all that MuJoCo derives from them.

    Args:
        batch: of n simulations.
        layout, system: common to them.
        parameters: of these n.
        mask: (n,) bool, those with new parameters.
        names: the new parameters.
    """
    if not names & MASSES:
        return
    p = parameters
    if names & {"payload_mass", "payload_inertia"}:
        factor = p.payload_mass[mask] / system.payload_mass * p.payload_inertia[mask]
        batch.expand("body_mass")[mask, layout.payload_body] = p.payload_mass[mask]
        batch.expand("body_inertia")[mask, layout.payload_body] = system.payload_inertia * factor[:, None]
    if "payload_center_of_mass" in names:
        batch.expand("body_ipos")[mask, layout.payload_body] = p.payload_center_of_mass[mask]
    if "vehicle_mass" in names:
        for n, vehicle in enumerate(system.vehicles):
            own = p.vehicle_mass[mask, n]
            moments = np.array(vehicle.inertia) * (own / vehicle.mass)[:, None]
            batch.expand("body_mass")[mask, layout.drone_bodies[n]] = own
            batch.expand("body_inertia")[mask, layout.drone_bodies[n]] = moments
    # MuJoCo's derived constants (invweight0, subtree masses): stale ones would give contacts and cables the stiffness
    # of other masses. `update_models` follows, because cables' solref depends on them.
    batch.set_const(mask)
