"""The rig in numbers: payload and anchors of any team."""

from __future__ import annotations

from typing import Any

import numpy as np

from multilift_marl.errors import ConfigError, RigError
from multilift_marl.rig.mesh import Mesh, read_mesh
from multilift_marl.schema.sections import PayloadConfig, SystemConfig
from multilift_marl.schema.values import UNITS

MAX_ANCHOR_DISTANCE = 0.1  # [m] of an anchor from the payload's surface
REST_SEPARATION = 0.6  # [m] between falcons at rest, by which the standard rig is sized


def standard_length(config: SystemConfig, scale: float) -> float:
    """Return 1 m for a falcon's span, or more where a ring of drones about one point would be too narrow."""
    n, spread = config.env.num_drones, np.min(np.sin(np.deg2rad(config.cable.angle)))
    if config.payload.shape != "point" or n == 1 or spread == 0:
        return scale
    return scale * max(1.0, REST_SEPARATION / (2 * np.sin(np.pi / n) * spread))


def find_mesh(payload: PayloadConfig) -> Mesh | None:
    """Return the payload's mesh, or None for another shape; a ConfigError if the two do not go together."""
    if payload.shape == "mesh" and payload.mesh is not None:
        return read_mesh(payload.mesh, payload.size)
    if payload.shape == "mesh":
        raise ConfigError("payload.shape=mesh needs payload.mesh; give the path of an .obj or .stl file")
    for key in ("mesh", "origin"):
        if getattr(payload, key) not in (None, "center"):
            raise ConfigError(f"payload.{key} means nothing to a {payload.shape}; drop it or use payload.shape=mesh")
    return None


def find_origin(payload: PayloadConfig, mesh: Mesh | None) -> np.ndarray:
    """Return from where anchors and the centre of mass count (3,) [m], the geometric centre being zero."""
    return np.zeros(3) if mesh is None or payload.origin == "center" else mesh.middle


def place_anchors(
    config: SystemConfig, n: int, length: np.ndarray, scale: float, mesh: Mesh | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return anchors (n, 3) from the geometric centre and edges (3,) [m]: the configured or the standard ones.

    Args:
        config: payload and cables count.
        n: number of drones.
        length: of the cables (n,) [m].
        scale: of the vehicles, a falcon's being 1.
        mesh: of the payload, None for other shapes.

    Raises:
        ConfigError: another number of anchors than of drones, or what means nothing to a point.
    """
    payload = config.payload
    reach = np.min(length * np.sin(np.deg2rad(config.cable.angle)))
    ring = max(0.27 * scale, REST_SEPARATION * scale / (2 * np.sin(np.pi / n)) - reach) if n > 1 else 0.0
    if payload.anchor_radius is not None:
        if payload.anchors is not None or payload.shape == "point":
            raise ConfigError("payload.anchor_radius is for anchors on a ring; drop it, or payload.anchors")
        ring = payload.anchor_radius
    edge = 2 * max(ring, 0.15 * scale)
    rectangle = n == 4 and payload.shape != "cylinder" and payload.anchor_radius is None
    standard = np.array([0.55, 0.45, 0.15]) * scale if rectangle else np.array([edge, edge, 0.15 * scale])
    size = standard if payload.size is None else np.asarray(payload.size, float)
    size = size if mesh is None else mesh.edges
    inset = 0.005 * scale  # the cables are tied to rings this far inside the rim and above the lid
    lid, rim = size[2] / 2 + inset, size[:2] / 2 - inset
    if payload.anchors is not None:
        anchors = np.asarray(payload.anchors, float)
        if len(anchors) != n:
            raise ConfigError(f"payload.anchors lists {len(anchors)} anchors for env.num_drones={n}: give one for each")
        anchors = anchors - find_origin(payload, mesh)
    elif payload.shape == "point":
        anchors = np.zeros((n, 3))
    elif rectangle:
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        anchors = np.concatenate([corners * rim, np.full((4, 1), lid)], axis=1)
    else:
        widest = size[:2].min() / 2
        if payload.anchor_radius is not None and ring > widest:
            raise ConfigError(
                f"payload.anchor_radius={ring:g} lies outside a payload of {2 * widest:g} m; raise payload.size to "
                f"{2 * ring:g} or more"
            )
        azimuth, ring = 2 * np.pi * np.arange(n) / n, min(ring, widest)
        anchors = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.full(n, lid)], axis=1)
    if payload.shape == "point":
        for key in ("size", "inertia", "center_of_mass"):
            if getattr(payload, key) is not None:
                raise ConfigError(f"payload.{key} means nothing to a point; drop it or use payload.shape=box")
        size = np.full(3, 0.1 * scale)
        if np.any(anchors != 0):
            raise ConfigError(
                "payload.anchors of a point payload must all be [0, 0, 0]; use payload.shape=box for others"
            )
    return anchors, size


def uniform_inertia(shape: str, mass: float, size: np.ndarray) -> np.ndarray:
    """Return the principal moments (3,) of a uniform body [kg m²]."""
    if shape == "cylinder":
        # m (r²/4 + h²/12) and m r²/2, with the diameter 2 r for size[0].
        across = size[0] ** 2 / 16 + size[2] ** 2 / 12
        return mass * np.array([across, across, size[0] ** 2 / 8])
    return mass / 12 * np.array([size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2])


def check_body(shape: str, size: np.ndarray, center_of_mass: np.ndarray, anchors: np.ndarray) -> None:
    """Refuse bodies that cannot be, and anchors off the body.

    Args:
        shape: of the payload.
        size: its edges (3,) [m].
        center_of_mass, anchors: from the geometric centre (3,), (N, 3) [m].

    Raises:
        ConfigError: why not, and what to change.
    """
    if shape == "cylinder" and size[0] != size[1]:
        raise ConfigError(
            f"payload.size {size.tolist()} of a cylinder must give its diameter twice, then its height; "
            "make the first two equal"
        )
    if _outside(shape, size, center_of_mass[None])[0] > 1e-9:
        raise ConfigError(
            f"payload.center_of_mass {center_of_mass.tolist()} lies outside the payload of size {size.tolist()}; count "
            "it from the geometric centre, or with payload.origin=file from that of the mesh's file"
            + _unit_hint(shape, size, center_of_mass[None], 0)
        )
    outside = _outside(shape, size, anchors)
    if np.any(outside > MAX_ANCHOR_DISTANCE):
        i = int(np.argmax(outside))
        raise RigError(
            f"payload.anchors: anchor {i} is out of reach, {outside[i]:.2f} m outside the payload; move it onto the "
            f"payload{_unit_hint(shape, size, anchors, MAX_ANCHOR_DISTANCE)}",
            anchors=np.flatnonzero(outside > MAX_ANCHOR_DISTANCE),
        )


def _unit_hint(shape: str, size: np.ndarray, points: np.ndarray, most: float) -> str:
    """Return a hint at the unit in which points (N, 3) would lie within `most` [m] of the body, "" if in none."""
    inside = []
    if np.abs(points).max() < 5 * size.max():
        return ""
    for name, factor in UNITS["m"].items():
        meant = points * factor
        if (_outside(shape, size, meant) <= most).all():
            inside.append((abs(np.log(np.abs(meant).max() / size.max() * 3)), name))
    gap, name = min(inside, default=(np.inf, ""))
    return f", in m and not in {name}" if gap < np.log(5) else ""


def _outside(shape: str, size: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how far (N,) points (N, 3), counted from the geometric centre, lie outside the body [m]."""
    over = np.maximum(np.abs(points) - size / 2, 0)
    if shape == "cylinder":
        # Beyond the rim, as one distance in the place of two.
        over[:, 0] = np.maximum(np.hypot(points[:, 0], points[:, 1]) - size[0] / 2, 0)
        over[:, 1] = 0
    return np.linalg.norm(over, axis=1)


def mean(values: list[float]) -> float:
    """Return the mean, exact where all values are equal."""
    return values[0] + sum(value - values[0] for value in values) / len(values)


def vector_per_drone(value: tuple[Any, ...], n: int, key: str) -> np.ndarray:
    """Return one vector for each of n drones (n, 3); a ConfigError that names `key` if a list has another length."""
    vectors = np.asarray(value, float)
    if vectors.shape not in ((3,), (n, 3)):
        raise ConfigError(
            f"{key} lists {len(vectors)} vectors for env.num_drones={n}: give one vector or one for each drone"
        )
    return np.broadcast_to(vectors, (n, 3)).copy()


def per_drone(value: float | tuple[float, ...], n: int, key: str) -> np.ndarray:
    """Return one value for each of n drones (n,); a ConfigError that names `key` if a list has another length."""
    values = np.atleast_1d(np.asarray(value, float))
    if len(values) not in (1, n) or (isinstance(value, tuple) and len(values) != n):
        raise ConfigError(
            f"{key} lists {len(values)} values for env.num_drones={n}: give one value or one for each drone"
        )
    return np.broadcast_to(values, (n,)).copy()
