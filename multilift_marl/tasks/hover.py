"""Hover: hold the payload at a fixed pose despite a payload mass, and a force on it, that the drones do not know."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from multilift_marl.mdp.initial_states import StartOptions, make_ranges, start_near_target
from multilift_marl.mdp.rewards import Term, action_rate, attitude, distance, steadiness
from multilift_marl.schema.values import Float, Section
from multilift_marl.tasks.base import Task


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
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.4, distance, 0.25, "m"),
        "precision": Term(0.25, distance, 0.01, "m"),
        "attitude": Term(0.15, attitude, 6.0, "deg"),
        "level": Term(0.1, attitude, 1.0, "deg"),
        "stillness": Term(0.1, steadiness, (0.2, 0.3), "m/s, rad/s"),
        "action_rate": Term(-0.05, action_rate),
    }

    def prepare(self) -> None:
        """See `Task.prepare`."""
        super().prepare()
        self._ranges = make_ranges(self.options)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw target, displacement, tilt and velocity; see `Task.start`."""
        start_near_target(env, rng, self.view_for(start_near_target), self._ranges, self.equilibrium)
