"""Regroup: drones leave and join a payload that nobody has weighed, unannounced, and it is to stay in place."""

from __future__ import annotations

from math import cos, sin
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.formation import place_formation
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import inlined
from multilift_marl.math3d import add, clip, mat, matrow, mul, norm, put, row, scale, sub, vec
from multilift_marl.mdp.criteria import CONDITION, Criterion, tension_criterion
from multilift_marl.mdp.failures import BROKEN, ignore
from multilift_marl.mdp.initial_states import StartOptions, make_ranges, start_near_target
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import (
    RestBounds,
    Term,
    action_rate,
    attitude,
    distance,
    stillness,
    update_peak_tension,
)
from multilift_marl.schema.values import Between, Float, Section
from multilift_marl.sim.state import hover_drone
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.target_checks import warn_of_time

SLACK = 0.08  # [-] of its cable's length, by which a drone that waits to join is below its slot
TAKE_UP = 2.0  # [s] in which the slot of a drone that has joined rises, and the drone takes its share of the load


class RegroupOptions(StartOptions):
    """When the team changes, where it starts, and what counts as success."""

    start_radius: Float = Field(0.2, ge=0, description="[m] start within a ball of this radius about the target")
    start_tilt: Float = Field(5.0, ge=0, le=90, description="[deg] largest tilt of the payload at the start")
    start_speed: Float = Field(0.1, ge=0, description="[m/s] largest speed of the team at the start")
    absent: Annotated[Float, Between(0, 1, "-")] = Field(
        0.5, description="[-] probability that a drone is not attached at the start"
    )
    events: tuple[Float, ...] = Field(
        (4.0, 8.0), description="[s] from when on the team changes: a drone leaves, or the one that is absent joins"
    )
    event_spread: Float = Field(0.5, ge=0, description="[s] by which each of these is later, at most")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of its target ...")
    success_angle: Float = Field(5.0, gt=0, description="[deg] ... and of its attitude ...")
    success_speed: Float = Field(0.2, gt=0, description="[m/s] ... no faster than this ...")
    success_body_rate: Float = Field(0.5, gt=0, description="[rad/s] ... and turning no faster than this ...")
    success_seconds: Float = Field(
        1.0, gt=0, description="[s] ... throughout the seconds before each event and the last seconds, and ..."
    )
    success_tension: Float = Field(
        20.0, gt=1, description="[-] no cable's tension at any time, mean of a physics step, over its resting tension"
    )


class RegroupArrays(NamedTuple):
    """Who leaves and joins in an episode, and when."""

    when: np.ndarray
    """(E, K) of each event [s]."""
    who: np.ndarray
    """(E, K) number of the drone, int64."""
    joins: np.ndarray
    """(E, K) bool, whether it joins."""
    attached: np.ndarray
    """(E, N) bool, whose cables are attached."""
    waiting: np.ndarray
    """(E, N) bool, drones that are to join as soon as they reach their cables."""
    slack: np.ndarray
    """(E, N) by how much slots are lowered [m]."""
    event: np.ndarray
    """(E,) number of the next one, int64."""
    held: np.ndarray
    """(E, K) bool, whether the payload was held before each event."""
    peak_tension: np.ndarray
    """(E,) largest tension in the episode over that at rest [-]."""


class RegroupSettings(NamedTuple):
    """Constants of the task."""

    bounds: RestBounds
    seconds: float
    """[s] that the payload is to be held before an event."""
    lowered: np.ndarray
    """(N,) by how much the slots of drones that are not attached are lowered [m]."""


@inlined
def change_team(e, v):
    """Let drones leave and join when their time has come; lower the slots of those that wait."""
    own, goal, state = v.own, v.goal, v.state
    event = own.event[e]
    # One at a time is away: nobody leaves while another one waits to join.
    alone = True
    for n in range(own.waiting.shape[1]):
        alone = alone and not own.waiting[e, n]
    if event < own.when.shape[1] and v.time[e] >= own.when[e, event] and (alone or own.joins[e, event]):
        who = own.who[e, event]
        # The time is a sum of steps, whose round-off must not decide.
        own.held[e, event] = v.good_time[e] >= v.settings.seconds - 1e-9
        own.waiting[e, who] = own.joins[e, event]
        own.attached[e, who] = False  # who is to join is not attached either
        own.event[e] = event + 1
    place_formation(e, goal, v.rig)
    payload, turned = row(state.payload_position, e), matrow(state.payload_rotation, e)
    for n in range(own.attached.shape[1]):
        if own.waiting[e, n]:
            anchor = add(payload, mul(turned, row(v.rig.anchors, n)))
            hook = add(vec(state.drone_position, e, n), mul(mat(state.drone_rotation, e, n), row(v.rig.hooks, n)))
            # A cable that does not reach the hook cannot be attached.
            if norm(sub(hook, anchor)) <= v.parameters.cable_length[e, n]:
                own.waiting[e, n], own.attached[e, n] = False, True
        state.cable_broken[e, n] = not own.attached[e, n]
        # The slot sinks and rises at a steady speed; the drone knows whether it carries.
        lowered = v.settings.lowered[n]
        aim, step = 0.0 if own.attached[e, n] else lowered, lowered / TAKE_UP * v.control_dt
        change = clip(aim - own.slack[e, n], -step, step)
        own.slack[e, n] += change
        goal.slots[e, n, 2] -= own.slack[e, n]
        goal.slot_velocity[e, n, 2] = -change / v.control_dt
        # What is fed forward comes and goes with the slot.
        put(goal.cable_force[e, n], scale(1.0 - own.slack[e, n] / lowered, vec(goal.cable_force, e, n)))
    update_peak_tension(e, v, own.peak_tension)


@inlined
def attached(e, n, v):
    """1 if the own cable is attached."""
    return 1.0 if v.own.attached[e, n] else 0.0


@inlined
def absent_azimuth(e, n, v):
    """Cosine and sine of the azimuth of the drone that is not attached; 0 if all are."""
    c, s = 0.0, 0.0
    for m in range(v.own.attached.shape[1]):
        if not v.own.attached[e, m]:
            c, s = cos(v.rig.azimuth[m]), sin(v.rig.azimuth[m])
    return c, s


class Regroup(Task):
    """Hold a payload of unknown mass and centre of mass while drones leave and join; see docs/regroup.md."""

    name: ClassVar[str] = "regroup"
    Options: ClassVar[type[Section]] = RegroupOptions
    options: RegroupOptions
    own: RegroupArrays
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.4, distance, 0.25, "m"),
        "precision": Term(0.25, distance, 0.03, "m"),
        "attitude": Term(0.1, attitude, 20.0, "deg"),
        "level": Term(0.15, attitude, 3.0, "deg"),
        "stillness": Term(0.1, stillness, (0.2, 0.3), "m/s, rad/s"),
        "action_rate": Term(-0.05, action_rate),
    }
    CAN_PLAN: ClassVar[bool] = False
    CHAINS: ClassVar[bool] = False  # whose free end a drone would have to fetch
    KERNELS: ClassVar[Kernels] = Kernels(plan=change_team)
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("attached", 1, "-", "-", "1 if the own cable is attached", attached),
    )
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = (
        Component("absent_azimuth", 2, "-", "-", "cosine and sine of that of the absent drone, 0 if none is",
                  absent_azimuth),
    )  # fmt: skip
    MIN_DRONES: ClassVar[int] = 3  # one alone cannot hold a payload level

    def count_limits(self) -> dict[str, tuple[int, int]]:
        """Bound what kernels index by, see `Task`."""
        return {"who": (0, self.world.num_drones - 1), "event": (0, len(self.options.events))}

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, world, e, n = self.options, self.world, self.world.num_envs, self.world.num_drones
        times = (*option.events, np.inf)
        if option.events and (option.events[0] < 0 or min(np.diff(times)) <= option.event_spread):
            raise ConfigError(
                f"task_options.events={option.events} must rise by more than task_options.event_spread="
                f"{option.event_spread:g} from one to the next"
            )
        if option.events and option.events[0] < option.success_seconds:
            raise ConfigError(
                f"task_options.events={option.events} must leave task_options.success_seconds="
                f"{option.success_seconds:g} before the first"
            )
        if option.events:
            until = f"with task_options.events={option.events}, every episode of task regroup can succeed from"
            end = option.events[-1] + option.event_spread + option.success_seconds
            warn_of_time(until, end, self.config.env.episode_seconds)
        if self.config.cable.breaking_load is not None:
            raise ConfigError("cables of task regroup do not break; leave cable.breaking_load out")
        self._ranges = make_ranges(option)
        world.breakable = True
        shape = (e, len(option.events))
        self.own = RegroupArrays(
            np.zeros(shape), np.zeros(shape, np.int64), np.zeros(shape, bool), np.ones((e, n), bool),
            np.zeros((e, n), bool), np.zeros((e, n)), np.zeros(e, np.int64), np.zeros(shape, bool), np.zeros(e),
        )  # fmt: skip
        self.mask.ignored[:] = ignore(BROKEN)
        self.settings = RegroupSettings(
            RestBounds.of(option), option.success_seconds, SLACK * world.system.cable_length
        )

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw target, start and events; see `Task.start`."""
        start_near_target(env, rng, self.view_for(start_near_target), self._ranges, self.equilibrium)
        self.world.state.cable_broken[env], self.goal.slot_velocity[env] = False, 0.0  # of a draw, an episode before
        option, own, n = self.options, self.own, self.world.num_drones
        own.attached[env], own.waiting[env], own.slack[env] = True, False, 0.0
        own.event[env], own.held[env], own.peak_tension[env] = 0, False, 0.0
        absent = int(rng.integers(n)) if rng.random() < option.absent else None
        if absent is not None:
            self._detach(env, absent)
        # After one drone has left, the next event is that it may join again, which it does once it reaches its cable.
        for k, earliest in enumerate(option.events):
            own.when[env, k] = earliest + rng.uniform(0.0, option.event_spread)
            own.joins[env, k] = absent is not None
            own.who[env, k] = rng.integers(n) if absent is None else absent
            absent = int(own.who[env, k]) if absent is None else None

    def begin(self, env: int) -> bool:
        """See `Task.begin`; who is absent is drawn, and with it who joins: a given state cannot say otherwise."""
        if (self.world.state.cable_broken[env] == self.own.attached[env]).any():
            raise ValueError(
                f"the given state of environment {env} has cable_broken={self.world.state.cable_broken[env].tolist()}, "
                f"but its draw has {(~self.own.attached[env]).tolist()}; leave it out: who is absent is drawn, with "
                "the probability task_options.absent"
            )
        return super().begin(env)

    def _detach(self, env: int, n: int) -> None:
        """Let drone n start without its cable, a little nearer to its anchor."""
        state, rig = self.world.state, self.rig
        self.own.attached[env, n], self.own.slack[env, n] = False, self.settings.lowered[n]
        state.cable_broken[env, n] = True
        anchor = state.payload_position[env] + state.payload_rotation[env] @ rig.anchors[n]
        place = anchor + (1 - SLACK) * (state.drone_position[env, n] - anchor)
        hover_drone(env, n, state, (0.0, 0.0, 0.0), self.goal.drone_yaw[env] + rig.heading[n], self.equilibrium)
        state.drone_position[env, n] = place
        self.goal.slots[env, n, 2] -= self.own.slack[env, n]
        self.goal.cable_force[env, n] = 0.0

    def succeeded(self) -> np.ndarray:
        """At rest before each event and throughout the last seconds, all joined, and never too large a tension."""
        own, option = self.own, self.options
        held = super().succeeded() & own.held.all(axis=1)
        return held & self._changed() & (own.peak_tension <= option.success_tension)

    def _changed(self) -> np.ndarray:
        """Return in which environments (E,) all events are over and nobody waits to join."""
        return np.asarray((self.own.event == len(self.options.events)) & ~self.own.waiting.any(axis=1))

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        own = self.own
        return (
            *super().criteria(),
            tension_criterion(own.peak_tension, self.options.success_tension),
            Criterion(
                "held_before_events", CONDITION, lambda: np.asarray(1.0 * ~own.held.all(axis=1)), throughout=False
            ),
            Criterion("events_done", CONDITION, lambda: np.where(self._changed(), 0.0, 1.0), False),
        )
