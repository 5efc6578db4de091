"""Loss: one drone's motors stop for good, and the others hold the payload."""

from __future__ import annotations

from math import cos, radians, sin
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.gains import make_gains
from multilift_marl.control.redistribution import RAMP, WAIT, plan_offset, redistributed_slots
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import inlined
from multilift_marl.math3d import scale
from multilift_marl.mdp.criteria import CONDITION, Criterion, tension_criterion
from multilift_marl.mdp.initial_states import StartOptions, make_ranges, start_near_target
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import (
    RestBounds,
    Term,
    action_rate,
    attitude,
    distance,
    snatch,
    stillness,
    update_peak_tension,
)
from multilift_marl.schema.values import Between, Float, Section
from multilift_marl.sensing.loss_detection import LEAST_CHANGE, SETTLED, WINDOW, expect_changes, notice_loss
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.target_checks import warn_of_time


class LossOptions(StartOptions):
    """When a drone is lost, where the team starts, and what counts as success."""

    loss_time: tuple[Float, Float] = Field((2.0, 4.0), description="[s] earliest and latest stop of the motors")
    snap: bool = Field(False, description="whether the lost drone's cable breaks, so that it is gone")
    broadcast: bool = Field(True, description="whether all drones observe a loss at once; otherwise each detects it")
    noticed_angle: Annotated[Float, Between(1, 90, "deg")] = Field(
        25.0, description="[deg] tilt of the payload at which drones detect a loss without broadcast"
    )
    success_distance: Float = Field(0.10, gt=0, description="[m] payload within this of its target ...")
    success_angle: Float = Field(10.0, gt=0, description="[deg] ... and of its attitude, as level as can be held ...")
    success_speed: Float = Field(0.2, gt=0, description="[m/s] ... no faster than this ...")
    success_body_rate: Float = Field(0.5, gt=0, description="[rad/s] ... and turning no faster than this ...")
    success_seconds: Float = Field(2.0, gt=0, description="[s] ... throughout the last seconds, and ...")
    success_tension: Float = Field(
        20.0, gt=1,
        description="[-] no cable's tension at any time, mean of a physics step, over its resting tension; the lost "
        "drone's does not count",
    )  # fmt: skip


class LossArrays(NamedTuple):
    """Who is lost in an episode, and when."""

    when: np.ndarray
    """(E,) the motors stop [s]."""
    who: np.ndarray
    """(E,) number of the drone, int64."""
    peak_tension: np.ndarray
    """(E,) largest tension in the episode over that at rest [-]."""
    counted_tension: np.ndarray
    """(E,) the same, as the reward has counted it [-]."""
    known: np.ndarray
    """(E, N) bool, drones that know of the loss."""
    known_who: np.ndarray
    """(E, N) whom they take for lost, int64."""
    known_when: np.ndarray
    """(E, N) since when they know [s]."""
    unsure: np.ndarray
    """(E, N) bool, drones that do not know on which side it is yet."""
    noticed_at: np.ndarray
    """(E, N, 3) where they took the payload to be when they noticed it by their cables [m]."""
    past: np.ndarray
    """(E, N, K, 2) tension of their cables over that at rest [-] and climb of its end [m/s], in K past policy steps."""


class LossSettings(NamedTuple):
    """Constants of the task."""

    bounds: RestBounds
    tension: float
    """Largest tension of a success over that at rest [-]."""
    snap: bool
    """Whether the lost drone's cable breaks."""
    broadcast: bool
    by_cable: bool
    """Whether drones notice a loss by their own cables alone."""
    noticed_angle: float
    """[rad]"""
    changes: np.ndarray
    """(N lost, N, 2) of their cables when a drone is lost, see `expect_changes` [-], [m/s]."""
    offsets: np.ndarray
    """(N lost, N, 3) by how much slots are to move after a loss, see `redistributed_slots` [m]."""


@inlined
def stop_motors(e, v):
    """Stop the motors when their time has come."""
    who = v.own.who[e]
    if v.time[e] >= v.own.when[e] and not v.mask.lost[e, who]:
        v.mask.lost[e, who] = True
        v.disturbances.motors_off[e, who] = True
        if v.settings.snap:
            v.state.cable_broken[e, who] = True
    # Here, at every control step: a snatch is over within a policy step.
    update_peak_tension(e, v, v.own.peak_tension)


@inlined
def end_step(e, v):
    """Let drones know of a loss, and the next step count what tension it adds."""
    notice_loss(e, v)
    v.own.counted_tension[e] = v.own.peak_tension[e]


@inlined
def lost(e, n, v):
    """1 if the own motors have stopped."""
    return 1.0 if v.mask.lost[e, n] else 0.0


@inlined
def team_lost(e, n, v):
    """1 if those of any drone have."""
    return 1.0 if v.mask.lost[e, v.own.who[e]] else 0.0


@inlined
def knows_loss(e, n, v):
    """1 if one knows of a loss."""
    return 1.0 if v.own.known[e, n] else 0.0


@inlined
def lost_direction(e, n, v):
    """Cosine and sine of the lost drone's azimuth from the own one; 0 before, the sine also while it is unsure."""
    angle, known = v.rig.azimuth[v.own.known_who[e, n]] - v.rig.azimuth[n], knows_loss(e, n, v)
    # Drones that the own cable cannot tell apart are on either side of it: only the sine differs.
    return known * cos(angle), 0.0 if v.own.unsure[e, n] else known * sin(angle)


@inlined
def planned_offset(e, n, v):
    """By how much the own slot is to move after a loss, in its frame."""
    # Before a loss is known, drone 0 and any time are read; the factor 0 below takes that out.
    who, seconds = v.own.known_who[e, n], v.time[e] - v.own.known_when[e, n]
    cosine = cos(v.rig.azimuth[who] - v.rig.azimuth[n])
    offset = plan_offset(seconds, v.settings.offsets[who, n], cosine, not v.settings.snap)
    return scale(knows_loss(e, n, v), offset)


@inlined
def lost_azimuth(e, n, v):
    """Cosine and sine of the lost drone's azimuth; 0 before."""
    azimuth, any_lost = v.rig.azimuth[v.own.who[e]], team_lost(e, n, v)
    return any_lost * cos(azimuth), any_lost * sin(azimuth)


@inlined
def progress(e, n, v):
    """Time since the loss over that of the planned motion, at most 1."""
    return team_lost(e, n, v) * min((v.time[e] - v.own.when[e]) / (WAIT + RAMP), 1.0)


class Loss(Task):
    """Hold the payload with one drone less; see docs/loss.md."""

    name: ClassVar[str] = "loss"
    Options: ClassVar[type[Section]] = LossOptions
    options: LossOptions
    own: LossArrays
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.45, distance, 0.25, "m"),
        "precision": Term(0.25, distance, 0.03, "m"),
        "attitude": Term(0.15, attitude, 20.0, "deg"),
        "stillness": Term(0.15, stillness, (0.2, 0.3), "m/s, rad/s"),
        "snatch": Term(0.0, snatch),
        "action_rate": Term(-0.05, action_rate),
    }
    CAN_PLAN: ClassVar[bool] = False
    KERNELS: ClassVar[Kernels] = Kernels(plan=stop_motors, update=end_step)
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("lost", 1, "-", "-", "1 if the own motors have stopped", lost),
        Component("team_lost", 1, "-", "-", "1 if those of any drone have, as observed or detected", knows_loss),
        Component(
            "lost_direction", 2, "slot", "-", "cosine and sine of its azimuth from the own one; 0 before",
            lost_direction,
        ),
        Component(
            "planned_offset", 3, "slot", "m", "by how much the own slot is to move after a loss, by a plan",
            planned_offset, False,
        ),
    )  # fmt: skip
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = (
        Component("team_lost", 1, "-", "-", "1 if a drone's motors have stopped", team_lost),
        Component("lost_azimuth", 2, "-", "-", "cosine and sine of its azimuth; 0 before", lost_azimuth),
        Component("progress", 1, "-", "-", "of the planned motion", progress),
    )
    MIN_DRONES: ClassVar[int] = 2

    def count_limits(self) -> dict[str, tuple[int, int]]:
        """Bound what kernels index by, see `Task`."""
        return dict.fromkeys(("who", "known_who"), (0, self.world.num_drones - 1))

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, world, control = self.options, self.world, self.config.acting
        early, late = option.loss_time
        if not 0 <= early <= late:
            raise ConfigError(f"task_options.loss_time={option.loss_time} must list the earlier one first")
        until = f"with task_options.loss_time={option.loss_time}, every episode of task loss can succeed from"
        warn_of_time(until, late + option.success_seconds, self.config.env.episode_seconds)
        e, n, gains = world.num_envs, world.num_drones, make_gains(control, world.system)
        changes = expect_changes(world.system, gains.mass)
        by_cable = self._notice_by_cable(changes)
        self._ranges = make_ranges(option)
        # Or models are not brought into line with cables that the task breaks: these would go on pulling.
        world.breakable = world.breakable or option.snap
        offsets = redistributed_slots(world.system, gains, not option.snap, control.max_offset)
        self.own = LossArrays(
            np.zeros(e), np.zeros(e, np.int64), np.zeros(e), np.zeros(e), np.zeros((e, n), bool),
            np.zeros((e, n), np.int64), np.zeros((e, n)), np.zeros((e, n), bool), np.zeros((e, n, 3)),
            np.zeros((e, n, max(1, round(WINDOW / self.dt)), 2)),
        )  # fmt: skip
        self.settings = LossSettings(
            RestBounds.of(option),
            option.success_tension,
            option.snap,
            option.broadcast,
            by_cable,
            radians(option.noticed_angle),
            changes,
            offsets,
        )

    def _notice_by_cable(self, changes: np.ndarray) -> bool:
        """Return whether drones notice a loss by their own cables alone.

        Raises:
            ConfigError: they have to, but measure nothing of them, or would not feel each loss.
        """
        known, early = self.config.env, self.options.loss_time[0]
        if self.options.broadcast:
            return False
        if self.world.system.payload_shape == "point":
            raise ConfigError(
                "payload.shape=point does not tilt, by which drones notice a loss; set task_options.broadcast=true"
            )
        if known.sensing not in ("onboard", "blind") or known.communication != "none":
            return False
        why = ""
        if known.sensing == "onboard":
            # The diagonal is a drone's own loss, which it need not feel.
            felt = (np.linalg.norm(changes, axis=2) >= LEAST_CHANGE) | np.eye(len(changes), dtype=bool)
            if felt.all() and early >= SETTLED:
                return True
            if felt.all():
                raise ConfigError(
                    f"task_options.loss_time={self.options.loss_time} is too early for drones that notice a loss by "
                    f"their own cables, which swing for {SETTLED:g} s; raise it, or set task_options.broadcast=true"
                )
            why = f", and some of {len(changes)} drones would not feel it by their cables"
        raise ConfigError(
            f"env.sensing={known.sensing} does not show the payload's tilt, by which drones notice a loss{why}; set "
            "task_options.broadcast=true, or env.sensing=onboard and env.communication=neighbours or all"
        )

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw target, start, drone and time; see `Task.start`."""
        start_near_target(env, rng, self.view_for(start_near_target), self._ranges, self.equilibrium)
        self.own.who[env] = rng.integers(self.world.num_drones)
        self.own.when[env] = rng.uniform(*self.options.loss_time)
        self.mask.lost[env], self.own.peak_tension[env], self.own.counted_tension[env] = False, 0.0, 0.0
        self.own.known[env], self.own.known_who[env], self.own.known_when[env] = False, 0, 0.0
        self.own.unsure[env], self.own.past[env] = False, 0.0

    def succeeded(self) -> np.ndarray:
        """At rest throughout the last seconds, with a drone less, and never too large a tension."""
        # An episode that was over before the loss shows nothing.
        rested = super().succeeded() & self.mask.lost.any(axis=1)
        return rested & (self.own.peak_tension <= self.options.success_tension)

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        return (
            *super().criteria(),
            tension_criterion(self.own.peak_tension, self.options.success_tension),
            Criterion("drone_lost", CONDITION, lambda: np.asarray(~self.mask.lost.any(axis=1) * 1.0), throughout=False),
        )
