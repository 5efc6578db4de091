"""What the numbers of a policy mean beside their names: the keys of a configuration that decide it."""

from __future__ import annotations

import json
from operator import attrgetter

from multilift_marl.config.config import Config
from multilift_marl.control.action_interface import THRUST
from multilift_marl.control.actions import ACTIONS
from multilift_marl.envs.commander import COMMANDERS
from multilift_marl.schema.planner import PlannerConfig

_HOW = {"deadline", "patience", "sweeps", "distributed"}  # of `planner`: by what a plan is made in time, not which one


def changed_meanings(there: Config, here: Config) -> list[str]:
    """Return the keys that differ, of those by which actions and observations of the same names mean something else.

    They are full scales and, in SI units, the rate: in units of the cables it is another one on every rig. Actions
    for a planner mean something else by other settings of it, too.

    Args:
        there: configuration of a policy.
        here: of environments that it is to fly.
    """
    scales = [f"control.{number.limit}" for number in ACTIONS[there.control.action].numbers if number.limit != THRUST]
    rate = ["env.policy_hz"] if there.env.units == "si" else []
    planned = there.control.action in COMMANDERS
    planner = [f"planner.{key}" for key in PlannerConfig.model_fields if planned and key not in _HOW]
    return [key for key in dict.fromkeys([*scales, *rate, *planner]) if spell(key, there) != spell(key, here)]


def spell(key: str, config: Config) -> str:
    """Return key=value of a configuration as a command takes it."""
    value = attrgetter(key)(config)
    return f"{key}={value if isinstance(value, str) else json.dumps(value)}"
