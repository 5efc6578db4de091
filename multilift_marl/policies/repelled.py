"""A potential field by each drone's own senses, `policy=formation_repelled`: slots moved away from what is near.

Each drone moves its slot against the nearest points of obstacles that it observes beside it, within a distance and in
proportion to how much nearer they are. Numbers: most successes on training maps of `navigate_senses`
(`results/tune_rules.py`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.math3d import heading
from multilift_marl.policies.slot_offsets import offset_actions

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

OVER = 0.9  # sine of the elevation above which points are over the drone, as those are that are not there


class FormationRepelled:
    """Acts by `reference`.

    Args:
        vec: environments with `env.obstacle_sensing` map or local; what the drones observe is read at every `act`.

    Class attributes:
        DISTANCE: from a drone within which an obstacle moves its slot [m].
        GAIN: by which, over how much nearer it is [-].
        SWAY: share of that along the target's velocity which is left out [-].
    """

    INTERFACE: ClassVar[str] = "reference"
    DISTANCE: float = 1.3
    GAIN: float = 0.7
    SWAY: float = 0.0

    def __init__(self, vec: MultiliftVec):
        if not self.sees(vec):
            raise ConfigError(
                "policy=formation_repelled needs the nearest points of obstacles; set env.obstacle_sensing=local"
            )
        self._vec = vec

    @staticmethod
    def sees(vec: MultiliftVec) -> bool:
        """Return whether drones observe the nearest points of obstacles."""
        return vec.config.env.obstacle_sensing in ("map", "local")

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Do nothing: it remembers nothing."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 4) in [-1, 1] for the present state of the environments."""
        vec, goal, view = self._vec, self._vec.task.goal, self._vec.task.view
        e, n = vec.num_envs, vec.num_drones
        assert view.obstacle_readings is not None
        points = view.obstacle_readings.reshape(e, n, -1, 3)
        level = points[..., :2]
        far = np.maximum(np.linalg.norm(level, axis=-1), 1e-3)
        over = np.abs(points[..., 2]) > np.minimum(OVER * np.linalg.norm(points, axis=-1), self.DISTANCE)
        push = np.where(over, 0.0, self.GAIN * np.maximum(self.DISTANCE - far, 0.0))
        away = -(level / far[..., None] * push[..., None]).sum(axis=2)
        rotation = view.estimated.drone_rotation
        yaw = np.array([[heading(tuple(each.ravel())) for each in team] for team in rotation])
        c, s = np.cos(yaw), np.sin(yaw)
        world = np.stack([c * away[..., 0] - s * away[..., 1], s * away[..., 0] + c * away[..., 1]], axis=-1)
        speed = np.linalg.norm(goal.velocity[:, :2], axis=1)[:, None]
        way = np.where(speed > 1e-6, goal.velocity[:, :2] / np.maximum(speed, 1e-6), 0.0)[:, None]
        world -= self.SWAY * (world * way).sum(axis=-1, keepdims=True) * way
        beside = np.concatenate([world, np.zeros((e, n, 1))], axis=-1)
        return offset_actions(beside, goal, vec.config.control.max_offset)
