"""How far apart drones rest: too close is refused, little more is warned of, each with the change that mends it."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, log10
from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError, RigError, warn_once
from multilift_marl.math3d import segment_distance
from multilift_marl.rig.system import System
from multilift_marl.schema.sections import RandomizationConfig, SystemConfig

MIN_SPARE = 1.1  # [-] distance of resting drones over the limit: at 1.05 baselines collide in up to 42 % of hovers
SAFE_SPARE = 1.15  # [-] below which is warned of
_FLATTEST = 79.0  # [deg] that a cable may be raised to
_LONGEST = 20.0  # [-] times that cables may be lengthened by
_TRIED = 40  # changes, from none to the largest, between which the smallest that is enough is searched for
_HALVINGS = 12

Build = Callable[[SystemConfig], System]
Check = Callable[[SystemConfig, System], None]


class Gap(NamedTuple):
    """The two drones that rest closest, measured by how close they may be."""

    drones: tuple[int, int]
    apart: float
    """[m]"""
    limit: float
    """[m] at which they count as having collided."""
    verb: str
    """"would", or "may" where only a draw of `randomization` brings them so close."""


def check_separation(config: SystemConfig, system: System, build: Build, check: Check) -> None:
    """Refuse drones that rest too close, nominally or by a draw of the payload's mass and of the cables.

    Args:
        config: of the system.
        system: which can fly otherwise.
        build: makes the system of a configuration.
        check: raises a ConfigError for a system that cannot fly for other reasons.

    Raises:
        RigError: which drones, how close, and the smallest angle or length of cables that keeps them apart.
    """
    if system.num_drones == 1:
        return
    ranges = config.randomization
    gap = find_gap(system, ranges, MIN_SPARE)
    if gap is not None:
        raise RigError(
            f"neighbouring {_describe(gap)}, closer than {MIN_SPARE:g} × the separation limit of {gap.limit:.2f} m; "
            f"{_cure(config, system, gap, MIN_SPARE, build, check)}",
            drones=gap.drones,
        )
    gap = find_gap(system, ranges, SAFE_SPARE)
    if gap is not None:
        warn_once(
            "rig",
            f"neighbouring {_describe(gap)}, which spares {100 * (gap.apart / gap.limit - 1):.0f} % of the separation "
            f"limit of {gap.limit:.2f} m, and below {100 * (SAFE_SPARE - 1):.0f} % teams collide more often; "
            f"{_cure(config, system, gap, SAFE_SPARE, build, check)}",
        )


def find_gap(system: System, ranges: RandomizationConfig, spare: float) -> Gap | None:
    """Return the two drones that rest closest, below `spare` [-] times the limit; None where all keep that.

    Cables are drawn one by one: a drone with its shortest may be beside one with its longest.
    """
    strain = np.linalg.norm(system.formation_force, axis=1) / (system.cable_stiffness * system.cable_length)
    cables = system.cable_ends - system.anchors

    def grown(mass: float, stiffness: float, length: float) -> np.ndarray:
        """Return by which share of a resting cable it is longer, under factors on mass, stiffness and length (N, 1)."""
        stretched: np.ndarray = length * (1 + strain * mass / (stiffness * length)) / (1 + strain) - 1
        return stretched[:, None]

    short = grown(1 - ranges.payload_mass, 1 + ranges.cable_stiffness, 1 - ranges.cable_length) * cables
    long = grown(1 + ranges.payload_mass, 1 - ranges.cable_stiffness, 1 + ranges.cable_length) * cables
    least = system.min_separation
    for verb in ("would", "may"):
        apart = np.linalg.norm(system.slots[:, None] - system.slots[None], axis=-1)
        if verb == "may" and (short != long).any():
            ends = list(zip(map(tuple, system.slots + short), map(tuple, system.slots + long), strict=True))
            apart = np.array([[segment_distance(*one, *other) for other in ends] for one in ends])
        apart += 1e9 * np.eye(system.num_drones)
        i, j = (int(k) for k in np.unravel_index(np.argmin(apart - spare * least), apart.shape))
        if apart[i, j] < spare * least[i, j]:
            return Gap((i, j), float(apart[i, j]), float(least[i, j]), verb)
    return None


def _describe(gap: Gap) -> str:
    return f"drones {gap.drones[0]} and {gap.drones[1]} {gap.verb} rest {gap.apart:.2f} m apart"


def _cure(config: SystemConfig, system: System, gap: Gap, spare: float, build: Build, check: Check) -> str:
    """Return what to change: the smallest angle and the smallest length of cables that is enough, where there are."""
    lower = "lower randomization.cable_length, " if gap.verb == "may" and config.randomization.cable_length else ""
    spread = "" if system.payload_shape == "point" else "spread payload.anchors"

    def keeps_apart(changed: SystemConfig) -> bool:
        try:
            return find_gap(build(changed), config.randomization, spare) is None
        except ConfigError:
            return False

    def flies(changed: SystemConfig) -> bool:
        try:
            check(changed, build(changed))
        except ConfigError:
            return False
        return keeps_apart(changed)

    raised = []
    for key, change in (("angle", _wider), ("length", _longer)):
        value = _smallest(lambda share: keeps_apart(_with(config, key, change(config, system, share))))  # noqa: B023
        if value is None:
            continue
        enough = _rounded_up(change(config, system, value))
        if flies(_with(config, key, enough)):
            raised.append(f"cable.{key} to {list(enough) if isinstance(enough, tuple) else enough}")
    if raised:
        return f"{lower}raise {' or '.join(raised)}{spread and f', or {spread}'}"
    return f"{lower}{spread and f'{spread} or '}raise cable.length or cable.angle"


def _smallest(enough: Callable[[float], bool]) -> float | None:
    """Return the smallest share in (0, 1] of the largest change that is enough; None if none is."""
    shares = np.linspace(0.0, 1.0, _TRIED + 1)
    first = next((k for k in range(1, _TRIED + 1) if enough(shares[k])), None)
    if first is None:
        return None
    low, high = float(shares[first - 1]), float(shares[first])
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _with(config: SystemConfig, key: str, value: float | tuple[float, ...]) -> SystemConfig:
    """Return a configuration with other cables."""
    return config.model_copy(update={"cable": config.cable.model_copy(update={key: value})})


def _wider(config: SystemConfig, system: System, share: float) -> float | tuple[float, ...]:
    """Return `cable.angle`, `share` of the way from what it is to the flattest [deg].

    The slopes of a list grow in proportion, which keeps the balance of cables that end at one height.
    """
    angle = config.cable.angle
    if not isinstance(angle, tuple):
        return angle + share * (_FLATTEST - angle)
    slope = np.tan(np.deg2rad(angle))
    most = np.tan(np.deg2rad(_FLATTEST)) / max(slope.max(), 1e-9)
    return tuple(np.rad2deg(np.arctan(slope * (1 + share * (most - 1)))).tolist())


def _longer(config: SystemConfig, system: System, share: float) -> float | tuple[float, ...]:
    """Return `cable.length`, longer by up to `_LONGEST` in even ratios [m]: one number where all are alike."""
    length = system.cable_length * _LONGEST**share
    return float(length[0]) if np.ptp(length) == 0 else tuple(length.tolist())


def _rounded_up(value: float | tuple[float, ...]) -> float | tuple[float, ...]:
    """Return numbers of at most three digits and not less, those of a list of five: they are to balance."""
    if isinstance(value, tuple):
        return tuple(_ceil(each, 5) for each in value)
    return _ceil(value, 3)


def _ceil(value: float, digits: int) -> float:
    step = 10.0 ** (ceil(log10(max(abs(value), 1e-9))) - digits)
    return float(f"{ceil(value / step) * step:.{digits + 2}g}")
