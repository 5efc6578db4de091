"""Land: the team puts its payload down on a pad and lets the cables go slack."""

from __future__ import annotations

from math import hypot, radians
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.formation import place_formation
from multilift_marl.kernels.jit import drawing, inlined
from multilift_marl.math3d import add, ease, matrow, norm, put, putmat, rot_z, row, scale, sub, tmul, vec
from multilift_marl.mdp.criteria import CONDITION, Criterion, length
from multilift_marl.mdp.failures import LOAD_GROUND, TOUCH, Limits, ignore, payload_height
from multilift_marl.mdp.ground import (
    CARRIED,
    CREEP,
    Ground,
    Margin,
    Origin,
    Pace,
    cable_chord,
    keep_hook,
    make_ground,
    margin_ratio,
    move_goal,
    pace_of,
    paced,
    pull_fraction,
    readiness,
    scale_cable_force,
    set_resting_goal,
)
from multilift_marl.mdp.initial_states import check_target_height, set_equilibrium
from multilift_marl.mdp.observations import Component, target_velocity
from multilift_marl.mdp.rewards import Term, action_rate, tolerance
from multilift_marl.schema.values import Float, Section
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.state import SystemState
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.target_checks import check_way, warn_of_time

APPROACH = (0.1, 2.7)  # begin and length of each phase [s], as of the next ones: level to the pad,
DESCEND = (2.0, 2.8)  # down,
SETTLE = (4.8, 1.6)  # slowly onto the ground,
RELEASE = (6.4, 2.2)  # cable forces fade,
LOWER = (8.6, 1.4)  # drones come closer
NEAR = 0.12  # [m] above the ground where the slow last part of the descent begins, for the span of a falcon
SHORTER = 0.15  # of its length: how much nearer to its anchor a drone comes in the end
AIRBORNE, LANDED, CRASHED = range(3)
_LANDED_WELL = ignore(LOAD_GROUND)
_AT_REST = 0.02  # [m/s]


class LandOptions(Section):
    """Ranges of the start and bounds of success."""

    origin: Origin = (0.0, 0.0)
    pad_xy: Float = Field(1.0, ge=0, description="[m] pad's x and y within ± this; the team starts above the origin")
    pad_yaw: Float = Field(45.0, ge=0, le=180, description="[deg] heading of team and pad within ± this")
    start_height: Float = Field(1.5, gt=0, description="[m] of the payload at the start")
    pad_radius: Float = Field(0.1, gt=0, description="[m] payload on the pad: within this of its middle")
    touch_speed: Float = Field(0.3, gt=0, description="[m/s] largest speed of the payload when it touches the ground")
    clearance: Float = Field(
        0.3, gt=0, description="[m] drones from payload and ground; less for a span below a falcon's"
    )
    success_seconds: Float = Field(1.0, gt=0, description="[s] at rest, slack and clear throughout the last seconds")
    pace: Pace = 1.0
    margin: Margin = 0.0


class LandArrays(NamedTuple):
    """What an episode holds beside its goal."""

    course: np.ndarray
    """(E, 3) from the start, above the origin, to the pad [m]."""
    touch: np.ndarray
    """(E,) int64, AIRBORNE, LANDED or CRASHED."""
    speed: np.ndarray
    """(E,) of the payload a control step ago [m/s]."""
    pull_fraction: np.ndarray
    """(E,) of the nominal cable forces that is fed forward [-]."""


class LandSettings(NamedTuple):
    """Constants of the task, and what counts as landed."""

    ground: Ground
    origin: tuple[float, float]
    """Above which teams start [m]."""
    approach: tuple[float, float]
    """Begin and length [s], as of the next ones."""
    descend: tuple[float, float]
    settle: tuple[float, float]
    release: tuple[float, float]
    lower: tuple[float, float]
    radius: float
    """Payload within this of the pad's middle [m]."""
    speed: float
    """Largest at touchdown [m/s]."""
    clearance: float
    """Between the surfaces of drones, payload and ground [m]."""
    drone_half: float
    """Largest extent of the largest drone from its centre [m]."""


@drawing
def start_above_origin(e, rng, v, equilibrium, ranges):
    """Draw the pad; write a team at rest above the origin. Ranges are x and y [m], heading [rad], height [m]."""
    goal, (xy, yaw, height) = v.goal, ranges
    # A payload on the ground has its centre of mass at `ground.payload`: the course leads down, z < 0.
    put(v.own.course[e], (rng.uniform(-xy, xy), rng.uniform(-xy, xy), v.settings.ground.payload - height))
    set_resting_goal(e, goal, (*v.settings.origin, height))
    putmat(goal.rotation[e], rot_z(rng.uniform(-yaw, yaw)))
    place_formation(e, goal, v.rig)
    still = (0.0, 0.0, 0.0)
    set_equilibrium(e, v, goal, equilibrium, (row(goal.position, e), matrow(goal.rotation, e)), still, still)


@inlined
def advance(e, v):
    """Move the goal on: to the pad, down, slowly onto it; then cable forces fade and drones come closer."""
    goal, rig, own, ground, t, plan = v.goal, v.rig, v.own, v.settings.ground, v.time[e], v.settings
    course = row(own.course, e)
    # At every control step, and not only after a policy step, in which a payload could touch and bounce unseen.
    see_touchdown(e, v)
    # The slow part is no longer than the whole descent, where teams start low.
    near = min(NEAR * ground.size, -course[2])
    # The start again, from the course alone; the three phases add up on it.
    set_resting_goal(e, goal, (*plan.origin, ground.payload - course[2]))
    move_goal(e, goal, (course[0], course[1], 0.0), ease(t, plan.approach[0], plan.approach[1]))
    move_goal(e, goal, (0.0, 0.0, course[2] + near), ease(t, plan.descend[0], plan.descend[1]))
    move_goal(e, goal, (0.0, 0.0, -near), ease(t, plan.settle[0], plan.settle[1]))
    place_formation(e, goal, rig)
    # After the formation, which writes slots and full cable forces anew in each step: both are changed from there.
    own.pull_fraction[e] = 1.0 - ease(t, plan.release[0], plan.release[1])[0]
    lower = ease(t, plan.lower[0], plan.lower[1])
    for n in range(rig.slots.shape[0]):
        chord = cable_chord(e, n, goal, rig)
        keep_hook(e, n, v, own.pull_fraction[e], ground.cable_weight)
        put(goal.slots[e, n], add(vec(goal.slots, e, n), scale(-SHORTER * lower[0], chord)))
        put(goal.slot_velocity[e, n], scale(-SHORTER * lower[1], chord))
        put(goal.slot_acceleration[e, n], scale(-SHORTER * lower[2], chord))
        # After the slot's acceleration, from which it takes the load's inertia that is not moved along.
        scale_cable_force(e, n, v, own.pull_fraction[e], ground.cable_weight)


@inlined
def see_touchdown(e, v):
    """Classify the payload's first touch of the ground by its speed now or a control step ago.

    The ground is no failure for one that has landed well.
    """
    own, settings = v.own, v.settings
    speed = norm(row(v.state.payload_velocity, e))
    if own.touch[e] == AIRBORNE and load_height(e, v.state, v.limits) < TOUCH:
        # The step in which it touches may have stopped it already: the faster of two counts.
        soft = max(speed, own.speed[e]) <= settings.speed
        own.touch[e] = LANDED if soft and off_pad(e, v) <= settings.radius else CRASHED
    own.speed[e] = speed
    v.mask.ignored[e] = _LANDED_WELL if own.touch[e] == LANDED else 0


@inlined
def load_height(e, state, limits):
    """Return the height of the lowest point of the payload of environment e [m]."""
    return payload_height(row(state.payload_position, e), matrow(state.payload_rotation, e), limits)


@inlined
def off_pad(e, v):
    """Return the level distance of the payload of environment e from the middle of its pad [m]."""
    payload, course, (x, y) = v.state.payload_position, v.own.course, v.settings.origin
    return hypot(payload[e, 0] - x - course[e, 0], payload[e, 1] - y - course[e, 1])


@inlined
def _drone_clear(e, n, v):
    """Return whether drone n of environment e is clear of payload and ground."""
    drone = vec(v.state.drone_position, e, n)
    # In the payload's frame, with whose axes its box is aligned.
    away = tmul(matrow(v.state.payload_rotation, e), sub(drone, row(v.state.payload_position, e)))
    center, half = v.limits.payload_center, v.limits.payload_half  # a cylinder counts as the box about it
    # Distance of the drone's centre from a box, 0 inside.
    x = max(abs(away[0] - center[0]) - half[0], 0.0)
    y = max(abs(away[1] - center[1]) - half[1], 0.0)
    z = max(abs(away[2] - center[2]) - half[2], 0.0)
    # The ground is as far as the centre is high. A drone counts as the sphere about its box, whatever its tilt.
    return min(norm((x, y, z)), drone[2]) - v.settings.drone_half >= v.settings.clearance


@inlined
def _excess(e, n, v):
    """Return by how much the tension of cable n is above that of a slack one, a chain's own weight [N]."""
    return max(v.state.cable_tension[e, n] - v.settings.ground.cable_weight[n], 0.0)


@inlined
def is_put_down(e, v):
    """Payload at rest on the pad, every cable slack, every drone clear."""
    good = off_pad(e, v) <= v.settings.radius
    for n in range(v.action.shape[1]):
        # Exactly 0: a slack massless cable has no tension at all, and a chain's own weight is cut off.
        good = good and _excess(e, n, v) == 0.0 and _drone_clear(e, n, v)
    return good and norm(row(v.state.payload_velocity, e)) <= _AT_REST and load_height(e, v.state, v.limits) < TOUCH


@inlined
def slackness(e, v, margin):
    """Cables slack, once the payload is not carried; the margin counts tensions over those at rest."""
    loose, count = 0.0, v.action.shape[1]
    for n in range(count):
        loose += tolerance(_excess(e, n, v) / v.resting_tension[n], margin) / count
    return (1.0 - v.own.pull_fraction[e]) * loose


@inlined
def time_to_touch(e, n, v):
    """Time until the target is on the ground."""
    return v.settings.settle[0] + v.settings.settle[1] - v.time[e]


def _components(frame: str) -> tuple[Component, ...]:
    return (
        Component(
            "time_to_touch", 1, "-", "s", "until the target is on the ground; negative afterwards", time_to_touch
        ),
        Component("pull_share", 1, "-", "-", "share of the nominal cable force that is fed forward", pull_fraction),
        Component("target_velocity", 3, frame, "m/s", "velocity of the target", target_velocity),
    )


class Land(Task):
    """Land and let go; see docs/land.md."""

    name: ClassVar[str] = "land"
    Options: ClassVar[type[Section]] = LandOptions
    options: LandOptions
    own: LandArrays
    settings: LandSettings
    REWARD: ClassVar[dict[str, Term]] = {
        **CARRIED,
        "ready": Term(0.5, readiness, 0.25, "m"),
        "slack": Term(0.5, slackness, 0.1, "-"),
        "action_rate": Term(-0.05, action_rate),
    }
    CAN_PLAN: ClassVar[bool] = False
    KERNELS: ClassVar[Kernels] = Kernels(is_good=is_put_down, plan=advance, check=see_touchdown)
    EXTRA: ClassVar[tuple[Component, ...]] = _components("slot")
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = _components("target")

    def count_limits(self) -> dict[str, tuple[int, int]]:
        """Bound what kernels index by, see `Task`."""
        return {"touch": (AIRBORNE, CRASHED)}

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, system, e = self.options, self.world.system, self.world.num_envs
        pace = pace_of(option.pace, system)
        ground = make_ground(system)
        margin_ratio(option.margin, system)  # of which cables have enough
        creeping = option.margin / CREEP
        half = max((drone_half_size(vehicle) for vehicle in system.vehicles), key=np.linalg.norm)
        self.own = LandArrays(np.zeros((e, 3)), np.zeros(e, np.int64), np.zeros(e), np.zeros(e))
        self.settings = LandSettings(
            ground=ground,
            origin=option.origin,
            approach=paced(APPROACH, pace),
            descend=paced(DESCEND, pace),
            settle=paced(SETTLE, pace, longer=creeping),
            release=paced(RELEASE, pace, later=creeping),
            lower=paced(LOWER, pace, later=creeping),
            radius=option.pad_radius,
            speed=option.touch_speed,
            clearance=option.clearance * min(ground.size, 1.0),
            drone_half=float(np.linalg.norm(half)),
        )
        start, down = f"task_options.start_height={option.start_height:g} m", ground.payload - option.start_height
        check_target_height(start, option.start_height, system)
        check_way(start, "lower it", (0.0, 0.0, min(down + NEAR * ground.size, 0.0)), self.settings.descend[1], system)
        pad = f"task_options.pad_xy={option.pad_xy:g} m"
        check_way(pad, "lower it", (option.pad_xy, 0.0, 0.0), self.settings.approach[1], system)
        end = sum(self.settings.lower) + option.success_seconds
        if end > sum(LOWER) + LandOptions().success_seconds:  # else the usual plan, cut on purpose
            warn_of_time(f"by its plan, task {self.name} can succeed from", end, self.config.env.episode_seconds)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw the pad; the team hangs at rest above the origin. See `Task.start`."""
        option = self.options
        ranges = option.pad_xy, radians(option.pad_yaw), option.start_height
        start_above_origin(env, rng, self.view_for(start_above_origin), self.equilibrium, ranges)
        self.own.touch[env], self.own.speed[env], self.time[env] = AIRBORNE, 0.0, 0.0
        # At t = 0 it writes what is fed forward and what is ignored, which are still those of the last episode's end.
        advance(env, self.view_for(advance))

    def succeeded(self) -> np.ndarray:
        """Touched down softly, and at rest, slack and clear throughout the last seconds."""
        return (self.own.touch == LANDED) & super().succeeded()

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`: a soft landing, and what `is_put_down` asks for."""
        state, course, settings = self.world.state, self.own.course, self.settings
        slack, clear = settings.ground.cable_weight, settings.clearance
        soft = Criterion("soft_landing", CONDITION, lambda: (self.own.touch != LANDED) * 1.0, throughout=False)
        if self.KERNELS.is_good is not is_put_down:
            return (soft,)
        return (
            soft,
            Criterion("pad_distance_m", settings.radius, lambda: _level(state, course, settings) - settings.radius),
            Criterion("speed_m_s", _AT_REST, lambda: length(state.payload_velocity) - _AT_REST),
            Criterion("height_m", TOUCH, lambda: lowest_points(state, self.limits) - TOUCH),
            Criterion("cable_force_n", 0.0, lambda: (state.cable_tension - slack).max(axis=1)),
            Criterion("clearance_m", clear, lambda: clear - _room(state, self.limits) + settings.drone_half),
        )


def _level(state: SystemState, course: np.ndarray, settings: LandSettings) -> np.ndarray:
    """Return level distances of payloads from the middle of their pad (E,) [m], see `off_pad`."""
    return np.asarray(np.hypot(*((state.payload_position - course)[:, :2] - settings.origin).T))


def lowest_points(state: SystemState, limits: Limits) -> np.ndarray:
    """Return heights of the payloads' lowest points (E,) [m], see `load_height`."""
    # The third row of R holds the heights of the body axes, as in `failures.payload_height`.
    up, half = state.payload_rotation[:, 2], limits.payload_half
    if limits.payload_round:
        reach = np.hypot(up[:, 0], up[:, 1]) * half[0] + np.abs(up[:, 2]) * half[2]
    else:
        reach = np.abs(up) @ half
    return np.asarray(state.payload_position[:, 2] + up @ np.array(limits.payload_center) - reach)


def _room(state: SystemState, limits: Limits) -> np.ndarray:
    """Return least distances of drones' centres from payload and ground (E,) [m], see `_drone_clear`."""
    away = (state.drone_position - state.payload_position[:, None]) @ state.payload_rotation
    outside = np.maximum(np.abs(away - np.array(limits.payload_center)) - limits.payload_half, 0.0)
    return np.asarray(np.minimum(np.linalg.norm(outside, axis=2), state.drone_position[..., 2]).min(axis=1))
