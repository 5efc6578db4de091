"""The parts of a flight: what was the least and the most in each, and what has failed of a team that rests."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.mdp.failures import MAX_TILT
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World


class Phase(NamedTuple):
    """Extremes of a part of the flight; without a step, or of one drone, the separation is infinite."""

    name: str
    seconds: float
    separation: float
    """[m] least distance of two drones."""
    tension: float
    """[N] largest of a cable."""
    tilt: float
    """[deg] largest of a drone."""

    def joined(self, state: SystemState, peak: float, seconds: float) -> Phase:
        """Return the phase with a further state, reached after `seconds` with a peak tension [N]."""
        places, up = state.drone_position[0], state.drone_rotation[0, :, 2, 2]
        apart = np.linalg.norm(places[:, None] - places, axis=-1)[~np.eye(len(places), dtype=bool)]
        tilt = float(np.degrees(np.arccos(np.clip(up.min(), -1.0, 1.0))))
        return Phase(
            self.name,
            self.seconds + seconds,
            min(self.separation, float(apart.min(initial=np.inf))),
            max(self.tension, peak, float(state.cable_tension[0].max())),
            max(self.tilt, tilt),
        )


def find_failure(world: World) -> str:
    """Return what has failed of a team that rests, "" if nothing has."""
    state, (n,) = world.state, world.state.drone_position.shape[1:2]
    apart = np.linalg.norm(state.drone_position[0, :, None] - state.drone_position[0], axis=-1)
    if (apart < world.system.min_separation)[~np.eye(n, dtype=bool)].any():
        return "drone_collision"
    if state.cable_broken[0].any():
        return "cable_broken"
    return "tilt" if state.drone_rotation[0, :, 2, 2].min() < np.cos(np.radians(MAX_TILT)) else ""
