"""Payloads of any shape: what MuJoCo says of a mesh filled with uniform matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from multilift_marl.errors import ConfigError


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
    if not Path(path).is_file():
        raise ConfigError(f"payload.mesh={path!r} is missing, there is no {Path(path).resolve()}; correct the path")
    mesh = _measure(path, np.ones(3))
    return mesh if size is None else _measure(path, np.asarray(size) / mesh.edges)


def _measure(path: str, scale: np.ndarray) -> Mesh:
    spec = mujoco.MjSpec()
    add_mesh(spec, "payload", path, scale)
    body = spec.worldbody.add_body()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="payload", density=1.0)
    try:
        model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        raise ConfigError(f"payload.mesh={path!r} cannot be a body ({reason}); give a closed surface") from None
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.mesh_quat[0])
    points = model.mesh_vert @ rotation.reshape(3, 3).T + model.mesh_pos[0]
    low, high = points.min(axis=0), points.max(axis=0)
    return Mesh(
        path=str(path),
        scale=scale,
        middle=(low + high) / 2,
        edges=high - low,
        center_of_mass=model.body_ipos[1].copy(),
        inertia=model.body_inertia[1] / model.body_mass[1],
        axes=model.body_iquat[1].copy(),
    )
