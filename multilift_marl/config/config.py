"""The whole configuration: every parameter once. YAML files and overrides only change values."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from multilift_marl.config.units import scale_control
from multilift_marl.rig.resolve import resolve_system
from multilift_marl.rig.system import System
from multilift_marl.schema.control import ControlConfig
from multilift_marl.schema.files import pin_options
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.schema.sections import RewardTerm, SystemConfig
from multilift_marl.schema.training import EvalConfig, TrainConfig


class Config(SystemConfig):
    """What is simulated, and what a task and its training make of it."""

    reward: dict[str, RewardTerm] = Field({}, description="weight of a reward term of the task, or weight and margin")
    task_options: Annotated[dict[str, Any], AfterValidator(pin_options)] = Field({}, description="options of the task")
    planner: PlannerConfig = PlannerConfig()
    train: TrainConfig = TrainConfig()
    eval: EvalConfig = EvalConfig()

    @cached_property
    def system(self) -> System:
        """The physical system that this configuration describes; a ConfigError if it cannot be or cannot fly."""
        return resolve_system(self)

    @cached_property
    def acting(self) -> ControlConfig:
        """`control`, its full scales of actions in SI units whatever `env.units` is."""
        return self.control if self.env.units == "si" else scale_control(self.control, self.system)
