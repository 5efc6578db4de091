"""Take-off: lift the payload off the ground with cables that are slack at first, and hold it at a target pose."""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.values import Float, Section
from multilift_marl.control.formation import Reference, place_formation
from multilift_marl.math3d import add, clip, ease, matrow, put, putmat, rot_z, row, scale, sub, vec
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.failures import BELOW, CABLE, GROUND, LOAD_GROUND, ignore, payload_height
from multilift_marl.tasks.ground import (
    cable_chord,
    cable_rise,
    make_ground,
    mean_slot_tolerance,
    move_goal,
    set_resting_goal,
    share_force,
    stand_team,
    standing_distance,
)
from multilift_marl.tasks.observations import Component
from multilift_marl.tasks.rewards import action_rate, pose_reward, tolerance

RISE, TIGHTEN, PULL, LIFT = (0.1, 1.6), (1.7, 1.2), (2.9, 1.2), (4.1, 2.5)  # begin and length of each phase [s]
ARRIVED = LIFT[0] + LIFT[1]  # [s] from when on the target stays
SLACK, TAUT = 0.006, 0.002  # of a cable's length: short of taut after the rise, beyond taut before the pull
STANDING, FLYING, LIFTED = range(3)
FORGIVEN = (ignore(GROUND, LOAD_GROUND, BELOW, CABLE), ignore(LOAD_GROUND, CABLE), 0)
_HALF_WAY = 0.5  # of the formation's height: every drone that far above its anchor, and the team counts as flying
_LIFTED = 0.02  # [m] of the payload's lowest point above the ground, for the span of a falcon
_HARMLESS = 1.5  # times the resting tension that costs nothing


class TakeoffOptions(Section):
    """Ranges of the start and bounds of success."""

    place_xy: Float = Field(1.0, ge=0, description="[m] payload's x and y within ± this")
    target_yaw: Float = Field(45.0, ge=0, le=180, description="[deg] heading of payload and target within ± this")
    target_height: Float = Field(1.5, gt=0, description="[m] of the payload at the end")
    start_spread: Float = Field(0.1, ge=0, description="[-] drones' places about their slots', in lengths of a cable")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of its final target ...")
    success_angle: Float = Field(5.0, gt=0, description="[deg] ... and within this of its attitude ...")
    success_seconds: Float = Field(2.0, gt=0, description="[s] ... throughout the last seconds")
    success_tension: Float = Field(2.0, gt=1, description="[-] largest tension at any time, over the resting tension")


class Takeoff(Task):
    """Lift off and hold; see docs/takeoff.md."""

    name: ClassVar[str] = "takeoff"
    Options: ClassVar[type[Section]] = TakeoffOptions
    options: TakeoffOptions
    REWARD: ClassVar[dict[str, float]] = {
        "position": 0.4,
        "precision": 0.25,
        "attitude": 0.15,
        "level": 0.1,
        "stillness": 0.1,
        "ready": 1.0,
        "snatch": -0.5,
        "action_rate": -0.05,
    }
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("time_to_lift", 1, "-", "s", "until the target leaves the ground; negative afterwards, at least -4"),
        Component("pull_share", 1, "-", "-", "share of the nominal pull that is fed forward"),
        Component("climb_rate", 1, "world", "m/s", "vertical velocity of the target"),
    )
    EXTRA_STATE: ClassVar[int] = 3
    SAVED: ClassVar[tuple[str, ...]] = ("place", "stand", "stage", "share", "peak")

    def __init__(self, config: Config, world: World, reference: Reference):
        super().__init__(config, world, reference)
        e, n, system, option = world.num_envs, world.num_drones, world.system, self.options
        self._ground, self._spread = make_ground(system), option.start_spread * float(system.cable_length.min())
        self._distance = standing_distance(system, self._spread)
        self._climb = option.target_height - self._ground.payload
        self._static, self._mass = system.resting_tension, system.payload_mass
        self.place, self.stand = np.zeros((e, 3)), np.zeros((e, n, 3))
        self.stage, self.share, self.peak = np.zeros(e, np.int64), np.zeros(e), np.zeros(e)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw where the payload and the drones stand; see `Task.start`."""
        option, state = self.options, self.world.state
        _start(
            env, rng, state, self.goal, self.rig, self._ground, option.place_xy, radians(option.target_yaw),
            self._distance, self._spread,
        )  # fmt: skip
        self.place[env], self.stand[env] = self.goal.position[env], state.drone_position[env]
        self.stage[env], self.share[env], self.peak[env] = STANDING, 0.0, 0.0
        self.watch.ignored[env] = FORGIVEN[STANDING]
        self.time[env] = 0.0
        _plan(env, env + 1, 0.0, *self._planned())

    def planner(self, lo: int, hi: int) -> Callable[[], None]:
        """Raise drones, tighten cables, pull, lift; see `Task.planner`."""
        return bind(_plan, lo, hi, self.control_dt, *self._planned())

    def observe_extra(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None]:
        """Tell where in the plan the team is; see `Task.observer`."""
        return bind(_observe, lo, hi, self.time, self.share, self.goal, observation, critic)

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Pay for keeping the plan, as drones first and as payload later; see `Task.scorer`."""
        success = (self.options.success_distance, radians(self.options.success_angle))
        return bind(
            _score, lo, hi, self.world.state, self.goal, self.errors, self.time, self.share, self.peak, action,
            previous, self.weights, success, self.dt, self.terms, self.good_time,
        )  # fmt: skip

    def succeeded(self) -> np.ndarray:
        """At the final target throughout the last seconds, and never too large a tension."""
        static = self._static.max() * self.world.hidden_loads.payload_mass / self._mass
        gentle = self.world.stats.tension_max <= self.options.success_tension * static
        return gentle & (self.good_time >= self.options.success_seconds - 1e-9)

    def _planned(self) -> tuple[Any, ...]:
        return (
            self.time, self.place, self.stand, self.stage, self.share, self.peak, self.world.state, self.goal,
            self.rig, self._ground, self.limits, self._climb, self._static, self.watch,
        )  # fmt: skip


@kernel
def _start(e, rng, state, goal, rig, ground, xy, yaw, distance, spread):
    set_resting_goal(e, goal, (rng.uniform(-xy, xy), rng.uniform(-xy, xy), ground.payload))
    putmat(goal.rotation[e], rot_z(rng.uniform(-yaw, yaw)))
    place_formation(e, goal, rig)
    stand_team(e, rng, state, goal, rig, ground, distance, spread)


@kernel
def _plan(lo, hi, dt, time, place, stand, stage, share, peak, state, goal, rig, ground, limits, climb, static, watch):
    """Move the goals of environments lo to hi on by `dt`, and see who has left the ground."""
    for e in range(lo, hi):
        time[e] += dt
        t = time[e]
        set_resting_goal(e, goal, row(place, e))
        move_goal(e, goal, (0.0, 0.0, climb), ease(t, LIFT[0], LIFT[1]))
        place_formation(e, goal, rig)
        cable_force, risen, tight = (
            ease(t, PULL[0], PULL[1]),
            ease(t, RISE[0], RISE[1]),
            ease(t, TIGHTEN[0], TIGHTEN[1]),
        )
        share[e] = cable_force[0]
        for n in range(rig.slots.shape[0]):
            chord = cable_chord(e, n, goal, rig)
            reach = -SLACK + (SLACK + TAUT) * tight[0] - TAUT * cable_force[0]
            slot = add(vec(goal.slots, e, n), scale(reach, chord))
            under = sub(vec(stand, e, n), add(vec(goal.slots, e, n), scale(-SLACK, chord)))
            put(goal.slots[e, n], add(slot, _way(under, 1.0 - risen[0] ** 2, 1.0 - risen[0])))
            put(goal.slot_velocity[e, n], _way(under, -2.0 * risen[0] * risen[1], -risen[1]))
            curved = risen[1] ** 2 + risen[0] * risen[2]
            put(goal.slot_acceleration[e, n], _way(under, -2.0 * curved, -risen[2]))
            share_force(e, n, goal, share[e], rig, ground.cable_weight[n])
            peak[e] = max(peak[e], state.cable_tension[e, n] / static[n])
        stage[e] = _stage(e, stage[e], state, rig, limits, ground.size)
        watch.ignored[e] = FORGIVEN[stage[e]]


@kernel
def _way(way, level, up):
    """Return a vector, its level part and its height scaled."""
    return (level * way[0], level * way[1], up * way[2])


@kernel
def _stage(e, stage, state, rig, limits, size):
    """Return how far off the ground a team is that was at `stage`."""
    payload, attitude = row(state.payload_position, e), matrow(state.payload_rotation, e)
    if stage == STANDING:
        for n in range(rig.slots.shape[0]):
            if cable_rise(e, n, state, rig) < _HALF_WAY * (rig.slots[n, 2] - rig.anchors[n, 2]):
                return STANDING
        return FLYING
    if stage == FLYING and payload_height(payload, attitude, limits) > _LIFTED * size:
        return LIFTED
    return stage


@kernel
def _observe(lo, hi, time, share, goal, observation, critic):
    for e in range(lo, hi):
        told = (max(LIFT[0] - time[e], -4.0), share[e], goal.velocity[e, 2])
        put(critic[e, critic.shape[1] - 3 :], told)
        for n in range(observation.shape[1]):
            put(observation[e, n, observation.shape[2] - 3 :], told)


@kernel
def _score(
    lo, hi, state, goal, errors, time, share, peak, action, previous, weights, success, dt, terms, good_time
):  # fmt: skip
    for e in range(lo, hi):
        near = tolerance(errors.distance[e], 0.5)  # a payload that lies still elsewhere earns little
        pose_reward(e, state, goal, errors, share[e] * near, weights, terms)
        terms[e, 5] = weights[5] * (1.0 - share[e]) * mean_slot_tolerance(e, state, goal, 0.1)
        terms[e, 6] = weights[6] * clip(peak[e] - _HARMLESS, 0.0, 1.0)
        terms[e, 7] = weights[7] * action_rate(e, action, previous)
        peak[e] = 0.0
        good = time[e] >= ARRIVED and errors.distance[e] <= success[0] and errors.angle[e] <= success[1]
        good_time[e] = good_time[e] + dt if good else 0.0
