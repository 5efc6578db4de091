"""The vehicle of each drone, by configuration: a preset, one's own by name, or a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from multilift_marl.errors import ConfigError, nearest
from multilift_marl.physical import GRAVITY
from multilift_marl.plugins import describe_unknown, load_entry_points
from multilift_marl.rig import plausible
from multilift_marl.rig.presets import PRESETS
from multilift_marl.rig.urdf import REQUIRED, read_urdf
from multilift_marl.rig.vehicle import Vehicle
from multilift_marl.schema.files import is_vehicle_file, is_yaml, parse_mapping, read_pinned
from multilift_marl.schema.sections import VehicleConfig
from multilift_marl.schema.validate import validate

_SHIPPED = frozenset(PRESETS)
_VECTORS = ("inertia", "rotor_azimuth", "rotor_spin", "drag")


def resolve_vehicles(config: VehicleConfig, n: int) -> tuple[Vehicle, ...]:
    """Return the vehicle of each of n drones: its preset with the configured fields in place of the preset's own.

    Raises:
        ConfigError: a list of another length, an unknown preset, or a vehicle that cannot be or cannot hover.
    """
    fields = config.model_dump(exclude_none=True)
    values = {key: _one_each(value, n, key) for key, value in fields.items()}
    alike = all(len(set(each)) == 1 for each in values.values())
    vehicles = []
    for i in range(n):
        try:
            vehicles.append(_resolve({key: each[i] for key, each in values.items()}))
        except ConfigError as error:
            raise error if alike else ConfigError(f"drone {i}: {error}") from None
    return tuple(vehicles)


def register_vehicle(name: str, **fields: Any) -> Vehicle:
    """Make a vehicle of one's own known by name, `vehicle.preset=<name>`.

    Args:
        name: not that of a shipped vehicle; of one's own, the latest counts.
        **fields: as in the section `vehicle` of a configuration, in its units; what is left out is that of `preset`, a
            falcon unless another is named.

    Returns:
        The vehicle.

    Raises:
        ConfigError: an unknown field, a wrong value, a name that is taken, or a vehicle that cannot be or cannot hover.
    """
    if name in _SHIPPED or is_vehicle_file(name):
        raise ConfigError(f"a vehicle of one's own cannot have the name '{name}': choose one that is not taken")
    PRESETS[name] = _make_vehicle(name, fields)
    return PRESETS[name]


def describe_team(vehicles: tuple[Vehicle, ...]) -> str:
    """Return how many of which vehicles, such as "2 × falcon, 1 × iris"."""
    return ", ".join(f"{count} × {name}" for name, count in Counter(vehicle.name for vehicle in vehicles).items())


def _one_each(value: Any, n: int, key: str) -> tuple[Any, ...]:
    """Return the value of each of n drones, of one for all or a list with one for each."""
    vector = key in _VECTORS and value and not isinstance(value[0], tuple)
    if vector or not isinstance(value, tuple):
        return (value,) * n
    if len(value) != n:
        raise ConfigError(
            f"vehicle.{key} lists {len(value)} values for env.num_drones={n}: give one value or one for each drone"
        )
    return value


def _find_vehicle(preset: str, given: Collection[str]) -> Vehicle:
    """Return the vehicle of a name or a file, of which the `given` fields will be replaced."""
    if is_yaml(preset):
        path, content = read_pinned("vehicle.preset", preset, 10**6)
        return _make_vehicle(path.stem, parse_mapping(content, path, "fields of a vehicle, such as 'mass: 0.7',"), path)
    if is_vehicle_file(preset):
        path, content = read_pinned("vehicle.preset", preset, 10**6)
        fields = read_urdf(path, content)
        validate(VehicleConfig, fields, "vehicle", where=str(path))
        if missing := [f"vehicle.{key}" for key in REQUIRED if key not in fields and key not in given]:
            raise ConfigError(f"vehicle.preset={path} does not say {', '.join(missing)}; give them beside it")
        azimuth = tuple(np.deg2rad(fields.pop("rotor_azimuth")))
        return replace(PRESETS["falcon"], name=path.stem, rotor_azimuth=azimuth, **fields)
    if preset not in PRESETS:
        load_entry_points()
    if preset not in PRESETS:
        cure = "; one's own needs import=<module>, or is a file, <name>.yaml or .urdf"
        unknown = f"unknown vehicle.preset '{preset}'{nearest(preset, PRESETS, otherwise=cure)}"
        raise ConfigError(describe_unknown(preset, unknown))
    return PRESETS[preset]


def _make_vehicle(name: str, fields: dict[str, Any], file: Path | str = "") -> Vehicle:
    """Return a vehicle of `fields` as in the section `vehicle`, from a `file` if one is named."""
    config = validate(VehicleConfig, fields, "vehicle", where=str(file))
    if file and is_vehicle_file(str(config.preset)):  # it might be the file itself
        raise ConfigError(f"preset={fields['preset']} in {file} must be the name of a vehicle, not another file")
    (vehicle,) = resolve_vehicles(config, 1)
    return replace(vehicle, name=name)


def _resolve(fields: dict[str, Any]) -> Vehicle:
    base = _find_vehicle(fields.pop("preset"), fields)
    if "rotor_azimuth" in fields:
        fields["rotor_azimuth"] = tuple(float(angle) for angle in np.deg2rad(fields["rotor_azimuth"]))
    vehicle = replace(base, **fields)
    _check_vehicle(vehicle)
    return vehicle


def check_rotors(vehicle: Vehicle) -> None:
    """Refuse rotors that overlap, which the models of downwash and ground effect exclude: a ConfigError."""
    rotors = vehicle.rotor_positions
    apart = min(float(np.linalg.norm(a - b)) for i, a in enumerate(rotors) for b in rotors[:i])
    if 2 * vehicle.rotor_radius > apart:
        raise ConfigError(
            f"rotors of vehicle.rotor_radius={vehicle.rotor_radius:g} m overlap, their axes {apart:.3g} m apart; "
            "lower it or raise vehicle.arm, or switch wind.wash and wind.ground_effect off"
        )


def _check_vehicle(vehicle: Vehicle) -> None:
    inertia, spin, position = np.array(vehicle.inertia), np.array(vehicle.rotor_spin), vehicle.rotor_positions
    if 2 * inertia.max() > inertia.sum() * (1 + 1e-9):
        raise ConfigError(
            f"vehicle.inertia {inertia.tolist()} is impossible: no moment may exceed the sum of the other two"
        )
    if vehicle.rotor_speed_min >= vehicle.rotor_speed_max:
        raise ConfigError(
            f"vehicle.rotor_speed_min={vehicle.rotor_speed_min:g} rad/s must be less than the "
            f"{vehicle.rotor_speed_max:g} rad/s that vehicle.rotor_thrust_max={vehicle.rotor_thrust_max:g} N takes"
            + plausible.unit_hint(vehicle.rotor_speed_min, "rad/s", vehicle.rotor_speed_max / 4, 4.0)
        )
    if not np.all(np.abs(spin) == 1) or spin.sum() != 0:
        raise ConfigError(
            f"vehicle.rotor_spin {spin.tolist()} must hold 1 for two rotors and -1 for the other two, or yaw is out of "
            "control"
        )
    if np.abs(position.sum(axis=0)).max() > 1e-6 * vehicle.arm:
        raise ConfigError(
            f"vehicle.rotor_azimuth {np.rad2deg(vehicle.rotor_azimuth).round(3).tolist()} does not balance: equal "
            "thrusts must give no torque, so place the rotors in opposite pairs"
            + (", in degrees and not in rad" if plausible.radians_for_degrees(vehicle) else "")
        )
    # The allocation without its lengths: nearly singular where some axis cannot be turned about.
    unit = np.stack([np.ones(4), position[:, 0] / vehicle.arm, position[:, 1] / vehicle.arm, spin])
    if np.linalg.svd(unit, compute_uv=False).min() < 0.05:
        raise ConfigError(
            f"vehicle.rotor_azimuth {np.rad2deg(vehicle.rotor_azimuth).round(3).tolist()} with vehicle.rotor_spin "
            f"{spin.tolist()} cannot turn the drone about each axis: let opposite rotors turn alike"
        )
    if vehicle.spare_lift <= 0:
        thrust = 4 * vehicle.rotor_thrust_max
        hint = plausible.unit_hint(vehicle.mass, "kg", thrust / (3 * GRAVITY))
        raise ConfigError(
            f"vehicle '{vehicle.name}' of vehicle.mass={vehicle.mass:g} kg cannot lift itself with {thrust:g} N"
            f"{hint or '; raise vehicle.rotor_thrust_max'}"
        )
    plausible.check_vehicle(vehicle)
