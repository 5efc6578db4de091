"""True parameters that may differ between environments and from what the controller knows.

They are absolute, or factors on what the configuration says: setting them twice is the same as setting them once.
"""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl.rig.system import System
from multilift_marl.sim.cables import limit_solref
from multilift_marl.sim.scene import Layout


class Parameters(NamedTuple):
    """What of the system each environment may have its own of."""

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


_FAR = 1e9  # [m] at which the limit of a broken cable's tendon begins
POSITIVE = tuple(name for name in Parameters._fields if not name.endswith(("center_of_mass", "drag")))
CONFIGURED = (  # cost something in every step, so they may only differ where the configuration says that they do
    "payload_center_of_mass", "payload_drag", "vehicle_thrust_coefficient", "vehicle_rotor_time_constant",
    "vehicle_drag",
)  # fmt: skip
_MASSES = frozenset(("payload_mass", "payload_inertia", "payload_center_of_mass", "vehicle_mass"))


class RotorVariation(NamedTuple):
    """What the loops over physics steps need of them, where centres of mass, rotors or drag vary at all."""

    payload_center_of_mass: np.ndarray
    """(E, 3) from the nominal one, payload frame [m]."""
    payload_drag: np.ndarray
    """(E,) [-] over nominal."""
    thrust: np.ndarray
    """(E, N) [-] likewise."""
    drag: np.ndarray
    """(E, N) [-] likewise."""
    rising: np.ndarray
    """(E, N, 3), see `dynamics.Constants`."""
    falling: np.ndarray
    """(E, N, 3)."""


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
    )


def lag_shares(h: float) -> tuple[float, float, float]:
    """Return exp(-h), and the means of exp(-t) and exp(-2t) over 0 to h, for a step h in time constants."""
    return exp(-h), (1 - exp(-h)) / h, (1 - exp(-2 * h)) / (2 * h)


def make_rotor_variation(system: System, parameters: Parameters) -> RotorVariation | None:
    """Return what the loops need, None where neither the payload's centre of mass nor rotors nor drag vary."""
    if not system.varied.intersection(CONFIGURED):
        return None
    e, n = parameters.vehicle_mass.shape
    varied = RotorVariation(
        payload_center_of_mass=parameters.payload_center_of_mass,
        payload_drag=parameters.payload_drag,
        thrust=parameters.vehicle_thrust_coefficient,
        drag=parameters.vehicle_drag,
        rising=np.zeros((e, n, 3)),
        falling=np.zeros((e, n, 3)),
    )
    write_lags(varied, system, parameters, np.ones(e, bool))
    return varied


def write_lags(varied: RotorVariation, system: System, parameters: Parameters, mask: np.ndarray) -> None:
    """Bring the rotors' lags of the environments in `mask` into line with their time constants."""
    for e in np.flatnonzero(mask):
        for n, vehicle in enumerate(system.vehicles):
            factor = parameters.vehicle_rotor_time_constant[e, n]
            varied.rising[e, n] = lag_shares(system.timestep / (factor * vehicle.rotor_time_constant_up))
            varied.falling[e, n] = lag_shares(system.timestep / (factor * vehicle.rotor_time_constant_down))


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
    changed, names = np.zeros(len(mask), bool), set()
    for name, value in values.items():
        old, new = getattr(parameters, name), np.asarray(value)
        differs = mask & (new != old).reshape(len(mask), -1).any(axis=1)
        if differs.any():
            changed |= differs
            names.add(name)
            old[differs] = new[differs]
    return changed, names


def write_model(
    batch: Batch, model: mujoco.MjModel, layout: Layout, system: System, p: Parameters,
    chosen: np.ndarray, names: set[str], broken: np.ndarray,
) -> None:  # fmt: skip
    """Write parameters into a batch's models, with all that MuJoCo derives from them.

    Args:
        batch: of n simulations.
        model, layout, system: what they share.
        p: of these n.
        chosen: (n,) bool, those with new parameters.
        names: what of them is new.
        broken: (n, N) cables.
    """
    mass = p.payload_mass[chosen] / system.payload_mass * p.payload_inertia[chosen]
    if names & {"payload_mass", "payload_inertia"}:
        batch.expand("body_mass")[chosen, layout.payload_body] = p.payload_mass[chosen]
        batch.expand("body_inertia")[chosen, layout.payload_body] = system.payload_inertia * mass[:, None]
    if "payload_center_of_mass" in names:
        batch.expand("body_ipos")[chosen, layout.payload_body] = p.payload_center_of_mass[chosen]
    if "vehicle_mass" in names:
        weights, moments = batch.expand("body_mass"), batch.expand("body_inertia")
        for n, vehicle in enumerate(system.vehicles):
            own = p.vehicle_mass[chosen, n]
            weights[chosen, layout.drone_bodies[n]] = own
            moments[chosen, layout.drone_bodies[n]] = np.array(vehicle.inertia) * (own / vehicle.mass)[:, None]
    massless, longer = system.cable_model == "massless", "cable_length" in names
    if longer:
        apply_cable_limits(batch, system, p, broken)
    heavier = bool(names & _MASSES)
    if massless and (heavier or "cable_stiffness" in names):
        batch.expand("tendon_solref_lim")
    if heavier:
        batch.set_const(chosen)
    if massless and (heavier or "cable_stiffness" in names):
        inverse_weight = batch.expanded("tendon_invweight0")
        own = model.tendon_invweight0 if inverse_weight is None else inverse_weight[chosen]
        solref = limit_solref(p.cable_stiffness[chosen], system.cable_damping, own)
        batch.expand("tendon_solref_lim")[chosen] = solref


def apply_cable_limits(batch: Batch, system: System, p: Parameters, broken: np.ndarray) -> None:
    """Let the massless cables in `broken` (n, N) bool of a batch's simulations pull no more, all others be whole."""
    if system.cable_model == "massless":
        batch.expand("tendon_range")[..., 1] = np.where(broken, _FAR, p.cable_length)
