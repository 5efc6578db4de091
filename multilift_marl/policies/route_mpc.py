"""Model-predictive control along a route among obstacles, `policy=mpc_route`: a search over pose and formation shape.

At the start of an episode a route is searched on the map (`navigation/planner.py`); the team's plans follow it. Where
obstacles are known only from near, it is searched anew, from the motion under way, whenever one comes into sight.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.errors import ConfigError, warn_once
from multilift_marl.math3d import heading
from multilift_marl.navigation.planner import RouteSettings, find_route
from multilift_marl.planning.route import NoRoute, Route
from multilift_marl.policies.mpc import TeamMpc
from multilift_marl.rig.obstacles import NONE
from multilift_marl.sim.obstacle_bodies import box_distance
from multilift_marl.sim.obstacles import Obstacles
from multilift_marl.tasks.navigate import Navigate

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

SIGHT = 2.5  # [m] from a drone or the payload, within which obstacles of level `unknown` are seen
INSIDE = 0.1  # [m] that routes keep from the bounds of the map, beyond which the payload is out of range
AHEAD = 0.1  # [s] that a route which goes on begins later, as a search takes time
RETRY = 0.2  # [s] after a search that found no way on


class RouteMpc(TeamMpc):
    """As `TeamMpc`, with the map of the task `navigate`.

    Attributes:
        routes: of each environment (E,), None where none was found: there the team stays where it began.
        begun: when they begin (E,) [s].
        searches: of the episodes so far (E,).
        search_time: CPU time of the first search and of the longest later one, of each environment (E, 2) [s].
    """

    def __init__(self, vec: MultiliftVec):
        if not isinstance(vec.task, Navigate):
            raise ConfigError(f"policy=mpc_route needs the map of task navigate, not {vec.task.name}; take policy=mpc")
        super().__init__(vec, self._follow)
        e = vec.num_envs
        self._task = vec.task
        self.routes: list[Route | None] = [None] * e
        self.begun, self.searches, self.search_time = np.zeros(e), np.zeros(e), np.zeros((e, 2))
        self._before: list[tuple[Route | None, float]] = [(None, 0.0)] * e
        self._known = np.zeros(vec.world.obstacles.kind.shape, bool)
        self._due = np.zeros(e)
        self._new = np.ones(e, bool)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """See `TeamMpc.reset`."""
        super().reset(mask)
        self._new[slice(None) if mask is None else mask] = True

    def act(self, observation: np.ndarray) -> np.ndarray:
        """See `TeamMpc.act`."""
        for e in range(self._vec.num_envs):
            self._see(e)
        return super().act(observation)

    def metrics(self) -> dict[str, np.ndarray]:
        """Return those of `TeamMpc`, and how long searches took (E,) [s], NaN where there was no later one."""
        later = np.where(self.searches > 1, self.search_time[:, 1], np.nan)
        return super().metrics() | {"route_search_s": self.search_time[:, 0].copy(), "route_replan_s": later}

    def _see(self, e: int) -> None:
        """Search a route where the episode is new, or an obstacle that was not known is in sight."""
        seen, time = self._in_sight(e), float(self._task.time[e])
        if self._new[e]:
            self._new[e], self._known[e], self._due[e] = False, seen, np.inf
            self.routes[e], self.begun[e], self.searches[e], self.search_time[e] = None, 0.0, 0, 0.0
            self._before[e] = None, 0.0
            self._search(e, None, 0.0)
        elif (seen & ~self._known[e]).any() or time >= self._due[e]:
            self._known[e] |= seen
            if time < self.begun[e]:  # the last search is still under way
                self._due[e] = self.begun[e]
                return
            self._due[e] = np.inf
            route = self.routes[e]
            begin = time if route is None else time + AHEAD
            departure = None if route is None else route.sample(np.array([begin - self.begun[e]]))[:3, 0]
            self._search(e, departure, begin)

    def _in_sight(self, e: int) -> np.ndarray:
        """Return which obstacles (M,) are known to be there: all, or those near a drone or the payload."""
        obstacles, state = self._vec.world.obstacles, self._vec.world.state
        if self._task.options.level != "unknown":
            known: np.ndarray = obstacles.kind[e] != NONE
            return known
        points = [state.payload_position[e], *state.drone_position[e]]
        seen = self._known[e].copy() if not self._new[e] else np.zeros(obstacles.kind.shape[1], bool)
        for m in np.flatnonzero((obstacles.kind[e] != NONE) & ~seen).tolist():
            seen[m] = min(box_distance(e, m, tuple(point), obstacles) for point in points) <= SIGHT
        return seen

    def _search(self, e: int, departure: np.ndarray | None, begin: float) -> None:
        """Replace the route of an environment from a time on [s]; the one that it has stays where none is found."""
        own, state = self._task.own, self._vec.world.state
        settings = RouteSettings(low=tuple(own.low[e] + INSIDE), high=tuple(own.high[e] - INSIDE))
        start = np.append(state.payload_position[e], heading(tuple(state.payload_rotation[e].ravel())))
        known = self._map(e)
        self.searches[e] += 1
        try:
            route = find_route(
                self._vec.world.system, known, 0, start, np.append(own.goal[e], 0.0), settings, departure
            )
        except NoRoute as error:
            warn_once("no_route", f"policy=mpc_route: {error}")
            self._due[e] = begin + RETRY
            return
        took = route.report.planning_time
        if departure is None:
            self.search_time[e, 0] = took
        else:
            self.search_time[e, 1] = max(self.search_time[e, 1], took)
        self._before[e] = self.routes[e], self.begun[e]
        self.routes[e], self.begun[e] = route, begin

    def _map(self, e: int) -> Obstacles:
        """Return the obstacles of an environment that are known."""
        known = Obstacles(*(array[e : e + 1].copy() for array in self._vec.world.obstacles))
        known.kind[0, ~self._known[e]] = NONE
        return known

    def _follow(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return places, attitudes and shapes along the routes, see `TeamMpc.preview`."""
        shape, n = times.shape, self._vec.num_drones
        places, turned = np.zeros((*shape, 3)), np.tile(np.eye(3), (*shape, 1, 1))
        forces = np.tile(self._vec.world.system.formation_force, (*shape, 1, 1)).reshape(*shape, n, 3)
        for e, (before, begun) in enumerate(self._before):
            places[e] = self._task.own.start[e]
            # Differences at the beginning of a route reach back to the one before it.
            late = (times[e] >= self.begun[e]) | (before is None)
            for route, begin, chosen in ((before, begun, ~late), (self.routes[e], self.begun[e], late)):
                if route is not None and chosen.any():
                    found = route.evaluate(times[e][chosen] - begin)
                    places[e][chosen], turned[e][chosen], forces[e][chosen] = found
        return places, turned, forces
