"""What a policy is to be told, and what its answers mean, for programs that fly it without this package."""

from __future__ import annotations

from typing import Any

import numpy as np

from multilift_marl.agents.policy import LearnedPolicy
from multilift_marl.agents.trained import FORMAT
from multilift_marl.agents.versions import package_versions
from multilift_marl.config.config import Config
from multilift_marl.control.actions import ACTIONS, THRUST, Team
from multilift_marl.control.formation import Goal, Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.setpoints import Setpoint
from multilift_marl.errors import CheckpointError
from multilift_marl.sim.state import SystemState
from multilift_marl.tasks import find_task
from multilift_marl.tasks.base import INTEGRAL_LIMIT
from multilift_marl.tasks.observations import FRAMES, list_components, observation_names


def make_contract(policy: LearnedPolicy) -> dict[str, Any]:
    """Return the contract of a policy, ready for JSON; docs/export.md explains every field.

    Raises:
        CheckpointError: this version observes or acts otherwise than the policy was trained to.
        ConfigError: the task is not known, or its system is impossible.
    """
    config, kind = policy.config, policy.config.train.actor
    _check_names(policy)
    return {
        "format": FORMAT,
        "task": config.task,
        "policy_hz": config.env.policy_hz,
        "observation": _describe_observation(policy),
        "action": _describe_action(policy),
        "frames": FRAMES,
        "inside": {
            "normaliser": f"each number, standardised, within ± {policy.actor.normalizer.clip:g} deviations",
            "script": f"the matrix of {config.train.residual}, added to the network's action",
            "clipping": "actions within [-1, 1]",
        },
        "drones": {"trained": config.env.num_drones, "any_number": True, "whole_team": kind != "local"},
        "formation": _describe_formation(config),
        "training": {"frames": policy.frames, "algorithm": config.train.algorithm, "actor": kind, "seed": config.seed},
        "versions": package_versions("onnx", "onnxscript", "onnxruntime"),
        "config": config.model_dump(mode="json"),
    }


def _check_names(policy: LearnedPolicy) -> None:
    config = policy.config
    actions = tuple(number.name for number in ACTIONS[config.control.action].numbers)
    observations = observation_names(len(actions), find_task(config.task).EXTRA, config.env.history)
    for found, known, what in (
        (policy.action_names, actions, "actions"),
        (policy.observation_names, observations, "observations"),
    ):
        if found != known:
            raise CheckpointError(f"{policy.source} was trained with other {what} than this version has; train again")


def _describe_observation(policy: LearnedPolicy) -> dict[str, Any]:
    config, size = policy.config, len(policy.observation_names)
    parts, at = [], 0
    for part in list_components(len(policy.action_names), find_task(config.task).EXTRA):
        parts.append({"first": at, **part._asdict()})
        at += part.size
    return {
        "shape": ["batch", "drones", size],
        "dtype": "float32",
        "steps": config.env.history,
        "step_size": at,
        "components": parts,
        "integral_limit": INTEGRAL_LIMIT,
        "names": list(policy.observation_names),
    }


def _describe_action(policy: LearnedPolicy) -> dict[str, Any]:
    control = policy.config.control
    thrusts = iter(np.moveaxis(_measure_thrusts(policy.config), -1, 0).tolist())
    numbers = []
    for name, frame, unit, limit, meaning in ACTIONS[control.action].numbers:
        full = None if limit == THRUST else getattr(control, limit)
        low, zero, high = next(thrusts) if full is None else (-full, 0.0, full)
        scale = {"at_minus_one": low, "at_zero": zero, "at_one": high}
        numbers.append({"name": name, "frame": frame, "unit": unit, "meaning": meaning, **scale})
    return {
        "interface": control.action,
        "shape": ["batch", "drones", len(numbers)],
        "dtype": "float32",
        "range": [-1.0, 1.0],
        "numbers": numbers,
    }


def _measure_thrusts(config: Config) -> np.ndarray:
    """Return the thrusts (3, N, K) [N] that actions of -1, 0 and 1 set in a team at rest, as the interface tells."""
    system, interface = config.system, ACTIONS[config.control.action](config.control, 1.0 / config.sim.control_hz)
    e, n = 3, system.num_drones
    action = np.broadcast_to(np.array([-1.0, 0.0, 1.0])[:, None, None], (e, n, len(interface.numbers))).copy()
    team = Team(
        SystemState.zeros(e, n), Goal.zeros(e, n), Reference.zeros(e, n), Setpoint.zeros(e, n),
        np.tile(system.hook_force, (e, 1, 1)), np.zeros((e, n, 4)), make_gains(config.control, system),
    )  # fmt: skip
    interface.set_action(0, e, action, team)()
    return interface.thrusts(team)


def _describe_formation(config: Config) -> list[dict[str, Any]]:
    """Return where each drone of the team that was trained rests, in the frame of a level payload [m, rad]."""
    system = config.system
    return [
        {
            "slot": system.slots[n].tolist(),
            "slot_azimuth": float(system.slot_azimuth[n]),
            "anchor": system.anchors[n].tolist(),
            "hook": system.hooks[n].tolist(),
            "cable_length": float(system.cable_length[n]),
        }
        for n in range(system.num_drones)
    ]
