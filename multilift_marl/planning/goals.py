"""Goals of planned teams: where the payload is to be over the horizon, as a pose, a sampled trajectory or a path."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import put
from multilift_marl.planning.paths import FILE, Path, place
from multilift_marl.planning.spline import NO_FILE, fit_spline, sample_spline


class Goal(NamedTuple):
    """The payload's motion, of one team for all or of each of E teams."""

    positions: np.ndarray
    """(1 or E, K + 1, 5, 3) at the times of `TeamExpert.times` [m]."""
    rotations: np.ndarray
    """(1 or E, K + 1, 5, 3, 3)."""


def pose_goal(times: np.ndarray, positions: np.ndarray, rotations: np.ndarray | None = None) -> Goal:
    """Return the goal of a pose at rest.

    Args:
        times: of a plan, `TeamExpert.times`.
        positions: (3,) or (E, 3) [m].
        rotations: (3, 3) or (E, 3, 3); None: level, heading along x.

    Raises:
        ConfigError: other shapes, numbers that are not finite, or matrices that are no rotations.
    """
    place = _checked("positions", positions, (3,))
    turn = _checked_rotations(rotations, len(place))
    place, turn = np.broadcast_arrays(place[:, None, None, :, None], turn[:, None, None])
    shape = len(place), *times.shape
    return Goal(np.array(np.broadcast_to(place[..., 0], (*shape, 3))), np.array(np.broadcast_to(turn, (*shape, 3, 3))))


def sampled_goal(
    times: np.ndarray, at: np.ndarray, positions: np.ndarray, rotations: np.ndarray | None = None, begin: float = 0.0
) -> Goal:
    """Return the goal of a trajectory that goes smoothly through samples and rests before and after them.

    Args:
        times: of a plan, `TeamExpert.times`.
        at: (T,) times of the samples, two or more, increasing [s].
        positions: (T, 3) or (E, T, 3) [m].
        rotations: (T, 3, 3) or (E, T, 3, 3); None: level, heading along x.
        begin: when the plan begins [s].

    Raises:
        ConfigError: other shapes, times that do not increase, numbers that are not finite, no rotations.
    """
    at = np.asarray(at, float)
    if at.ndim != 1 or len(at) < 2 or not np.isfinite(at).all() or not (np.diff(at) > 0).all():
        raise ConfigError("the times of a sampled goal are to be two or more that increase; correct `at`")
    place = _checked("positions", positions, (len(at), 3))
    turn = _checked_rotations(rotations, len(place), (len(at),))
    roll = np.arctan2(turn[..., 2, 1], turn[..., 2, 2])
    pitch = -np.arcsin(np.clip(turn[..., 2, 0], -1.0, 1.0))
    yaw = np.unwrap(np.arctan2(turn[..., 1, 0], turn[..., 0, 0]), axis=1)
    count, when = max(len(place), len(turn)), begin + times.ravel() - at[0]
    values = np.zeros((count, len(when), 6))
    for e in range(count):
        own = place[min(e, len(place) - 1)]
        angles = np.stack([each[min(e, len(turn) - 1)] for each in (roll, pitch, yaw)], axis=1)
        for i, part in enumerate((own, angles)):
            rows = np.column_stack([at - at[0], part, np.zeros(len(at))])
            values[e, :, 3 * i : 3 * i + 3] = sample_spline(fit_spline(rows), when)[0, :, :3]
    shape = count, *times.shape
    return Goal(values[..., :3].reshape(*shape, 3), _rotation(values[..., 3:]).reshape(*shape, 3, 3))


def path_goal(times: np.ndarray, path: Path, begin: float | np.ndarray = 0.0, table: np.ndarray = NO_FILE) -> Goal:
    """Return the goal of the paths of E teams, which the payload follows level and without turning.

    Args:
        times: of a plan, `TeamExpert.times`.
        path: of each team, see `paths.py`.
        begin: (E,) or one time at which plans begin, from the start of the path [s].
        table: spline of a file, for those of kind FILE.

    Raises:
        ConfigError: times that are not finite or of another number of teams; no file for paths of a file.
    """
    count = len(path.kind)
    begin = np.asarray(begin, float)
    if begin.shape not in ((), (count,)) or not np.isfinite(begin).all():
        raise ConfigError(
            f"the goal's `begin` has shape {begin.shape}; give one finite time, or one for each of {count} paths"
        )
    if (path.kind == FILE).any() and table is NO_FILE:
        raise ConfigError("a path of a file needs its spline; give `table`, see `spline.fit_spline`")
    positions = np.zeros((count, *times.shape, 3))
    _set_places(np.broadcast_to(begin, count).copy(), times, path, table, positions)
    return Goal(positions, np.array(np.broadcast_to(np.eye(3), (count, *times.shape, 3, 3))))


@kernel
def _set_places(begin, times, path, table, positions):
    for e in range(positions.shape[0]):
        for k in range(times.shape[0]):
            for i in range(times.shape[1]):
                put(positions[e, k, i], place(e, begin[e] + times[k, i], path, table))


def _checked(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array (1 or E, *shape) of finite numbers."""
    array = np.asarray(values, float)
    if array.shape == shape:
        array = array[None]
    if array.ndim != len(shape) + 1 or array.shape[1:] != shape or not len(array):
        raise ConfigError(
            f"the goal's {name} have shape {np.shape(values)}; give {shape}, or (E, {str(shape)[1:]} for E teams"
        )
    if not np.isfinite(array).all():
        raise ConfigError(f"the goal's {name} hold numbers that are not finite; correct them")
    return array


def _checked_rotations(rotations: np.ndarray | None, count: int, samples: tuple[int, ...] = ()) -> np.ndarray:
    """Return rotations (1 or E, *samples, 3, 3)."""
    if rotations is None:
        return np.broadcast_to(np.eye(3), (1, *samples, 3, 3))
    turn = _checked("rotations", rotations, (*samples, 3, 3))
    if len(turn) not in (1, count) and count != 1:
        raise ConfigError(f"the goal has {count} positions but {len(turn)} rotations; give as many, or one")
    square = turn @ np.swapaxes(turn, -1, -2)
    if not np.allclose(square, np.eye(3), atol=1e-6) or not (np.linalg.det(turn) > 0).all():
        raise ConfigError("the goal's rotations are no rotation matrices; give orthonormal ones of determinant 1")
    return turn


def _rotation(angles: np.ndarray) -> np.ndarray:
    """Return Rz(yaw) Ry(pitch) Rx(roll) of angles (..., 3) roll, pitch, yaw."""
    (sr, sp, sy), (cr, cp, cy) = np.moveaxis(np.sin(angles), -1, 0), np.moveaxis(np.cos(angles), -1, 0)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(each, axis=-1) for each in rows], axis=-2)
