"""Targets that no team can follow, and those that come too late in an episode: refused, or warned of, by options."""

from __future__ import annotations

from math import ceil, pi, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multilift_marl.errors import ConfigError, warn_once
from multilift_marl.mdp.initial_states import check_target_height
from multilift_marl.planning.path_file import find_overload
from multilift_marl.planning.paths import RAMP, draw_curve, largest_rates
from multilift_marl.rig.system import System
from multilift_marl.schema.sections import RandomizationConfig

_LEAP = 0.5  # [m] a target may as well leap by less
_SHARES = np.linspace(0.0, 1.0, 101)  # of a motion's time, at which it is looked at
_RATE = 140 * (_SHARES * (1 - _SHARES)) ** 3  # of `math3d.ease` over its mean, ...
_BEND = 420 * (_SHARES * (1 - _SHARES)) ** 2 * (1 - 2 * _SHARES)  # ... and that rate's slope


def warn_of_time(what: str, end: float, seconds: float) -> None:
    """Warn where an episode of `seconds` ends before `end` [s]; `what` says of whom that is the time."""
    if end > seconds + 1e-9:
        warn_once(
            "tasks",
            f"{what} {end:.1f} s, but env.episode_seconds={seconds:g} ends before; raise it to {ceil(end + 0.5)}",
        )


def check_way(source: str, cure: str, way: ArrayLike, seconds: float, system: System) -> None:
    """Refuse, by a ConfigError, a target that is too fast for the nominal team.

    Args:
        source: keys of the target, and their values.
        cure: what is to be done with them.
        way: (3,) from rest to rest, see `math3d.ease` [m].
        seconds: that it takes.
        system: the team.
    """
    if np.linalg.norm(way) < _LEAP:
        return
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        bend = _BEND[:, None] * np.asarray(way) / np.square(seconds)
        _check_thrust(source, cure, seconds * _SHARES, bend, system)


def check_curve(source: str, cure: str, speed: float, acceleration: float, system: System) -> None:
    """Do as `check_way` for a level curve that is followed from rest, see `paths.own_time`.

    Args:
        source, cure: see `check_way`.
        speed, acceleration: the largest on it [m/s], [m/s²].
        system: the team.
    """
    # Its own time gathers its rate in RAMP: along the curve by the slope of that rate, across by its square.
    rate = np.cumsum(_RATE) / _RATE.sum()
    with np.errstate(over="ignore"):
        size = np.hypot(speed * _RATE / RAMP, acceleration * rate**2)
        _check_thrust(source, cure, RAMP * _SHARES, size[:, None] * [1.0, 0.0, 0.0], system)


def _check_thrust(source: str, cure: str, times: np.ndarray, bend: np.ndarray, system: System) -> None:
    """Refuse accelerations (T, 3) [m/s²]."""
    still = np.zeros(len(times))
    if fault := find_overload(times, np.column_stack([bend, still]), still, system, RandomizationConfig()):
        raise ConfigError(f"{source} is too fast: {fault}; {cure}")


def check_paths(option: Any, seconds: float, system: System) -> None:
    """Refuse, by a ConfigError, forms of a path (TrackOptions) that go too low or too fast in `seconds`.

    Those of a file and of way-points are checked where they are read.
    """
    speed, acceleration, radius, rate = (
        span[1] for span in (option.speed, option.acceleration, option.radius, option.rate)
    )
    limits = f"task_options.speed={speed:g} m/s and acceleration={acceleration:g} m/s²"
    for form in set(option.path) - {"file", "waypoints"}:
        check_target_height(f"task_options.height={option.height:g}", option.height, system)
        if form in ("circle", "helix"):
            climb = option.climb if form == "helix" else 0.0
            # As in `paths.place`: the height is the sine of a quarter of the angle, which `own_time` leaves RAMP / 2.
            phase = 0.25 * rate * max(seconds - RAMP / 2, 0.0)
            lowest = -1.0 if phase > 1.5 * pi else min(sin(phase), 0.0)
            low = f"task_options.climb={option.climb:g} from height={option.height:g}"
            check_target_height(low, option.height + climb * lowest, system)
            circle = f"task_options.rate={rate:g} rad/s with radius={radius:g} m"
            largest = np.hypot(radius, climb / 4) * rate, np.hypot(radius, climb / 16) * rate**2
            check_curve(circle, "lower one of them", *largest, system)
        elif form == "random":
            room = f"task_options.room={list(option.room)} about height={option.height:g}"
            check_target_height(room, option.height - option.room[2], system)
            # A curve like those of episodes: short of the acceleration where the speed is reached first, or the speed.
            fastest, hardest = largest_rates(draw_curve(np.random.default_rng(0), np.array(option.room)))
            pace = min(speed / fastest, sqrt(acceleration / hardest))
            check_curve(limits, "lower them", pace * fastest, pace**2 * hardest, system)
        else:
            check_curve(limits, "lower them", speed, acceleration, system)


def check_gaps(option: Any, reach: float, apart: float, system: System) -> None:
    """Refuse, by a ConfigError, gaps that a payload does not fit through, and a target too fast or low.

    Args:
        option: GateOptions.
        reach: the target moves from x = -reach to x = reach [m].
        apart: from the end of one gap to the begin of the next [m].
        system: the team.
    """
    check_target_height(f"task_options.height={option.height:g}", option.height, system)
    # A drone may pass on its edge.
    width = max(system.payload_size[:2].min(), *(2 * min(vehicle.half_size) for vehicle in system.vehicles))
    if (narrow := option.gap_width[0]) <= width:
        raise ConfigError(
            f"task_options.gap_width={narrow:g} m is too narrow for payload and drones; raise it above {width:.3g} m"
        )
    top = option.height + system.payload_center[2] + system.payload_size[2] / 2
    if option.gap_height <= top:
        raise ConfigError(
            f"task_options.gap_height={option.gap_height:g} m is no higher than the top of the payload at its target, "
            f"{top:.3g} m; raise it, or lower task_options.height"
        )
    duration = option.arrival - option.set_off
    times = f"task_options.arrival={option.arrival:g} s after set_off={option.set_off:g} s"
    check_way(times, "give it more time", (2 * reach, 0.0, 0.0), duration, system)
    # At its mean speed; it is faster in the middle, slower at both ends.
    aside = duration * apart / (2 * reach)
    check_way(
        f"task_options.gap_offset={option.gap_offset:g} m", "lower it", (0.0, option.gap_offset, 0.0), aside, system
    )
