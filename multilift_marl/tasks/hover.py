"""Hover: hold the payload at a target pose, whatever its mass and whatever pushes it."""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import ClassVar

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.values import Float, Section
from multilift_marl.control.formation import Reference
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.rewards import action_rate, pose_reward
from multilift_marl.tasks.starts import StartOptions, make_ranges, start_near_target


class HoverOptions(StartOptions):
    """Ranges of the start and bounds of success."""

    target_height: tuple[Float, Float] = Field((1.0, 2.0), description="[m] lowest and highest target")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of its target ...")
    success_angle: Float = Field(5.0, gt=0, description="[deg] ... and within this of its attitude ...")
    success_seconds: Float = Field(2.0, gt=0, description="[s] ... throughout the last seconds, or a shorter episode")


class Hover(Task):
    """Hold the payload at a pose; see docs/hover.md."""

    name: ClassVar[str] = "hover"
    Options: ClassVar[type[Section]] = HoverOptions
    options: HoverOptions
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
        self._ranges = make_ranges(self.options)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw target, displacement, tilt and velocity; see `Task.start`."""
        start_near_target(env, rng, self.world.state, self.goal, self.rig, self._ranges, self.hanging, mass)

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
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
        pose_reward(e, state, goal, errors, 1.0, weights, terms)
        terms[e, 5] = weights[5] * action_rate(e, action, previous)
        good = errors.distance[e] <= success[0] and errors.angle[e] <= success[1]
        good_time[e] = good_time[e] + dt if good else 0.0
