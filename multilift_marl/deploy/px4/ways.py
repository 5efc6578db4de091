"""Ways between the places where a team rests: the payload on a straight line, its formation turned as a body."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.math3d import heading
from multilift_marl.planning.waypoints import plan_waypoints

SPEED, ACCELERATION = 1.0, 0.7  # [m/s], [m/s²] at most on the way to and from the task, of payload and outermost slot
HOLD = 2.0  # [s] at the end of a way
_NEAR = 0.01  # [m], [rad] within which there is no way to go


class Goal(NamedTuple):
    """Where a team is to be, N drones."""

    slots: np.ndarray
    """(N, 3) [m]."""
    cable_force: np.ndarray
    """(N, 3) [N]."""
    yaw: float
    """To which the drones face, beside their own headings [rad]."""
    pose: tuple[float, float, float, float]
    """Place [m] and heading [rad] of the payload."""


def read_goal(vec: MultiliftVec) -> Goal:
    """Return where environment 0 is to be."""
    goal = vec.task.planned  # where controllers are to hold the team: in `pose` that is not its target yet
    x, y, z = goal.position[0].tolist()
    pose = x, y, z, float(heading(tuple(goal.rotation[0].ravel())))
    return Goal(goal.slots[0].copy(), goal.cable_force[0].copy(), float(goal.drone_yaw[0]), pose)


def plan_way(config: Config, begin: Goal, end: Goal) -> tuple[float, dict[str, Any]] | None:
    """Return how long the way between two goals takes with a rest at its end [s], and its `task_options` of `track`.

    The payload goes on a straight line and turns the shorter way round, and the formation with it. None if it is there.
    """
    before, after = np.array(begin.pose), np.array(end.pose)
    after[3] = before[3] + wrapped(after[3] - before[3])
    if np.abs(after - before).max() < _NEAR:
        return None
    places = tuple(before.tolist()), tuple(after.tolist())
    path = plan_waypoints(places, None, (SPEED, SPEED), (ACCELERATION, ACCELERATION), config.system)
    options = {"path": "waypoints", "waypoints": places, "waypoint_times": path.times.tolist()}
    return float(path.times[-1]) + HOLD, options


def wrapped(angle: float) -> float:
    """Return an angle in [-π, π)."""
    return float(np.remainder(angle + np.pi, 2 * np.pi) - np.pi)
