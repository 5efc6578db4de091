"""Numbers that cannot be in the unit of their key, and the unit that they are likely in.

Bounds are wide: a factor of ten or more beyond the shipped vehicles and rigs, or a limit of physics.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.errors import ConfigError, warn_once
from multilift_marl.physical import GRAVITY
from multilift_marl.schema.values import UNITS

if TYPE_CHECKING:
    from multilift_marl.rig.mesh import Mesh
    from multilift_marl.rig.vehicle import Vehicle

MAX_THRUST = 50.0  # [-] of a drone over its weight
SPEED_OF_SOUND = 340.0  # [m/s] which tips of rotors stay below; faster ones are refused where rpm explain them
MAX_IDLE = 0.75  # [-] of a drone's weight that idle rotors may lift
MAX_LAG = 1.0  # [s] of rotors
MAX_TORQUE_RATIO = 3.0  # [-] over the arm; of presets 0.09 to 0.24
LEAST_TORQUE_RATIO = 1e-3  # [-] over the arm, below which it is refused where another unit explains it
MAX_RADIUS = 10.0  # [-] of a rotor over the arm; of presets 0.5 to 0.6
INERTIA = (1e-4, 100.0)  # [-] largest moment over mass × arm²; of presets 0.35 to 0.59, of auto6 1
LEAST_DENSITY = 0.01  # [kg/m³] of a payload
AIR = 1.2  # [kg/m³] denser than which a payload is that is larger than
LARGE = 5.0  # [-] cable and drone
MOST_DENSITY = 25_000.0  # [kg/m³] of a mesh; of osmium 22 590
MAX_PAYLOAD_INERTIA = 10.0  # [-] over mass × (sum of squares of the other two edges); a uniform box has 1/12
LONG = 150.0  # [-] of a cable over its drone, of which a warning tells


def unit_hint(value: float, unit: str, usual: float, within: float = 10.0) -> str:
    """Return "; if that is in mm, give 0.3" of the other unit in which a value is nearest to the usual one.

    Args:
        value: in `unit`.
        unit: of the key, see `UNITS`.
        usual: value.
        within: how many times more or less than the usual a value may be, else there is no hint, "".
    """
    if not (value > 0 and usual > 0):
        return ""
    gap, name, factor = min((abs(np.log(value * factor / usual)), name, factor) for name, factor in UNITS[unit].items())
    return f"; if that is in {name}, give {value * factor:.4g}" if gap < np.log(within) else ""


def check_vehicle(vehicle: Vehicle) -> None:
    """Refuse a vehicle whose numbers do not go together in SI units: a ConfigError."""
    if 4 * vehicle.rotor_thrust_max <= MAX_THRUST * vehicle.mass * GRAVITY:  # else feasibility refuses it
        _check_rotor_speeds(vehicle)
    for direction in ("up", "down"):
        lag = getattr(vehicle, f"rotor_time_constant_{direction}")
        if lag > MAX_LAG:
            hint = unit_hint(lag, "s", 0.03, 50.0)
            raise ConfigError(
                f"rotors of vehicle.rotor_time_constant_{direction}={lag:g} s are too slow to fly{hint or '; lower it'}"
            )
    for key, most, usual in (("torque_ratio", MAX_TORQUE_RATIO, 0.15), ("rotor_radius", MAX_RADIUS, 0.6)):
        value = getattr(vehicle, key)
        if value > most * vehicle.arm:
            hint = unit_hint(value, "m", usual * vehicle.arm)
            raise ConfigError(
                f"vehicle.{key}={value:g} m is {value / vehicle.arm:.3g} × vehicle.arm={vehicle.arm:g} m, more than "
                f"{most:g}{hint or '; correct one of them'}"
            )
    meant = vehicle.torque_ratio / vehicle.thrust_coefficient
    if vehicle.torque_ratio < LEAST_TORQUE_RATIO * vehicle.arm and 0.02 < meant / vehicle.arm < MAX_TORQUE_RATIO:
        raise ConfigError(
            f"vehicle.torque_ratio={vehicle.torque_ratio:g} m lets rotors turn the drone hardly at all; if that is "
            f"torque over squared speed [N m s²], give that over vehicle.thrust_coefficient, {meant:.4g}"
        )
    _check_inertia(vehicle)


def _check_rotor_speeds(vehicle: Vehicle) -> None:
    places = vehicle.rotor_positions
    apart = min(float(np.linalg.norm(a - b)) for i, a in enumerate(places) for b in places[:i])
    tips = vehicle.rotor_speed_max * min(vehicle.rotor_radius, apart / 2)  # a radius may be left that of the preset
    if SPEED_OF_SOUND < tips < SPEED_OF_SOUND * 30 / np.pi:
        raise ConfigError(
            f"rotors of vehicle.thrust_coefficient={vehicle.thrust_coefficient:g} N s² would turn at "
            f"{vehicle.rotor_speed_max:.4g} rad/s for vehicle.rotor_thrust_max={vehicle.rotor_thrust_max:g} N, their "
            f"tips faster than sound; if that is per rpm², give {(30 / np.pi) ** 2 * vehicle.thrust_coefficient:.4g}"
        )
    idle = 4 * vehicle.thrust_coefficient * vehicle.rotor_speed_min**2 / (vehicle.mass * GRAVITY)
    if idle > MAX_IDLE:
        hint = unit_hint(vehicle.rotor_speed_min, "rad/s", vehicle.rotor_speed_min * (0.05 / idle) ** 0.5, 5.0)
        raise ConfigError(
            f"rotors that idle at vehicle.rotor_speed_min={vehicle.rotor_speed_min:g} rad/s lift {100 * idle:.3g} % of "
            f"the drone's weight, more than {100 * MAX_IDLE:g} %, and it could not descend{hint or '; lower it'}"
        )


def _check_inertia(vehicle: Vehicle) -> None:
    largest, scale = max(vehicle.inertia), vehicle.mass * vehicle.arm**2
    if INERTIA[0] * scale <= largest <= INERTIA[1] * scale:
        return
    if largest > scale:
        hint = unit_hint(largest, "kg m²", 0.5 * scale)
    else:
        hint = unit_hint(vehicle.arm, "m", (2 * largest / vehicle.mass) ** 0.5)
        hint = hint.replace("that is", "vehicle.arm is")
    raise ConfigError(
        f"vehicle.inertia {list(vehicle.inertia)} kg m² is {largest / scale:.2g} × vehicle.mass={vehicle.mass:g} kg × "
        f"vehicle.arm={vehicle.arm:g} m squared, beyond {INERTIA[0]:g} to {INERTIA[1]:g}"
        f"{hint or '; correct one of them'}"
    )


def radians_for_degrees(vehicle: Vehicle) -> bool:
    """Return whether the directions of rotors balance if their numbers, in degrees, are taken as radians."""
    meant = replace(vehicle, rotor_azimuth=tuple(np.rad2deg(vehicle.rotor_azimuth)))
    return bool(np.abs(meant.rotor_positions.sum(axis=0)).max() < 0.01 * vehicle.arm)


def check_payload(
    mass: float, edges: np.ndarray, inertia: np.ndarray, mesh: Mesh | None, given: bool, reach: float
) -> None:
    """Refuse a payload whose numbers do not go together in SI units.

    Args:
        mass: [kg].
        edges: of its bounding box (3,) [m].
        inertia: principal moments (3,) [kg m²].
        mesh: of it, None for other shapes.
        given: whether the edges are configured or a mesh's, not those of the standard rig.
        reach: length of the longest cable and the largest drone [m].

    Raises:
        ConfigError: with the likely unit.
    """
    if given:
        _check_density(mass, edges, float(np.prod(edges)) if mesh is None else mesh.volume, mesh, reach)
    square = float(mass * (np.sum(edges**2) - edges.min() ** 2))
    if inertia.max() > MAX_PAYLOAD_INERTIA * square:
        hint = unit_hint(float(inertia.max()), "kg m²", square / 12)
        raise ConfigError(
            f"payload.inertia {inertia.tolist()} kg m² is more than a body of {mass:g} kg and {_by(edges)} m can have"
            f"{hint.replace('that', 'the largest') or '; lower it or give payload.size'}"
        )


def _check_density(mass: float, edges: np.ndarray, volume: float, mesh: Mesh | None, reach: float) -> None:
    density = mass / volume
    light = density < LEAST_DENSITY or (density < AIR and edges.max() > LARGE * reach)
    heavy = mesh is not None and density > MOST_DENSITY
    if not light and not heavy:
        return
    key = f"payload.mesh={mesh.path}" if mesh is not None and (mesh.scale == 1).all() else "payload.size"
    gaps = [(abs(np.log(edges.max() * factor / (0.5 * reach))), name) for name, factor in UNITS["m"].items()]
    cure = f"; correct it, or payload.mass={mass:g} kg"
    if light:
        name = min(gaps)[1]
        size = [float(f"{edge:.4g}") for edge in edges * UNITS["m"][name]]
        cure = f"; if it is in {name}, give payload.size={size}"
    raise ConfigError(
        f"{key} makes a payload of {_by(edges)} m, {'lighter than air' if light else 'denser than any metal'} with "
        f"{mass:.3g} kg{cure}"
    )


def _by(edges: np.ndarray) -> str:
    return " × ".join(f"{edge:.3g}" for edge in edges)


def warn_of_cables(length: np.ndarray, spans: np.ndarray, angle: float | tuple[float, ...]) -> None:
    """Log a warning of cables that are likely in another unit, though they can be as they are.

    Args:
        length: (N,) [m].
        spans: of the drones (N,) [m].
        angle: from the vertical, one or one for each drone [deg].
    """
    i = int(np.argmax(length / spans))
    if length[i] > LONG * spans[i]:
        hint = unit_hint(float(length[i]), "m", float(5 * spans[i]))
        warn_once("rig", f"cable.length={length[i]:g} m is {length[i] / spans[i]:.3g} × the span of its drone{hint}")
    steep = [each for each in np.atleast_1d(angle) if 0 < each < 1]
    if steep:
        turned = np.rad2deg(steep[0])
        warn_once(
            "rig", f"cable.angle={steep[0]:g} is in degrees and almost vertical; if that is in rad, give {turned:.4g}"
        )
