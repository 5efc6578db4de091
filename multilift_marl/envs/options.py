"""What `reset` is asked for, checked: which environments, which seed, and what is fixed of the episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from multilift_marl.errors import nearest
from multilift_marl.math3d import add, matrow, mul, row, sub
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.feasibility import MAX_LOAD, MAX_WIND
from multilift_marl.rig.plausible import MAX_THRUST
from multilift_marl.rig.system import System
from multilift_marl.sim.parameters import CONFIGURED
from multilift_marl.sim.state import SystemState, hook_position
from multilift_marl.sim.world import World

Rows = dict[str, np.ndarray]
_LARGEST = {  # of a given state, of the length of a vector and its unit; physics diverges beyond 100 m/s and 500 rad/s
    "payload_position": (1e4, "m"), "drone_position": (1e4, "m"),
    "payload_velocity": (MAX_WIND, "m/s"), "drone_velocity": (MAX_WIND, "m/s"),
    "payload_body_rates": (100.0, "rad/s"), "drone_body_rates": (100.0, "rad/s"),
}  # fmt: skip
_FACTORS = (
    0.01,
    100.0,
)  # of fixed masses, inertias, lengths, stiffnesses, thrusts, lags and drags, over the nominal ones
OPTIONS = ("randomization", "state")
MOST_STRETCH = 0.01  # [-] of its length that a cable may be stretched at the start, or ...
MOST_TENSION = 5.0  # [-] ... as much as this times its tension at rest stretches it


def check_mask(mask: Any, num_envs: int) -> np.ndarray:
    """Return a mask as an array (E,) bool; a ValueError if it is none of `num_envs` environments."""
    mask = np.asarray(mask)
    if mask.shape != (num_envs,) or mask.dtype != bool:
        raise ValueError(f"mask has shape {mask.shape} and dtype {mask.dtype}, expected bool {(num_envs,)}")
    return mask


def check_seed(seed: Any) -> None:
    """Refuse what is no seed, None excepted, by a ValueError."""
    # True is an int to Python.
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if seed is not None and not (whole and 0 <= seed < 2**63):
        raise ValueError(f"seed must be a whole number from 0 to 2**63 - 1, but is {seed!r}")


def read_options(options: Mapping[str, Any], mask: np.ndarray, drawn: Rows, state: SystemState) -> dict[str, Rows]:
    """Return the fixed draw and state of `options`, by option and name, with a row for each environment in `mask`.

    Args:
        options: as given to `reset`.
        mask: (E,) bool.
        drawn: all that may be fixed, by name, environment first.
        state: for the shapes of its fields.

    Raises:
        ValueError: an unknown name, a wrong shape, or values that cannot be.
    """
    for name in options:
        if name not in OPTIONS:
            raise ValueError(f"unknown reset option '{name}'{nearest(str(name), OPTIONS)}")
    for name in OPTIONS:
        if not isinstance(options.get(name, {}), Mapping):
            raise ValueError(f"reset option '{name}' must be a dict of values by name, such as {{'payload_mass': 1.6}}")
    fixed = {}
    for name, value in options.get("randomization", {}).items():
        if name not in drawn:
            raise ValueError(_unknown_draw(str(name), drawn))
        fixed[name] = _rows(f"randomization '{name}'", value, drawn[name], mask)
    given = {}
    for name, value in options.get("state", {}).items():
        if name not in SystemState._fields:
            raise ValueError(f"unknown field '{name}' of the state{nearest(str(name), SystemState._fields)}")
        if name == "cable_tension":
            raise ValueError("cable_tension cannot be given: it follows from where drones and payload are")
        given[name] = _rows(f"state '{name}'", value, getattr(state, name), mask, scalars=False)
        _check_field(name, given[name])
    return {"randomization": fixed, "state": given}


def _unknown_draw(name: str, drawn: Rows) -> str:
    if name in (*CONFIGURED, "action_delay", "observation_delay", "observation_bias"):
        return f"{name} is not drawn here, and costs speed where it is; set randomization.{name} above 0"
    return f"unknown draw '{name}'{nearest(name, drawn)}"


def _rows(what: str, value: Any, like: np.ndarray, mask: np.ndarray, scalars: bool = True) -> np.ndarray:
    """Return a row of `value` for each environment in `mask`; it has E rows, as many as these, or one for all."""
    count, shape = int(mask.sum()), like.shape[1:]
    try:
        # Checked in float64, so that nothing is compared that float32 has rounded; `exact` shows what whole numbers or
        # truth values lose by the conversion.
        array = np.array(value, like.dtype if like.dtype != np.float32 else float)
        exact = np.array(value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} must hold numbers, but is {value!r}") from None
    if like.dtype.kind in "ib" and (exact.dtype.kind not in "iufb" or (exact != array).any()):
        kind = "true or false" if like.dtype.kind == "b" else "whole numbers"
        raise ValueError(f"{what} must hold {kind}, but is {value!r}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} holds NaN or infinite values; give finite numbers")
    # One for all, then one for each of all E environments, then one for each in the mask. Where the mask has all,
    # the last two are the same rows.
    if array.shape == shape or (scalars and not array.shape):
        return np.broadcast_to(array, (count, *shape))
    if array.shape == like.shape:
        return array[mask]
    if array.shape == (count, *shape):
        return array
    raise ValueError(f"{what} has shape {array.shape}, expected {(count, *shape)}, {like.shape} or {shape}")


def _check_field(name: str, rows: np.ndarray) -> None:
    """Refuse rotations and rotor speeds that are none."""
    if name.endswith("rotation"):
        # R Rᵀ = 1 holds of reflections, too, whose determinant is -1.
        off = np.abs(rows @ np.swapaxes(rows, -1, -2) - np.eye(3)).max()
        if off > 1e-6 or (np.linalg.det(rows) < 0).any():
            raise ValueError(f"state '{name}' must hold rotation matrices (3, 3), with orthonormal columns, det 1")
    if name == "rotor_speed" and (rows < 0).any():
        raise ValueError("state 'rotor_speed' must not be negative; the sense of rotation is the vehicle's")


def check_state(given: Rows, system: System) -> None:
    """Refuse a given state as fast, far or spinning as no team is, by a ValueError."""
    for name, rows in given.items():
        if name in _LARGEST:
            largest, unit = _LARGEST[name]
            size = float(np.abs(rows).max())  # first, since squares may overflow
            size = size if size > largest else float(np.linalg.norm(rows, axis=-1).max())
            if size > largest:
                raise ValueError(f"state '{name}' is {size:.3g} {unit} long, more than {largest:g} {unit}; give less")
    if "rotor_speed" in given:
        fastest = np.array([vehicle.rotor_speed_max for vehicle in system.vehicles])[:, None]
        if (beyond := given["rotor_speed"] > fastest * (1 + 1e-9)).any():
            # (rows, N, 4): the last index but one is the drone.
            n = int(np.argwhere(beyond)[0][-2])
            raise ValueError(
                f"state 'rotor_speed' of drone_{n} is {given['rotor_speed'][beyond].max():.4g} rad/s, more than its "
                f"rotors reach, {fastest[n, 0]:.4g} rad/s; give less"
            )


def check_draw(fixed: Rows, nominal: Rows, system: System) -> None:
    """Refuse fixed draws that no configuration could have, by a ValueError.

    Args:
        fixed: by name, with a row for each environment.
        nominal: of what is drawn about a nominal value, by name, (...).
        system: of the environments.
    """
    low, high = _FACTORS
    for name, rows in fixed.items():
        if name == "payload_center_of_mass":
            _refuse_beyond(name, rows, float(np.linalg.norm(system.payload_size)), "m")
        elif name in nominal:
            # A body may have no drag, but not no mass, length or stiffness.
            least = 0.0 if name.endswith("drag") else low
            factor = rows / nominal[name]
            if not ((factor >= least) & (factor <= high)).all():
                odd = rows[~((factor >= least) & (factor <= high))]
                raise ValueError(
                    f"randomization '{name}' is {odd.flat[0]:.3g}, not within {least:g} and {high:g} times the nominal "
                    f"{float(nominal[name].flat[0]):.3g}; give less of a change, or change the configuration"
                )
        elif name == "wind":
            _refuse_beyond(name, rows, MAX_WIND, "m/s")
        elif name == "payload_force":
            _refuse_beyond(name, rows, MAX_LOAD * GRAVITY * system.payload_mass, "N")
        elif name == "observation_bias":
            _refuse_beyond(name, rows, 100.0, "in its units")
    # The ratio counts: each that is fixed is checked with the other, which is nominal where it is not.
    coefficient, mass = fixed.get("vehicle_thrust_coefficient", 1.0), fixed.get("vehicle_mass", system.drone_mass)
    rotors = np.sum(fixed.get("rotor_thrust_coefficient", np.ones(4)), axis=-1)
    thrust = np.array([vehicle.rotor_thrust_max for vehicle in system.vehicles]) * coefficient * rotors
    names = [
        name for name in ("vehicle_mass", "vehicle_thrust_coefficient", "rotor_thrust_coefficient") if name in fixed
    ]
    if names and (thrust > MAX_THRUST * GRAVITY * mass).any():
        raise ValueError(
            f"with the {' and '.join(names)} that reset is to fix, a drone lifts more than {MAX_THRUST:g} × its "
            "weight; fix heavier drones or weaker rotors"
        )


def _refuse_beyond(name: str, rows: np.ndarray, largest: float, unit: str) -> None:
    if (size := float(np.abs(rows).max(initial=0.0))) > largest:
        raise ValueError(f"randomization '{name}' holds {size:.3g} {unit}, more than {largest:.4g}; give less")


def check_delays(fixed: Rows, longest: dict[str, int]) -> None:
    """Refuse delays longer than those that are remembered, by a ValueError."""
    for name, most in longest.items():
        if name in fixed and not ((fixed[name] >= 0) & (fixed[name] <= most)).all():
            raise ValueError(f"{name} must be from 0 to {most}, the longest of randomization.{name}; raise that")


def check_stretch(world: World, e: int, length: np.ndarray, stiffness: np.ndarray) -> None:
    """Refuse a start of environment e with over-stretched cables of `length` [m] and `stiffness` [N/m], each (N,).

    Raises:
        ValueError: naming the cable.
    """
    state, system = world.state, world.system
    for n, anchor in enumerate(system.anchors):
        if state.cable_broken[e, n]:
            continue
        foot = add(row(state.payload_position, e), mul(matrow(state.payload_rotation, e), tuple(anchor)))
        span = float(np.linalg.norm(sub(hook_position(e, n, state, world.rig.hooks), foot)))
        # A resting cable is stretched by T/k: a soft one, by more than 1 %, may start like that.
        most = max(MOST_STRETCH * length[n], MOST_TENSION * system.resting_tension[n] / stiffness[n])
        if span > length[n] + most:
            raise ValueError(
                f"the given state stretches cable {n} of environment {e} to {span:.3f} m, but it is {length[n]:.3f} m "
                "long; move drone or payload"
            )
