"""Obstacles among which teams fly: convex bodies, fixed or moving back and forth, each environment its own.

Row m of an environment is one obstacle; rows of kind NONE are free. A wall with gaps is several boxes, a mesh its
convex hull. Distances are in `obstacle_distance.py`, their bodies in MuJoCo's model in `obstacle_bodies.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, put, scale, vec
from multilift_marl.rig.obstacles import BOX as BOX
from multilift_marl.rig.obstacles import CYLINDER as CYLINDER
from multilift_marl.rig.obstacles import HULL as HULL
from multilift_marl.rig.obstacles import NONE as NONE
from multilift_marl.rig.obstacles import SPHERE as SPHERE
from multilift_marl.rig.obstacles import Scenery, find_hull
from multilift_marl.rig.system import System

HIDDEN = (0.0, 0.0, -100.0)  # [m] where free rows are


class Obstacles(NamedTuple):
    """M obstacles of E environments; live arrays."""

    kind: np.ndarray
    """(E, M) int64, NONE, BOX, CYLINDER (upright in its own frame), SPHERE or HULL."""
    size: np.ndarray
    """(E, M, 3) half edges of the box that encloses it in its own frame: of a cylinder radius twice and half height,
    of a sphere its radius thrice [m]."""
    rotation: np.ndarray
    """(E, M, 3, 3) its own frame to world; fixed."""
    position: np.ndarray
    """(E, M, 3) of its middle, now [m]."""
    velocity: np.ndarray
    """(E, M, 3) now [m/s]."""
    center: np.ndarray
    """(E, M, 3) about which it moves: position = center + travel · sin(2π (t/period + phase)) [m]."""
    travel: np.ndarray
    """(E, M, 3) zero of a fixed one [m]."""
    period: np.ndarray
    """(E, M) [s]."""
    phase: np.ndarray
    """(E, M) [-]."""
    clock: np.ndarray
    """(E,) t, since `World.load` [s]."""
    hull: np.ndarray
    """(E, M) int64, row of `vertices` of a HULL."""
    vertices: np.ndarray
    """(H, V, 3) of hulls from the middles of their boxes, in their own frames, see `make_hulls`; fixed [m]."""

    @classmethod
    def zeros(cls, num_envs: int, count: int) -> Obstacles:
        """Return M free rows."""
        shape = num_envs, count
        place = np.tile(np.array(HIDDEN), (*shape, 1))
        return cls(
            kind=np.zeros(shape, np.int64),
            size=np.ones((*shape, 3)),
            rotation=np.tile(np.eye(3), (*shape, 1, 1)),
            position=place,
            velocity=np.zeros((*shape, 3)),
            center=place.copy(),
            travel=np.zeros((*shape, 3)),
            period=np.ones(shape),
            phase=np.zeros(shape),
            clock=np.zeros(num_envs),
            hull=np.zeros(shape, np.int64),
            vertices=np.zeros((0, 1, 3)),
        )


def make_obstacles(system: System, num_envs: int) -> Obstacles:
    """Return the rows of E environments: those of the configuration, then free ones for the task."""
    scenery = system.scenery
    made = Obstacles.zeros(num_envs, scenery.count)._replace(vertices=make_hulls(system))
    hulls = 0
    for m, each in enumerate(scenery.obstacles):
        made.kind[:, m], made.size[:, m], made.rotation[:, m] = each.kind, each.size, each.rotation
        made.center[:, m], made.travel[:, m] = each.position, each.travel
        made.position[:, m] = each.position
        made.period[:, m], made.phase[:, m] = each.period, each.phase
        if each.kind == HULL:
            made.hull[:, m] = hulls
            hulls += 1
    for e in range(num_envs):
        move_obstacles(e, made)
    return made


def count_hulls(scenery: Scenery) -> int:
    """Return how many obstacles are hulls."""
    return sum(each.vertices is not None for each in scenery.obstacles)


def make_hulls(system: System) -> np.ndarray:
    """Return the vertices (H, V, 3) of the hulls, from their middles [m]; the last of a shorter list repeated.

    Where there may be obstacles, the last is that of a payload that is a mesh.
    """
    scenery, mesh = system.scenery, system.payload_mesh
    found = [each.vertices for each in scenery.obstacles if each.vertices is not None]
    if mesh is not None and scenery.count:
        found.append(find_hull(mesh.points - mesh.middle))
    longest = max((len(vertices) for vertices in found), default=1)
    hulls = np.zeros((len(found), longest, 3))
    for row, vertices in zip(hulls, found, strict=True):
        row[:] = vertices[-1]
        row[: len(vertices)] = vertices
    return hulls


@kernel
def move_obstacles(e, obstacles):
    """Write places and velocities of what moves in environment e at its clock's time; return whether anything does."""
    moving = False
    for m in range(obstacles.kind.shape[1]):
        travel = vec(obstacles.travel, e, m)
        if travel[0] == 0.0 and travel[1] == 0.0 and travel[2] == 0.0:
            continue
        moving = True
        rate = 2.0 * pi / obstacles.period[e, m]
        angle = rate * obstacles.clock[e] + 2.0 * pi * obstacles.phase[e, m]
        put(obstacles.position[e, m], add(vec(obstacles.center, e, m), scale(sin(angle), travel)))
        put(obstacles.velocity[e, m], scale(rate * cos(angle), travel))
    return moving


def restart_obstacles(env: int, obstacles: Obstacles) -> None:
    """Put the obstacles of one environment where they are when an episode starts."""
    obstacles.clock[env] = 0.0
    move_obstacles(env, obstacles)


def check_obstacles(saved: Mapping[str, np.ndarray], obstacles: Obstacles, scenery: Scenery) -> None:
    """Refuse a saved state, which fits otherwise, whose obstacles are others than configured or of no kind.

    Raises:
        ValueError: naming the key.
    """
    if not scenery.count:
        return
    fixed = len(scenery.obstacles)
    for name in ("kind", "size", "rotation", "hull", "center", "travel", "period", "phase"):
        key = f"obstacles.{name}"
        array, own = saved[key], getattr(obstacles, name)
        other = (array[:, :fixed] != own[:, :fixed]).any()
        if name in ("kind", "hull"):  # kernels index by these; hulls are of the configuration alone
            other |= (array[:, fixed:] < 0).any() or (array[:, fixed:] > (SPHERE if name == "kind" else 0)).any()
        if other:
            raise ValueError(
                f"the saved state does not fit these environments: '{key}' holds obstacles that are not theirs; give "
                "what state_dict() returned"
            )


def half_extents(kind: np.ndarray, size: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return half the extents along the world's axes (M, 3) [m] of obstacles, or of the boxes that enclose them.

    Args:
        kind, size, rotation: of M obstacles, see `Obstacles`.
    """
    return np.where(kind[:, None] == SPHERE, size, np.einsum("mij,mj->mi", np.abs(rotation), size))


def clear_obstacles(env: int, obstacles: Obstacles, first: int = 0) -> None:
    """Make the rows of one environment from `first` on free."""
    obstacles.kind[env, first:] = NONE
    obstacles.center[env, first:] = obstacles.position[env, first:] = HIDDEN
    obstacles.travel[env, first:] = obstacles.velocity[env, first:] = 0.0


def place_obstacle(
    env: int, row: int, obstacles: Obstacles, kind: int, size: tuple[float, float, float],
    position: tuple[float, float, float], yaw: float = 0.0,
) -> None:  # fmt: skip
    """Put a fixed box, cylinder or sphere into a row; sizes as in `Obstacles.size`, `yaw` [rad] turns it about z."""
    c, s = cos(yaw), sin(yaw)
    obstacles.kind[env, row] = kind
    obstacles.size[env, row] = size
    obstacles.rotation[env, row] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    obstacles.center[env, row] = obstacles.position[env, row] = position
    obstacles.travel[env, row] = obstacles.velocity[env, row] = 0.0
    obstacles.period[env, row], obstacles.phase[env, row], obstacles.hull[env, row] = 1.0, 0.0, 0
