"""Paths from files: read a table of times and positions, smooth it, check that the team can fly it."""

from __future__ import annotations

from math import ceil, isfinite, pi
from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError, warn_once
from multilift_marl.mdp.failures import least_height
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.feasibility import find_violation
from multilift_marl.planning.path_table import COLUMNS, KEY, SAMPLING, read_table
from multilift_marl.planning.spline import fit_spline, sample_spline
from multilift_marl.rig.system import System
from multilift_marl.schema.files import read_pinned
from multilift_marl.schema.sections import RandomizationConfig

MAX_ROWS = 20_000  # of a spline: seconds to fit
_MIN_ROWS = 4
_MIN_STEP = 1e-5  # [s] between rows
_MOST = 1e20  # of a number; nanoseconds since 1970 are 2e18
_FAST_TURN = 4.0  # [rad/s] of a target that turns by more than a turn: faster ones are likely in degrees
_SLOW = 0.02  # [m/s] that a path much longer than its episode must reach somewhere
_MIN_WEIGHT = 0.1  # [-] of gravity that the payload must still hang by when it is lowered, or cables go slack
_SAMPLES = 8  # of each piece of the spline, where it is checked


class PathFile(NamedTuple):
    """A file and how its path is read."""

    reference: str
    """Of the file, see `pin_file`."""
    spacing: float
    """Least time between the rows that the path passes through [s]."""
    ramp: float
    """In which the target gathers its speed, and loses it [s]; 0: as written."""
    offset: tuple[float, float, float]
    """Added to each position [m]."""


def load_path(
    file: PathFile, seconds: float, system: System, ranges: RandomizationConfig, key: str = KEY
) -> np.ndarray:
    """Return the spline (K, 13) of a file; see `thin_rows`, `ramp_rows` and `fit_spline`.

    Args:
        file: and how it is read.
        seconds: that an episode takes.
        system, ranges: the team that is to fly it and what its episodes draw.
        key: that the file was given by, for messages.

    Raises:
        ConfigError: no such file, not the table that is expected, or a path that the team cannot fly.
    """
    spacing, ramp = file.spacing, file.ramp
    rows, source = read_rows(file.reference, key), f"{key}={file.reference.partition('#')[0]}"
    rows[:, 1:4] += file.offset
    _check_times(source, rows, seconds)
    if (count := len(_keep_rows(rows[:, 0], spacing))) > MAX_ROWS:
        raise ConfigError(
            f"{source} has {count} rows, more than {MAX_ROWS}; raise task_options.file_spacing={spacing:g} s, "
            "or keep of the file what an episode flies"
        )
    thin = thin_rows(rows, spacing)
    if ramp > 0:
        if rows[-1, 0] < ramp:
            raise ConfigError(f"task_options.file_ramp={ramp:g} s is longer than the {rows[-1, 0]:g} s of {source}")
        thin = ramp_rows(thin, ramp)
    if (step := np.diff(thin[:, 0]).min()) < _MIN_STEP:
        raise ConfigError(
            f"{source} has rows {step:.2g} s apart, less than {_MIN_STEP:g} s; raise task_options.file_spacing"
        )
    table = fit_spline(thin)
    check_height(source, table, system, ", or lift it by task_options.file_offset")
    slower = "" if ramp else ", or give it task_options.file_ramp=2 to do so"
    check_thrust(source, table, system, ranges, slower)
    _warn_of_limits(source, table, system, ranges)
    warn_of_length(source, table, seconds)
    return table


def warn_of_length(source: str, table: np.ndarray, seconds: float) -> None:
    """Warn of a path that takes longer than an episode of `seconds`; `source` is its key, and a file's path."""
    if (lasts := table[-1, 0]) > seconds:
        warn_once(
            "tasks", f"{source} takes {lasts:.4g} s, but an episode ends after {seconds:g} s; set "
            f"env.episode_seconds={ceil(lasts)} to fly all of it",
        )  # fmt: skip


def _warn_of_limits(source: str, table: np.ndarray, system: System, ranges: RandomizationConfig) -> None:
    """Warn of a path on which a team that followed it without error would exceed its limits."""
    if violation := find_violation(table, system, ranges):
        warn_once("tasks", f"{source} leads the team beyond its limits: {violation}; make it slower or smoother")


def read_rows(reference: str, key: str = KEY) -> np.ndarray:
    """Return the rows t [s], x, y, z [m], yaw [rad] of a file (K, 5): t begins at 0, yaw is unwrapped.

    Args:
        reference: of the file, see `pin_file`.
        key: that it was given by, for messages.

    Raises:
        ConfigError: no such file, or not the table that is expected.
    """
    path, content = read_pinned(key, reference)
    source = f"{key}={path}"
    rows = read_table(source, content)
    if rows.ndim != 2 or rows.shape[1] not in (4, 5):
        shape = f"{rows.shape[1]} columns" if rows.ndim == 2 else f"an array of shape {rows.shape}"
        raise ConfigError(f"{source} holds {shape}; give 4 columns t, x, y, z or 5 with yaw")
    if len(rows) < _MIN_ROWS:
        raise ConfigError(f"{source} has {len(rows)} rows, too few for a smooth path; give {_MIN_ROWS} or more")
    rows = np.hstack([rows, np.zeros((len(rows), 5 - rows.shape[1]))])
    if not (np.abs(rows) < _MOST).all():
        row, column = np.argwhere(~(np.abs(rows) < _MOST))[0]
        raise ConfigError(f"{source} holds {rows[row, column]} as {COLUMNS[column]} in row {row + 1}; correct it")
    steps = np.diff(rows[:, 0])
    if steps.min() <= 0:
        row = int(np.argmax(steps <= 0))
        raise ConfigError(
            f"{source}: t does not increase from row {row + 1} ({rows[row, 0]:g} s) to row {row + 2} "
            f"({rows[row + 1, 0]:g} s); sort the rows by t and leave out repeated ones"
        )
    rows[:, 0] -= rows[0, 0]
    rows[:, 4] = _unwrap(source, rows[:, 0], rows[:, 4])
    return rows


def _unwrap(source: str, t: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return yaw (K,) [rad] without leaps of a turn; one that spans more than a turn has none and stays as it is.

    Raises:
        ConfigError: it is likely in degrees, or rows lie so far apart that it may turn either way between them.
    """
    span, steps = np.ptp(yaw), np.diff(yaw)
    leaps = np.abs(np.abs(steps) - 360) < 60
    fast = span > 2 * pi and np.abs(steps / np.diff(t)).max() > _FAST_TURN
    whole = span > 4 * pi and (yaw == np.round(yaw)).all()
    if leaps.any() or fast or whole:
        raise ConfigError(
            f"{source}: yaw goes from {yaw.min():g} to {yaw.max():g} rad within {t[-1]:g} s; if it is in degrees, "
            "name its column yaw_deg or convert it, else let it turn more slowly"
        )
    if span > 2 * pi + 0.01:
        return yaw
    unwrapped = np.unwrap(yaw)
    unclear = (np.abs(steps) > pi) & (np.abs(np.diff(unwrapped)) > pi / 2)
    if unclear.any():
        row = int(np.argmax(unclear))
        raise ConfigError(
            f"{source}: yaw may turn either way from row {row + 1} ({yaw[row]:g} rad) to row {row + 2} "
            f"({yaw[row + 1]:g} rad); put rows between them"
        )
    return unwrapped


def _check_times(source: str, rows: np.ndarray, seconds: float) -> None:
    """Refuse a path that hardly moves within an episode of `seconds`, because its times are no seconds."""
    steps, moves = np.diff(rows[:, 0]), np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1)
    fastest, lasts = float((moves / steps).max()), float(rows[-1, 0])
    if lasts <= 5 * seconds or fastest >= _SLOW or np.ptp(rows[:, 1:4], axis=0).max() < 0.05:
        return
    units = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    likely = next((unit for unit, factor in units.items() if fastest / factor > 2 * _SLOW), "ns")
    raise ConfigError(
        f"{source} takes {lasts:.4g} s and moves by at most {fastest:.2g} m/s, hardly within an episode of "
        f"{seconds:g} s; if t is in {likely}, name its column t_{likely} or convert it, else raise env.episode_seconds"
    )


def thin_rows(rows: np.ndarray, spacing: float) -> np.ndarray:
    """Return rows (K, 5) at least `spacing` [s] apart, each smoothed by the rows about it.

    A row that others surround is replaced by the cubic nearest to those within `spacing` before and after it, so that
    what was rounded or measured does not become jerk. The first row, the last and lone ones stay as they are.
    """
    t = rows[:, 0]
    kept = _keep_rows(t, spacing)
    thin = rows[kept]
    for k, i in enumerate(kept[1:-1], start=1):
        first, last = np.searchsorted(t, [t[i] - spacing * (1 + 1e-9), t[i] + spacing * (1 + 1e-9)])
        if last - first > _MIN_ROWS:
            thin[k, 1:] = np.polyfit(t[first:last] - t[i], rows[first:last, 1:], 3)[-1]
    return thin


def _keep_rows(times: np.ndarray, spacing: float) -> list[int]:
    """Return which of the times (K,) are at least `spacing` [s] apart, the first and the last among them."""
    t, kept = times.tolist(), [0]
    for i in range(1, len(t) - 1):
        if t[i] - t[kept[-1]] >= spacing * (1 - 1e-9) and t[-1] - t[i] >= spacing * (1 - 1e-9):
            kept.append(i)
    return [*kept, len(t) - 1]


def ramp_rows(rows: np.ndarray, ramp: float) -> np.ndarray:
    """Return rows (K, 5) of the same path, on which the target gathers its speed within `ramp` [s], and loses it so.

    Its own time runs slower than time at first and at last, smoothly to the third derivative; both take `ramp` in place
    of half of it. Between rows the path is a cubic, its slopes those of parabolas through three rows.
    """
    t, last = rows[:, 0], rows[-1, 0]
    slopes = np.gradient(rows[:, 1:], t, axis=0, edge_order=2)
    begin = np.linspace(0.0, ramp, max(_MIN_ROWS, round(ramp / SAMPLING)) + 1)
    s = begin / ramp
    own = ramp * s**5 * (7 - 14 * s + 10 * s**2 - 2.5 * s**3)  # as `paths.own_time`, of a ramp of 2 s
    inside = (t > ramp / 2 + SAMPLING / 2) & (t < last - ramp / 2 - SAMPLING / 2)
    middle = rows[inside] + [ramp / 2, 0, 0, 0, 0]
    first = np.column_stack([begin, _interpolate(rows, slopes, own)])
    end = np.column_stack([last + ramp - begin, _interpolate(rows, slopes, last - own)])[::-1]
    return np.concatenate([first, middle, end if end[0, 0] > first[-1, 0] + SAMPLING / 2 else end[1:]])


def _interpolate(rows: np.ndarray, slopes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return values (T, 4) at times (T,) [s], cubic between rows (K, 5) with slopes (K, 4)."""
    i = np.clip(np.searchsorted(rows[:, 0], at, side="right") - 1, 0, len(rows) - 2)
    h = (rows[i + 1, 0] - rows[i, 0])[:, None]
    u = (at - rows[i, 0])[:, None] / h
    gap = rows[i + 1, 1:] - rows[i, 1:]
    bend = u * (1 - u) * ((1 - u) * (h * slopes[i] - gap) - u * (h * slopes[i + 1] - gap))
    return rows[i, 1:] + u * gap + bend


def _sample_all(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times (T,) all along a spline, and what it is there (4, T, 4)."""
    shares = np.arange(_SAMPLES) / _SAMPLES
    t = np.append((table[:-1, :1] + np.diff(table[:, :1], axis=0) * shares).ravel(), table[-1, 0])
    return t, sample_spline(table, t)


def check_height(source: str, table: np.ndarray, system: System, cure: str = "") -> None:
    """Refuse a path on which the payload, level, would touch the ground; drones hang above it.

    Args:
        source: key of the path, and a file's path, for the message.
        table: (K, 13) spline of the path.
        system: that is to fly it.
        cure: what else can be done.
    """
    t, motion = _sample_all(table)
    lowest = int(np.argmin(motion[0, :, 2]))
    least = least_height(system)
    if motion[0, lowest, 2] < least:
        raise ConfigError(
            f"{source}: at {t[lowest]:.2f} s z is {motion[0, lowest, 2]:.3g} m and the payload would touch the "
            f"ground; z is up and in metres, keep it above {least:.3g} m{cure}"
        )


def check_thrust(source: str, table: np.ndarray, system: System, ranges: RandomizationConfig, cure: str = "") -> None:
    """Refuse a path that is too fast for the team, its heaviest payload and its weakest rotors included.

    What begins or ends in motion is given a `cure`; for the others see `check_height`.
    """
    t, (_, rate, bend, _) = _sample_all(table)
    if fault := find_overload(t, bend, rate[:, 3], system, ranges):
        raise ConfigError(
            f"{source} is too fast: {fault}; make the path slower or smoother (t in s, x, y, z in m, yaw in rad; it "
            f"begins and ends at rest{cure})"
        )


def find_overload(
    times: np.ndarray, bend: np.ndarray, yaw_rate: np.ndarray, system: System, ranges: RandomizationConfig
) -> str:
    """Return when and why a target is too fast for the team; nothing if it is not.

    A team that accelerates by a hangs as at rest, but in gravity g - a: hovering thrusts grow by |a + g e_z| / g.
    Drones of a formation that turns also accelerate about its middle.

    Args:
        times: (T,) [s].
        bend: (T, 4) accelerations of x, y, z [m/s²] and yaw [rad/s²].
        yaw_rate: (T,) [rad/s].
        system, ranges: the team, and what its episodes draw.
    """
    gravity = bend[:, :3] + [0.0, 0.0, GRAVITY]
    if gravity[:, 2].min() < _MIN_WEIGHT * GRAVITY:
        i = np.argmin(gravity[:, 2])
        return f"at {times[i]:.2f} s its target falls at {-bend[i, 2]:.3g} m/s² and the cables would go slack"
    own = (1 + ranges.vehicle_mass) * system.drone_mass
    hover = (1 + ranges.payload_mass) * system.hook_force + own[:, None] * [0.0, 0.0, GRAVITY]
    swing = np.hypot(yaw_rate**2, bend[:, 3])[:, None] * np.linalg.norm(system.slots[:, :2], axis=1)
    thrust = np.linalg.norm(gravity, axis=1)[:, None] / GRAVITY * np.linalg.norm(hover, axis=1) + own * swing
    most = 4 * np.array([vehicle.rotor_thrust_max for vehicle in system.vehicles])
    most = most * ranges.weakest_rotor
    i, n = np.unravel_index(np.argmax(thrust / most), thrust.shape)
    if isfinite(thrust[i, n]) and thrust[i, n] <= most[n]:
        return ""
    turns = f" and {bend[i, 3]:.3g} rad/s²" if bend[:, 3].any() else ""
    return (
        f"at {times[i]:.2f} s its target accelerates at {np.linalg.norm(bend[i, :3]):.3g} m/s²{turns}, for which drone "
        f"{n} would need {thrust[i, n]:.3g} N of its {most[n]:.3g} N"
    )
