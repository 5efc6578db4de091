"""Drones let go in any attitude: rotors saturate, and roll and pitch must come before thrust for them to come back."""

from __future__ import annotations

import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.config.schema import ControlConfig
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.math3d import axis_angle, quat_to_mat
from multilift_marl.rig.vehicles import GRAVITY, PRESETS
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Result, Row

_HEIGHT, _SECONDS = 1000.0, 30.0  # [m], [s]
_KNOWN = (90.0, 179.0, 179.9)  # [deg] of roll
_BACK = 0.05  # [m]


def release(fast: bool) -> Result:
    """Drones of every preset are let go at rest at their references, rotors at hover speed, in random attitudes."""
    result = Result()
    for name in PRESETS:
        fall, lost = release_drones(name, attitudes(30 if fast else 1000))
        quantity = f"drones not back within {100 * _BACK:g} cm after {_SECONDS:g} s, of {len(lost)}"
        result.rows.append(Row(f"release, {name}", quantity, 0, lost.sum(), lost.sum(), 0))
        for angle, depth in zip(_KNOWN, fall, strict=False):
            text = f"fall from {angle:g}° of roll [m] (for information)"
            result.rows.append(Row(f"release, {name}", text, 0.0, depth, depth, float("inf")))
        deepest = float(fall[len(_KNOWN) :].max())
        text = "largest fall from random attitudes [m] (for information)"
        result.rows.append(Row(f"release, {name}", text, 0.0, deepest, deepest, float("inf")))
    return result


def attitudes(count: int, seed: int = 0) -> np.ndarray:
    """Return known rolls, then `count` attitudes uniform over all rotations (K, 3, 3)."""
    known = [np.reshape(axis_angle((1.0, 0.0, 0.0), float(np.deg2rad(angle))), (3, 3)) for angle in _KNOWN]
    quaternions = np.random.default_rng(seed).normal(size=(count, 4))
    return np.stack([*known, *(np.reshape(quat_to_mat(*q.tolist()), (3, 3)) for q in quaternions)])


def release_drones(preset: str, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far each drone fell (K,) [m], and whether it is not back at its reference (K,)."""
    count = len(start)
    system = load_config("hover", {"env.num_drones": 1, "vehicle.preset": preset, "payload.mass": 1e-3}).system
    world, gains, reference = World(system, count, 1), make_gains(ControlConfig(), system), Reference.zeros(count, 1)
    state = world.state
    reference.position[:] = [0.0, 0.0, _HEIGHT]
    state.payload_position[:], state.drone_position[:] = [0.0, 50.0, 0.0], reference.position
    state.drone_rotation[:, 0] = start
    state.rotor_speed[:] = np.sqrt(system.drone_mass[0] * GRAVITY / 4 / system.vehicle.thrust_coefficient)
    world.load(np.ones(count, bool))
    world.break_cables(np.ones((count, 1), bool))
    lowest, no_pull = np.full(count, _HEIGHT), np.zeros((count, 1, 3))
    for _ in range(round(_SECONDS / system.timestep)):
        fly(0, count, state, reference, no_pull, world.thrust, gains)
        world.step(world.thrust)
        lowest = np.minimum(lowest, state.drone_position[:, 0, 2])
    away = np.linalg.norm(state.drone_position - reference.position, axis=-1)[:, 0]
    return _HEIGHT - lowest, ~(away < _BACK)
