"""What the numbers of an action stand for: name, frame, unit and full scale, beside each interface that takes them."""

from __future__ import annotations

from typing import NamedTuple


class ActionComponent(NamedTuple):
    """One number of an action, in [-1, 1]."""

    name: str
    frame: str
    unit: str
    limit: str
    """Key of `control` with what 1 stands for, -1 for its opposite; THRUST where drones have limits of their own."""
    meaning: str


THRUST = ""
"""The limit of thrusts: -1 is the least that the rotors can, 0 the one at rest, 1 the largest."""


def vector_components(unit: str, limit: str, meaning: str) -> tuple[ActionComponent, ...]:
    """Return the three numbers of a vector in the slot frame; `meaning` says of what."""
    return tuple(
        ActionComponent(name, "slot", unit, limit, f"{meaning}, {where}")
        for name, where in (("outward", "away from the payload"), ("sideways", "to the left of that"), ("up", "upward"))
    )


def rate_components(
    *axes: str, limit: str = "max_tilt_rate", meaning: str = "angular velocity"
) -> tuple[ActionComponent, ...]:
    """Return a body rate for each of the axes, "roll", "pitch" or "yaw"."""
    where = {"roll": "about body x", "pitch": "about body y", "yaw": "about body z"}
    return tuple(ActionComponent(f"{axis}_rate", "body", "rad/s", limit, f"{meaning} {where[axis]}") for axis in axes)


YAW_RATE = ActionComponent("yaw_rate", "world", "rad/s", "max_yaw_rate", "change of the heading, about the vertical")
