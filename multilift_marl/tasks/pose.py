"""Pose: bring the payload to one pose after the other, tilted ones too."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, cos, radians, sin
from typing import ClassVar

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.values import Float, Section
from multilift_marl.control.cable_forces import make_wrench_distribution
from multilift_marl.control.formation import Goal, Reference
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import matmul, matrow, norm, put, rotation_vector, row, sub, transpose, turn
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.observations import Component
from multilift_marl.tasks.rewards import action_rate, tolerance
from multilift_marl.tasks.starts import hang_team
from multilift_marl.tasks.targets import draw_plan, make_bounds
from multilift_marl.tasks.trajectory import Plan, advance_plan, hold_plan_pose, select_candidate, set_goal_from_plan


class PoseOptions(Section):
    """Ranges of the targets and bounds of success."""

    target_xy: Float = Field(1.0, ge=0, description="[m] target x and y within ± this")
    target_height: tuple[Float, Float] = Field((1.0, 2.0), description="[m] lowest and highest target")
    target_tilt: Float = Field(45.0, ge=0, lt=60, description="[deg] target roll and pitch within ± this")
    target_yaw: Float = Field(180.0, ge=0, le=180, description="[deg] target heading within ± this")
    target_seconds: Float = Field(4.0, gt=0, description="[s] until the next target")
    way_seconds: Float = Field(3.0, gt=0, description="[s] that the planned way to a target takes")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of each target ...")
    success_angle: Float = Field(5.0, gt=0, description="[deg] ... and within this of its attitude ...")
    success_seconds: Float = Field(1.0, gt=0, description="[s] ... throughout its last seconds, or a shorter one's all")


class Pose(Task):
    """Bring the payload to poses that change; see docs/pose.md."""

    name: ClassVar[str] = "pose"
    Options: ClassVar[type[Section]] = PoseOptions
    options: PoseOptions
    REWARD: ClassVar[dict[str, float]] = {
        "position": 0.3,
        "precision": 0.25,
        "attitude": 0.2,
        "alignment": 0.15,
        "stillness": 0.1,
        "action_rate": -0.05,
    }
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("planned_position", 3, "slot", "m", "the planned way's present position minus target"),
        Component("planned_velocity", 3, "slot", "m/s", "the way's velocity"),
        Component("planned_rotation", 3, "slot", "rad", "rotation vector from target to the way's attitude"),
        Component("time_left", 1, "-", "-", "until the next target, over the time that each one has"),
    )
    EXTRA_STATE: ClassVar[int] = 10
    SAVED: ClassVar[tuple[str, ...]] = ("reached", "_pose", "_pull", "_course", "_stage")

    def __init__(self, config: Config, world: World, reference: Reference):
        super().__init__(config, world, reference)
        option, system, e = self.options, world.system, world.num_envs
        if option.target_height[0] > option.target_height[1]:
            raise ConfigError(f"task_options.target_height={option.target_height} must list the lower one first")
        if option.way_seconds > option.target_seconds:
            raise ConfigError(
                f"task_options.way_seconds={option.way_seconds:g} must not exceed target_seconds="
                f"{option.target_seconds:g}: the way would never end"
            )
        self._length, self._hold = config.env.episode_seconds, min(option.target_seconds, config.env.episode_seconds)
        self.targets = ceil(self._length / self._hold - 1e-9)
        self.reached = np.zeros((e, self.targets), bool)
        self.plan = Plan.zeros(e, self.targets, world.num_drones)
        self._pose, self._pull, self._course, self._stage = self.plan
        planned = Goal.zeros(e, world.num_drones)
        self.planned = planned._replace(slot_frame=self.goal.slot_frame)  # actions point as the observations do
        self._balance = make_wrench_distribution(self.rig.anchors)
        self._bounds = make_bounds(system, config.control, self.limits, 1 + config.randomization.payload_mass)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw a level pose to start from and the targets; the team hangs there at rest; see `Task.start`."""
        option, tilt = self.options, radians(self.options.target_tilt)
        ranges = (option.target_xy, *option.target_height, radians(option.target_yaw), tilt)
        drawn = draw_plan(env, rng, ranges, self.plan, self.goal, self.rig, self.nominal_hanging, self._bounds)
        if drawn < 0:
            raise ConfigError(
                "this team can hold hardly any of the poses of task pose; lower task_options.target_tilt, raise "
                "target_height or change the rig"
            )
        planned, inertia, nominal = self.planned, self.world.system.inertia_matrix, self.nominal_hanging
        known = inertia, self._balance, self._hold, option.way_seconds, self._bounds
        select_candidate(env, self.time, self.plan, planned, self.rig, nominal, *known)
        _start(env, self.world.state, self.plan, self.goal, planned, self.rig, nominal, self.hanging, mass)
        self.reached[env] = False

    def planner(self, lo: int, hi: int) -> Callable[[], None]:
        """Lead the way to each target in turn; see `Task.planner`."""
        inertia, attitude = self.world.system.inertia_matrix, self.world.state.payload_rotation
        return bind(
            advance_plan, lo, hi, self.time, self.control_dt, self.plan, self.goal, self.planned, self.rig,
            self.hanging, inertia, self._balance, attitude, self._hold, self.options.way_seconds,
        )  # fmt: skip

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Pay for closeness, attitude and stillness; note which targets were reached; see `Task.scorer`."""
        option = self.options
        success = (option.success_distance, radians(option.success_angle), option.success_seconds)
        clock = (self.dt, self._hold, self._length)
        return bind(
            _score, lo, hi, self.world.state, self.errors, action, previous, self.weights, success, clock, self.time,
            self.plan, self.terms, self.good_time, self.reached,
        )  # fmt: skip

    def succeeded(self) -> np.ndarray:
        """Within the success region throughout the last second of every target."""
        return np.asarray(self.reached.all(axis=1))

    def in_error_window(self, time: float, length: float) -> bool:
        """Count the last second of every target."""
        gone = time - self._hold * (ceil(time / self._hold - 1e-9) - 1)
        return (
            time > length - self.options.success_seconds + 1e-9
            or gone > self._hold - self.options.success_seconds + 1e-9
        )

    def observe_extra(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None]:
        """Tell where the way is; see `Task.observer`."""
        return bind(_observe, lo, hi, self.goal, self.planned, self.time, self.plan, self._hold, observation, critic)


@kernel
def _start(e, state, plan, goal, planned, rig, nominal, hanging, mass):
    hold_plan_pose(e, 0, plan, planned, rig, nominal)
    still = (0.0, 0.0, 0.0)
    hang_team(
        e, state, planned, rig, hanging, mass, row(planned.position, e), matrow(planned.rotation, e), still, still
    )
    plan.stage[e] = 0
    set_goal_from_plan(e, 1, plan, goal, rig, nominal)  # last, since it shares the slot frames with the way


@kernel
def _score(lo, hi, state, errors, action, previous, weights, success, clock, time, plan, terms, good_time, reached):
    dt, hold, length = clock
    for e in range(lo, hi):
        distance, angle = errors.distance[e], errors.angle[e]
        speed, spin = norm(row(state.payload_velocity, e)), norm(row(state.payload_body_rates, e))
        terms[e, 0] = weights[0] * tolerance(distance, 0.5)
        terms[e, 1] = weights[1] * tolerance(distance, 0.02)
        terms[e, 2] = weights[2] * tolerance(angle, radians(20.0))
        terms[e, 3] = weights[3] * tolerance(angle, radians(2.0))
        terms[e, 4] = weights[4] * tolerance(speed, 0.2) * tolerance(spin, 0.3)
        terms[e, 5] = weights[5] * action_rate(e, action, previous)
        good = distance <= success[0] and angle <= success[1]
        good_time[e] = good_time[e] + dt if good else 0.0
        begun = plan.stage[e] * hold
        ends = min(begun + hold, length)
        if time[e] > ends - 0.5 * dt:
            reached[e, plan.stage[e]] = good_time[e] >= min(success[2], ends - begun) - 1e-9


@kernel
def _observe(lo, hi, goal, planned, time, plan, hold, observation, critic):
    size, state = observation.shape[2], critic.shape[1]
    for e in range(lo, hi):
        ahead, velocity = sub(row(planned.position, e), row(goal.position, e)), row(planned.velocity, e)
        twisted = rotation_vector(matmul(matrow(planned.rotation, e), transpose(matrow(goal.rotation, e))))
        left = (plan.stage[e] + 1) - time[e] / hold
        for n in range(observation.shape[1]):
            c, s = goal.slot_frame[e, n, 0], -goal.slot_frame[e, n, 1]  # world to slot frame
            _write_observation(observation[e, n, size - 10 :], c, s, ahead, velocity, twisted, left)
        _write_observation(critic[e, state - 10 :], cos(goal.yaw[e]), -sin(goal.yaw[e]), ahead, velocity, twisted, left)


@kernel
def _write_observation(out, c, s, ahead, velocity, twisted, left):
    put(out[0:3], turn(c, s, ahead))
    put(out[3:6], turn(c, s, velocity))
    put(out[6:9], turn(c, s, twisted))
    out[9] = left
