"""Triangles from files: Wavefront .obj, and .stl in binary and in text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

MAX_FACES = 200_000  # seconds to load, whatever the shape
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
_HEADER = 84  # bytes before the facets of a binary .stl file
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_triangles(path: Path, content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (V, 3) that triangles have and the triangles (F, 3) of a file, in its own coordinates.

    Args:
        path: of the file, which ends in .obj or .stl.
        content: of the file.

    Raises:
        ValueError: it holds something else, or more than MAX_FACES; why, and the cure.
    """
    points, faces = _read_obj(content) if path.suffix.lower() == ".obj" else _read_stl(content)
    _check_count(len(faces))
    if not len(faces):
        raise ValueError("it holds no triangles; export the surface of the body again")
    if not np.isfinite(points).all() or np.abs(points).max() > 1e9:
        raise ValueError("it holds coordinates that are no finite numbers below 1e9; export it again")
    used, faces = np.unique(faces, return_inverse=True)
    return points[used], faces.reshape(-1, 3)


def _check_count(count: int) -> None:
    if count > MAX_FACES:
        raise ValueError(
            f"it has {count} triangles, more than {MAX_FACES}; reduce it in the program that made it, or in MeshLab"
        )


def _read_stl(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    count = int.from_bytes(content[80:_HEADER], "little") if len(content) >= _HEADER else 0
    facets = content[_HEADER:]
    # A binary file may begin with "solid" as well: the length that its count gives decides.
    binary = len(content) >= _HEADER and len(facets) == count * _FACET.itemsize
    if not binary and content.lstrip()[:5].lower() == b"solid":
        return _read_text_stl(content)
    if len(facets) < count * _FACET.itemsize or not count:
        raise ValueError(
            f"its header promises {count} triangles, but {len(facets) // _FACET.itemsize} follow; export it again"
        )
    _check_count(count)
    with np.errstate(invalid="ignore"):  # refused below
        corners = np.frombuffer(facets, _FACET, count)["corners"].astype(float)
    return _join(corners.reshape(-1, 3))


def _read_text_stl(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    _check_count(content.lower().count(b"endfacet"))
    corners = [match.groups() for match in _VERTEX.finditer(content)]
    if len(corners) % 3:
        raise ValueError(f"it has {len(corners)} vertices, not three for each triangle; export it again")
    return _join(_numbers(corners))


def _join(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of corners (3 F, 3), of which equal ones are one vertex."""
    points, faces = np.unique(corners, axis=0, return_inverse=True)
    return points, faces.reshape(-1, 3)


def _read_obj(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    _check_count(max(content.count(b"\nf ") + content.count(b"\nf\t"), content.count(b"\nv") // 9))  # vn, vt among them
    vertices: list[list[bytes]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(content.replace(b"\\\n", b" ").splitlines(), start=1):
        keyword, *words = line.split() or [b""]
        if keyword == b"v":
            if len(words) < 3:
                raise ValueError(f"a vertex in line {number} has {len(words)} coordinates; export it again")
            vertices.append(words[:3])
        elif keyword == b"f":
            faces.extend(_fan(words, len(vertices), number))
    return _numbers(vertices), np.array(faces, np.int64).reshape(-1, 3)


def _fan(words: list[bytes], known: int, line: int) -> Iterator[tuple[int, int, int]]:
    """Yield the triangles of a polygon, each of its words a vertex, "7/1/2" number 7 and "-1" the last one so far."""
    try:
        corners = [int(word.partition(b"/")[0]) for word in words]
    except ValueError:
        raise ValueError(f"a face in line {line} has corners that are no numbers; export it again") from None
    corners = [corner - 1 if corner > 0 else known + corner for corner in corners]
    if len(corners) < 3 or min(corners) < 0 or max(corners) >= known:
        raise ValueError(f"a face in line {line} is none of vertices above it; export it again")
    for second, third in zip(corners[1:], corners[2:], strict=False):
        yield corners[0], second, third


def _numbers(words: list[list[bytes]] | list[tuple[bytes, ...]]) -> np.ndarray:
    try:
        return np.array(words, "S").astype(float).reshape(-1, 3)
    except ValueError:
        raise ValueError("it holds coordinates that are no numbers; export it again") from None
