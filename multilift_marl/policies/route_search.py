"""Routes among obstacles of the teams of task `navigate`: searched when an episode begins, and when more is known.

Where `env.obstacle_sensing` is local or ranges, an obstacle is known, as a whole, once it has been within its range of
a drone or the payload, and the route is searched anew from the motion under way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.errors import ConfigError, warn_once
from multilift_marl.math3d import heading
from multilift_marl.navigation.planner import RouteSettings, find_route
from multilift_marl.planning.route import NoRoute, Route
from multilift_marl.rig.obstacles import NONE
from multilift_marl.sim.obstacle_bodies import box_distance
from multilift_marl.sim.obstacles import Obstacles
from multilift_marl.tasks.navigate import Navigate

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

RETRY = 0.2  # [s] after a search that found no way on


class RouteSearch:
    """What policies that follow routes have in common.

    Args:
        vec: environments of the task `navigate`, read at every `update_routes`.

    Class attributes:
        NAME: of the policy.
        INSIDE: what routes keep from the bounds of the map, beyond which the payload is out of range [m].
        AHEAD: by which a route that goes on begins later, as a search takes time [s].
        SAYS: whether it warns where no route is found.

    Attributes:
        routes: of each environment (E,), None where none was found: there the team stays where it began.
        begun: when they begin (E,) [s].
        known: obstacles that are known; those that are not have no kind.
        searches: of the episodes so far (E,).
        search_time: CPU time of the first search and of the longest later one, of each environment (E, 2) [s].

    Raises:
        ConfigError: another task, or senses that do not tell how the payload is turned.
    """

    NAME: ClassVar[str]
    INSIDE: ClassVar[float] = 0.1
    AHEAD: ClassVar[float] = 0.1
    SAYS: ClassVar[bool] = True
    _vec: MultiliftVec

    def __init__(self, vec: MultiliftVec):
        self.check(vec)
        env, e = vec.config.env, vec.num_envs
        assert isinstance(vec.task, Navigate)
        self._vec, self._task = vec, vec.task
        self.routes: list[Route | None] = [None] * e
        self.begun, self.searches, self.search_time = np.zeros(e), np.zeros(e), np.zeros((e, 2))
        self._flown: list[list[tuple[float, Route]]] = [[] for _ in range(e)]
        self.known = Obstacles(*(array.copy() for array in vec.world.obstacles))
        self._seen = np.zeros(self.known.kind.shape, bool)
        self._due = np.zeros(e)
        self._new = np.ones(e, bool)
        self._range = env.obstacles.range if env.obstacle_sensing in ("local", "ranges") else np.inf

    def check(self, vec: MultiliftVec) -> None:
        """Refuse, by a ConfigError, environments in which there are no routes."""
        if not isinstance(vec.task, Navigate):
            raise ConfigError(
                f"policy={self.NAME} needs the map of task navigate, not {vec.task.name}; take another policy"
            )
        env = vec.config.env
        if env.sensing in ("onboard", "blind") and env.communication == "none":
            raise ConfigError(
                f"policy={self.NAME} turns the payload, whose attitude drones do not know with env.sensing="
                f"{env.sensing}; set env.sensing=onboard env.communication=all"
            )

    def begin(self, mask: np.ndarray | None) -> None:
        """Search anew in the environments of the mask (E,) (None: all)."""
        self._new[slice(None) if mask is None else mask] = True

    def update_routes(self) -> None:
        """Search routes where the episode is new, an obstacle that was not known is in sight, or the team is lost."""
        for known, true in zip(self.known, self._vec.world.obstacles, strict=True):
            known[:] = true
        for e in range(self._vec.num_envs):
            self._see(e)

    def make_route(self, e: int, start: np.ndarray, settings: RouteSettings, departure: np.ndarray | None) -> Route:
        """Return a route from a start (4,) to the goal of environment e, see `find_route`; raise NoRoute."""
        goal = np.append(self._task.own.goal[e], 0.0)
        return find_route(self._vec.world.system, self.known, e, start, goal, settings, departure)

    def depart(self, e: int, route: Route, time: float) -> np.ndarray:
        """Return the motion (4, 4 + J) from which the next route goes on at a time [s], see `find_route`."""
        return route.sample(np.array([time - self.begun[e]]))[:, 0]

    def is_lost(self, e: int, time: float) -> bool:
        """Return whether the route of environment e no longer serves its team."""
        return False

    def follow(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return places (E, M, 3) [m], attitudes (E, M, 3, 3) and shapes (E, M, N, 3) [N] at times (E, M) [s]."""
        shape, n = times.shape, self._vec.num_drones
        places, turned = np.zeros((*shape, 3)), np.tile(np.eye(3), (*shape, 1, 1))
        forces = np.tile(self._vec.world.system.formation_force, (*shape, 1, 1)).reshape(*shape, n, 3)
        for e, flown in enumerate(self._flown):
            places[e] = self._task.own.start[e]
            for i, (begin, route) in enumerate(flown):
                late = times[e] >= (begin if i else -np.inf)
                if late.any():
                    found = route.evaluate(times[e][late] - begin)
                    places[e][late], turned[e][late], forces[e][late] = found
        return places, turned, forces

    def search_metrics(self) -> dict[str, np.ndarray]:
        """Return how many searches there were (E,), and what they took, see `search_time` [s]."""
        first, later = self.search_time.T.copy()
        return {"searches": self.searches.copy(), "search_s": first, "longest_later_search_s": later}

    def _see(self, e: int) -> None:
        time = float(self._task.time[e])
        if self._new[e]:
            self._seen[e] = False
        seen = self._in_sight(e)
        changed = (seen & ~self._seen[e]).any()
        self._seen[e] = seen
        self.known.kind[e, ~seen] = NONE
        if self._new[e]:
            self._new[e], self._due[e], self._flown[e] = False, np.inf, []
            self.routes[e], self.begun[e], self.searches[e], self.search_time[e] = None, 0.0, 0, 0.0
            self._search(e, None, 0.0)
        elif changed or time >= self._due[e] or self.is_lost(e, time):
            if time < self.begun[e]:  # the last search is still under way
                self._due[e] = self.begun[e]
                return
            self._due[e] = np.inf
            route = self.routes[e]
            begin = time if route is None else time + self.AHEAD
            self._search(e, None if route is None else self.depart(e, route, begin), begin)

    def _in_sight(self, e: int) -> np.ndarray:
        """Return which obstacles (M,) are known: all, or those that are or were near a drone or the payload."""
        obstacles, state = self._vec.world.obstacles, self._vec.world.state
        there: np.ndarray = obstacles.kind[e] != NONE
        if self._range == np.inf:
            return there
        seen = self._seen[e].copy()
        if (there & ~seen).any():
            points = [state.payload_position[e], *state.drone_position[e]]
            for m in np.flatnonzero(there & ~seen).tolist():
                seen[m] = min(box_distance(e, m, tuple(point), obstacles) for point in points) <= self._range
        return seen

    def _search(self, e: int, departure: np.ndarray | None, begin: float) -> None:
        """Replace the route of an environment from a time on [s]; the one that it has stays where none is found."""
        own, load = self._task.own, self._task.view.payload_estimate
        yaw = 0.0 if self._task.rig.is_point else heading(tuple(load.rotation[e, 0].ravel()))
        start = np.append(load.position[e].mean(axis=0), yaw)
        ends = np.array([start[:3], own.goal[e]])  # those of a given map may be closer to its bounds
        low = np.minimum(own.low[e] + self.INSIDE, ends.min(axis=0))
        high = np.maximum(own.high[e] - self.INSIDE, ends.max(axis=0))
        settings = RouteSettings(low=tuple(low), high=tuple(high))
        self.searches[e] += 1
        try:
            route = self.make_route(e, start, settings, departure)
        except NoRoute as error:
            if self.SAYS:
                warn_once("no_route", f"policy={self.NAME}: {error}")
            # A team that rests would search the same again.
            self._due[e] = np.inf if departure is None else begin + RETRY
            return
        took = route.report.planning_time
        if departure is None:
            self.search_time[e, 0] = took
        else:
            self.search_time[e, 1] = max(self.search_time[e, 1], took)
        # Differences at the beginning of a route reach back to those before it.
        self._flown[e] = [*self._flown[e][-2:], (begin, route)]
        self.routes[e], self.begun[e] = route, begin
