"""Bodies of any shape: triangles of a file, with the exact integrals over the volume that they enclose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.rig.mesh_file import read_triangles
from multilift_marl.rig.surface import integrate, surface_fault
from multilift_marl.schema.files import pin_file, read_pinned


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface, in the coordinates of its file [m] after scaling.

    Attributes:
        path: of the file.
        scale: factors of its coordinates (3,).
        points: vertices (V, 3) [m].
        faces: triangles of them, counter-clockwise as seen from outside (F, 3).
        volume: within [m³].
        middle: middle of its bounding box (3,) [m].
        edges: of its bounding box (3,) [m].
        center_of_mass: of a uniform filling (3,) [m].
        inertia: principal moments of a uniform filling of 1 kg about it (3,) [m²].
        axes: quaternion of the principal axes (4,).
    """

    path: str
    scale: np.ndarray
    points: np.ndarray
    faces: np.ndarray
    volume: float
    middle: np.ndarray
    edges: np.ndarray
    center_of_mass: np.ndarray
    inertia: np.ndarray
    axes: np.ndarray


def add_mesh(spec: mujoco.MjSpec, name: str, mesh: Mesh) -> None:
    """Add a mesh to a specification, of whose bodies it gives the shape, but no mass."""
    added = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    added.uservert, added.userface = mesh.points.ravel().tolist(), mesh.faces.ravel().tolist()


def read_mesh(reference: str, size: Sequence[float] | None = None, key: str = "payload.mesh") -> Mesh:
    """Return the mesh of a file, scaled to the bounding box `size` [m] (None: as it is, in metres).

    Args:
        reference: path of the file, or what `pin_file` made of it.
        size: edges (3,) [m].
        key: of the configuration, for messages.

    Raises:
        ConfigError: there is no such file, it is not the one that was pinned, or it holds no closed surface.
    """
    path, content = read_pinned(key, pin_file(reference))
    if path.suffix.lower() not in (".obj", ".stl"):
        raise ConfigError(f"{key}={path} is no .obj or .stl file; export the body as one of these")
    try:
        points, faces = read_triangles(path, content)
    except ValueError as error:
        raise ConfigError(f"cannot read {key}={path}: {error}") from None
    low, high = points.min(axis=0), points.max(axis=0)
    fault = "it is flat, so give it a thickness" if (high == low).any() else surface_fault(points, faces)
    scale = np.ones(3) if size is None or fault else np.asarray(size) / (high - low)
    points = points * scale
    volume, center_of_mass, inertia = integrate(points, faces)
    if fault is None and volume <= 0:
        fault = "its faces look inwards, so turn their vertices round"
    if fault is not None:
        raise ConfigError(f"{key}={path} is no closed surface: {fault}")
    moments, rotation, axes = np.zeros(3), np.zeros(9), np.zeros(4)
    mujoco.mju_eig3(moments, rotation, axes, inertia.ravel())
    return Mesh(
        path=str(path),
        scale=scale,
        points=points,
        faces=faces,
        volume=volume,
        middle=(low + high) / 2 * scale,
        edges=(high - low) * scale,
        center_of_mass=center_of_mass,
        inertia=moments,
        axes=axes,
    )
