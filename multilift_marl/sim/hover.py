"""Drones in numbers for the compiled loops: how each stands at rest, and where its cable is tied to it."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, cross, mat, mul, norm, put, putmat, row, sub, thrust_frame, tmul, vec
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import GRAVITY


class Drones(NamedTuple):
    """Numbers of each drone in a team."""

    mass: np.ndarray
    """(N,) [kg]."""
    thrust_coefficient: np.ndarray
    """(N,) [N s²]."""
    allocation: np.ndarray
    """(N, 4, 4) inverse allocation matrices."""
    hooks: np.ndarray
    """(N, 3) where the cable is tied, from the centre of mass, body frame [m]."""
    hooked: bool
    """Whether any hook is off its centre of mass."""


def make_drones(system: System) -> Drones:
    """Return the drones of `system`."""
    return Drones(
        mass=system.drone_mass,
        thrust_coefficient=np.array([vehicle.thrust_coefficient for vehicle in system.vehicles]),
        allocation=np.stack([np.linalg.inv(vehicle.allocation) for vehicle in system.vehicles]),
        hooks=np.ascontiguousarray(system.hooks),
        hooked=bool(system.hooks.any()),
    )


@kernel
def hook_position(e, n, state, hooks):
    """Return where cable n is tied to its drone, world frame [m]."""
    return add(vec(state.drone_position, e, n), mul(mat(state.drone_rotation, e, n), row(hooks, n)))


@kernel
def place_at_hook(e, n, state, place, hooks):
    """Put drone n where its hook is at `place`, with the attitude that it has."""
    put(state.drone_position[e, n], sub(place, mul(mat(state.drone_rotation, e, n), row(hooks, n))))


@kernel
def hover_drone(e, n, state, cable_force, yaw, drones):
    """Let drone n of environment e hold still: attitude and rotor speeds that pull its cable by `pull` [N]."""
    force = add(cable_force, (0.0, 0.0, drones.mass[n] * GRAVITY))
    attitude = thrust_frame(force, yaw)
    putmat(state.drone_rotation[e, n], attitude)
    total, torque = norm(force), (0.0, 0.0, 0.0)
    if drones.hooked:
        torque = cross(row(drones.hooks, n), tmul(attitude, cable_force))
    for k in range(4):
        square = total / (4.0 * drones.thrust_coefficient[n])
        if drones.hooked:
            a = drones.allocation[n, k]
            thrust = a[0] * total + a[1] * torque[0] + a[2] * torque[1] + a[3] * torque[2]
            square = max(thrust, 0.0) / drones.thrust_coefficient[n]
        state.rotor_speed[e, n, k] = sqrt(square)
