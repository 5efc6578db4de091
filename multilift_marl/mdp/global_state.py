"""The global state, for a critic: tables of components, what no drone observes among them.

Its values are true, whatever drones know. Vectors are given in the target's heading frame. Hidden parameters that the
configuration randomises are added (`HIDDEN`, `DRONE_HIDDEN`); drag, stiffness, and bias and delay of observations are
not, nor are actions that have yet to take effect.
"""

from __future__ import annotations

from collections.abc import Set
from typing import NamedTuple

from multilift_marl.kernels.jit import inlined
from multilift_marl.math3d import row, sub, vec
from multilift_marl.mdp.observations import (
    NO_OBSTACLE,
    Component,
    body_rates,
    count_numbers,
    kernels_first,
    own_velocity,
    payload_angular_velocity,
    payload_error,
    payload_error_integral,
    payload_rotation_error,
    payload_velocity,
    previous_action,
    rotation_error_integral,
    slot_direction,
    slot_error,
    thrust_axis,
    tracking_error,
)
from multilift_marl.sim.obstacle_distance import nearest_point


@inlined
def payload_force(e, n, v):
    """Hidden force on the payload."""
    return row(v.disturbances.payload_force, e)


@inlined
def wind(e, n, v):
    """Mean wind."""
    return row(v.disturbances.wind, e)


@inlined
def payload_mass(e, n, v):
    """Payload mass over the nominal one, minus 1."""
    return v.disturbances.payload_mass[e] / v.rig.payload_mass - 1.0


@inlined
def gust(e, n, v):
    """Wind beside the mean."""
    return row(v.gust, e)


@inlined
def payload_inertia(e, n, v):
    """Payload inertia over that of its mass, minus 1."""
    return v.parameters.payload_inertia[e] - 1.0


@inlined
def payload_center_of_mass(e, n, v):
    """Payload centre of mass from the nominal one."""
    return row(v.parameters.payload_center_of_mass, e)


@inlined
def action_delay(e, n, v):
    """Delay of actions."""
    return float(v.action_delay[e])


@inlined
def cable_length(e, n, v):
    """Cable length over the nominal one, minus 1."""
    return v.parameters.cable_length[e, n] / v.rig.cable_length[n] - 1.0


@inlined
def vehicle_mass(e, n, v):
    """Mass over the nominal one, minus 1."""
    return v.parameters.vehicle_mass[e, n] / v.rig.mass[n] - 1.0


@inlined
def thrust_coefficient(e, n, v):
    """Thrust coefficient over the nominal one, minus 1."""
    return v.parameters.vehicle_thrust_coefficient[e, n] - 1.0


@inlined
def own_rotors(e, n, v):
    """Thrust coefficient of each rotor over that of its drone, minus 1."""
    own = v.parameters.rotor_thrust_coefficient[e, n]
    return own[0] - 1.0, own[1] - 1.0, own[2] - 1.0, own[3] - 1.0


@inlined
def rotor_time_constant(e, n, v):
    """Time constant of the rotors over the nominal one, minus 1."""
    return v.parameters.vehicle_rotor_time_constant[e, n] - 1.0


@inlined
def target_height(e, n, v):
    """Height of the target."""
    return v.goal.position[e, 2]


@inlined
def cable_tension(e, n, v):
    """Tension over that at rest, minus 1."""
    return v.state.cable_tension[e, n] / v.resting_tension[n] - 1.0


@inlined
def payload_obstacle(e, n, v):
    """From the payload to the nearest point of an obstacle."""
    place = row(v.state.payload_position, e)
    return sub(nearest_point(e, place, NO_OBSTACLE, v.obstacles), place)


@inlined
def drone_obstacle(e, n, v):
    """From a drone to the nearest point of an obstacle."""
    place = vec(v.state.drone_position, e, n)
    return sub(nearest_point(e, place, NO_OBSTACLE, v.obstacles), place)


STATE = (  # global state of a critic: what belongs to no drone, hidden quantities among it
    Component("payload_error", 3, "target", "m", "payload position minus target", payload_error),
    Component("payload_velocity", 3, "target", "m/s", "payload velocity", payload_velocity),
    Component(
        "payload_rotation_error", 3, "target", "rad", "rotation vector from target to payload attitude",
        payload_rotation_error,
    ),
    Component(
        "payload_angular_velocity", 3, "target", "rad/s", "angular velocity of the payload", payload_angular_velocity
    ),
    Component(
        "payload_error_integral", 3, "target", "m s", "clipped integral of payload_error", payload_error_integral
    ),
    Component(
        "rotation_error_integral", 3, "target", "rad s", "clipped integral of payload_rotation_error",
        rotation_error_integral,
    ),
    Component("payload_force", 3, "target", "N", "hidden force on the payload", payload_force),
    Component("wind", 3, "target", "m/s", "mean wind", wind),
    Component("payload_mass", 1, "-", "-", "payload mass over the nominal one, minus 1", payload_mass),
    Component("target_height", 1, "world", "m", "height of the target", target_height),
)  # fmt: skip
DRONE_STATE = (  # then of each drone, and its last action
    Component("slot_error", 3, "target", "m", "position minus slot", slot_error),
    Component("velocity", 3, "target", "m/s", "velocity", own_velocity),
    Component("thrust_axis", 3, "target", "-", "body z axis", thrust_axis),
    Component("body_rates", 3, "body", "rad/s", "angular velocity", body_rates),
    Component("tracking_error", 3, "target", "m", "position minus smoothed reference", tracking_error),
    Component("cable_tension", 1, "-", "-", "tension over that at rest, minus 1", cable_tension),
    Component("slot_direction", 2, "target", "-", "cosine and sine of the slot's azimuth", slot_direction),
)


HIDDEN = {  # what the global state holds beside, where `randomization` varies it, or drones sense obstacles
    "payload_inertia": Component(
        "payload_inertia", 1, "-", "-", "payload inertia over that of its mass, minus 1", payload_inertia
    ),
    "payload_center_of_mass": Component(
        "payload_center_of_mass", 3, "payload", "m", "payload centre of mass from the nominal one",
        payload_center_of_mass,
    ),
    "action_delay": Component("action_delay", 1, "-", "policy steps", "delay of actions", action_delay),
    "gust": Component("gust", 3, "target", "m/s", "turbulence and gusts", gust),
    "obstacles": Component(
        "payload_obstacle", 3, "target", "m", "from the payload to the nearest point of an obstacle", payload_obstacle
    ),
}  # fmt: skip
DRONE_HIDDEN = {  # the same of each drone
    "cable_length": Component("cable_length", 1, "-", "-", "cable length over the nominal one, minus 1", cable_length),
    "vehicle_mass": Component("vehicle_mass", 1, "-", "-", "mass over the nominal one, minus 1", vehicle_mass),
    "vehicle_thrust_coefficient": Component(
        "thrust_coefficient", 1, "-", "-", "thrust coefficient over the nominal one, minus 1", thrust_coefficient
    ),
    "vehicle_rotor_time_constant": Component(
        "rotor_time_constant", 1, "-", "-", "time constant of the rotors over the nominal one, minus 1",
        rotor_time_constant,
    ),
    "rotor_thrust_coefficient": Component(
        "rotors", 4, "-", "-", "thrust coefficient of each rotor over that of its drone, minus 1", own_rotors
    ),
    "obstacles": Component(
        "nearest_obstacle", 3, "target", "m", "from the drone to the nearest point of an obstacle", drone_obstacle
    ),
}  # fmt: skip


class DroneNumbers(NamedTuple):
    """Where the numbers of the drones stand in the global state: `rows` rows of `size` from `first` on."""

    first: int
    rows: int
    size: int


class StateComponents(NamedTuple):
    """What the global state holds: `team`, for each drone `drones` and its last action, `rest`."""

    team: tuple[Component, ...]
    drone: tuple[Component, ...]
    hidden_drone: tuple[Component, ...]
    """Of each drone, what is hidden in an episode."""
    extra: tuple[Component, ...]
    """What the task adds."""
    hidden: tuple[Component, ...]
    """Of the team."""

    @property
    def drones(self) -> tuple[Component, ...]:
        """What there is of each drone before its last action."""
        return self.drone + self.hidden_drone

    @property
    def rest(self) -> tuple[Component, ...]:
        """What comes after the drones."""
        return kernels_first((*self.extra, *self.hidden))

    def drone_numbers(self, num_drones: int, action_size: int) -> DroneNumbers:
        """Return where the drones' numbers stand."""
        return DroneNumbers(count_numbers(self.team), num_drones, count_numbers(self.drones) + action_size)

    def listed(self, num_drones: int, action_size: int) -> tuple[Component, ...]:
        """Return all components, one after the other."""
        # The order in which the kernels of `observation_kernels` write.
        return (*self.team, *num_drones * (*self.drones, previous_action(action_size)), *self.rest)

    def size(self, num_drones: int, action_size: int) -> int:
        """Return how many numbers they are."""
        return count_numbers(self.listed(num_drones, action_size))


def state_components(varied: Set[str], extra: tuple[Component, ...] = ()) -> StateComponents:
    """Return what the global state holds.

    Args:
        varied: keys of `HIDDEN` and `DRONE_HIDDEN` by which environments differ; "obstacles" where they are sensed.
        extra: what the task adds.
    """
    hidden, of_drone = (tuple(part for key, part in table.items() if key in varied) for table in (HIDDEN, DRONE_HIDDEN))
    return StateComponents(STATE, DRONE_STATE, of_drone, extra, hidden)
