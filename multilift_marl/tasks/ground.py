"""Where tasks meet the ground: how a team stands there, and how its targets leave it and come to it."""

from __future__ import annotations

from math import cos, hypot, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import add, matrow, mul, norm, put, putmat, rot_z, row, scale, sub, vec
from multilift_marl.rig.resolve import MIN_SEPARATION
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.tasks.rewards import tolerance

_SLACK_REACH = 0.9  # of its cable: the farthest that a drone stands from its anchor


class Ground(NamedTuple):
    """A team on the ground, in numbers."""

    payload: float
    """Height of the centre of mass of a payload that stands upright on the ground [m]."""
    drone: np.ndarray
    """(N,) height of each drone that stands there [m]."""
    idle: np.ndarray
    """(N,) speed of its rotors that idle [rad/s]."""
    size: float
    """Span of the largest vehicle over a falcon's, by which lengths scale."""
    cable_weight: np.ndarray
    """(N,) weight of each cable [N]."""


def make_ground(system: System) -> Ground:
    """Return the numbers of `system`."""
    half, center = system.payload_size / 2, system.payload_center
    return Ground(
        payload=float(half[2] - center[2]),
        drone=np.array([drone_half_size(vehicle)[2] for vehicle in system.vehicles]),
        idle=np.array([vehicle.rotor_speed_min for vehicle in system.vehicles], float),
        size=float(system.min_separation.max()) / MIN_SEPARATION,
        cable_weight=GRAVITY * system.cable_mass,
    )


def standing_distance(system: System, spread: float) -> np.ndarray:
    """Return how far level (N,) [m] drones stand from the payload: at their slots' distance, or clear of it.

    Args:
        system: the system.
        spread: how far the drones may be moved from there [m].

    Raises:
        ConfigError: a drone beside the payload would be out of its cable's reach.
    """
    ground, half = make_ground(system), system.payload_size[:2] / 2 + np.abs(system.payload_center[:2])
    least = hypot(*half) + 1.5 * max(vehicle.arm for vehicle in system.vehicles) + spread
    distance = np.maximum(np.hypot(system.slots[:, 0], system.slots[:, 1]), least)
    place = distance[:, None] * np.stack([np.cos(system.slot_azimuth), np.sin(system.slot_azimuth)], axis=1)
    level = np.hypot(*(place - system.anchors[:, :2]).T) + spread
    reach = np.hypot(level, ground.payload + system.anchors[:, 2] - ground.drone) / system.cable_length
    if np.any(reach > _SLACK_REACH):
        i = int(reach.argmax())
        raise ConfigError(
            f"cable {i} is too short for its drone to stand beside the payload: that takes {reach[i]:.2f} of its "
            f"length, at most {_SLACK_REACH} may be; raise cable.length or lower task_options.start_spread"
        )
    return distance


@kernel
def stand_team(e, rng, state, goal, rig, ground, distance, spread):
    """Write a team at rest on the ground, its payload at the target of environment e.

    The drones stand at level distances (N,) [m] from it, each moved by a vector uniform in a disc of radius `spread`.
    """
    put(state.payload_position[e], row(goal.position, e))
    putmat(state.payload_rotation[e], matrow(goal.rotation, e))
    state.payload_velocity[e] = state.payload_body_rates[e] = 0.0
    state.drone_velocity[e] = state.drone_body_rates[e] = 0.0
    for n in range(rig.azimuth.shape[0]):
        azimuth, where = goal.yaw[e] + rig.azimuth[n], rng.uniform(-pi, pi)
        moved = spread * sqrt(rng.uniform(0.0, 1.0))
        x = goal.position[e, 0] + distance[n] * cos(azimuth) + moved * cos(where)
        y = goal.position[e, 1] + distance[n] * sin(azimuth) + moved * sin(where)
        putmat(state.drone_rotation[e, n], rot_z(goal.yaw[e]))
        put(state.drone_position[e, n], (x, y, ground.drone[n]))
        state.rotor_speed[e, n] = ground.idle[n]


@kernel
def set_resting_goal(e, goal, position):
    """Put the target of environment e at `position` [m], at rest."""
    put(goal.position[e], position)
    goal.velocity[e] = goal.acceleration[e] = goal.jerk[e] = 0.0


@kernel
def move_goal(e, goal, way, eased):
    """Move the target of environment e along `way` [m] as `eased`, see `math3d.ease`; several ways add up."""
    put(goal.position[e], add(row(goal.position, e), scale(eased[0], way)))
    put(goal.velocity[e], add(row(goal.velocity, e), scale(eased[1], way)))
    put(goal.acceleration[e], add(row(goal.acceleration, e), scale(eased[2], way)))
    put(goal.jerk[e], add(row(goal.jerk, e), scale(eased[3], way)))


@kernel
def cable_chord(e, n, goal, rig):
    """Return the way from where anchor n is at the target pose of environment e to the slot of its drone [m]."""
    anchor = (rig.anchors[n, 0], rig.anchors[n, 1], rig.anchors[n, 2])
    at = add(row(goal.position, e), mul(matrow(goal.rotation, e), anchor))
    return sub(vec(goal.slots, e, n), at)


@kernel
def share_force(e, n, goal, share, rig, cable_weight):
    """Scale the nominal pull of drone n by `share`; of a slack cable the drone carries half its weight `rope` [N].

    What the drone's slot does about the target, the load does not: its inertia, which the controller feeds forward
    with all accelerations, is taken off again.
    """
    cable_force = scale(share, vec(goal.cable_force, e, n))
    idle = scale(-rig.force[n, 2] / GRAVITY, vec(goal.slot_acceleration, e, n))
    put(goal.cable_force[e, n], add(add(cable_force, idle), (0.0, 0.0, 0.5 * (1.0 - share) * cable_weight)))


@kernel
def mean_slot_tolerance(e, state, goal, margin):
    """Return how well the drones of environment e keep their slots: the mean `tolerance` of their distances."""
    total, count = 0.0, goal.slots.shape[1]
    for n in range(count):
        total += tolerance(norm(sub(vec(state.drone_position, e, n), vec(goal.slots, e, n))), margin)
    return total / count


@kernel
def cable_rise(e, n, state, rig):
    """Return how far drone n of environment e is above its anchor [m]."""
    anchor = (rig.anchors[n, 0], rig.anchors[n, 1], rig.anchors[n, 2])
    turned = mul(matrow(state.payload_rotation, e), anchor)
    return state.drone_position[e, n, 2] - state.payload_position[e, 2] - turned[2]
