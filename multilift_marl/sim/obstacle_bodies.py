"""Obstacles in MuJoCo: geoms of the world that nothing moves, each environment with its own forms, sizes and places.

They are geoms of the world itself, which cost less than bodies of their own (`bench/obstacles.py`). What touches a
moving one meets its surface at rest, so that friction does not drag along.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.math3d import (
    add,
    mat,
    mat_to_quat,
    matmul,
    matrow,
    mul,
    norm,
    put,
    quat_to_mat,
    row,
    sub,
    tmul,
    vec,
)
from multilift_marl.rig.obstacles import BOX, CYLINDER, HULL, NONE, SPHERE
from multilift_marl.rig.system import System
from multilift_marl.sim.obstacles import Obstacles, move_obstacles

_GEOM = mujoco.mjtGeom
_GEOMS = {BOX: _GEOM.mjGEOM_BOX, CYLINDER: _GEOM.mjGEOM_CYLINDER, SPHERE: _GEOM.mjGEOM_SPHERE, HULL: _GEOM.mjGEOM_MESH}


def obstacle_names(system: System) -> list[str]:
    """Return the names of the obstacles' bodies and geoms."""
    return [f"obstacle_{m}" for m in range(system.scenery.count)]


def add_obstacles(spec: mujoco.MjSpec, system: System) -> None:
    """Add a geom for each obstacle that there may be, in the origin: `ShardObstacles.load` puts it where it is."""
    add_hulls(spec, system)
    fixed, hulls = system.scenery.obstacles, 0
    for m, name in enumerate(obstacle_names(system)):
        kind = fixed[m].kind if m < len(fixed) else BOX
        if kind == HULL:
            spec.worldbody.add_geom(name=name, type=_GEOM.mjGEOM_MESH, meshname=hull_name(hulls))
            hulls += 1
            continue
        size = fixed[m].size if m < len(fixed) else np.ones(3)
        spec.worldbody.add_geom(name=name, type=_GEOMS[kind], size=geom_size(kind, size))


def hull_name(number: int) -> str:
    """Return the name of a hull's mesh."""
    return f"hull_{number}"


def add_hulls(spec: mujoco.MjSpec, system: System) -> None:
    """Add the meshes of the obstacles that are hulls."""
    vertices = [each.vertices for each in system.scenery.obstacles if each.vertices is not None]
    for number, points in enumerate(vertices):
        mesh = spec.add_mesh(name=hull_name(number), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        mesh.uservert = points.ravel().tolist()


def geom_size(kind: int, half: np.ndarray) -> np.ndarray:
    """Return MuJoCo's `geom_size` (3,) of a box, cylinder or sphere with half edges (3,) of the box about it."""
    return np.array({BOX: half, CYLINDER: (half[0], half[2], 0.0), SPHERE: (half[0], 0.0, 0.0)}[kind], float)


class GeomPlaces(NamedTuple):
    """Places of the obstacles' geoms in the models of a shard's environments."""

    position: np.ndarray
    """(environments, geoms, 3) [m]."""
    quaternion: np.ndarray
    """(environments, geoms, 4)."""
    geom: np.ndarray
    """(M,) int64 number of each obstacle's."""
    own_position: np.ndarray
    """(M, 3) of the geom in the obstacle's frame [m]: the compiler moves meshes to their principal axes."""
    own_rotation: np.ndarray
    """(M, 3, 3) the geom's frame to the obstacle's."""
    first: int
    """The first environment."""
    timestep: float
    """[s]."""


class ShardObstacles:
    """The obstacles of a batch's environments, the first of which is number `first`.

    Args:
        batch: of the simulations.
        model: of all.
        first: environment.
        system: of all.
        obstacles: of all environments; live.

    Attributes:
        step: moves them on by a physics step, before MuJoCo takes it.
    """

    def __init__(self, batch: Batch, model: mujoco.MjModel, first: int, system: System, obstacles: Obstacles):
        self._batch, self._obstacles, self._fixed = batch, obstacles, len(system.scenery.obstacles)
        geoms = np.array([model.geom(name).id for name in obstacle_names(system)])
        turned = np.array([quat_to_mat(*quaternion) for quaternion in model.geom_quat[geoms]]).reshape(-1, 3, 3)
        position, quaternion = batch.expand("geom_pos"), batch.expand("geom_quat")
        own = model.geom_pos[geoms].copy(), turned
        self._places = GeomPlaces(position, quaternion, geoms, *own, first, system.timestep)
        batch.expand("geom_sameframe")[:, geoms] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        self.step: Callable[[], None] = bind(step_obstacles, self._places, obstacles)

    def load(self, mask: np.ndarray) -> None:
        """Give the simulations in the mask (environments,) the obstacles as they are at the clock's time."""
        self._write_forms(mask)
        for i in np.flatnonzero(mask).tolist():
            move_obstacles(self._places.first + i, self._obstacles)
            write_places(i, self._places, self._obstacles)

    def _write_forms(self, mask: np.ndarray) -> None:
        """Write kinds and sizes of the task's obstacles to the models."""
        geoms = self._places.geom[self._fixed :].tolist()
        if not geoms:
            return
        fields = ("geom_type", "geom_size", "geom_rbound", "geom_aabb")
        kinds, sizes, radii, boxes = (self._batch.expand(name) for name in fields)
        for i in np.flatnonzero(mask).tolist():
            for m, geom in enumerate(geoms, self._fixed):
                e = self._places.first + i
                kind, half = int(self._obstacles.kind[e, m]), self._obstacles.size[e, m]
                if kind != NONE:
                    kinds[i, geom], sizes[i, geom] = int(_GEOMS[kind]), geom_size(kind, half)
                    radii[i, geom], boxes[i, geom] = bounding_radius(kind, half), [0.0, 0.0, 0.0, *half]


@kernel
def step_obstacles(places, obstacles):
    """Move the obstacles of a shard's environments on by a physics step."""
    for i in range(places.position.shape[0]):
        e = places.first + i
        obstacles.clock[e] += places.timestep
        if move_obstacles(e, obstacles):
            write_places(i, places, obstacles)


@kernel
def write_places(i, places, obstacles):
    """Write places and attitudes of the obstacles into model i."""
    e = places.first + i
    for m in range(obstacles.kind.shape[1]):
        g = places.geom[m]
        frame = mat(obstacles.rotation, e, m)
        put(places.position[i, g], add(vec(obstacles.position, e, m), mul(frame, row(places.own_position, m))))
        quaternion = mat_to_quat(matmul(frame, matrow(places.own_rotation, m)))
        for k in range(4):
            places.quaternion[i, g, k] = quaternion[k]


def bounding_radius(kind: int, half: np.ndarray) -> float:
    """Return the radius of the sphere about an obstacle's middle that encloses it [m]."""
    if kind == SPHERE:
        return float(half[0])
    return float(np.hypot(half[0], half[2]) if kind == CYLINDER else np.linalg.norm(half))


@kernel
def box_distance(e, m, point, obstacles):
    """Return the distance of a point to the box about obstacle m [m], at most that to the obstacle; 0 inside."""
    offset = tmul(mat(obstacles.rotation, e, m), sub(point, vec(obstacles.position, e, m)))
    size = obstacles.size
    x = max(abs(offset[0]) - size[e, m, 0], 0.0)
    y = max(abs(offset[1]) - size[e, m, 1], 0.0)
    z = max(abs(offset[2]) - size[e, m, 2], 0.0)
    return norm((x, y, z))
