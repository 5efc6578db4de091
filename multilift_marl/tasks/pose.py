"""Pose: bring the payload to one pose after the other, tilted ones too."""

from __future__ import annotations

from math import ceil, radians, sqrt
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.config.config import Config
from multilift_marl.control.cable_forces import WrenchDistribution, make_wrench_distribution
from multilift_marl.control.formation import Goal
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import inlined, kernel
from multilift_marl.math3d import matmul, matrow, rotation_vector, row, sub, transpose
from multilift_marl.mdp.criteria import Criterion
from multilift_marl.mdp.initial_states import check_target_height, set_equilibrium
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import (
    RestBounds,
    Term,
    action_rate,
    attitude,
    closeness,
    distance,
    failure,
    formation,
    spin,
    stillness,
)
from multilift_marl.planning.targets import MAX_LEAP, Bounds, draw_plan, make_bounds
from multilift_marl.planning.trajectory import (
    Plan,
    advance_plan,
    hold_plan_pose,
    preview_plan,
    select_candidate,
    set_goal_from_plan,
    turn_team,
)
from multilift_marl.schema.validate import validate
from multilift_marl.schema.values import Float, Section, Shares
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.target_checks import check_way, warn_of_time


class PoseOptions(Section):
    """Ranges of the targets and bounds of success."""

    target_xy: Float = Field(1.0, ge=0, description="[m] target x and y within ± this")
    target_height: tuple[Float, Float] = Field((1.0, 2.0), description="[m] lowest and highest target")
    target_tilt: Float = Field(45.0, ge=0, lt=60, description="[deg] target roll and pitch within ± this")
    target_yaw: Float = Field(180.0, ge=0, le=180, description="[deg] target heading within ± this")
    target_share: Shares = Field(
        (1.0, 1.0), description="where targets lie on the way from the last pose, 0, to the one drawn, 1: uniform draw"
    )
    target_seconds: Float = Field(4.0, gt=0, description="[s] until the next target")
    way_seconds: Float = Field(3.0, gt=0, description="[s] that the planned trajectory to a target takes")
    plan: bool = Field(True, description="a trajectory to each target is planned and followed; false: the goal jumps")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of each target ...")
    success_angle: Float = Field(5.0, gt=0, description="[deg] ... and within this of its attitude ...")
    success_seconds: Float = Field(1.0, gt=0, description="[s] ... throughout its last seconds, or a shorter one's all")


class PoseArrays(NamedTuple):
    """What an episode holds beside its goal."""

    plan: Plan
    reached: np.ndarray
    """(E, K) bool, targets at which the payload was held."""


class PoseSettings(NamedTuple):
    """Constants of the task."""

    bounds: RestBounds
    holdable: Bounds
    success_seconds: float
    hold: float
    """How long each target stays [s]."""
    seconds: float
    """How long the trajectory to it takes [s]."""
    length: float
    """Of an episode [s]."""
    inertia: tuple[float, ...]
    """Of the payload in its frame, 9 numbers [kg m²]."""
    distribution: WrenchDistribution


@kernel
def start_at_first_pose(e, v, equilibrium):
    """Write a team at rest at the first pose of its plan; the next one is its goal."""
    plan, planned, still = v.own.plan, v.planned, (0.0, 0.0, 0.0)
    hold_plan_pose(e, 0, plan, planned, v.rig)
    set_equilibrium(e, v, planned, equilibrium, (row(planned.position, e), matrow(planned.rotation, e)), still, still)
    plan.stage[e] = 0
    set_goal_from_plan(e, 1, plan, v.goal, v.rig)  # last, since it shares the slot frames with the plan
    if not v.has_plan:
        for n in range(v.rig.slots.shape[0]):
            turn_team(e, n, plan.pose[e, 0, 3], v)


@inlined
def note_reached(e, v):
    """Note whether the payload was held at a target whose time is over."""
    settings, stage = v.settings, v.own.plan.stage[e]
    begin = stage * settings.hold
    end = min(begin + settings.hold, settings.length)
    # In the last policy step before the next target, which begins between two of them or, to round-off, with one.
    if v.time[e] > end - v.dt + 1e-6:
        v.own.reached[e, stage] = v.good_time[e] >= min(settings.success_seconds, end - begin) - 1e-9


@inlined
def planned_position(e, n, v):
    """Planned position minus target."""
    return sub(row(v.planned.position, e), row(v.goal.position, e))


@inlined
def planned_velocity(e, n, v):
    """Planned velocity."""
    return row(v.planned.velocity, e)


@inlined
def planned_rotation(e, n, v):
    """Rotation vector from target to planned attitude."""
    return rotation_vector(matmul(matrow(v.planned.rotation, e), transpose(matrow(v.goal.rotation, e))))


@inlined
def time_left(e, n, v):
    """Time until the next target, over the time that each one has."""
    return (v.own.plan.stage[e] + 1) - v.time[e] / v.settings.hold


def _components(frame: str) -> tuple[Component, ...]:
    return (
        Component("planned_position", 3, frame, "m", "present position of the plan minus target", planned_position),
        Component("planned_velocity", 3, frame, "m/s", "its velocity", planned_velocity),
        Component("planned_rotation", 3, frame, "rad", "rotation vector from target to its attitude", planned_rotation),
        Component("time_left", 1, "-", "-", "until the next target, over the time that each one has", time_left),
    )


class Pose(Task):
    """Bring the payload to poses that change; see docs/pose.md."""

    name: ClassVar[str] = "pose"
    Options: ClassVar[type[Section]] = PoseOptions
    options: PoseOptions
    own: PoseArrays
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.3, distance, 0.5, "m"),
        "precision": Term(0.25, distance, 0.02, "m"),
        "attitude": Term(0.2, attitude, 20.0, "deg"),
        "alignment": Term(0.15, attitude, 2.0, "deg"),
        "stillness": Term(0.1, stillness, (0.2, 0.3), "m/s, rad/s"),
        "formation": Term(0.0, formation, 0.3, "m"),
        "closeness": Term(0.0, closeness, (0.5, 0.3), "m"),
        "spin": Term(0.0, spin, 2.0, "rad/s"),
        "failure": Term(0.0, failure),
        "action_rate": Term(-0.05, action_rate),
    }
    KERNELS: ClassVar[Kernels] = Kernels(plan=advance_plan, update=note_reached)
    EXTRA: ClassVar[tuple[Component, ...]] = _components("slot")
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = _components("target")

    @classmethod
    def extra(cls, config: Config) -> tuple[Component, ...]:
        """See `Task.extra`; without a plan there is none to observe."""
        parts = super().extra(config)
        if validate(PoseOptions, config.task_options, "task_options").plan:
            return parts
        return tuple(part for part in parts if not part.name.startswith("planned"))

    def count_limits(self) -> dict[str, tuple[int, int]]:
        """Bound what kernels index by, see `Task`."""
        # `pose` has the start and K targets: the stage is from 0 to K - 1.
        return {"plan.stage": (0, self.own.plan.pose.shape[1] - 2)}

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, system, e, n = self.options, self.world.system, self.world.num_envs, self.world.num_drones
        if option.target_height[0] > option.target_height[1]:
            raise ConfigError(f"task_options.target_height={option.target_height} must list the lower one first")
        low, high = option.target_height
        check_target_height(f"task_options.target_height={option.target_height}", high, system)
        if option.way_seconds > option.target_seconds:
            raise ConfigError(
                f"task_options.way_seconds={option.way_seconds:g} must not exceed target_seconds="
                f"{option.target_seconds:g}: the plan would never arrive"
            )
        length = self.config.env.length
        hold = min(option.target_seconds, length)
        # The last target may have less time than the others; round-off must not add one that has none.
        targets = ceil(length / hold - 1e-9)
        self.own = PoseArrays(Plan.zeros(e, targets, n), np.zeros((e, targets), bool))
        if option.plan:
            # between places drawn uniformly, the root of the mean square
            spans = np.array([2 * option.target_xy, 2 * option.target_xy, high - low]) / sqrt(6)
            leap = min(option.target_share[1] * float(np.linalg.norm(spans)), MAX_LEAP)
            way = f"task_options.way_seconds={option.way_seconds:g} for {leap:.3g} m"
            check_way(way, "raise it", (leap, 0.0, 0.0), option.way_seconds, system)
            last = f"with task_options.way_seconds={option.way_seconds:g} the plan of task pose ends at"
            warn_of_time(last, (targets - 1) * hold + option.way_seconds, length)
            # Actions point as observations do.
            self.planned = Goal.zeros(e, n)._replace(slot_frame=self.goal.slot_frame)
        self.settings = PoseSettings(
            holdable=make_bounds(system, self.config.control, self.limits, self.config.randomization),
            bounds=RestBounds.of(option),
            success_seconds=option.success_seconds,
            hold=hold,
            seconds=option.way_seconds,
            length=length,
            inertia=system.inertia_matrix,
            distribution=make_wrench_distribution(self.rig.anchors),
        )

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw a level pose to start from and the targets; the team hangs there at rest; see `Task.start`."""
        option, tilt = self.options, radians(self.options.target_tilt)
        ranges = (option.target_xy, *option.target_height, radians(option.target_yaw), tilt, *option.target_share)
        if draw_plan(env, rng, self.view_for(draw_plan), ranges) < 0:
            raise ConfigError(
                "this team can hold hardly any of the poses of task pose; lower task_options.target_tilt, raise "
                "target_height or change the rig"
            )
        # Before the start is written: to compare candidates overwrites time, stage and planned pose.
        if self.options.plan:
            select_candidate(env, self.view_for(select_candidate))
        start_at_first_pose(env, self.view_for(start_at_first_pose), self.equilibrium)
        self.own.reached[env] = False

    def preview_targets(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the planned poses, without a plan the present target; see `Task.preview_targets`."""
        if not self.options.plan:
            return super().preview_targets(times)
        position, rotation = np.zeros((*times.shape, 3)), np.zeros((*times.shape, 3, 3))
        preview_plan(times, self.own.plan, self.settings.hold, self.settings.seconds, position, rotation)
        return position, rotation

    def succeeded(self) -> np.ndarray:
        """Within the success region throughout the last second of every target."""
        return np.asarray(self.own.reached.all(axis=1))

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        # Stated where `succeeded` is overridden, for `says_criteria` trusts no older ones: here they are the same.
        return super().criteria()

    def success_windows(self) -> tuple[tuple[float, float], ...]:
        """Return the last seconds of every target; see `Task.success_windows`."""
        option, hold, length = self.settings.success_seconds, self.settings.hold, self.settings.length
        times = [(k * hold, min((k + 1) * hold, length)) for k in range(self.own.reached.shape[1])]
        return tuple((end - min(option, end - begin), end) for begin, end in times)

    def in_error_window(self, time: float, length: float) -> bool:
        """Count the last second of every target."""
        settings = self.settings
        # Time since the present target began; at its very end it still is the present one, hence ceil - 1, not floor.
        gone = time - settings.hold * (ceil(time / settings.hold - 1e-9) - 1)
        return time > length - settings.success_seconds + 1e-9 or gone > settings.hold - settings.success_seconds + 1e-9
