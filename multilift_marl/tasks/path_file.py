"""Paths from files: read a table of times and positions, smooth it, check that the team can fly it."""

from __future__ import annotations

import csv
import io
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from multilift_marl.config.files import read_pinned
from multilift_marl.config.schema import RandomizationConfig
from multilift_marl.errors import ConfigError
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.tasks.failures import TOUCH
from multilift_marl.tasks.spline import fit_spline, sample_spline

KEY = "task_options.file"
COLUMNS = ("t", "x", "y", "z", "yaw")
_MIN_ROWS = 4
_MIN_WEIGHT = 0.1  # [-] of gravity that the payload must still hang by when it is lowered, or cables go slack
_SAMPLES = 8  # of each piece of the spline, where it is checked


def load_path(reference: str, spacing: float, system: System, ranges: RandomizationConfig) -> np.ndarray:
    """Return the spline (K, 13) of a file; see `thin_rows` and `fit_spline`.

    Args:
        reference: of the file, see `pin_file`.
        spacing: least time between the rows that it passes through [s].
        system, ranges: the team that is to fly it and what its episodes draw.

    Raises:
        ConfigError: no such file, not the table that is expected, or a path that the team cannot fly.
    """
    table = fit_spline(thin_rows(read_rows(reference), spacing))
    name = reference.partition("#")[0]
    _check_height(name, table, system)
    _check_thrust(name, table, system, ranges)
    return table


def read_rows(reference: str) -> np.ndarray:
    """Return the rows t [s], x, y, z [m], yaw [rad] of a file (K, 5): t begins at 0, yaw is unwrapped.

    Raises:
        ConfigError: no such file, or not the table that is expected.
    """
    path, content = read_pinned(KEY, reference)
    readers = {".csv": _read_csv, ".npy": _read_array, ".npz": _read_arrays}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{KEY}={path} is no .csv, .npy or .npz file; save the path as one of these")
    rows = reader(path, content)
    if rows.ndim != 2 or rows.shape[1] not in (4, 5):
        shape = f"{rows.shape[1]} columns" if rows.ndim == 2 else f"an array of shape {rows.shape}"
        raise ConfigError(f"{KEY}={path} holds {shape}; give 4 columns t, x, y, z or 5 with yaw")
    if len(rows) < _MIN_ROWS:
        raise ConfigError(f"{KEY}={path} has {len(rows)} rows, too few for a smooth path; give {_MIN_ROWS} or more")
    rows = np.hstack([rows, np.zeros((len(rows), 5 - rows.shape[1]))])
    if not np.isfinite(rows).all():
        row, column = np.argwhere(~np.isfinite(rows))[0]
        raise ConfigError(f"{KEY}={path} holds {rows[row, column]} as {COLUMNS[column]} in row {row + 1}; correct it")
    steps = np.diff(rows[:, 0])
    if steps.min() <= 0:
        row = int(np.argmax(steps <= 0))
        raise ConfigError(
            f"{KEY}={path}: t does not increase from row {row + 1} ({rows[row, 0]:g} s) to row {row + 2} "
            f"({rows[row + 1, 0]:g} s); sort the rows by t and leave out repeated ones"
        )
    rows[:, 0] -= rows[0, 0]
    rows[:, 4] = np.unwrap(rows[:, 4])
    return rows


def _read_csv(path: Path, content: bytes) -> np.ndarray:
    """Return the rows of a CSV file, by the names in its first line where that holds names."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(f"{KEY}={path} is no text; save it as comma-separated values in UTF-8") from None
    lines = [[cell.strip() for cell in line] for line in csv.reader(io.StringIO(text)) if "".join(line).strip()]
    chosen: list[int] | None = None
    if lines and any(_number(cell) is None for cell in lines[0]):
        names = [cell.lstrip("# ").lower() for cell in lines.pop(0)]  # NumPy writes "# t,x,y,z"
        if missing := [name for name in COLUMNS[:4] if name not in names]:
            raise ConfigError(
                f"{KEY}={path} has no column {missing[0]} (its first line names {', '.join(names)}); name the columns "
                "t, x, y, z and, if it turns, yaw"
            )
        chosen = [names.index(name) for name in COLUMNS if name in names]
    rows = []
    for i, line in enumerate(lines, start=1):
        if len(line) != len(lines[0]) or (chosen and max(chosen) >= len(line)):
            raise ConfigError(f"{KEY}={path} has {len(line)} columns in row {i}, unlike the rows before; correct it")
        cells = [line[k] for k in chosen] if chosen else line
        values = [_number(cell) for cell in cells]
        if None in values:
            raise ConfigError(f"{KEY}={path} holds {cells[values.index(None)]!r} in row {i}; give a number")
        rows.append(values)
    return np.array(rows, float).reshape(len(rows), -1) if rows else np.zeros((0, 4))


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _read_array(path: Path, content: bytes) -> np.ndarray:
    array = _load(path, content)
    if not isinstance(array, np.ndarray):
        raise ConfigError(f"{KEY}={path} holds several arrays, as an .npz file does; name it so")
    return _real(path, array)


def _read_arrays(path: Path, content: bytes) -> np.ndarray:
    """Return the columns of an .npz file, its arrays t, x, y, z and yaw."""
    arrays = _load(path, content)
    if isinstance(arrays, np.ndarray):
        raise ConfigError(f"{KEY}={path} holds one array, as an .npy file does; name it so")
    names = [name for name in COLUMNS if name in arrays]
    if missing := [name for name in COLUMNS[:4] if name not in names]:
        raise ConfigError(f"{KEY}={path} has no array {missing[0]}; save arrays t, x, y, z and, if it turns, yaw")
    columns = [_real(path, arrays[name]) for name in names]
    if any(column.shape != columns[0].shape or column.ndim != 1 for column in columns):
        raise ConfigError(f"{KEY}={path} holds arrays of different shapes; give each one number for every time")
    return np.stack(columns, axis=1)


def _load(path: Path, content: bytes) -> Any:
    """Return the array of a file, or its arrays by name."""
    try:
        loaded = np.load(io.BytesIO(content), allow_pickle=False)
        return loaded if isinstance(loaded, np.ndarray) else {name: loaded[name] for name in loaded.files}
    except Exception:  # numpy, zipfile and zlib raise many kinds for damaged files
        raise ConfigError(f"{KEY}={path} is damaged or no array of numbers; save it by numpy.save again") from None


def _real(path: Path, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "iuf":
        raise ConfigError(f"{KEY}={path} holds {array.dtype} values; save an array of real numbers")
    return array.astype(float)


def thin_rows(rows: np.ndarray, spacing: float) -> np.ndarray:
    """Return rows (K, 5) at least `spacing` [s] apart, each smoothed by the rows about it.

    A row that others surround is replaced by the cubic nearest to those within `spacing` before and after it, so that
    what was rounded or measured does not become jerk. The first row, the last and lone ones stay as they are.
    """
    t, kept = rows[:, 0], [0]
    for i in range(1, len(rows) - 1):
        if t[i] - t[kept[-1]] >= spacing * (1 - 1e-9) and t[-1] - t[i] >= spacing * (1 - 1e-9):
            kept.append(i)
    kept.append(len(rows) - 1)
    thin = rows[kept]
    for k, i in enumerate(kept[1:-1], start=1):
        first, last = np.searchsorted(t, [t[i] - spacing * (1 + 1e-9), t[i] + spacing * (1 + 1e-9)])
        if last - first > _MIN_ROWS:
            thin[k, 1:] = np.polyfit(t[first:last] - t[i], rows[first:last, 1:], 3)[-1]
    return thin


def _sample_all(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times (T,) all along a spline, and what it is there (4, T, 4)."""
    shares = np.arange(_SAMPLES) / _SAMPLES
    t = np.append((table[:-1, :1] + np.diff(table[:, :1], axis=0) * shares).ravel(), table[-1, 0])
    return t, sample_spline(table, t)


def _check_height(name: str, table: np.ndarray, system: System) -> None:
    """Refuse a path on which the payload, level, would touch the ground; drones hang above it."""
    t, motion = _sample_all(table)
    lowest = int(np.argmin(motion[0, :, 2]))
    least = TOUCH + system.payload_size[2] / 2 - system.payload_center[2]
    if motion[0, lowest, 2] < least:
        raise ConfigError(
            f"{KEY}={name}: at {t[lowest]:.2f} s z is {motion[0, lowest, 2]:.3g} m and the payload would touch the "
            f"ground; z is up and in metres, keep it above {least:.3g} m"
        )


def _check_thrust(name: str, table: np.ndarray, system: System, ranges: RandomizationConfig) -> None:
    """Refuse a path that is too fast for the team, its heaviest payload and its weakest rotors included.

    A team that accelerates by a hangs as at rest, but in gravity g - a: hovering thrusts grow by |a + g e_z| / g.
    Drones of a formation that turns also accelerate about its middle.
    """
    t, (_, rate, bend, _) = _sample_all(table)
    gravity = bend[:, :3] + [0.0, 0.0, GRAVITY]
    if gravity[:, 2].min() < _MIN_WEIGHT * GRAVITY:
        i = np.argmin(gravity[:, 2])
        raise ConfigError(
            f"{KEY}={name} is too fast: at {t[i]:.2f} s its target falls at {-bend[i, 2]:.3g} m/s² and the cables "
            "would go slack; make the path slower or smoother (t in s, x, y, z in m; it begins and ends at rest)"
        )
    own = (1 + ranges.vehicle_mass) * system.drone_mass
    hover = (1 + ranges.payload_mass) * system.hook_force + own[:, None] * [0.0, 0.0, GRAVITY]
    swing = np.hypot(rate[:, 3] ** 2, bend[:, 3])[:, None] * np.linalg.norm(system.slots[:, :2], axis=1)
    thrust = np.linalg.norm(gravity, axis=1)[:, None] / GRAVITY * np.linalg.norm(hover, axis=1) + own * swing
    most = 4 * np.array([vehicle.rotor_thrust_max for vehicle in system.vehicles])
    most = most * (1 - ranges.vehicle_thrust_coefficient)
    i, n = np.unravel_index(np.argmax(thrust / most), thrust.shape)
    if not isfinite(thrust[i, n]) or thrust[i, n] > most[n]:
        raise ConfigError(
            f"{KEY}={name} is too fast: at {t[i]:.2f} s its target accelerates at {np.linalg.norm(bend[i, :3]):.3g} "
            f"m/s² and {bend[i, 3]:.3g} rad/s², for which drone {n} would need {thrust[i, n]:.3g} N of its "
            f"{most[n]:.3g} N; make the path slower or smoother (t in s, x, y, z in m, yaw in rad; it begins and ends "
            "at rest)"
        )
