"""A route: the motion of a payload and of its team's shape from rest at a start to rest at a goal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.planning.spline import sample_spline


class NoRoute(ConfigError):
    """A route that cannot be found, and why."""


class RouteReport(NamedTuple):
    """What the search for a route found, and what it took."""

    expanded: int
    """States of the lattice that were expanded."""
    length: float
    """Of the payload's way [m]."""
    duration: float
    """[s]"""
    clearance: float
    """Of the team from obstacles along the route, at least, or the distance beyond which it is not measured [m]."""
    planning_time: float
    """CPU time of the search [s]."""


class Route(NamedTuple):
    """Pose and shape in time: quintic pieces, whose first four derivatives are continuous; at rest at both ends."""

    times: np.ndarray
    """(T,) of the knots, from 0 [s]."""
    table: np.ndarray
    """(T, 1 + 3 D) of x, y, z [m], yaw [rad] and the J coordinates of the shape, D = 4 + J, see `fit_spline`."""
    rest: np.ndarray
    """(N, 3) cable forces on the payload in the resting formation, in its heading frame [N]."""
    modes: np.ndarray
    """(J, N, 3) internal forces of each coordinate of the shape [N]."""
    report: RouteReport

    def evaluate(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions (M, 3) [m], attitudes (M, 3, 3) and cable forces (M, N, 3) [N] at times (M,) [s].

        The forces balance the resting payload, in its heading frame; their directions are those of the cables, which
        is the formation's shape. Before the route's start it rests there, after its end at the goal.
        """
        values = self.sample(times)[0]
        rotations = np.zeros((len(values), 3, 3))
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(values[:, 3])
        rotations[:, 1, 0] = np.sin(values[:, 3])
        rotations[:, 0, 1], rotations[:, 2, 2] = -rotations[:, 1, 0], 1.0
        return values[:, :3], rotations, self.forces(values[:, 4:])

    def sample(self, times: np.ndarray) -> np.ndarray:
        """Return x, y, z, yaw and shape at times (M,) [s] and their first three derivatives, (4, M, 4 + J)."""
        return sample_spline(self.table, np.asarray(times, dtype=float))

    def forces(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the cable forces (M, N, 3) [N] of shapes (M, J)."""
        return self.rest + np.tensordot(coordinates, self.modes, axes=1)
