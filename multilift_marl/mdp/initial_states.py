"""How teams stand when an episode starts."""

from __future__ import annotations

from math import cos, pi, radians, sin, sqrt
from typing import NamedTuple

from pydantic import Field

from multilift_marl.control.formation import goal_hook, place_formation
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import drawing, kernel
from multilift_marl.math3d import (
    add,
    axis_angle,
    matmul,
    matrow,
    mul,
    norm,
    put,
    putmat,
    rot_z,
    row,
    scale,
    sub,
    unit,
    vec,
)
from multilift_marl.mdp.failures import least_height
from multilift_marl.rig.constants import RigArrays
from multilift_marl.rig.system import System
from multilift_marl.schema.validate import check_magnitudes
from multilift_marl.schema.values import Float, Section
from multilift_marl.sim.cables.catenary import cable_end
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.state import hover_drone, place_at_hook


def true_equilibrium(rig: RigArrays, parameters: Parameters, e: int) -> RigArrays:
    """Return the numbers of the team in environment e."""
    p = parameters
    return rig._replace(
        mass=p.vehicle_mass[e],
        thrust_coefficient=rig.thrust_coefficient * p.vehicle_thrust_coefficient[e],
        rotor_strength=p.rotor_thrust_coefficient[e],
        cable_length=p.cable_length[e],
        cable_stiffness=p.cable_stiffness[e],
        cable_weight=rig.cable_weight * (p.cable_length[e] / rig.cable_length),
        load=float(p.payload_mass[e] / rig.payload_mass),
    )


@kernel
def in_ball(rng, radius):
    """Return a vector uniform in a ball."""
    z, azimuth = rng.uniform(-1.0, 1.0), rng.uniform(-pi, pi)
    # The cube root, or half of all vectors would lie in an eighth of the ball. A uniform z gives directions uniform on
    # the sphere (Archimedes).
    r = radius * rng.uniform(0.0, 1.0) ** (1.0 / 3.0)
    flat = r * sqrt(1.0 - z * z)
    return (flat * cos(azimuth), flat * sin(azimuth), r * z)


@kernel
def set_equilibrium(e, v, goal, equilibrium, pose, velocity, moved):
    """Write a team that moves as one, its cables at the tension of rest and in the directions of its slots.

    Args:
        e: the environment.
        v: View; its state is written.
        goal: whose slots and cable forces, moved, the drones' cables point to.
        equilibrium: RigArrays of the environment, the true ones.
        pose: of the payload: position [m] and attitude, 9 numbers; cables keep their lengths.
        velocity: of all bodies [m/s].
        moved: of the slots from the goal's [m].
    """
    state, rig = v.state, v.rig
    payload, attitude = pose
    put(state.payload_position[e], payload)
    put(state.payload_velocity[e], velocity)
    putmat(state.payload_rotation[e], attitude)
    state.payload_body_rates[e] = 0.0
    for n in range(rig.slots.shape[0]):
        # the direction of the cable, from the payload's anchor to the hook at the slot
        anchor = add(payload, mul(attitude, row(rig.anchors, n)))
        cable = sub(add(goal_hook(e, n, goal, rig), moved), anchor)
        direction = scale(1.0 / norm(cable), cable)
        if equilibrium.cable_weight[n] > 0.0:
            direction = unit(add(direction, _sag(e, n, goal, rig)))
        # its tension in the middle
        half = (0.0, 0.0, 0.5 * equilibrium.cable_weight[n])
        tension = equilibrium.load * norm(sub(vec(goal.cable_force, e, n), half))
        end = cable_end(
            direction,
            tension,
            equilibrium.cable_length[n],
            equilibrium.cable_stiffness[n],
            equilibrium.cable_segments[n],
            equilibrium.cable_weight[n],
        )
        # the drone hovers there, and carries the cable's force
        put(state.drone_velocity[e, n], velocity)
        state.drone_body_rates[e, n] = 0.0
        cable_force = add(scale(tension, direction), half)
        hover_drone(e, n, state, cable_force, goal.drone_yaw[e] + rig.heading[n], equilibrium)
        place_at_hook(e, n, state, add(anchor, end), equilibrium.hooks)


@kernel
def _sag(e, n, goal, rig):
    """Return the direction of the force in the middle of a heavy cable at the target, less that of its chord."""
    anchor = add(row(goal.position, e), mul(matrow(goal.rotation, e), row(rig.anchors, n)))
    middle = sub(vec(goal.cable_force, e, n), (0.0, 0.0, 0.5 * rig.cable_weight[n]))
    return sub(unit(middle), unit(sub(goal_hook(e, n, goal, rig), anchor)))


class TargetOptions(Section):
    """Where a target may be, one for the whole episode."""

    target_xy: Float = Field(1.0, ge=0, description="[m] target x and y within ± this")
    target_height: tuple[Float, Float] = Field((1.5, 2.5), description="[m] lowest and highest target")
    target_yaw: Float = Field(45.0, ge=0, le=180, description="[deg] target heading within ± this")


class StartOptions(TargetOptions):
    """Where a team may start, moved as one from hanging at its target."""

    start_radius: Float = Field(0.5, ge=0, description="[m] start within a ball of this radius about the target")
    start_tilt: Float = Field(10.0, ge=0, le=90, description="[deg] largest tilt of the payload at the start")
    start_speed: Float = Field(0.3, ge=0, description="[m/s] largest speed of the team at the start")


def check_options(options: Section, system: System) -> None:
    """Refuse, by a ConfigError, options of a task that are too large or, of targets that stay, in the ground."""
    check_magnitudes(options, "task_options")
    if isinstance(options, TargetOptions):
        check_heights(options, system)


def check_heights(option: TargetOptions, system: System) -> None:
    """Refuse heights of a target in the wrong order, or in the ground, by a ConfigError."""
    low, high = option.target_height
    if low > high:
        raise ConfigError(f"task_options.target_height={option.target_height} must list the lower one first")
    check_target_height(f"task_options.target_height={option.target_height}", low, system)


def check_target_height(source: str, height: float, system: System) -> None:
    """Refuse, by a ConfigError, a target [m] at which the payload, level, would touch the ground.

    Args:
        source: key of the target, and its value.
        height: its lowest place [m].
        system: the team.
    """
    if height < (least := least_height(system)):
        raise ConfigError(
            f"{source}: at a height of {height:.3g} m the payload would touch the ground; keep it above {least:.3g} m"
        )


class StartRanges(NamedTuple):
    """StartOptions in SI units."""

    xy: float
    low: float
    high: float
    yaw: float
    radius: float
    tilt: float
    speed: float


def make_ranges(option: StartOptions) -> StartRanges:
    """Return the ranges of `option`."""
    return StartRanges(
        option.target_xy, *option.target_height, radians(option.target_yaw),
        option.start_radius, radians(option.start_tilt), option.start_speed,
    )  # fmt: skip


@drawing
def start_near_target(e, rng, v, ranges, equilibrium):
    """Draw a target, and a team in hanging equilibrium there, then moved, tilted and set in motion as one.

    Args:
        e: the environment.
        rng: generator of the episode.
        v: View; goal and state are written.
        ranges: StartRanges.
        equilibrium: RigArrays of the environment, the true ones.
    """
    goal, rig = v.goal, v.rig
    x, y = rng.uniform(-ranges.xy, ranges.xy), rng.uniform(-ranges.xy, ranges.xy)
    put(goal.position[e], (x, y, rng.uniform(ranges.low, ranges.high)))
    putmat(goal.rotation[e], rot_z(rng.uniform(-ranges.yaw, ranges.yaw)))
    place_formation(e, goal, rig)
    moved = in_ball(rng, ranges.radius)
    # A uniform direction: that of a vector uniform in a ball.
    axis = in_ball(rng, 1.0)
    tilt = axis_angle(scale(1.0 / max(norm(axis), 1e-9), axis), rng.uniform(0.0, ranges.tilt))
    velocity = in_ball(rng, ranges.speed)
    attitude = matrow(goal.rotation, e)
    if not rig.is_point:  # a point has no attitude: it counts as aligned
        attitude = matmul(tilt, attitude)
    set_equilibrium(e, v, goal, equilibrium, (add(row(goal.position, e), moved), attitude), velocity, moved)
