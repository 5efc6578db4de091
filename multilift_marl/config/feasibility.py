"""What a system must be able to do before anything is simulated: hover, hold, keep apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.config.teams import check_rotors, describe_team
from multilift_marl.config.vehicles import GRAVITY
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import thrust_frame

if TYPE_CHECKING:
    from multilift_marl.config.schema import RandomizationConfig
    from multilift_marl.config.system import System

MIN_THRUST_TO_WEIGHT = 1.18
MAX_BENDING = 500.0  # [-] rate of bending in physics steps: substeps are as short as its inverse


def check_possible(system: System, ranges: RandomizationConfig) -> None:
    """Refuse what cannot fly, the heaviest payload and the heaviest and weakest drones included.

    Raises:
        ConfigError: why not, and what to change.
    """
    n, vehicles, heaviest = system.num_drones, system.vehicles, 1 + ranges.payload_mass
    if system.air.wash or system.air.ground_effect:
        for vehicle in vehicles:
            check_rotors(vehicle)
    if system.air.turbulence and not system.wind[:2].any() and not ranges.wind:
        raise ConfigError(
            "wind.turbulence is as strong as the horizontal mean wind, and there is none; set wind.velocity or "
            "randomization.wind, or switch wind.turbulence off"
        )
    thrust = 4 * np.array([vehicle.rotor_thrust_max for vehicle in vehicles])
    if thrust.sum() < MIN_THRUST_TO_WEIGHT * system.weight:
        lifted = "payload, drones and cables" if system.cable_mass.any() else "payload and drones"
        raise ConfigError(
            f"{describe_team(vehicles)} lift {thrust.sum():.1f} N, less than {MIN_THRUST_TO_WEIGHT} × the weight of "
            f"{lifted}, {system.weight:.1f} N; lower payload.mass ({system.payload_mass:g} kg) or add drones"
        )
    rope = system.drone_pull - system.formation_force
    own = (1 + ranges.vehicle_mass) * GRAVITY * system.drone_mass[:, None] * [0, 0, 1]
    hover = np.linalg.norm(heaviest * system.formation_force + rope + own, axis=1)
    thrust *= 1 - ranges.vehicle_thrust_coefficient
    if np.any(hover > thrust):
        i = int(np.argmax(hover - thrust))
        varied = ranges.vehicle_mass or ranges.vehicle_thrust_coefficient
        cure = "randomization.vehicle_mass, randomization.vehicle_thrust_coefficient, " if varied else ""
        raise ConfigError(
            f"drone {i} would need {hover[i]:.1f} N of its {thrust[i]:.1f} N to hover under the heaviest payload; "
            f"lower {cure}payload.mass, randomization.payload_mass or cable.angle, or share the load by payload.anchors"
        )
    if system.hooks.any():
        _check_hooks(system, ranges)
    tight = heaviest * system.resting_tension
    if np.any(tight >= system.breaking_load):
        i = int(np.argmax(tight - system.breaking_load))
        raise ConfigError(
            f"cable {i} would break at rest: {tight[i]:.1f} N under the heaviest payload, but cable.breaking_load is "
            f"{system.breaking_load[i]:g} N; raise it or lower payload.mass"
        )
    if system.bending_rate * system.timestep > MAX_BENDING:
        stiff = replace(system, bending_damping=0 * system.bending_damping).bending_rate == system.bending_rate
        name = "bending_stiffness" if stiff else "bending_damping"
        raise ConfigError(
            f"cable.{name}={getattr(system, name).max():g} is too stiff for links so light; lower it or "
            "cable.segments, or raise cable.density"
        )
    if n > 1:
        apart = np.linalg.norm(system.slots[:, None] - system.slots[None], axis=-1) + 1e9 * np.eye(n)
        i, j = (int(k) for k in np.unravel_index(np.argmin(apart - system.min_separation), apart.shape))
        if apart[i, j] < system.min_separation[i, j]:
            raise ConfigError(
                f"neighbouring drones {i} and {j} would rest {apart[i, j]:.2f} m apart, closer than the separation "
                f"limit of {system.min_separation[i, j]:.2f} m; spread payload.anchors or raise cable.length or "
                "cable.angle"
            )


def check_fixed(system: System, ranges: RandomizationConfig, fixed: Mapping[str, np.ndarray]) -> None:
    """Refuse masses and rotors fixed for episodes with which a team could not lift what it carries.

    The limit is the configuration's, or the worst that it draws anyway where that is less.

    Args:
        system, ranges: the configured ones.
        fixed: `payload_mass` (K,) [kg], `vehicle_mass` (K, N) [kg] and `vehicle_thrust_coefficient` (K, N) [-] of K
            episodes, or some of them; other names do not count.

    Raises:
        ConfigError: naming what is fixed.
    """
    culprits = [name for name in ("payload_mass", "vehicle_mass", "vehicle_thrust_coefficient") if name in fixed]
    if not culprits:
        return
    worst = _lift(
        system, (1 + ranges.payload_mass) * system.payload_mass, (1 + ranges.vehicle_mass) * system.drone_mass,
        1 - ranges.vehicle_thrust_coefficient,
    )  # fmt: skip
    thrust, weight = np.broadcast_arrays(*_lift(system, **{name: fixed[name] for name in culprits}))
    limit = min(MIN_THRUST_TO_WEIGHT, worst[0] / worst[1])
    short = np.flatnonzero(thrust < limit * weight * (1 - 1e-9))
    if len(short):
        least = short[0]
        raise ConfigError(
            f"with the {' and '.join(culprits)} that reset is to fix, {describe_team(system.vehicles)} lift "
            f"{thrust[least]:.1f} N, less than {limit:.3g} × their weight with the payload, {weight[least]:.1f} N; "
            "fix lighter bodies or stronger rotors"
        )


def _lift(
    system: System, payload_mass: np.ndarray | float | None = None, vehicle_mass: np.ndarray | None = None,
    vehicle_thrust_coefficient: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the thrust and the weight [N] of a team, nominal where nothing else is given."""
    payload = system.payload_mass if payload_mass is None else payload_mass
    drones = system.drone_mass if vehicle_mass is None else vehicle_mass
    thrust = 4 * np.array([vehicle.rotor_thrust_max for vehicle in system.vehicles]) * vehicle_thrust_coefficient
    return thrust.sum(axis=-1), GRAVITY * (payload + drones.sum(axis=-1) + system.cable_mass.sum())


def _check_hooks(system: System, ranges: RandomizationConfig) -> None:
    """Refuse hooks so far from a drone's centre that its rotors could not hold their moment."""
    heaviest, weakest = 1 + ranges.payload_mass, 1 - ranges.vehicle_thrust_coefficient
    pulls = heaviest * system.formation_force + system.drone_pull - system.formation_force
    for i, vehicle in enumerate(system.vehicles):
        force = pulls[i] + [0, 0, (1 + ranges.vehicle_mass) * vehicle.mass * GRAVITY]
        pull = np.reshape(thrust_frame(tuple(force), 0.0), (3, 3)).T @ pulls[i]
        wrench = [np.linalg.norm(force), *np.cross(system.hooks[i], pull)]
        rotors = np.linalg.solve(vehicle.allocation, wrench)
        least = vehicle.thrust_coefficient * vehicle.rotor_speed_min**2
        most = weakest * vehicle.rotor_thrust_max
        if rotors.min() < least or rotors.max() > most:
            raise ConfigError(
                f"drone {i} would need {rotors.min():.2f} to {rotors.max():.2f} N of its rotors to hold the pull at "
                f"cable.hook {system.hooks[i].tolist()}, but they give {least:.2f} to "
                f"{most:.2f} N; move the hook nearer to the centre of mass"
            )
