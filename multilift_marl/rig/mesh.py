"""Payloads of any shape: MuJoCo reads the file, the mass properties are exact integrals over its closed surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from multilift_marl.errors import ConfigError, reason, shorten


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface, in the coordinates of its file [m] after scaling.

    Attributes:
        path: of the file.
        scale: factors of its coordinates (3,).
        middle: middle of its bounding box (3,) [m].
        edges: of its bounding box (3,) [m].
        center_of_mass: of a uniform filling (3,) [m].
        inertia: principal moments of a uniform filling of 1 kg about it (3,) [m²].
        axes: quaternion of the principal axes (4,).
    """

    path: str
    scale: np.ndarray
    middle: np.ndarray
    edges: np.ndarray
    center_of_mass: np.ndarray
    inertia: np.ndarray
    axes: np.ndarray


def add_mesh(spec: mujoco.MjSpec, name: str, path: str, scale: np.ndarray) -> None:
    """Add the file's mesh, its coordinates times `scale` (3,), to a specification."""
    spec.add_mesh(name=name, file=str(Path(path).resolve()), scale=list(scale))


def read_mesh(path: str, size: Sequence[float] | None = None) -> Mesh:
    """Return the mesh of a file, scaled to the bounding box `size` [m] (None: as it is, in metres).

    Raises:
        ConfigError: there is no such file, or it holds no closed surface.
    """
    if Path(path).suffix.lower() not in (".obj", ".stl"):
        raise ConfigError(f"payload.mesh={path!r} is no .obj or .stl file; give the path of one")
    try:
        missing = not Path(path).is_file()
    except OSError as error:  # a name too long, say
        raise ConfigError(f"cannot read payload.mesh={shorten(path)} ({reason(error)}); correct the path") from error
    if missing:
        raise ConfigError(f"payload.mesh={path!r} is missing, there is no {Path(path).absolute()}; correct the path")
    mesh = _measure(path, np.ones(3))
    return mesh if size is None else _measure(path, np.asarray(size) / mesh.edges)


def _measure(path: str, scale: np.ndarray) -> Mesh:
    points, faces = _load(path, scale)
    fault = _surface_fault(points, faces)
    volume, center_of_mass, inertia = _integrate(points, faces)
    if fault is None and volume <= 0:
        fault = "its faces look inwards, so turn their vertices round"
    if fault is not None:
        raise ConfigError(f"payload.mesh={path!r} is no closed surface: {fault}")
    moments, rotation, axes = np.zeros(3), np.zeros(9), np.zeros(4)
    mujoco.mju_eig3(moments, rotation, axes, inertia.ravel())
    low, high = points.min(axis=0), points.max(axis=0)
    return Mesh(
        path=str(path),
        scale=scale,
        middle=(low + high) / 2,
        edges=high - low,
        center_of_mass=center_of_mass,
        inertia=moments,
        axes=axes,
    )


def _load(path: str, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) [m] and triangles (F, 3) of a file as MuJoCo reads it, in the file's coordinates."""
    spec = mujoco.MjSpec()
    add_mesh(spec, "payload", path, scale)
    body = spec.worldbody.add_body()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="payload", density=1.0)
    try:
        model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        raise ConfigError(f"payload.mesh={path!r} cannot be a body ({reason}); give a closed surface") from None
    # MuJoCo moves a mesh into its principal frame, and says where that was.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    points = model.mesh_vert @ rotation.reshape(3, 3).T + model.mesh_pos[0]
    return points, np.asarray(model.mesh_face)


def _surface_fault(points: np.ndarray, faces: np.ndarray) -> str | None:
    """Return why a surface does not enclose a volume, None if it does.

    Each edge must be passed as often in one direction as in the other. Vertices count as one where they coincide to
    1e-5 of the body's size: the triangles of an .stl file have three of their own each.
    """
    size = np.ptp(points, axis=0).max()
    _, vertex = np.unique(np.round(points / (1e-5 * size)).astype(np.int64), axis=0, return_inverse=True)
    corners = vertex.reshape(-1)[faces]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    forward = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    balance = np.bincount(edge, forward)
    if not balance.any():
        return None
    if (np.bincount(edge) % 2).any():
        return "it has holes, so close them"
    return "neighbouring faces look to different sides, so turn the vertices of one round"


def _integrate(points: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume [m³], centre of mass (3,) [m] and inertia about it of 1 kg (3, 3) [m²] within a closed surface.

    Each triangle spans a tetrahedron with a point, of positive volume if it faces away from it and else of negative
    volume; those outside cancel, so the sum is exact for any shape.
    """
    origin = points.mean(axis=0)
    corners = (points - origin)[faces]
    volumes = np.linalg.det(corners) / 6
    volume = volumes.sum()
    if volume == 0:
        return 0.0, origin, np.eye(3)
    total = corners.sum(axis=1)
    center = (volumes[:, None] * total).sum(axis=0) / (4 * volume)
    # ∫ x xᵀ dV of a tetrahedron with a corner at the origin: V/20 (Σ c cᵀ + (Σ c)(Σ c)ᵀ)
    products = np.einsum("fki,fkj->fij", corners, corners) + np.einsum("fi,fj->fij", total, total)
    second = np.einsum("f,fij->ij", volumes, products) / (20 * volume) - np.outer(center, center)
    return float(volume), origin + center, np.trace(second) * np.eye(3) - second
