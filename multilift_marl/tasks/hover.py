"""Hover: hold the payload at a target pose, whatever its mass and whatever pushes it."""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import ClassVar

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.schema import Config, Float, Section
from multilift_marl.control.formation import Reference
from multilift_marl.errors import ConfigError
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.starts import StartRanges, start_near_target
from multilift_marl.tasks.terms import mean_change, pay_pose


class HoverOptions(Section):
    """Ranges of the start and bounds of success."""

    target_xy: Float = Field(1.0, ge=0, description="[m] target x and y within ± this")
    target_height: tuple[Float, Float] = Field((1.0, 2.0), description="[m] lowest and highest target")
    target_yaw: Float = Field(45.0, ge=0, le=180, description="[deg] target heading within ± this")
    start_radius: Float = Field(0.5, ge=0, description="[m] start within a ball of this radius about the target")
    start_tilt: Float = Field(10.0, ge=0, le=90, description="[deg] largest tilt of the payload at the start")
    start_speed: Float = Field(0.3, ge=0, description="[m/s] largest speed of the team at the start")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of its target ...")
    success_angle: Float = Field(5.0, gt=0, description="[deg] ... and within this of its attitude ...")
    success_seconds: Float = Field(2.0, gt=0, description="[s] ... throughout the last seconds, or a shorter episode")


class Hover(Task):
    """Hold the payload at a pose; see docs/hover.md."""

    name: ClassVar[str] = "hover"
    Options: ClassVar[type[Section]] = HoverOptions
    REWARD: ClassVar[dict[str, float]] = {
        "position": 0.4,
        "precision": 0.25,
        "attitude": 0.15,
        "level": 0.1,
        "stillness": 0.1,
        "action_rate": -0.05,
    }

    def __init__(self, config: Config, world: World, reference: Reference):
        super().__init__(config, world, reference)
        self._success_seconds = min(self.options.success_seconds, config.env.episode_seconds)
        if self.options.target_height[0] > self.options.target_height[1]:
            raise ConfigError(f"task_options.target_height={self.options.target_height} must list the lower one first")

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw target, displacement, tilt and velocity; see `Task.start`."""
        option = self.options
        ranges = StartRanges(
            option.target_xy, *option.target_height, radians(option.target_yaw),
            option.start_radius, radians(option.start_tilt), option.start_speed,
        )  # fmt: skip
        start_near_target(env, rng, self.world.state, self.goal, self.rig, ranges, self.hanging, mass)

    def scorer(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Pay for closeness, attitude and stillness; see `Task.scorer`."""
        success = (self.options.success_distance, radians(self.options.success_angle))
        return bind(
            _score, lo, hi, self.world.state, self.goal, self.errors, action, previous, self.weights, success, self.dt,
            self.terms, self.good_time,
        )  # fmt: skip

    def succeeded(self) -> np.ndarray:
        """Within the success region throughout the last seconds."""
        return self.good_time >= self._success_seconds - 1e-9


@kernel
def _score(lo, hi, state, goal, errors, action, previous, weights, success, dt, terms, good_time):
    for e in range(lo, hi):
        pay_pose(e, state, goal, errors, 1.0, weights, terms)
        terms[e, 5] = weights[5] * mean_change(e, action, previous)
        good = errors.distance[e] <= success[0] and errors.angle[e] <= success[1]
        good_time[e] = good_time[e] + dt if good else 0.0
