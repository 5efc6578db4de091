"""The payload's surface as triangles, and the obstacles' corners, for plots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from multilift_marl.rig.obstacles import BOX, CYLINDER, HULL
from multilift_marl.rig.system import System
from multilift_marl.tasks.scenery import Box

_SIDES = 48  # of what stands for a cylinder
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_BOX = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
"""Triangles of the corners, counter-clockwise as seen from outside."""


def payload_surface(system: System) -> np.ndarray:
    """Return the triangles (F, 3, 3) of the payload's surface from its centre of mass, in its frame [m].

    They are counter-clockwise as seen from outside; a point payload has none.
    """
    half, mesh = system.payload_size / 2, system.payload_mesh
    if system.payload_shape == "point":
        return np.zeros((0, 3, 3))
    if mesh is not None:
        return mesh.points[mesh.faces] - mesh.middle + system.payload_center
    if system.payload_shape == "cylinder":
        return _cylinder(half[0], half[2]) + system.payload_center
    return (half * _CORNERS)[_BOX] + system.payload_center


def obstacle_corners(boxes: Iterable[Box], hulls: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return of each obstacle points (V, 3) of its surface, world frame [m], whose convex hull is its outline.

    Args:
        boxes: what stands around, see `Task.scenery`.
        hulls: `Obstacles.vertices`.
    """
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros(_SIDES), np.ones(_SIDES)
    level, upright = np.column_stack([c, s, zero]), np.column_stack([c, zero, s])
    rings = np.vstack([level, upright, upright[:, [1, 0, 2]]])
    unit = {BOX: _CORNERS, CYLINDER: np.vstack([np.column_stack([c, s, -one]), np.column_stack([c, s, one])])}
    found = []
    for box in boxes:
        points = hulls[box.hull] if box.kind == HULL else unit.get(box.kind, rings) * box.size
        found.append(points @ np.reshape(box.rotation, (3, 3)).T + box.position)
    return tuple(found)


def find_outline(points: np.ndarray) -> np.ndarray:
    """Return the corners (K, 2) of the convex hull of points (V, 2), counter-clockwise (Andrew's monotone chain)."""
    rows = np.unique(points.round(9), axis=0).tolist()
    corners: list[list[float]] = []
    for side in (rows, rows[::-1]):
        chain: list[list[float]] = []
        for x, y in side:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], (x, y)) <= 0:
                chain.pop()
            chain.append([x, y])
        corners += chain[:-1]
    return np.array(corners or rows)


def _turn(a: Sequence[float], b: Sequence[float], c: Sequence[float]) -> float:
    """Return twice the area of the triangle a, b, c, positive if it is counter-clockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _cylinder(radius: float, half_height: float) -> np.ndarray:
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    low = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(_SIDES, -half_height)])
    high = low * [1, 1, -1]
    after_low, after_high = np.roll(low, -1, 0), np.roll(high, -1, 0)
    bottom, top = np.tile([0, 0, -half_height], (_SIDES, 1)), np.tile([0, 0, half_height], (_SIDES, 1))
    sides = [(low, after_low, after_high), (low, after_high, high), (bottom, after_low, low), (top, high, after_high)]
    return np.concatenate([np.stack(corners, axis=1) for corners in sides])
