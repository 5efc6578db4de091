"""Masses and moments of inertia of payload and drones in every environment, for the compiled loops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, cross, dot, matrow, mul, quat_to_mat, row, sub, tmul
from multilift_marl.rig.system import System
from multilift_marl.sim.parameters import Parameters


class Inertias(NamedTuple):
    """Of each body: 0 is the payload, 1 + n drone n."""

    mass: np.ndarray
    """(E, 1 + N) [kg]."""
    inertia: np.ndarray
    """(E, 1 + N, 3, 3) about the centre of mass, body frame [kg m²]."""
    inverse: np.ndarray
    """(E, 1 + N, 3, 3) its inverse; zero of a point payload, which does not turn."""
    center: np.ndarray
    """(E, 1 + N, 3) centre of mass from the origin of the body frame [m]."""


def make_inertias(system: System, parameters: Parameters) -> Inertias:
    """Return the inertias of `system`, those of each environment by `parameters`."""
    e, n = parameters.vehicle_mass.shape
    inertias = Inertias(
        np.zeros((e, 1 + n)), np.zeros((e, 1 + n, 3, 3)), np.zeros((e, 1 + n, 3, 3)), np.zeros((e, 1 + n, 3))
    )
    update_inertias(inertias, system, parameters)
    return inertias


def update_inertias(inertias: Inertias, system: System, parameters: Parameters) -> None:
    """Bring inertias into line with parameters."""
    inertias.mass[:, 0], inertias.mass[:, 1:] = parameters.payload_mass, parameters.vehicle_mass
    inertias.center[:, 0] = parameters.payload_center_of_mass
    axes = np.reshape(quat_to_mat(*system.payload_axes.tolist()), (3, 3))
    scale = parameters.payload_mass / system.payload_mass * parameters.payload_inertia
    inertias.inertia[:, 0] = scale[:, None, None] * (axes * system.payload_inertia @ axes.T)
    for i, vehicle in enumerate(system.vehicles):
        own = parameters.vehicle_mass[:, i] / vehicle.mass
        inertias.inertia[:, 1 + i] = own[:, None, None] * np.diag(vehicle.inertia)
    inertias.inverse[:, 1:] = np.linalg.inv(inertias.inertia[:, 1:])
    if system.payload_shape != "point":
        inertias.inverse[:, 0] = np.linalg.inv(inertias.inertia[:, 0])


@kernel
def mobility(e, b, attitude, point, direction, inertias):
    """Return how fast a point of body b moves along `direction` for a unit impulse along it there [1/kg].

    Args:
        e, b: environment and body.
        attitude: of the body, 9 numbers.
        point: from the origin of the body frame, body frame [m].
        direction: unit vector, world frame.
        inertias: Inertias.
    """
    moment = cross(sub(point, row(inertias.center[e], b)), tmul(attitude, direction))
    return 1.0 / inertias.mass[e, b] + dot(moment, mul(matrow(inertias.inverse[e], b), moment))


@kernel
def point_motion(position, attitude, velocity, rates, point):
    """Return place and velocity of a point of a body, given in its frame."""
    return add(position, mul(attitude, point)), add(velocity, mul(attitude, cross(rates, point)))
