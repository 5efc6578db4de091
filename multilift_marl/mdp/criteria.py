"""What a success needs, bound by bound, for reports that say why an episode was none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.mdp.env_data import Errors
from multilift_marl.mdp.rewards import RestBounds
from multilift_marl.schema.values import Float, Section
from multilift_marl.sim.state import SystemState

CONDITION = float("nan")  # bound of a criterion that is met or not: its excess is 1 or 0


class ArrivalOptions(Section):
    """What counts as success where a payload is carried to a goal."""

    success_distance: Float = Field(0.10, gt=0, description="[m] payload within this of the goal ...")
    success_angle: Float = Field(10.0, gt=0, description="[deg] ... and of its attitude, heading included ...")
    success_speed: Float = Field(0.1, gt=0, description="[m/s] ... no faster than this ...")
    success_body_rate: Float = Field(0.2, gt=0, description="[rad/s] ... and turning no faster than this ...")
    success_seconds: Float = Field(1.0, gt=0, description="[s] ... throughout the last seconds, and ...")
    success_tension: Float = Field(
        3.0, gt=1, description="[-] no cable's tension at any time, mean of a physics step, over its resting tension"
    )


class Criterion(NamedTuple):
    """One bound of the success of a task."""

    name: str
    """With its unit as suffix: _m, _deg, _s, _m_s, _rad_s, _n, or none for a ratio or a condition."""
    bound: float
    """In that unit, or `CONDITION`."""
    excess: Callable[[], np.ndarray]
    """Returns how far beyond the bound each environment is now (E,), at most 0 where it keeps to it."""
    throughout: bool = True
    """Whether it counts throughout `Task.success_windows`; otherwise at the end of the episode."""


def rest_criteria(
    bounds: Any, errors: Errors, state: SystemState, place: np.ndarray | None = None
) -> tuple[Criterion, ...]:
    """Return what `rewards.is_at_rest` asks for, its finite bounds; nothing where `bounds` are no RestBounds.

    With `place`, live (E, 3), the payload is to rest there [m], wherever its target is.
    """
    if not isinstance(bounds, RestBounds):
        return ()

    def distance() -> np.ndarray:
        return errors.distance if place is None else length(state.payload_position - place)

    found = (
        Criterion("distance_m", bounds.distance, lambda: distance() - bounds.distance),
        Criterion("angle_deg", float(np.rad2deg(bounds.angle)), lambda: np.rad2deg(errors.angle - bounds.angle)),
        Criterion("speed_m_s", bounds.speed, lambda: length(state.payload_velocity) - bounds.speed),
        Criterion("body_rate_rad_s", bounds.body_rate, lambda: length(state.payload_body_rates) - bounds.body_rate),
    )
    return tuple(each for each in found if np.isfinite(each.bound))


def tension_criterion(peak: np.ndarray, bound: float) -> Criterion:
    """Return the bound of an episode's largest tension over that at rest, the live array `peak` (E,)."""
    return Criterion("tension", bound, lambda: peak - bound, throughout=False)


def length(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors (E, 3)."""
    return np.asarray(np.sqrt((vectors**2).sum(axis=1)))


def says_criteria(task: type) -> bool:
    """Return whether a task's `criteria` are those of its `succeeded`, not of one that it has overridden."""
    return issubclass(_definer(task, "criteria"), _definer(task, "succeeded"))


def _definer(task: type, name: str) -> type:
    return next(each for each in task.__mro__ if name in vars(each))
