"""What a route asks of its team: cable forces, places and thrusts of the drones, and their distance from obstacles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.control.cable_forces import RANK, wrench_matrix
from multilift_marl.navigation.team_clearance import Scene, TeamBody, measure_clearance
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.route import Route
from multilift_marl.rig.system import System

TICK = 0.02  # [s] between the times that are looked at
MAX_THRUST = 0.9  # over the largest thrust of a drone
MIN_TENSION = 0.2  # over the resting one
APART = 1.05  # of drones that swing, over the distance that is a collision; shapes at rest keep more


class RouteMotion(NamedTuple):
    """A team along its route, by flatness: without errors, feedback and drag."""

    times: np.ndarray
    """(M,) [s]."""
    places: np.ndarray
    """(M, 4) x, y, z [m] and yaw [rad] of the payload."""
    arms: np.ndarray
    """(M, N, 3) each cable from its anchor to its drone, in the payload's frame [m]."""
    tension: np.ndarray
    """(M, N) over the resting one."""
    thrust: np.ndarray
    """(M, N) over the largest one."""
    tilt: np.ndarray
    """(M, N) of the thrusts [rad]."""
    separation: np.ndarray
    """(M,) of the two drones that are closest, over the distance that counts as a collision."""
    clearance: np.ndarray
    """(M,) from obstacles, no more than what was asked for [m]."""

    def feasible(self, tilt: float, until: float = np.inf) -> bool:
        """Return whether thrusts, tensions, distances and tilts, at most `tilt` [rad], keep limits until a time [s]."""
        part = self.times <= until
        within = self.thrust[part].max() <= MAX_THRUST and self.tilt[part].max() <= tilt
        apart = self.separation[part].min() >= APART
        return bool(within and apart and self.tension[part].min() >= MIN_TENSION)


def move_team(route: Route, system: System, body: TeamBody, scene: Scene, enough: float) -> RouteMotion:
    """Return a team's motion along a route; clearances are measured up to `enough` [m]."""
    times = np.arange(0.0, route.times[-1] + TICK, TICK)
    value, _, second, _ = route.sample(times)
    c, s = np.cos(value[:, 3]), np.sin(value[:, 3])
    zero, one = np.zeros_like(c), np.ones_like(c)
    turned = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)

    # The inertia of the payload, in its frame, and the least change of the cable forces that exerts it.
    wrench = np.zeros((len(times), 6))
    wrench[:, :3] = system.payload_mass * np.einsum("tij,ti->tj", turned, second[:, :3])
    wrench[:, 5] = system.inertia_matrix[8] * second[:, 3]
    inverse = np.linalg.pinv(wrench_matrix(system.anchors), rcond=RANK)
    force = route.forces(value[:, 4:]) + (wrench @ inverse.T).reshape(len(times), -1, 3)
    tension = np.linalg.norm(force, axis=-1)
    arms = system.cable_length[:, None] * force / tension[..., None]

    # Newton's law of the drones.
    place = value[:, None, :3] + np.einsum("tij,tnj->tni", turned, system.anchors + arms)
    acceleration = np.gradient(np.gradient(place, TICK, axis=0), TICK, axis=0)
    acceleration[..., 2] += GRAVITY
    thrust = np.einsum("tij,tnj->tni", turned, force) + system.drone_mass[:, None] * acceleration
    size = np.linalg.norm(thrust, axis=-1)
    most = np.array([4 * vehicle.rotor_thrust_max for vehicle in system.vehicles])

    clearance = np.empty(len(times))
    places = np.ascontiguousarray(value[:, :4])
    measure_clearance(places, np.ascontiguousarray(arms), body, scene, enough, clearance)
    tilt = np.arccos(np.clip(thrust[..., 2] / size, -1, 1))
    rest = np.linalg.norm(system.formation_force, axis=1)
    offset = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1)
    separation = (offset + 1e9 * np.eye(len(rest))) / (system.min_separation + np.eye(len(rest)))
    apart = separation.min(axis=(1, 2))
    return RouteMotion(times, places, arms, tension / rest, size / most, tilt, apart, clearance)
