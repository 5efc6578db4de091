"""Turn aside and file through, by each drone's own senses: `policy=formation_filed`, a rule for walls with a gap.

A drone that sees two obstacles takes the middle between their nearest points for a gap, and puts its set-point on a
line through it, drawn in sideways as far as the gap is narrow. One that sees a single obstacle ahead stops before it
and slides along it, first to the left, and back where its payload is far off the line from start to goal. Beside the
line a drone follows the payload, since another one may have seen more. Numbers: most successes on training maps of
`navigate_slots`, at margins of 0.34 and 0.05 m in place of its own (`results/tune_rules.py`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.math3d import heading
from multilift_marl.policies.repelled import OVER
from multilift_marl.policies.slot_offsets import offset_actions

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

AHEAD = 0.2  # [m] before the drone, beyond which a point is ahead
BESIDE = 0.6  # of the half formation: drawn in no further


class FormationFiled:
    """Acts by `reference`.

    Args:
        vec: environments of `navigate` with `env.obstacle_sensing` map or local; what drones observe is read at `act`.

    Class attributes:
        STOP: distance ahead of a drone that sees no way through within which it goes no further [m].
        SLIDE: by which it moves its slot sideways then [m].
        ROOM: between the drone's centre and either side of a gap [m].
        FOLLOW: share of the payload's distance beside the line that slots follow [-].
        TURN: distance of the payload beside the line at which it slides back [m].
    """

    INTERFACE: ClassVar[str] = "reference"
    STOP: float = 0.39
    SLIDE: float = 0.66
    ROOM: float = 0.18
    FOLLOW: float = 0.86
    TURN: float = 1.9

    def __init__(self, vec: MultiliftVec):
        if not self.sees(vec):
            raise ConfigError(
                "policy=formation_filed is for task navigate and the nearest points of obstacles; set "
                "env.obstacle_sensing=local"
            )
        self._vec = vec
        self._side = np.ones((vec.num_envs, vec.num_drones))
        self._gap = np.full((vec.num_envs, vec.num_drones, 3), np.nan)

    @staticmethod
    def sees(vec: MultiliftVec) -> bool:
        """Return whether drones know the line to fly along and observe the nearest points of obstacles."""
        return vec.config.task == "navigate" and vec.config.env.obstacle_sensing in ("map", "local")

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget gaps and sides in the environments of the mask (E,) (None: all)."""
        chosen = slice(None) if mask is None else mask
        self._side[chosen], self._gap[chosen] = 1.0, np.nan

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 4) in [-1, 1] for the present state of the environments."""
        vec, task = self._vec, self._vec.task
        view, goal, own = task.view, task.goal, task.own
        e, n = vec.num_envs, vec.num_drones
        # 1. All along and beside the line from start to goal: from drones to points, drones, slots, payload.
        line = (own.goal - own.start)[:, :2]
        length = np.linalg.norm(line, axis=1, keepdims=True)
        line = np.where(length > 0, line, [1.0, 0.0]) / np.where(length > 0, length, 1.0)  # straight up: any line does
        axes = np.stack([line, np.stack([-line[:, 1], line[:, 0]], -1)], 1)  # (E, 2, 2)
        place = np.einsum("eij,enj->eni", axes, view.estimated.drone_position[..., :2] - own.start[:, None, :2])
        slots = np.einsum("eij,enj->eni", axes, goal.slots[..., :2] - own.start[:, None, :2])
        load = view.payload_estimate.position[..., :2] - own.start[:, None, :2]
        load = np.broadcast_to(np.einsum("eij,enj->eni", axes, load), place.shape)
        points, there = self._points(axes)
        # 2. Gaps between two that are seen are remembered until they are behind.
        pair = there.sum(-1) >= 2
        first, second = points[..., 0, :], points[..., min(1, points.shape[2] - 1), :]
        middle, half = place + (first + second) / 2, np.abs(first[..., 1] - second[..., 1]) / 2
        found = np.concatenate([middle, half[..., None]], -1)
        self._gap = np.where(pair[..., None], found, self._gap)
        passed = place[..., 0] > self._gap[..., 0] + 1.0
        self._gap[passed] = np.nan
        knows = ~np.isnan(self._gap[..., 0])
        # 3. Sides are changed far off the line.
        self._side = np.where(load[..., 1] > self.TURN, -1.0, np.where(load[..., 1] < -self.TURN, 1.0, self._side))
        # 4. Set-points: with the payload beside the line; on a line through the gap; along an obstacle.
        wanted = slots.copy()
        beside = slots - np.einsum("eij,ej->ei", axes, (goal.position - own.start)[:, :2])[:, None]
        moving = np.linalg.norm(goal.velocity, axis=1) > 1e-3
        wanted[..., 1] += np.where(moving[:, None], self.FOLLOW * (load[..., 1] + beside[..., 1] - slots[..., 1]), 0.0)
        width = np.maximum(np.abs(beside[..., 1]).max(axis=1, keepdims=True), 1e-6)  # 0 where all are on the line
        drawn = np.clip((self._gap[..., 2] - self.ROOM) / width, 1 - BESIDE, 1.0)
        wanted[..., 1] = np.where(knows, self._gap[..., 1] + drawn * beside[..., 1], wanted[..., 1])
        ahead = np.where(there, points[..., 0], np.inf)
        blocked = ~knows & ((ahead > AHEAD) & (ahead < self.STOP)).any(-1)
        wanted[..., 0] = np.where(blocked, np.minimum(wanted[..., 0], place[..., 0]), wanted[..., 0])
        wanted[..., 1] = np.where(blocked, place[..., 1] + self._side * self.SLIDE, wanted[..., 1])
        moved = np.einsum("eji,enj->eni", axes, wanted - slots)
        return offset_actions(np.concatenate([moved, np.zeros((e, n, 1))], -1), goal, vec.config.control.max_offset)

    def _points(self, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the observed points (E, N, k, 2) from the drones, along and beside the line, and which there are."""
        vec, view = self._vec, self._vec.task.view
        assert view.obstacle_readings is not None
        points = view.obstacle_readings.reshape(vec.num_envs, vec.num_drones, -1, 3)
        there = np.abs(points[..., 2]) < OVER * np.linalg.norm(points, axis=-1)
        rotation = view.estimated.drone_rotation
        yaw = np.array([[heading(tuple(each.ravel())) for each in team] for team in rotation])[..., None]
        c, s = np.cos(yaw), np.sin(yaw)
        level = np.stack([c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1]], -1)
        return np.einsum("eij,enkj->enki", axes, level), there
