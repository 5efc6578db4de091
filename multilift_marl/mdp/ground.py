"""Where tasks meet the ground: how a team stands there, and how its targets leave it and come to it."""

from __future__ import annotations

from math import cos, hypot, pi, sin, sqrt
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.formation import goal_hook, hook_arm
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import inlined, kernel
from multilift_marl.math3d import add, matrow, mul, put, putmat, rot_z, row, scale, sub, vec
from multilift_marl.mdp import rewards
from multilift_marl.mdp.rewards import Term, tolerance
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.resolve import MIN_SEPARATION
from multilift_marl.rig.system import System
from multilift_marl.schema.values import Between, Float
from multilift_marl.sim.contact import drone_half_size

FAR = 0.5  # [m] from its target, at which a payload's pose earns half
CREEP = 0.006  # [m/s] at which a margin is gone through
MAX_MARGIN = 0.2  # of a cable's length
LONG = 2.0  # [m] a cable whose swing the phases of plans are long enough for
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


def resting_distance(system: System, spread: float) -> np.ndarray:
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
    # From the anchor on the lying payload to the drone that stands: across, and down or up.
    reach = np.hypot(level, ground.payload + system.anchors[:, 2] - ground.drone) / system.cable_length
    if np.any(reach > _SLACK_REACH):
        i = int(reach.argmax())
        raise ConfigError(
            f"cable {i} is too short for its drone to stand beside the payload: that takes {reach[i]:.2f} of its "
            f"length, at most {_SLACK_REACH} may be; raise cable.length or lower task_options.start_spread"
        )
    return distance


@kernel
def place_on_ground(e, rng, v, ground, distance, spread):
    """Write a team at rest on the ground, its payload at the target of environment e.

    Args:
        e: the environment.
        rng: generator of the episode.
        v: View; its state is written.
        ground: Ground.
        distance: level distances (N,) of the drones from the payload [m].
        spread: radius of the disc in which each drone is moved from there, uniformly [m].
    """
    state, goal, rig = v.state, v.goal, v.rig
    put(state.payload_position[e], row(goal.position, e))
    putmat(state.payload_rotation[e], matrow(goal.rotation, e))
    state.payload_velocity[e] = state.payload_body_rates[e] = 0.0
    state.drone_velocity[e] = state.drone_body_rates[e] = 0.0
    for n in range(rig.azimuth.shape[0]):
        azimuth, where = goal.yaw[e] + rig.azimuth[n], rng.uniform(-pi, pi)
        # The root makes it uniform over the disc's area.
        moved = spread * sqrt(rng.uniform(0.0, 1.0))
        x = goal.position[e, 0] + distance[n] * cos(azimuth) + moved * cos(where)
        y = goal.position[e, 1] + distance[n] * sin(azimuth) + moved * sin(where)
        putmat(state.drone_rotation[e, n], rot_z(goal.yaw[e] + rig.heading[n]))
        put(state.drone_position[e, n], (x, y, ground.drone[n]))
        state.rotor_speed[e, n] = ground.idle[n]


@kernel
def set_resting_goal(e, goal, position):
    """Put the target of environment e at `position` [m], at rest."""
    put(goal.position[e], position)
    goal.velocity[e] = goal.acceleration[e] = goal.jerk[e] = 0.0


@kernel
def move_goal(e, goal, path, eased):
    """Move the target of environment e along `path` (3,) [m] as `eased`, see `math3d.ease`; several paths add up."""
    put(goal.position[e], add(row(goal.position, e), scale(eased[0], path)))
    put(goal.velocity[e], add(row(goal.velocity, e), scale(eased[1], path)))
    put(goal.acceleration[e], add(row(goal.acceleration, e), scale(eased[2], path)))
    put(goal.jerk[e], add(row(goal.jerk, e), scale(eased[3], path)))


@inlined
def cable_chord(e, n, goal, rig):
    """Return the vector from anchor n to the hook of its drone at the target of environment e [m]."""
    anchor = add(row(goal.position, e), mul(matrow(goal.rotation, e), row(rig.anchors, n)))
    return sub(goal_hook(e, n, goal, rig), anchor)


@inlined
def held_force(e, n, v, fraction, cable_weight):
    """Return what drone n holds of its nominal cable force, and of a slack cable half the weight (N,) [N]."""
    carried = (0.0, 0.0, 0.5 * (1.0 - fraction) * cable_weight[n])
    return add(scale(fraction, vec(v.goal.cable_force, e, n)), carried)


@inlined
def keep_hook(e, n, v, fraction, cable_weight):
    """Move the slot of drone n, which leans less by a fraction of its cable force, so that its hook stays in place."""
    goal, rig = v.goal, v.rig
    if rig.hooked:
        held, yaw = held_force(e, n, v, fraction, cable_weight), goal.drone_yaw[e]
        shift = sub(hook_arm(n, vec(goal.cable_force, e, n), yaw, rig), hook_arm(n, held, yaw, rig))
        put(goal.slots[e, n], add(vec(goal.slots, e, n), shift))


@inlined
def scale_cable_force(e, n, v, fraction, cable_weight):
    """Scale the nominal cable force of drone n; of a slack cable the drone carries half its weight (N,) [N].

    What the drone's slot does about the target, the load does not: its inertia, which the controller feeds forward
    with all accelerations, is taken off again.
    """
    goal, rig = v.goal, v.rig
    held = held_force(e, n, v, fraction, cable_weight)
    # The mass that a nominal cable force lifts, times the slot's acceleration.
    idle = scale(-rig.force[n, 2] / GRAVITY, vec(goal.slot_acceleration, e, n))
    put(goal.cable_force[e, n], add(held, idle))


@inlined
def carried(e, v):
    """Return by how much the payload's pose counts: as its weight is carried, and little if it lies elsewhere."""
    return v.own.pull_fraction[e] * tolerance(v.errors.distance[e], FAR)


@inlined
def position(e, v, margin):
    """Payload close to its target, while it is carried."""
    return rewards.distance(e, v, margin) * carried(e, v)


@inlined
def attitude(e, v, margin):
    """Payload close to its target's attitude, while it is carried."""
    return rewards.attitude(e, v, margin) * carried(e, v)


@inlined
def steadiness(e, v, speed, rate):
    """Payload as fast as its target, and turning slowly, while it is carried."""
    return rewards.steadiness(e, v, speed, rate) * carried(e, v)


@inlined
def readiness(e, v, margin):
    """Drones in their slots, while the payload is not carried."""
    return (1.0 - v.own.pull_fraction[e]) * rewards.formation(e, v, margin)


@inlined
def pull_fraction(e, n, v):
    """Fraction of the nominal cable force that is fed forward."""
    return v.own.pull_fraction[e]


@inlined
def cable_rise(e, n, state, rig):
    """Return how far drone n of environment e is above its anchor [m]."""
    turned = mul(matrow(state.payload_rotation, e), row(rig.anchors, n))
    return state.drone_position[e, n, 2] - state.payload_position[e, 2] - turned[2]


Pace = Annotated[
    Float,
    Between(0.1, 1),
    Field(description="[-] of the plan: 0.5 takes twice the time"),
]
"""Option of tasks that begin or end on the ground."""

Margin = Annotated[
    Float,
    Between(0, 0.3, "m"),
    Field(description="[m] expected error of drones' places; makes contact slower"),
]
"""Option of tasks that begin or end on the ground."""

Origin = Annotated[
    tuple[Float, Float],
    Between(-1e3, 1e3, "m"),
    Field(description="[m] x and y where the team starts; ranges of places are about them"),
]
"""Option of tasks that begin or end on the ground."""


def margin_ratio(margin: float, system: System) -> np.ndarray:
    """Return a margin [m] over the length of each cable (N,) [-].

    Raises:
        ConfigError: it is too large for the shortest cable.
    """
    ratio = margin / system.cable_length
    if ratio.max() > MAX_MARGIN:
        raise ConfigError(
            f"task_options.margin={margin:g} m is {ratio.max():.2f} of a cable's length, at most {MAX_MARGIN:g} may "
            "be; lower it or raise cable.length"
        )
    return ratio


def pace_of(pace: float, system: System) -> float:
    """Return the pace of a plan for cables of up to 2 m; longer ones swing slower, and take longer as they do."""
    return pace / max(1.0, sqrt(system.cable_length.max() / LONG))


def paced(phase: tuple[float, float], pace: float, later: float = 0.0, longer: float = 0.0) -> tuple[float, float]:
    """Return begin and length [s] of a phase at some pace, then later and longer by some time [s]."""
    return phase[0] / pace + later, phase[1] / pace + longer


CARRIED = {
    "position": Term(0.4, position, 0.25, "m"),
    "precision": Term(0.25, position, 0.01, "m"),
    "attitude": Term(0.15, attitude, 6.0, "deg"),
    "level": Term(0.1, attitude, 1.0, "deg"),
    "stillness": Term(0.1, steadiness, (0.2, 0.3), "m/s, rad/s"),
}
"""Reward terms of a payload that is to be at its target while it is carried."""
