"""Model-predictive control along a route among obstacles, `policy=mpc_route`: a search over pose and formation shape.

At the start of an episode a route is searched on the map (`navigation/planner.py`); the team's plans follow it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.policies.mpc import TeamMpc
from multilift_marl.policies.route_search import RouteSearch

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


class RouteMpc(RouteSearch, TeamMpc):
    """As `TeamMpc`, along the routes of `RouteSearch`.

    Class attributes:
        HINGE: of `planner.clearance` at most [m]: more would push teams off routes that lead closer to obstacles.
    """

    NAME: ClassVar[str] = "mpc_route"
    HINGE: ClassVar[float] = 0.06

    def __init__(self, vec: MultiliftVec):
        self.check(vec)
        if vec.config.planner.limits == "hard":
            raise ConfigError(f"policy={self.NAME} keeps clear of obstacles by soft limits; set planner.limits=soft")
        super(RouteSearch, self).__init__(vec, self.follow)  # of the planner
        RouteSearch.__init__(self, vec)
        around = self.planner.around
        points = around.points._replace(clearance=min(around.points.clearance, self.HINGE))
        self.planner.around = around._replace(obstacles=self.known, points=points)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """See `TeamMpc.reset`."""
        super().reset(mask)
        self.begin(mask)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """See `TeamMpc.act`."""
        self.update_routes()
        return super().act(observation)

    def metrics(self) -> dict[str, np.ndarray]:
        """Return those of `TeamMpc` and `search_metrics`."""
        return super().metrics() | self.search_metrics()
