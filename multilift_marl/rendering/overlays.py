"""What is drawn beside the bodies: trails, the path of the target, scenery; and the colours of cables."""

from __future__ import annotations

from collections import deque

import mujoco
import numpy as np

from multilift_marl.rig.obstacles import BOX, CYLINDER, HULL, SPHERE
from multilift_marl.sim.obstacle_bodies import geom_size, hull_name
from multilift_marl.tasks.scenery import Box

_GEOM = mujoco.mjtGeom
_FORMS = {BOX: _GEOM.mjGEOM_BOX, CYLINDER: _GEOM.mjGEOM_CYLINDER, SPHERE: _GEOM.mjGEOM_SPHERE}
_UPRIGHT = np.eye(3).ravel()
# sRGB of cables at 0, 1/4, ... 2 times the resting tension: light grey, blue, red, in perceptually equal steps (equal
# distances in OKLab; B. Ottosson, 2020). Grey, blue and red differ for every kind of colour blindness.
TENSION_COLOURS = np.array(
    [
        [0.66, 0.66, 0.66], [0.5133, 0.5873, 0.7225], [0.3667, 0.5071, 0.773], [0.2156, 0.415, 0.8148],
        [0.02, 0.3, 0.85], [0.3302, 0.3316, 0.69], [0.5033, 0.3208, 0.5263], [0.6561, 0.2628, 0.3473],
        [0.8, 0.08, 0.05],
    ]
)  # fmt: skip
_TRAIL_POINTS = 40  # of one trail
_MAX_DASHES = 300


def tension_colours(tension: np.ndarray, resting: np.ndarray) -> np.ndarray:
    """Return the colours (N, 3) of cables in [0, 1].

    Args:
        tension: (N,) [N].
        resting: tension of the resting team (N,) [N]; twice that and more is red.
    """
    ratio = np.clip(np.nan_to_num(tension / np.maximum(resting, 1e-9)), 0.0, 2.0)
    at = np.linspace(0.0, 2.0, len(TENSION_COLOURS))
    return np.stack([np.interp(ratio, at, channel) for channel in TENSION_COLOURS.T], axis=1)


def add_box(scene: mujoco.MjvScene, box: Box, model: mujoco.MjModel) -> None:
    """Add a box, cylinder, sphere or hull of a model; where the scene is full, nothing."""
    size, place = np.array(box.size, float), np.array(box.position, float)
    turned, rgba = np.array(box.rotation, float), np.array(box.rgba, np.float32)
    if box.kind != HULL:
        _add(scene, _FORMS[box.kind], geom_size(box.kind, size), place, rgba, turned)
        return
    mesh = model.mesh(hull_name(box.hull)).id
    # The compiler has moved the mesh to its principal axes: back.
    own = np.zeros(9)
    mujoco.mju_quat2Mat(own, model.mesh_quat[mesh])
    frame = turned.reshape(3, 3)
    geom = _add(
        scene, _GEOM.mjGEOM_MESH, np.ones(3), place + frame @ model.mesh_pos[mesh], rgba,
        (frame @ own.reshape(3, 3)).ravel(),
    )  # fmt: skip
    if geom is not None:
        geom.dataid = 2 * mesh  # the odd numbers are the hulls that MuJoCo computes


def add_lines(
    scene: mujoco.MjvScene, starts: np.ndarray, ends: np.ndarray, radius: float, rgba: np.ndarray, emission: float = 0.0
) -> None:
    """Add straight lines from `starts` (K, 3) to `ends` (K, 3) [m] with colours `rgba` (K, 4)."""
    for start, end, colour in zip(starts, ends, rgba, strict=True):
        geom = _add(scene, _GEOM.mjGEOM_CAPSULE, np.zeros(3), np.zeros(3), colour)
        if geom is not None:
            mujoco.mjv_connector(geom, _GEOM.mjGEOM_CAPSULE, radius, start, end)
            geom.emission = emission


def _add(
    scene: mujoco.MjvScene,
    kind: int,
    size: np.ndarray,
    position: np.ndarray,
    rgba: np.ndarray,
    rotation: np.ndarray = _UPRIGHT,
) -> mujoco.MjvGeom | None:
    """Add a geom that casts no shadow, and return it; None where the scene is full."""
    if scene.ngeom == scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, size, position, rotation, rgba)
    # mjv_initGeom leaves these unchanged
    geom.objtype = mujoco.mjtObj.mjOBJ_UNKNOWN
    geom.objid = -1
    geom.segid = -1
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    geom.castshadow = False
    scene.ngeom += 1
    return geom


def dashes(points: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and ends (K, 3) of dashes, each `length` [m] or more long, along a line through `points` (P, 3)."""
    run = np.append(0.0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum())
    count = int(min(run[-1] / (2 * length), _MAX_DASHES))
    at = np.linspace(0.0, run[-1], 2 * count + 1)
    line = np.stack([np.interp(at, run, points[:, axis]) for axis in range(3)], axis=1)
    return line[0:-1:2], line[1::2]


class Trail:
    """Where bodies were in the last seconds.

    Args:
        seconds: how long [s]; 0 for no trail.
    """

    def __init__(self, seconds: float):
        self.seconds = seconds
        self._past: deque[tuple[float, np.ndarray]] = deque()

    def clear(self) -> None:
        """Forget all."""
        self._past.clear()

    def add(self, time: float, bodies: np.ndarray) -> None:
        """Note where the bodies (B, 3) are at a time [s], later than all noted."""
        while self._past and self._past[0][0] < time - self.seconds:
            self._past.popleft()
        if not self._past or time - self._past[-1][0] >= self.seconds / _TRAIL_POINTS:
            self._past.append((time, bodies.copy()))

    def draw(self, scene: mujoco.MjvScene, time: float, bodies: np.ndarray, radius: float, rgba: np.ndarray) -> None:
        """Add the trails to `scene`, from now (`time` [s], `bodies` (B, 3)) fading into the past; `rgba` (B, 4)."""
        times = np.array([past[0] for past in self._past] + [time])
        places = np.stack([past[1] for past in self._past] + [bodies], axis=1)
        fresh = np.clip(1.0 - (time - times[:-1]) / max(self.seconds, 1e-9), 0.0, 1.0)
        for line, colour in zip(places, rgba, strict=True):
            faded = np.tile(colour, (len(fresh), 1))
            faded[:, 3] *= fresh
            add_lines(scene, line[:-1], line[1:], radius, faded)
