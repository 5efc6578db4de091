"""Closed surfaces of triangles: whether they are closed, and the integrals over what they enclose."""

from __future__ import annotations

from itertools import product

import numpy as np

_WELDS = (1e-6, 1e-5, 1e-4)  # of the body's size: vertices so near are one; exporters round, each in its own way
_HALF = [at for at in product((-1, 0, 1), repeat=3) if at > (0, 0, 0)]  # half of the 26 cells about one


def surface_fault(points: np.ndarray, faces: np.ndarray) -> str | None:
    """Return why a surface does not enclose a volume, None if it does.

    Each edge must be passed as often in one direction as in the other, where vertices near each other count as one: at
    the least of several distances at which the surface closes.

    Args:
        points: (V, 3).
        faces: triangles, their corners counter-clockwise as seen from outside (F, 3).
    """
    fault: str | None = "it is flat, so give it a thickness"
    size = float(np.ptp(points, axis=0).max())
    for share in _WELDS:
        corners = weld(points, share * size)[faces] if size > 0 else faces
        edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        edges = edges[edges[:, 0] != edges[:, 1]]
        if not len(edges):
            break
        # +1 for an edge passed from its lesser to its greater number, -1 the other way: a closed surface adds up to 0
        # at each.
        forward = np.where(edges[:, 0] < edges[:, 1], 1, -1)
        edge = np.unique(edges.min(axis=1) * len(points) + edges.max(axis=1), return_inverse=True)[1]
        if not np.bincount(edge, forward).any():
            return None
        odd = (np.bincount(edge) % 2).any()
        fault = (
            "it has holes, so close them"
            if odd
            else "neighbouring faces look to different sides, so turn the vertices of one round"
        )
    return fault


def weld(points: np.ndarray, distance: float) -> np.ndarray:
    """Return for each of the points (V, 3) a number (V,), the same for those that are joined.

    Points within `distance` of each other always are, on whichever side of a grid's line they lie; points farther apart
    than 3.5 of it are only if others between them are.
    """
    cells = np.floor((points - points.min(axis=0)) / distance).astype(np.int64) + 1
    # One number a cell, with a margin of one cell, so that neighbours across a border have numbers of their own.
    strides = np.cumprod([1, *(cells.max(axis=0)[:2] + 2)])
    occupied, cell = np.unique(cells @ strides, return_inverse=True)
    pairs = []
    for at in _HALF:
        place = np.searchsorted(occupied, occupied + strides @ at)
        place[place == len(occupied)] = 0
        here = np.flatnonzero(occupied[place] == occupied + strides @ at)
        pairs.append(np.stack([here, place[here]]))
    first, second = np.concatenate(pairs, axis=1)
    label = np.arange(len(occupied))
    while True:  # the least number spreads through what is connected
        least = label.copy()
        np.minimum.at(least, first, label[second])
        np.minimum.at(least, second, label[first])
        least = least[least]
        if (least == label).all():
            return label[cell.reshape(-1)]
        label = least


def integrate(points: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume [m³], centre of mass (3,) [m] and inertia about it of 1 kg (3, 3) [m²] within a closed surface.

    Each triangle spans a tetrahedron with a point, of positive volume if it faces away from it and else of negative
    volume; those outside cancel, so the sum is exact for any shape.
    """
    # MuJoCo's own integrals (`inertia="exact"`) keep vertices in single precision, so they are off by up to 1e-7, and
    # give numbers for an open surface in place of a refusal; they would spare these lines, not `surface_fault`.
    origin = points.mean(axis=0)
    corners = (points - origin)[faces]
    # Signed; corners counter-clockwise from outside make it positive for a convex body.
    volumes = np.linalg.det(corners) / 6
    volume = volumes.sum()
    if volume == 0:
        return 0.0, origin, np.eye(3)
    total = corners.sum(axis=1)
    center = (volumes[:, None] * total).sum(axis=0) / (4 * volume)
    # ∫ x xᵀ dV of a tetrahedron with a corner at the origin: V/20 (Σ c cᵀ + (Σ c)(Σ c)ᵀ)
    products = np.einsum("fki,fkj->fij", corners, corners) + np.einsum("fi,fj->fij", total, total)
    second = np.einsum("f,fij->ij", volumes, products) / (20 * volume) - np.outer(center, center)
    # J = tr(S) 1 - S, with S = ∫ x xᵀ over volume about the centre.
    return float(volume), origin + center, np.trace(second) * np.eye(3) - second
