"""The formation along a route among obstacles, `policy=formation_route`: each drone's slot where the route has it.

Routes are those of `policy=mpc_route`; there is no model and no feedback beside the drones' own controllers. Where the
team is to be on its route follows from how far the target is: which of its commands belongs to which situation does
not depend on when the route was found, so that a network can learn them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.math3d import heading
from multilift_marl.navigation.planner import RouteSettings
from multilift_marl.planning.route import Route
from multilift_marl.policies.route_search import RouteSearch
from multilift_marl.policies.slot_offsets import offset_actions

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

CLEARANCE = 0.2  # [m] that routes keep where there is room
COMFORT = 0.4  # [m] of clearance beyond which more is worth nothing
STRAYED = 0.4  # [m] from the route behind its place, beyond which it is searched anew from where the team is
AFTER = 0.3  # [s] after the last search, at least
_NEXT = np.arange(0.0, 0.6, 0.01)  # [s] in which the next place on a route is sought ...
_LAST = np.arange(0.0, 1.0, 0.05)  # ... and behind it the payload


class RouteFormation(RouteSearch):
    """Acts by `reference`, on the routes of `RouteSearch`."""

    NAME: ClassVar[str] = "formation_route"
    INTERFACE: ClassVar[str] = "reference"
    INSIDE: ClassVar[float] = 0.3  # as there is no feedback
    AHEAD: ClassVar[float] = 0.0
    SAYS: ClassVar[bool] = False  # it searches from wherever it has been led to

    def __init__(self, vec: MultiliftVec):
        super().__init__(vec)
        self._lead = 2.0 / vec.config.control.reference_frequency  # commands go through a filter of two poles

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Begin anew in the environments of the mask (E,) (None: all)."""
        self.begin(mask)

    def metrics(self) -> dict[str, np.ndarray]:
        """See `RouteSearch.search_metrics`."""
        return self.search_metrics()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 4) in [-1, 1] for the present state of the environments."""
        for e in range(self._vec.num_envs):
            self._keep_place(e)
        self.update_routes()
        vec, goal, system = self._vec, self._task.goal, self._vec.world.system
        places, turned, forces = (each[:, 0] for each in self.follow(self._task.time[:, None]))
        cables = system.cable_length[:, None] * forces / np.linalg.norm(forces, axis=-1, keepdims=True)
        drones = places[:, None] + np.einsum("eij,enj->eni", turned, system.anchors + cables)
        beside = drones - goal.slots - self._lead * goal.velocity[:, None]
        return offset_actions(beside, goal, vec.config.control.max_offset)

    def make_route(self, e: int, start: np.ndarray, settings: RouteSettings, departure: np.ndarray | None) -> Route:
        """See `RouteSearch.make_route`."""
        return super().make_route(e, start, replace(settings, clearance=CLEARANCE, comfort=COMFORT), departure)

    def is_lost(self, e: int, time: float) -> bool:
        """See `RouteSearch.is_lost`: the payload is far from the route behind its place."""
        route = self.routes[e]
        if route is None or time < self.begun[e] + AFTER:
            return False
        behind = route.sample(time - self.begun[e] - _LAST)[0][:, :3]
        return bool(np.linalg.norm(behind - self._payload(e), axis=1).min() > STRAYED)

    def depart(self, e: int, route: Route, time: float) -> np.ndarray:
        """See `RouteSearch.depart`; from where the payload is if that is far from the route."""
        motion = super().depart(e, route, time)
        if self.is_lost(e, time):
            load = self._task.view.payload_estimate
            motion[0, :3], motion[1, :3] = self._payload(e), load.velocity[e].mean(axis=0)
            if not self._task.rig.is_point:
                turned = heading(tuple(load.rotation[e, 0].ravel()))
                motion[0, 3] += np.remainder(turned - motion[0, 3] + np.pi, 2 * np.pi) - np.pi
        return motion

    def _payload(self, e: int) -> np.ndarray:
        """Return where the payload is (3,) [m], as the drones know it."""
        place: np.ndarray = self._task.view.payload_estimate.position[e].mean(axis=0)
        return place

    def _keep_place(self, e: int) -> None:
        """Move the beginning of the route so that its place now is as far along the way as the target soon is."""
        route, time = self.routes[e], float(self._task.time[e])
        if route is None or self._new[e]:
            return
        own, goal = self._task.own, self._task.goal
        way = (own.goal[e] - own.start[e]) / np.linalg.norm(own.goal[e] - own.start[e])
        place = time - self._task.dt - self.begun[e]
        times = np.clip(place + _NEXT, 0.0, route.times[-1])
        reached = route.sample(times)[0][:, :3] @ way >= (goal.position[e] + self._lead * goal.velocity[e]) @ way
        place = times[int(np.argmax(reached))] if reached.any() else times[-1]
        self.begun[e] = time - place
        self._flown[e] = [(self.begun[e], route)]
