"""What each drone observes: tables of components, each with what computes it; the global state is global_state.py.

Vectors are given in the drone's slot frame (x outward from the target payload pose through the drone's slot, z up):
the same situation has the same numbers for every drone, and an action of the `reference` interface the same direction.

A new component of all tasks makes earlier policies unusable; one of a task's own goes into its `EXTRA`. What is no
field of `SystemState` must first be computed there, and measured in `sensing/measurement.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import cos, sin
from typing import Any, NamedTuple

from multilift_marl.control.action_interface import to_slot_body
from multilift_marl.control.actions import ACTIONS
from multilift_marl.kernels.jit import inlined, is_plain
from multilift_marl.math3d import add, column, heading, mat, matrow, mul, row, scale, sub, vec
from multilift_marl.mdp.env_data import load_row
from multilift_marl.schema.sections import EnvConfig

FRAMES = {
    "world": "z up",
    "target": "the world, turned about z to the heading atan2(-R01, R11) of the payload's target attitude R",
    "slot": "x horizontal, outward from the target payload position through the drone's slot, y to the left, z up",
    "payload": "of the payload itself",
    "heading": "level, x along the drone's heading, y to the left, z up",
    "body": "of the drone itself: x forward, y left, z along the thrust",
    "slot body": "the body's, turned about its z axis so that x points outward through the drone's slot",
}


class Component(NamedTuple):
    """One named part of an observation, or of the global state."""

    name: str
    size: int
    """How many numbers."""
    frame: str
    """A key of `FRAMES`, or "-"."""
    unit: str
    meaning: str
    value: Callable[..., Any]
    """Inlined kernel of (e, n, View) that returns a number or a tuple; n is 0 for what belongs to no drone. Or a NumPy
    function of (View) that returns an array (E, N, size), of the global state (E, size); of a vector to be turned, all
    three numbers. In the global state, `estimated` is the true state."""
    turned: bool | None = None
    """Whether `value` is a vector in the world frame, to be turned into `frame`; None: three numbers in a slot or
    target frame are."""
    field: str | None = None
    """Of `View`, (E, N, size), that is copied in place of a value."""

    @property
    def is_turned(self) -> bool:
        """Whether the value is turned from the world frame."""
        return self.turned if self.turned is not None else self.size == 3 and self.frame in ("slot", "target")

    @property
    def is_cut(self) -> bool:
        """Whether only the level part of a turned vector counts."""
        return self.is_turned and self.size == 2


@inlined
def slot_error(e, n, v):
    """Own position minus own slot."""
    return sub(vec(v.estimated.drone_position, e, n), vec(v.goal.slots, e, n))


@inlined
def target_velocity(e, n, v):
    """Velocity of the target."""
    return row(v.goal.velocity, e)


@inlined
def own_velocity(e, n, v):
    """Own velocity."""
    return vec(v.estimated.drone_velocity, e, n)


@inlined
def thrust_axis(e, n, v):
    """Own body z axis."""
    return column(mat(v.estimated.drone_rotation, e, n), 2)


@inlined
def relative_heading(e, n, v):
    """Cosine and sine of the own heading relative to the one at rest."""
    # Not wrapped to ± π: cosine and sine are the same a full turn on.
    yaw = heading(mat(v.estimated.drone_rotation, e, n)) - v.goal.yaw[e] - v.rig.heading[n]
    return cos(yaw), sin(yaw)


@inlined
def body_rates(e, n, v):
    """Own angular velocity."""
    return vec(v.estimated.drone_body_rates, e, n)


@inlined
def turned_rates(e, n, v):
    """Own angular velocity in the slot body frame."""
    yaw = heading(mat(v.estimated.drone_rotation, e, n))
    return to_slot_body(vec(v.estimated.drone_body_rates, e, n), yaw, v.goal.slot_frame[e, n])


@inlined
def tracking_error(e, n, v):
    """Own position minus own smoothed reference."""
    return sub(vec(v.estimated.drone_position, e, n), vec(v.reference.position, e, n))


@inlined
def reference_velocity(e, n, v):
    """Velocity of the own smoothed reference."""
    return vec(v.reference.velocity, e, n)


@inlined
def anchor_position(e, n, v):
    """Where the own cable is attached to the payload."""
    k = load_row(n, v)
    return add(
        vec(v.payload_estimate.position, e, k), mul(mat(v.payload_estimate.rotation, e, k), row(v.rig.anchors, n))
    )


@inlined
def anchor_error(e, n, v):
    """Own anchor minus its place at the target pose."""
    target = add(row(v.goal.position, e), mul(matrow(v.goal.rotation, e), row(v.rig.anchors, n)))
    return sub(anchor_position(e, n, v), target)


@inlined
def cable_vector(e, n, v):
    """From own anchor to own hook."""
    hook = mul(mat(v.estimated.drone_rotation, e, n), row(v.rig.hooks, n))
    return sub(add(vec(v.estimated.drone_position, e, n), hook), anchor_position(e, n, v))


@inlined
def cable(e, n, v):
    """From own anchor to own hook, over the cable's natural length."""
    return scale(1.0 / v.rig.cable_length[n], cable_vector(e, n, v))


@inlined
def payload_error(e, n, v):
    """Payload position minus target."""
    return vec(v.estimated_errors.position, e, load_row(n, v))


@inlined
def payload_velocity(e, n, v):
    """Payload velocity."""
    return vec(v.payload_estimate.velocity, e, load_row(n, v))


@inlined
def payload_rotation_error(e, n, v):
    """Rotation vector from target to payload attitude."""
    return vec(v.estimated_errors.rotation, e, load_row(n, v))


@inlined
def payload_angular_velocity(e, n, v):
    """Angular velocity of the payload."""
    # Body rates are in the payload's frame, but vectors leave here in the world frame, to be turned like all others.
    k = load_row(n, v)
    return mul(mat(v.payload_estimate.rotation, e, k), vec(v.payload_estimate.body_rates, e, k))


@inlined
def payload_error_integral(e, n, v):
    """Clipped integral of payload_error."""
    return vec(v.estimated_errors.position_integral, e, load_row(n, v))


@inlined
def rotation_error_integral(e, n, v):
    """Clipped integral of payload_rotation_error."""
    return vec(v.estimated_errors.rotation_integral, e, load_row(n, v))


@inlined
def slot_direction(e, n, v):
    """Cosine and sine of the own slot's azimuth."""
    return cos(v.rig.azimuth[n]), sin(v.rig.azimuth[n])


@inlined
def measured_tension(e, n, v):
    """Measured tension over that at rest, minus 1."""
    return v.payload_estimate.tension[e, n] / v.resting_tension[n] - 1.0


OBSERVATION = (
    Component("slot_error", 3, "slot", "m", "own position minus own slot about the target pose", slot_error),
    Component("velocity", 3, "slot", "m/s", "own velocity", own_velocity),
    Component("thrust_axis", 3, "slot", "-", "own body z axis", thrust_axis),
    Component(
        # Two numbers, so that a turn past 180° does not make an observation leap.
        "heading", 2, "target", "-", "cosine and sine of own heading relative to the one at rest", relative_heading
    ),
    Component("body_rates", 3, "body", "rad/s", "own angular velocity", body_rates),
    Component("tracking_error", 3, "slot", "m", "own position minus own smoothed reference", tracking_error),
    Component("reference_velocity", 3, "slot", "m/s", "velocity of own smoothed reference", reference_velocity),
    Component(
        "anchor_error", 3, "slot", "m", "own cable's attachment on the payload minus its place at the target pose",
        anchor_error,
    ),
    Component("cable", 3, "slot", "-", "from own attachment to own hook, over the cable's natural length", cable),
    Component("payload_error", 3, "slot", "m", "payload position minus target", payload_error),
    Component("payload_velocity", 3, "slot", "m/s", "payload velocity", payload_velocity),
    Component(
        "payload_rotation_error", 3, "slot", "rad", "rotation vector from target to payload attitude",
        payload_rotation_error,
    ),
    Component(
        "payload_angular_velocity", 3, "slot", "rad/s", "angular velocity of the payload", payload_angular_velocity
    ),
    Component("payload_error_integral", 3, "slot", "m s", "clipped integral of payload_error", payload_error_integral),
    Component(
        "rotation_error_integral", 3, "slot", "rad s", "clipped integral of payload_rotation_error",
        rotation_error_integral,
    ),
    Component("slot_direction", 2, "target", "-", "cosine and sine of the own slot's azimuth", slot_direction),
)  # fmt: skip

SENSED = {  # what levels of `env.sensing` add
    "onboard": (
        Component("measured_tension", 1, "-", "-", "measured tension over that at rest, minus 1", measured_tension),
    )
}

NO_OBSTACLE = 100.0
"""[m] Straight above: where the nearest point of obstacles is observed that are not there."""


def count_readings(env: EnvConfig) -> int:
    """Return how many numbers a drone observes of obstacles."""
    points, beams = 3 * env.obstacles.points, env.obstacles.beams
    return {"none": 0, "map": points, "local": points, "ranges": beams}[env.obstacle_sensing]


def sensed_components(env: EnvConfig) -> tuple[Component, ...]:
    """Return what the sensors of `env.sensing` and `env.obstacle_sensing` add to observations."""
    sensed = SENSED.get(env.sensing, ())
    if env.obstacle_sensing == "none":
        return sensed
    meanings = {"points": "to the nearest points of the nearest obstacles", "ranges": "lengths of beams to obstacles"}
    kind = "ranges" if env.obstacle_sensing == "ranges" else "points"
    # `own_velocity` only fills the place of a value.
    readings = Component(
        f"obstacle_{kind}", count_readings(env), "heading", "m", meanings[kind], own_velocity, False,
        "obstacle_readings",
    )  # fmt: skip
    return (*sensed, readings)


_TURNED = {  # what interfaces that are about body rates observe in place of others
    "body_rates": Component("turned_rates", 3, "slot body", "rad/s", "own angular velocity", turned_rates)
}

OBSERVATION_SIZE = sum(part.size for part in OBSERVATION)
"""Numbers of an observation before the own last action."""


def kernels_first(parts: Iterable[Component]) -> tuple[Component, ...]:
    """Return the components in their order, NumPy functions last: where kernels write does not depend on these."""
    # Sorting is stable: each of the two groups keeps its order, which policies depend on.
    return tuple(sorted(parts, key=lambda part: is_plain(part.value)))


def count_numbers(parts: Sequence[Component]) -> int:
    """Return how many numbers the components are."""
    return sum(part.size for part in parts)


def list_components(action: str, extra: tuple[Component, ...] = ()) -> tuple[Component, ...]:
    """Return what an observation holds of one step, in order; see `observation_names`."""
    interface = ACTIONS[action]
    common = (_TURNED.get(part.name, part) for part in OBSERVATION) if interface.by_rates else OBSERVATION
    return (*common, previous_action(len(interface.numbers)), *extra)


def previous_action(size: int) -> Component:
    """Return the component of the last action, which is copied rather than computed."""
    # `own_velocity` only fills the place of a value: kernels copy the action and never call it.
    return Component("previous_action", size, "-", "-", "own last action", own_velocity, False, "action")


def observation_names(action: str, extra: tuple[Component, ...] = (), ages: tuple[int, ...] = (0,)) -> tuple[str, ...]:
    """Return the name of every number in an observation, such as "velocity_1", or "velocity_1@-2" of two steps ago.

    Args:
        action: the action interface.
        extra: what a task adds.
        ages: how many steps ago each observation is that it holds.
    """
    names = [f"{part.name}_{i}" for part in list_components(action, extra) for i in range(part.size)]
    return tuple(name + (f"@-{step}" if step else "") for step in ages for name in names)
