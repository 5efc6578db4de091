"""Acceleration set-points for autopilots that know the drone alone, not what hangs on it."""

from __future__ import annotations

import numpy as np

from multilift_marl.math3d import turn
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.system import System


class LoadFeedforward:
    """What the drones of a team carry, as accelerations: the forces on their cables, their loads' inertia, their drag.

    PX4's thrust is its acceleration set-point and gravity, times the mass of the drone alone.

    Args:
        system: the rig.
    """

    def __init__(self, system: System):
        self._mass, self._load_share = system.drone_mass, system.hook_force[:, 2] / GRAVITY
        self._drag = np.array([vehicle.drag for vehicle in system.vehicles])  # [kg/s], of a level drone

    def acceleration(
        self, drone: int, velocity: np.ndarray, acceleration: np.ndarray, cable_force: np.ndarray, yaw: float
    ) -> np.ndarray:
        """Return the acceleration (3,) [m/s²] to ask a drone's autopilot for, world frame.

        Args:
            drone: its number.
            velocity, acceleration: of its reference (3,) [m/s, m/s²].
            cable_force: its nominal force on its cable (3,) [N].
            yaw: its heading from east [rad].
        """
        c, s = np.cos(yaw), np.sin(yaw)
        # Into the axes of a level drone of this heading, and back.
        drag = np.array(turn(c, s, tuple(self._drag[drone] * turn(c, -s, tuple(velocity)))))
        return acceleration + (self._load_share[drone] * acceleration + cable_force + drag) / self._mass[drone]

    def jerk(self, drone: int, jerk: np.ndarray) -> np.ndarray:
        """Return the jerk (3,) [m/s³] by which the acceleration asked for of a drone changes where cables keep theirs.

        Args:
            drone: its number.
            jerk: of its reference (3,) [m/s³].
        """
        return np.asarray((1.0 + self._load_share[drone] / self._mass[drone]) * jerk)
