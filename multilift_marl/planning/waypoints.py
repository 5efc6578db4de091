"""Paths through way-points (`task_options.path=waypoints`): read, checked, timed, and joined by minimum snap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.mdp.failures import least_height
from multilift_marl.planning.feasibility import Margin, find_violation
from multilift_marl.planning.minimum_snap import allocate_times, fit_minimum_snap
from multilift_marl.planning.path_file import MAX_ROWS, check_height, check_thrust, warn_of_length
from multilift_marl.planning.path_table import SAMPLING, read_columns
from multilift_marl.planning.spline import sample_spline
from multilift_marl.rig.system import System
from multilift_marl.schema.files import read_pinned
from multilift_marl.schema.sections import RandomizationConfig

MAX_WAYPOINTS = 1000
_STEP = 0.05  # [s] between the rows of a table, quintics between which are the polynomials to well below 1 µm
_EXACT = 1e-6  # [m], [rad] by which way-points may be missed: round-off where times differ by orders of magnitude

Waypoints = str | tuple[tuple[float, ...], ...]
Range = tuple[float, float]


class Keys(NamedTuple):
    """By which way-points and their times are given, for messages."""

    waypoints: str = "task_options.waypoints"
    times: str = "task_options.waypoint_times"


OF_TASK = Keys()


class WaypointPath(NamedTuple):
    """Minimum-snap polynomials through way-points."""

    name: str
    """Of the way-points, for messages: their key, and a file's path."""
    times: np.ndarray
    """(K,) at which they are passed [s]."""
    table: np.ndarray
    """(T, 13) the polynomials as a spline, see `spline.fit_spline`."""
    timed: bool
    """Whether times were given, in place of speed and acceleration."""


def load_waypoints(
    waypoints: Waypoints, times: tuple[float, ...] | None, speed: Range, acceleration: Range, seconds: float,
    system: System, ranges: RandomizationConfig,
) -> np.ndarray:  # fmt: skip
    """Return the spline (T, 13) of a path that the team can fly.

    Args:
        waypoints, times, speed, acceleration: see `plan_waypoints`.
        seconds: that an episode takes.
        system, ranges: the team that is to fly it and what its episodes draw.

    Raises:
        ConfigError: see `plan_waypoints`; or the team cannot fly it, and what comes first.
    """
    path = plan_waypoints(waypoints, times, speed, acceleration, system)
    if violation := find_violation(path.table, system, ranges):
        raise ConfigError(describe_violation(path, violation))
    check_height(path.name, path.table, system)  # of teams that are not assessed, too
    check_thrust(path.name, path.table, system, ranges)
    warn_of_length(path.name, path.table, seconds)
    return path.table


def plan_waypoints(
    waypoints: Waypoints, times: tuple[float, ...] | None, speed: Range, acceleration: Range, system: System,
    keys: Keys = OF_TASK,
) -> WaypointPath:  # fmt: skip
    """Return the path from rest at the first way-point to rest at the last one.

    Args:
        waypoints: places x, y, z [m], each perhaps with a yaw [rad], which is turned to the short way; or the reference
            to a CSV file of columns x, y, z and, if it has them, yaw and t, see `pin_file`.
        times: at which they are passed [s], counted from the first; None: those of the file, else as short as speed and
            acceleration allow.
        speed, acceleration: largest ones of the payload and of its slots, a range of one value [m/s], [m/s²].
        system: of the team.
        keys: of way-points and times.

    Raises:
        ConfigError: no such file, or way-points or times that cannot be, and which.
    """
    name, values, written = _read(waypoints, keys.waypoints)
    given = written if times is None else np.array(times, float)
    _check_waypoints(name, values, system)
    if given is not None:
        _check_times(name, values, given, keys.times)
    values[:, 3] = np.unwrap(values[:, 3])
    timed = given is not None
    if given is None:
        _check_limits(name, speed, acceleration)
        given = allocate_times(values, system.slots[:, :2], speed[0], acceleration[0])
    passed = given - given[0]
    spline = fit_minimum_snap(passed, values)
    missed = np.abs(spline(passed) - values).max()
    if not missed < _EXACT:
        raise ConfigError(
            f"{name}: times between way-points differ so much that round-off would miss one by {missed:.2g}; give more "
            "even ones"
        )
    step = max(_STEP, 2 * passed[-1] / MAX_ROWS)
    pieces = [np.linspace(a, b, int((b - a) / step) + 2)[1:] for a, b in zip(passed[:-1], passed[1:], strict=True)]
    rows = np.concatenate([np.zeros(1), *pieces])
    table = np.hstack([rows[:, None], spline(rows), spline(rows, 1), spline(rows, 2)])
    return WaypointPath(name, passed, table, timed)


def describe_violation(path: WaypointPath, violation: Margin, prefix: str = "task_options.") -> str:
    """Return which limit is exceeded between which way-points, and what to change, as one sentence.

    Args:
        path, violation: what is wrong.
        prefix: of the keys speed and acceleration.
    """
    after = int(np.clip(np.searchsorted(path.times, violation.time), 1, len(path.times) - 1))
    cures = {"height": "place way-points higher", "distance": "turn more slowly, or take longer cables"}
    slower = "give it more time" if path.timed else f"lower {prefix}speed or {prefix}acceleration"
    cure = cures.get(violation.quantity, slower)
    return f"{path.name} cannot be flown: between way-points {after} and {after + 1}, {violation}; {cure}"


def sample_rows(table: np.ndarray) -> np.ndarray:
    """Return rows t, x, y, z, yaw (K, 5) of a spline as `path=file` reads them, `SAMPLING` or little more apart."""
    lasts = table[-1, 0]
    t = np.linspace(0.0, lasts, max(int(lasts / SAMPLING + 1e-9), 4) + 1)
    return np.column_stack([t, sample_spline(table, t)[0]])


def _read(waypoints: Waypoints, key: str) -> tuple[str, np.ndarray, np.ndarray | None]:
    """Return a name for messages, way-points (K, 4), and times (K,) [s] where a file has them."""
    if not isinstance(waypoints, str):
        rows = [(*place, 0.0) if len(place) == 3 else tuple(place) for place in waypoints]
        return key, np.array(rows, float).reshape(-1, 4), None
    path, content = read_pinned(key, waypoints)
    name = f"{key}={path}"
    if path.suffix.lower() != ".csv":
        raise ConfigError(f"{name} is no .csv file; give one, or a list of places")
    columns = read_columns(name, content, ("x", "y", "z"))
    yaw = columns.get("yaw", np.zeros(len(columns["x"])))
    return name, np.column_stack([columns["x"], columns["y"], columns["z"], yaw]), columns.get("t")


def _check_limits(name: str, speed: Range, acceleration: Range) -> None:
    """Refuse ranges of limits: the path is one for all episodes."""
    for key, (low, high) in (("speed", speed), ("acceleration", acceleration)):
        if low < high:
            raise ConfigError(
                f"{name}: the path is the same in all episodes, but task_options.{key} is a range; give one value, or "
                "each way-point its time"
            )


def _check_waypoints(name: str, values: np.ndarray, system: System) -> None:
    """Refuse way-points that cannot be."""
    if not 2 <= len(values) <= MAX_WAYPOINTS:
        raise ConfigError(f"{name} has {len(values)} way-points; give 2 to {MAX_WAYPOINTS}")
    if not np.isfinite(values).all() or np.abs(values).max() > 1e6:
        i = int(np.argmax(~(np.abs(values) <= 1e6).all(axis=1)))
        raise ConfigError(f"{name}: way-point {i + 1} is at {values[i, :3].tolist()} m; give finite places")
    lowest = least_height(system)
    if (low := values[:, 2] < lowest).any():
        i = int(np.argmax(low))
        raise ConfigError(
            f"{name}: at way-point {i + 1} z is {values[i, 2]:.3g} m and the payload would touch the ground; keep it "
            f"above {lowest:.3g} m"
        )
    if (same := (np.diff(values, axis=0) == 0).all(axis=1)).any():
        i = int(np.argmax(same))
        raise ConfigError(f"{name}: way-points {i + 1} and {i + 2} are equal; leave one of them out")


def _check_times(name: str, values: np.ndarray, times: np.ndarray, key: str) -> None:
    """Refuse times (K,) [s] of way-points (K, 4) that are not as many, or do not increase; `key` is theirs."""
    if len(times) != len(values):
        raise ConfigError(f"{key} has {len(times)} times for {len(values)} way-points; give each one")
    if not (rising := np.diff(times) > 0).all():
        i = int(np.argmin(rising))
        raise ConfigError(
            f"{name}: the times of way-points {i + 1} and {i + 2}, {times[i]:g} and {times[i + 1]:g} s, do not "
            "increase; correct them"
        )
