"""Landing: put the payload down on a pad, softly, and let the cables go slack."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, hypot, radians, sin
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.values import Float, Section
from multilift_marl.control.formation import Reference, place_formation
from multilift_marl.math3d import add, ease, matrow, norm, put, putmat, rot_z, row, scale, sub, tmul, turn, vec
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.failures import LOAD_GROUND, TOUCH, ignore, payload_height
from multilift_marl.tasks.ground import (
    cable_chord,
    make_ground,
    mean_slot_tolerance,
    move_goal,
    set_resting_goal,
    share_force,
)
from multilift_marl.tasks.observations import Component
from multilift_marl.tasks.rewards import action_rate, pose_reward, tolerance
from multilift_marl.tasks.starts import hang_team

APPROACH, DESCEND, SETTLE = (0.1, 2.7), (2.0, 2.8), (4.8, 1.6)  # begin and length of each phase [s]
RELEASE, LOWER = (6.4, 2.2), (8.6, 1.4)
DOWN = SETTLE[0] + SETTLE[1]  # [s] when the target is on the ground
NEAR = 0.12  # [m] above the ground where the slow last part of the way begins, for the span of a falcon
SHORTER = 0.15  # of its length: how much nearer to its anchor a drone comes in the end
AIRBORNE, LANDED, CRASHED = range(3)
_LANDED_WELL = ignore(LOAD_GROUND)
_AT_REST = 0.02  # [m/s]


class LandOptions(Section):
    """Ranges of the start and bounds of success."""

    pad_xy: Float = Field(1.0, ge=0, description="[m] pad's x and y within ± this; the team starts above the origin")
    pad_yaw: Float = Field(45.0, ge=0, le=180, description="[deg] heading of team and pad within ± this")
    start_height: Float = Field(1.5, gt=0, description="[m] of the payload at the start")
    pad_radius: Float = Field(0.1, gt=0, description="[m] payload on the pad: within this of its middle")
    touch_speed: Float = Field(0.3, gt=0, description="[m/s] largest speed of the payload when it touches the ground")
    clearance: Float = Field(
        0.3, gt=0, description="[m] drones from payload and ground; less for a span below a falcon's"
    )
    success_seconds: Float = Field(1.0, gt=0, description="[s] at rest, slack and clear throughout the last seconds")


class LandingLimits(NamedTuple):
    """What counts as down, in SI units."""

    radius: float
    speed: float
    clearance: float
    """Between the surfaces [m]."""
    drone_half: float
    """Largest extent of the largest drone from its centre [m]."""
    slack: np.ndarray
    """(N,) tension of a slack cable, at most: a chain's own weight [N]."""
    tension: np.ndarray
    """(N,) of the cables at rest, nominal [N]."""


class Land(Task):
    """Land and let go; see docs/land.md."""

    name: ClassVar[str] = "land"
    Options: ClassVar[type[Section]] = LandOptions
    options: LandOptions
    REWARD: ClassVar[dict[str, float]] = {
        "position": 0.4,
        "precision": 0.25,
        "attitude": 0.15,
        "level": 0.1,
        "stillness": 0.1,
        "ready": 0.5,
        "slack": 0.5,
        "action_rate": -0.05,
    }
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("time_to_touch", 1, "-", "s", "until the target is on the ground; negative afterwards"),
        Component("pull_share", 1, "-", "-", "share of the nominal pull that is fed forward"),
        Component("target_velocity", 3, "slot", "m/s", "velocity of the target"),
    )
    EXTRA_STATE: ClassVar[int] = 5
    SAVED: ClassVar[tuple[str, ...]] = ("course", "touch", "speed", "share")

    def __init__(self, config: Config, world: World, reference: Reference):
        super().__init__(config, world, reference)
        e, system, option = world.num_envs, world.system, self.options
        self._ground = make_ground(system)
        size, cable_weight = self._ground.size, self._ground.cable_weight
        half = max((drone_half_size(vehicle) for vehicle in system.vehicles), key=np.linalg.norm)
        self._down = LandingLimits(
            option.pad_radius, option.touch_speed, option.clearance * min(size, 1.0), float(np.linalg.norm(half)),
            cable_weight, system.resting_tension,
        )  # fmt: skip
        self.course, self.touch = np.zeros((e, 3)), np.zeros(e, np.int64)
        self.speed, self.share = np.zeros(e), np.zeros(e)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw the pad; the team hangs at rest above the origin. See `Task.start`."""
        option = self.options
        _start(
            env, rng, self.world.state, self.goal, self.rig, self.hanging, mass, option.pad_xy, radians(option.pad_yaw),
            self._ground.payload, option.start_height, self.course,
        )  # fmt: skip
        self.touch[env], self.speed[env], self.time[env] = AIRBORNE, 0.0, 0.0
        _plan(env, env + 1, 0.0, *self._planned())

    def planner(self, lo: int, hi: int) -> Callable[[], None]:
        """Fly to the pad, descend, settle, release, come lower; see `Task.planner`."""
        return bind(_plan, lo, hi, self.control_dt, *self._planned())

    def observe_extra(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None]:
        """Tell where in the plan the team is; see `Task.observer`."""
        return bind(_observe, lo, hi, self.time, self.share, self.goal, observation, critic)

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Pay for keeping the plan, as payload first and as slack drones later; see `Task.scorer`."""
        return bind(
            _score, lo, hi, self.world.state, self.goal, self.errors, self.course, self.share, self.limits, self._down,
            action, previous, self.weights, self.dt, self.terms, self.good_time,
        )  # fmt: skip

    def after_step(
        self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray, observation: np.ndarray, critic: np.ndarray
    ) -> list[Callable[[], None]]:
        """See who touches the ground before failures are looked for; see `Task.after_step`."""
        touching = (self.course, self.touch, self.speed, self.world.state, self.limits, self._down, self.watch)
        judge = bind(_touch_down, lo, hi, *touching)
        return [judge, *super().after_step(lo, hi, action, previous, observation, critic)]

    def succeeded(self) -> np.ndarray:
        """Touched down softly, and at rest, slack and clear throughout the last seconds."""
        return (self.touch == LANDED) & (self.good_time >= self.options.success_seconds - 1e-9)

    def _planned(self) -> tuple[Any, ...]:
        return (
            self.time, self.course, self.touch, self.speed, self.share, self.world.state, self.goal, self.rig,
            self._ground, self.limits, self._down, self.watch,
        )  # fmt: skip


@kernel
def _start(e, rng, state, goal, rig, hanging, mass, xy, yaw, low, high, way):
    put(way[e], (rng.uniform(-xy, xy), rng.uniform(-xy, xy), low - high))
    set_resting_goal(e, goal, (0.0, 0.0, high))
    putmat(goal.rotation[e], rot_z(rng.uniform(-yaw, yaw)))
    place_formation(e, goal, rig)
    still = (0.0, 0.0, 0.0)
    hang_team(e, state, goal, rig, hanging, mass, row(goal.position, e), matrow(goal.rotation, e), still, still)


@kernel
def _plan(lo, hi, dt, time, way, touch, speed, share, state, goal, rig, ground, limits, down, watch):
    """Move the goals of environments lo to hi on by `dt`, and see who touches the ground."""
    _touch_down(lo, hi, way, touch, speed, state, limits, down, watch)
    for e in range(lo, hi):
        time[e] += dt
        t, near = time[e], min(NEAR * ground.size, -way[e, 2])
        set_resting_goal(e, goal, (0.0, 0.0, ground.payload - way[e, 2]))
        move_goal(e, goal, (way[e, 0], way[e, 1], 0.0), ease(t, APPROACH[0], APPROACH[1]))
        move_goal(e, goal, (0.0, 0.0, way[e, 2] + near), ease(t, DESCEND[0], DESCEND[1]))
        move_goal(e, goal, (0.0, 0.0, -near), ease(t, SETTLE[0], SETTLE[1]))
        place_formation(e, goal, rig)
        share[e] = 1.0 - ease(t, RELEASE[0], RELEASE[1])[0]
        lower = ease(t, LOWER[0], LOWER[1])
        for n in range(rig.slots.shape[0]):
            chord = cable_chord(e, n, goal, rig)
            put(goal.slots[e, n], add(vec(goal.slots, e, n), scale(-SHORTER * lower[0], chord)))
            put(goal.slot_velocity[e, n], scale(-SHORTER * lower[1], chord))
            put(goal.slot_acceleration[e, n], scale(-SHORTER * lower[2], chord))
            share_force(e, n, goal, share[e], rig, ground.cable_weight[n])


@kernel
def _touch_down(lo, hi, way, touch, speed, state, limits, down, watch):
    """Judge payloads that touch the ground for the first time, by their speed now or a control step ago.

    The ground is no failure for one that has come down well.
    """
    for e in range(lo, hi):
        velocity = norm(row(state.payload_velocity, e))
        if touch[e] == AIRBORNE and load_height(e, state, limits) < TOUCH:
            soft = max(velocity, speed[e]) <= down.speed
            touch[e] = LANDED if soft and off_pad(e, way, state) <= down.radius else CRASHED
        speed[e] = velocity
        watch.ignored[e] = _LANDED_WELL if touch[e] == LANDED else 0


@kernel
def load_height(e, state, limits):
    """Return the height of the lowest point of the payload of environment e [m]."""
    return payload_height(row(state.payload_position, e), matrow(state.payload_rotation, e), limits)


@kernel
def off_pad(e, way, state):
    """Return the level distance of the payload of environment e from the middle of its pad [m]."""
    return hypot(state.payload_position[e, 0] - way[e, 0], state.payload_position[e, 1] - way[e, 1])


@kernel
def _drone_clear(e, n, state, limits, down):
    """Return whether drone n of environment e is clear of payload and ground."""
    drone = vec(state.drone_position, e, n)
    away = tmul(matrow(state.payload_rotation, e), sub(drone, row(state.payload_position, e)))
    center, half = limits.payload_center, limits.payload_half  # a cylinder counts as the box about it
    x = max(abs(away[0] - center[0]) - half[0], 0.0)
    y = max(abs(away[1] - center[1]) - half[1], 0.0)
    z = max(abs(away[2] - center[2]) - half[2], 0.0)
    return min(norm((x, y, z)), drone[2]) - down.drone_half >= down.clearance


@kernel
def _observe(lo, hi, time, share, goal, observation, critic):
    for e in range(lo, hi):
        c, s, velocity = cos(goal.yaw[e]), -sin(goal.yaw[e]), row(goal.velocity, e)
        _write_observation(critic[e, critic.shape[1] - 5 :], time[e], share[e], turn(c, s, velocity))
        for n in range(observation.shape[1]):
            cn, sn = goal.slot_frame[e, n, 0], -goal.slot_frame[e, n, 1]
            _write_observation(observation[e, n, observation.shape[2] - 5 :], time[e], share[e], turn(cn, sn, velocity))


@kernel
def _write_observation(out, time, share, velocity):
    out[0], out[1] = DOWN - time, share
    put(out[2:], velocity)


@kernel
def _score(
    lo, hi, state, goal, errors, way, share, limits, down, action, previous, weights, dt, terms, good_time
):  # fmt: skip
    for e in range(lo, hi):
        near = tolerance(errors.distance[e], 0.5)  # a payload that lies still elsewhere earns little
        pose_reward(e, state, goal, errors, share[e] * near, weights, terms)
        loose, good, count = 0.0, off_pad(e, way, state) <= down.radius, goal.slots.shape[1]
        for n in range(count):
            excess = max(state.cable_tension[e, n] - down.slack[n], 0.0)
            loose += tolerance(excess / down.tension[n], 0.1) / count
            good = good and excess == 0.0 and _drone_clear(e, n, state, limits, down)
        terms[e, 5] = weights[5] * (1.0 - share[e]) * mean_slot_tolerance(e, state, goal, 0.25)
        terms[e, 6] = weights[6] * (1.0 - share[e]) * loose
        terms[e, 7] = weights[7] * action_rate(e, action, previous)
        good = good and norm(row(state.payload_velocity, e)) <= _AT_REST and load_height(e, state, limits) < TOUCH
        good_time[e] = good_time[e] + dt if good else 0.0
