"""Obstacles of a configuration in numbers; walls become boxes, meshes their convex hulls."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians, sin

import mujoco
import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.rig.mesh import read_mesh
from multilift_marl.schema.scene import ObstacleConfig, SceneConfig

NONE, BOX, CYLINDER, SPHERE, HULL = range(5)
MAX_SPEED = 5.0  # [m/s]
_SIZES = {"box": 3, "wall": 3, "cylinder": 2, "sphere": 1, "mesh": 3}


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A convex body.

    Attributes:
        kind: BOX, CYLINDER, SPHERE or HULL.
        size: half edges of the box about it, in its own frame (3,) [m].
        position: of its middle, in the middle of its motion (3,) [m].
        rotation: its own frame to world (3, 3).
        travel: to both sides (3,) [m].
        period: [s].
        phase: [-].
        vertices: of a HULL, from its middle (V, 3) [m].
    """

    kind: int
    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    travel: np.ndarray
    period: float
    phase: float
    vertices: np.ndarray | None = None


@dataclass(frozen=True)
class Scenery:
    """The obstacles of a system.

    Attributes:
        obstacles: as configured.
        reserved: how many more a task may place.
    """

    obstacles: tuple[Obstacle, ...] = ()
    reserved: int = 0

    @property
    def count(self) -> int:
        """How many there may be."""
        return len(self.obstacles) + self.reserved


def resolve_scenery(config: SceneConfig) -> Scenery:
    """Return the obstacles of section `scene`; a ConfigError names the one that cannot be."""
    found = [part for i, each in enumerate(config.obstacles) for part in _resolve(each, f"scene.obstacles[{i}]")]
    return Scenery(tuple(found), config.reserved)


def _resolve(given: ObstacleConfig, key: str) -> list[Obstacle]:
    """Return the bodies of one obstacle."""
    needed = _SIZES[given.shape]
    speed = 2 * pi * float(np.linalg.norm(given.travel)) / given.period
    if speed > MAX_SPEED:
        raise ConfigError(
            f"{key} moves at up to {speed:.3g} m/s, and may at {MAX_SPEED:g}: faster ones pass through bodies between "
            "two steps; lengthen its period or shorten its travel"
        )
    if given.size is None and given.shape != "mesh":
        raise ConfigError(f"{key} has no size; give {needed} of them [m] for a {given.shape}")
    if given.size is not None and len(given.size) != needed:
        raise ConfigError(f"{key}.size has {len(given.size)} numbers, but a {given.shape} has {needed}")
    if given.gaps and given.shape != "wall":
        raise ConfigError(f"{key}.gaps are of walls, but its shape is {given.shape}; set shape: wall")
    if (given.mesh is None) == (given.shape == "mesh"):
        cure = "set its mesh to a file" if given.mesh is None else "set shape: mesh"
        raise ConfigError(f"{key} has shape {given.shape} and mesh {given.mesh}; {cure}")
    if given.shape == "wall":
        parts = _cut_wall(np.array(given.size, float), sorted(given.gaps), key)
        return [_make(given, BOX, half, middle) for half, middle in parts]
    if given.shape == "mesh":
        assert given.mesh is not None
        mesh = read_mesh(given.mesh, given.size, f"{key}.mesh")
        return [_make(given, HULL, mesh.edges / 2, np.zeros(3), find_hull(mesh.points - mesh.middle))]
    size = np.array(given.size, float)
    half = {"box": size, "cylinder": size[[0, 0, -1]], "sphere": size[[0, 0, 0]]}[given.shape] / 2
    return [_make(given, {"box": BOX, "cylinder": CYLINDER, "sphere": SPHERE}[given.shape], half, np.zeros(3))]


def _make(
    given: ObstacleConfig, kind: int, half: np.ndarray, middle: np.ndarray, vertices: np.ndarray | None = None
) -> Obstacle:
    """Return the body whose middle is `middle` (3,) from the obstacle's, in its own frame [m]."""
    rotation = rotation_matrix(*(radians(angle) for angle in given.rotation))
    return Obstacle(
        kind, half, np.array(given.position) + rotation @ middle, rotation, np.array(given.travel, float),
        given.period, given.phase, vertices,
    )  # fmt: skip


def rotation_matrix(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return Rz(yaw) Ry(pitch) Rx(roll) (3, 3); angles in rad."""
    about_x = np.array([[1, 0, 0], [0, cos(roll), -sin(roll)], [0, sin(roll), cos(roll)]])
    about_y = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    about_z = np.array([[cos(yaw), -sin(yaw), 0], [sin(yaw), cos(yaw), 0], [0, 0, 1]])
    product: np.ndarray = about_z @ about_y @ about_x
    return product


def _cut_wall(size: np.ndarray, gaps: list[tuple[float, ...]], key: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return half edges (3,) and middles (3,) from the wall's [m] of the boxes that gaps leave of a wall."""
    thick, width, height = size
    boxes = []

    def add(low: float, high: float, foot: float, top: float) -> None:
        if high - low > 1e-9 and top - foot > 1e-9:
            half = np.array([thick, high - low, top - foot]) / 2
            boxes.append((half, np.array([0.0, (low + high) / 2, (foot + top - height) / 2])))

    edge = -width / 2
    for middle, opening, *span in gaps:
        low, high = middle - opening / 2, middle + opening / 2
        foot, top = span or (0.0, height)
        if low < edge - 1e-9 or high > width / 2 + 1e-9 or not 0 <= foot < top <= height + 1e-9:
            raise ConfigError(
                f"{key} has a gap at {middle:g} m that overlaps another or leaves the wall of {width:g} x "
                f"{height:g} m; move or narrow it"
            )
        add(edge, low, 0.0, height)
        add(low, high, 0.0, foot)
        add(low, high, top, height)
        edge = high
    add(edge, width / 2, 0.0, height)
    if not boxes:
        raise ConfigError(f"{key} has gaps that leave nothing of the wall; narrow one")
    return boxes


def find_hull(points: np.ndarray) -> np.ndarray:
    """Return the vertices (V, 3) of the convex hull of points, by MuJoCo's compiler."""
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="hull", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    mesh.uservert = points.ravel().tolist()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull")
    model = spec.compile()
    graph = model.mesh_graph[model.mesh_graphadr[0] :]
    count = int(graph[0])
    vertices = model.mesh_vert[graph[2 + count : 2 + 2 * count]]
    # the compiler moves a mesh to its principal axes; back to the file's
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    found: np.ndarray = vertices @ rotation.reshape(3, 3).T + model.mesh_pos[0]
    return found
