"""Simple routes among obstacles, to compare `policy=mpc_route` with: paths of the payload alone, and one fixed shape.

They know what `RouteMpc` knows, replan when it does and are timed and flown alike. Numbers by candidates of
`results/tune_navigate.py tune`, of which not all were flown: the most successes on 8 training maps of each level.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from multilift_marl.navigation.formation_shapes import drone_places, make_shapes
from multilift_marl.navigation.payload_path import field_path, shortest_path, space_of, time_path
from multilift_marl.navigation.planner import RouteSettings
from multilift_marl.navigation.team_clearance import Scene, make_scene
from multilift_marl.planning.route import NoRoute, Route
from multilift_marl.policies.route_mpc import RouteMpc
from multilift_marl.rig.system import System

BLEND = 1.0  # [m] of its path on which a team in motion comes to heading and shape
_STEADY = 0.02  # [1/s] of a shape's coordinate
_WINDOW = 9  # knots over which headings are means


class PayloadRouteMpc(RouteMpc):
    """The shortest path of the payload alone, in the resting formation, its heading as at the start.

    Class attributes:
        RADIUS: by which obstacles are inflated [m].
        SPEED: of all bodies, at most [m/s].
    """

    NAME: ClassVar[str] = "mpc_payload"
    HINGE: ClassVar[float] = np.inf  # these routes leave it to soft limits to keep the team clear of obstacles
    RADIUS: float = 0.45
    SPEED: float = 1.5

    def make_route(self, e: int, start: np.ndarray, settings: RouteSettings, departure: np.ndarray | None) -> Route:
        """See `RouteMpc.make_route`."""
        path = self._path(e, start, settings, departure)
        modes = np.zeros((0, self._vec.num_drones, 3))
        return time_path(path, self._vec.world.system, modes, replace(settings, speed=self.SPEED), departure)

    def _path(self, e: int, start: np.ndarray, settings: RouteSettings, departure: np.ndarray | None) -> np.ndarray:
        """Return the path (K, 4) of the payload."""
        if departure is not None:
            start, departure = departure[0, :4], departure[:, :4]
        goal = np.append(self._task.own.goal[e], 0.0)
        scene = make_scene(self.known, e)
        return self._find(start.copy(), goal, space_of(settings, start), scene, departure)

    def _find(
        self, start: np.ndarray, goal: np.ndarray, space: np.ndarray, scene: Scene, departure: np.ndarray | None
    ) -> np.ndarray:
        return shortest_path(start, goal, space, scene, self.RADIUS, departure)


class NarrowRouteMpc(PayloadRouteMpc):
    """The same path, along which a narrow formation heads: drawn in at the start for good, at rest again at the goal.

    While its shape changes the team keeps to its route.

    Class attributes:
        DRAWN: how far it is drawn in, from 0 at rest to 1 at the narrowest shape that keeps drones apart.
    """

    NAME: ClassVar[str] = "mpc_narrow"
    RADIUS: float = 0.3
    DRAWN: float = 0.8

    def make_route(self, e: int, start: np.ndarray, settings: RouteSettings, departure: np.ndarray | None) -> Route:
        """See `RouteMpc.make_route`."""
        if departure is not None and np.abs(departure[1, 4:]).max(initial=0.0) > _STEADY:
            raise NoRoute("a formation goes on once it has been drawn in")
        path = self._path(e, start, settings, departure)
        modes, turned = narrowest_mode(self._vec.world.system)
        away = np.diff(path[:, :2], axis=0, append=path[-1:, :2])
        away[-1] = away[-2]
        heading = np.unwrap(np.append(path[0, 3], np.arctan2(away[:, 1], away[:, 0]) + turned))[1:]
        ends = _WINDOW // 2
        heading = np.convolve(np.pad(heading, ends, mode="edge"), np.full(_WINDOW, 1 / _WINDOW), mode="valid")
        states = np.column_stack([path[:, :3], heading, np.full((len(path), len(modes)), self.DRAWN)])
        turns = 2 * np.pi * round(heading[-1] / (2 * np.pi))
        last = np.concatenate([path[-1, :3], [turns], np.zeros(len(modes))])
        if departure is None:
            first = np.concatenate([path[0], np.zeros(len(modes))])
            states = np.vstack([first, states, last])
        else:
            along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1)))
            share = np.clip(along / BLEND, 0.0, 1.0)[:, None]
            states[:, 3:] = departure[0, 3:] + share * (states[:, 3:] - departure[0, 3:])
            states = np.vstack([states, last])
        return time_path(states, self._vec.world.system, modes, replace(settings, speed=self.SPEED), departure)


class PotentialRouteMpc(PayloadRouteMpc):
    """The payload's path down a potential field; where that ends in a local minimum, the team stays there.

    Class attributes:
        DISTANCE: within which an obstacle repels [m].
        GAIN: of the repulsion, see `field_path`.
    """

    NAME: ClassVar[str] = "mpc_potential"
    DISTANCE: float = 0.9
    GAIN: float = 0.3

    def _find(
        self, start: np.ndarray, goal: np.ndarray, space: np.ndarray, scene: Scene, departure: np.ndarray | None
    ) -> np.ndarray:
        return field_path(start, goal, space, scene, self.DISTANCE, self.GAIN)


def narrowest_mode(system: System) -> tuple[np.ndarray, float]:
    """Return the narrowest shape's mode (1, N, 3) [N], (0, N, 3) of that at rest, and its heading on a path [rad]."""
    shapes, half = make_shapes(system), system.payload_size[:2] / 2
    forces = [shapes.rest, *(shapes.rest + mode for mode in shapes.modes)]
    widths = [np.maximum(np.abs(drone_places(system, each)[:, :2]).max(axis=0), half) for each in forces]
    best, across = np.unravel_index(np.argmin(widths), (len(forces), 2))
    return shapes.modes[max(best - 1, 0) : best], 0.0 if across == 1 else -np.pi / 2
