"""What each drone observes, and the global state for a critic, common to all tasks.

Vectors are given in the drone's slot frame (x outward from the target payload pose through the drone's slot, z up):
in it the same situation looks the same to every drone, and an action of the `reference` interface points the same way.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, column, heading, mat, matrow, mul, row, scale, sub, turn, vec


class Component(NamedTuple):
    """One named part of an observation."""

    name: str
    size: int
    frame: str
    unit: str
    meaning: str


OBSERVATION = (
    Component("slot_error", 3, "slot", "m", "own position minus own slot about the target pose"),
    Component("velocity", 3, "slot", "m/s", "own velocity"),
    Component("thrust_axis", 3, "slot", "-", "own body z axis"),
    Component("heading", 2, "target", "-", "cosine and sine of own heading relative to the target's"),
    Component("body_rates", 3, "body", "rad/s", "own angular velocity"),
    Component("tracking_error", 3, "slot", "m", "own position minus own smoothed reference"),
    Component("reference_velocity", 3, "slot", "m/s", "velocity of own smoothed reference"),
    Component(
        "anchor_error", 3, "slot", "m", "own cable's attachment on the payload minus its place at the target pose"
    ),
    Component("cable", 3, "slot", "-", "from own attachment to own hook, over the cable's natural length"),
    Component("payload_error", 3, "slot", "m", "payload position minus target"),
    Component("payload_velocity", 3, "slot", "m/s", "payload velocity"),
    Component("payload_rotation_error", 3, "slot", "rad", "rotation vector from target to payload attitude"),
    Component("payload_angular_velocity", 3, "slot", "rad/s", "angular velocity of the payload"),
    Component("payload_error_integral", 3, "slot", "m s", "clipped integral of payload_error"),
    Component("rotation_error_integral", 3, "slot", "rad s", "clipped integral of payload_rotation_error"),
    Component("slot_direction", 2, "target", "-", "cosine and sine of the own slot's azimuth"),
    Component("previous_action", 4, "-", "-", "own last action"),  # as many as the action interface has
)
FRAMES = {
    "world": "z up",
    "target": "the world, turned about z to the heading atan2(-R01, R11) of the payload's target attitude R",
    "slot": "x horizontal, outward from the target payload position through the drone's slot, y to the left, z up",
    "body": "of the drone itself: x forward, y left, z along the thrust",
}
_STATE_SHARED = 26  # numbers of the global state that belong to no drone; see observe_team
_STATE_DRONE = 18  # numbers for each drone, beside its action


class DroneNumbers(NamedTuple):
    """Where the numbers of the drones stand in the global state: `rows` rows of `size` from `first` on."""

    first: int
    rows: int
    size: int


def drone_numbers(num_drones: int, action_size: int) -> DroneNumbers:
    """Return where the drones' numbers stand in the global state."""
    return DroneNumbers(_STATE_SHARED, num_drones, _STATE_DRONE + action_size)


def list_components(action_size: int, extra: tuple[Component, ...] = ()) -> tuple[Component, ...]:
    """Return what an observation holds of one step, in order; see `observation_names`."""
    return (*OBSERVATION[:-1], OBSERVATION[-1]._replace(size=action_size), *extra)


def observation_names(action_size: int, extra: tuple[Component, ...] = (), history: int = 1) -> tuple[str, ...]:
    """Return the name of every number in an observation, such as "velocity_1", or "velocity_1@-2" of two steps ago.

    Args:
        action_size: numbers of an action.
        extra: what a task adds.
        history: how many steps it holds, the newest first.
    """
    names = [f"{part.name}_{i}" for part in list_components(action_size, extra) for i in range(part.size)]
    return tuple(name + (f"@-{step}" if step else "") for step in range(history) for name in names)


@kernel
def remember(lo, hi, observation, told):
    """Put the newest observations (E, N, D) before those told earlier (E, N, H D) and drop the oldest."""
    size = observation.shape[2]
    for e in range(lo, hi):
        for n in range(observation.shape[1]):
            for k in range(told.shape[2] - 1, size - 1, -1):
                told[e, n, k] = told[e, n, k - size]
            for k in range(size):
                told[e, n, k] = observation[e, n, k]


def state_size(num_drones: int, action_size: int) -> int:
    """Return how many numbers the global state holds."""
    first, rows, size = drone_numbers(num_drones, action_size)
    return first + rows * size


@kernel
def _write(out, at, v):
    """Write a vector at position `at` and return the position after it."""
    out[at], out[at + 1], out[at + 2] = v
    return at + 3


@kernel
def observe_team(lo, hi, state, hidden_loads, goal, reference, errors, action, rig, nominal, observation, critic):
    """Write observations (E, N, D) and global states (E, S) of environments lo to hi.

    The global state holds, in the target's heading frame, the payload's errors, velocities and integrals, then what
    is hidden from the drones (payload mass over nominal minus 1, force, wind), then for each drone its slot error,
    velocity, thrust axis, body rates, tracking error, cable tension over nominal, cosine and sine of its azimuth, and
    previous action.

    Args:
        lo, hi: the environments.
        state, plant, goal, reference, errors: see their types.
        action: previous actions (E, N, A).
        rig: the nominal formation.
        nominal: cable length and tension (N, 2) and, in its last row, payload mass [m, N, kg].
        observation, critic: written.
    """
    for e in range(lo, hi):
        payload, attitude = row(state.payload_position, e), matrow(state.payload_rotation, e)
        target, target_attitude = row(goal.position, e), matrow(goal.rotation, e)
        spin = mul(attitude, row(state.payload_body_rates, e))
        payload_velocity = row(state.payload_velocity, e)
        count = action.shape[1]
        c, s = cos(goal.yaw[e]), -sin(goal.yaw[e])  # world to the target's heading frame
        out = critic[e]
        at = _write(out, 0, turn(c, s, row(errors.position, e)))
        at = _write(out, at, turn(c, s, payload_velocity))
        at = _write(out, at, turn(c, s, row(errors.rotation, e)))
        at = _write(out, at, turn(c, s, spin))
        at = _write(out, at, turn(c, s, row(errors.position_integral, e)))
        at = _write(out, at, turn(c, s, row(errors.rotation_integral, e)))
        at = _write(out, at, turn(c, s, row(hidden_loads.payload_force, e)))
        at = _write(out, at, turn(c, s, row(hidden_loads.wind, e)))
        out[at] = hidden_loads.payload_mass[e] / nominal[count, 0] - 1.0
        out[at + 1] = target[2]
        at += 2
        for n in range(count):
            cn, sn = goal.slot_frame[e, n, 0], -goal.slot_frame[e, n, 1]  # world to slot frame
            position, frame = vec(state.drone_position, e, n), mat(state.drone_rotation, e, n)
            slot = vec(goal.slots, e, n)
            slot_error, velocity = sub(position, slot), vec(state.drone_velocity, e, n)
            tracking_error = sub(position, vec(reference.position, e, n))
            rates = vec(state.drone_body_rates, e, n)
            anchor = (rig.anchors[n, 0], rig.anchors[n, 1], rig.anchors[n, 2])
            at_payload = add(payload, mul(attitude, anchor))
            anchor_error = sub(at_payload, add(target, mul(target_attitude, anchor)))
            cable = sub(add(position, mul(frame, row(rig.drones.hooks, n))), at_payload)
            own = observation[e, n]
            i = _write(own, 0, turn(cn, sn, slot_error))
            i = _write(own, i, turn(cn, sn, velocity))
            i = _write(own, i, turn(cn, sn, column(frame, 2)))
            yaw = heading(frame) - goal.yaw[e]
            own[i], own[i + 1] = cos(yaw), sin(yaw)
            i = _write(own, i + 2, rates)
            i = _write(own, i, turn(cn, sn, tracking_error))
            i = _write(own, i, turn(cn, sn, vec(reference.velocity, e, n)))
            i = _write(own, i, turn(cn, sn, anchor_error))
            i = _write(own, i, turn(cn, sn, scale(1.0 / nominal[n, 0], cable)))
            i = _write(own, i, turn(cn, sn, row(errors.position, e)))
            i = _write(own, i, turn(cn, sn, payload_velocity))
            i = _write(own, i, turn(cn, sn, row(errors.rotation, e)))
            i = _write(own, i, turn(cn, sn, spin))
            i = _write(own, i, turn(cn, sn, row(errors.position_integral, e)))
            i = _write(own, i, turn(cn, sn, row(errors.rotation_integral, e)))
            own[i], own[i + 1] = cos(rig.azimuth[n]), sin(rig.azimuth[n])
            i += 2
            at = _write(out, at, turn(c, s, slot_error))
            at = _write(out, at, turn(c, s, velocity))
            at = _write(out, at, turn(c, s, column(frame, 2)))
            at = _write(out, at, rates)
            at = _write(out, at, turn(c, s, tracking_error))
            out[at] = state.cable_tension[e, n] / nominal[n, 1] - 1.0
            out[at + 1], out[at + 2] = own[i - 2], own[i - 1]
            at += 3
            for k in range(action.shape[2]):
                own[i + k] = action[e, n, k]
                out[at + k] = action[e, n, k]
            at += action.shape[2]
