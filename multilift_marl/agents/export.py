"""Trained policies for other programs: the network as ONNX, and the contract of its inputs and outputs beside it."""

from __future__ import annotations

import hashlib
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import onnxscript  # noqa: F401 (torch's exporter works by it; so a missing one is named)
import torch
from torch import nn

from multilift_marl._files import write_together
from multilift_marl.agents.contract import CONTRACT_FORMAT
from multilift_marl.agents.logging import package_versions
from multilift_marl.agents.networks import Actor, Normalizer
from multilift_marl.agents.policy import LearnedPolicy, TrainedPolicy
from multilift_marl.config.config import Config
from multilift_marl.control.action_interface import FACTOR, THRUST, ControlContext
from multilift_marl.control.actions import ACTIONS
from multilift_marl.control.formation import Goal, Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.obstacle_margin import Margins
from multilift_marl.control.setpoints import Setpoint
from multilift_marl.errors import CheckpointError, ConfigError
from multilift_marl.mdp.env_data import INTEGRAL_LIMIT
from multilift_marl.mdp.observations import FRAMES, list_components, observation_names
from multilift_marl.mdp.rig_features import observed_units
from multilift_marl.sim.state import SystemState
from multilift_marl.tasks import find_task

NETWORK, CONTRACT = "policy.onnx", "policy.json"
_TOLERANCE = 1e-5  # of actions, between torch and onnxruntime, where rounding makes no more
_TRACED = (2, 3)  # teams and drones to trace with: neither is 1, which the exporter would take for a constant


class _Mean(nn.Module):
    """The deterministic policy: observations (batch, drones, D) to actions (batch, drones, A) within [-1, 1].

    With a GRU also its memory (batch, drones, H) before the step to that after it.
    """

    def __init__(self, actor: Actor):
        super().__init__()
        self.actor = actor
        self.training = False  # which the exporter asks for; of the actor there is one mode only

    def forward(
        self, observation: torch.Tensor, memory: torch.Tensor | None = None
    ) -> torch.Tensor | tuple[torch.Tensor, torch.Tensor]:
        # Clipping is part of the network, so that other programs need not know of it.
        if memory is None:
            return self.actor(observation)[0].clamp(-1, 1)
        memory = self.actor.remember(observation, memory)
        return self.actor(observation, memory)[0].clamp(-1, 1), memory


def export_policy(policy: TrainedPolicy, folder: str | Path, opset: int | None = None) -> dict[str, Any]:
    """Write policy.onnx and policy.json into a folder, which is made where there is none.

    The network takes `observation` (batch, drones, D) float32 and returns `action` (batch, drones, A) in [-1, 1], for
    any batch and number of drones. That of a policy with a GRU also takes `memory` (batch, drones, H), zeros at first,
    and returns `next_memory`. What was written is compared with the policy before this returns.

    Args:
        policy: what to export.
        folder: where to.
        opset: version of ONNX's operators, for a runtime that does not know newer ones; None for the exporter's own.

    Returns:
        The contract, as in policy.json; see docs/export.md.

    Raises:
        CheckpointError, ConfigError: see `make_contract`; or the policy is an exported one, its network cannot be
            expressed in this opset, or onnxruntime's actions are not the policy's.
        OSError: the folder cannot be written.
    """
    if not isinstance(policy, LearnedPolicy):
        raise ConfigError(f"{policy.source} is exported already; give the run or the checkpoint that it comes from")
    contract, gru = make_contract(policy), policy.config.train.gru
    model = _convert(policy, opset)
    difference = _compare(policy, model)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    serialized = model.SerializeToString()
    network = {
        "file": NETWORK,
        "sha256": hashlib.sha256(serialized).hexdigest(),
        "input": "observation",
        "output": "action",
        "memory": {"input": "memory", "output": "next_memory", "size": gru} if gru else None,
        "opset": model.opset_import[0].version,
        "ir_version": model.ir_version,
        "largest_difference": difference,
    }
    contract = {"network": network} | contract
    text = f"{json.dumps(contract, indent=1, ensure_ascii=False)}\n".encode()
    write_together({folder / NETWORK: serialized, folder / CONTRACT: text})
    return contract


def _convert(policy: LearnedPolicy, opset: int | None) -> onnx.ModelProto:
    """Return the network as an ONNX model, without what the exporter notes about this machine's source files."""
    gru = policy.config.train.gru
    inputs, outputs = {"observation": torch.zeros(*_TRACED, len(policy.observation_names))}, ["action"]
    if gru:
        inputs["memory"] = torch.zeros(*_TRACED, gru)
        outputs.append("next_memory")
    # Sizes that the model leaves open; all others become constants of it.
    free = {0: torch.export.Dim("batch"), 1: torch.export.Dim("drones")}
    with _silence(), torch.no_grad():
        program = torch.onnx.export(
            _Mean(policy.actor), tuple(inputs.values()), dynamo=True, dynamic_shapes=dict.fromkeys(inputs, free),
            input_names=list(inputs), output_names=outputs, verbose=False, opset_version=opset,
        )  # fmt: skip
    assert program is not None
    model = program.model_proto
    # Where a network cannot be expressed in that opset, the exporter keeps its own without an error.
    if opset is not None and (made := model.opset_import[0].version) != opset:
        raise ConfigError(
            f"the network cannot be expressed by opset={opset} of ONNX, only by {made}; give that or more"
        )
    model.ir_version = onnx.helper.find_min_ir_version_for(model.opset_import)  # the form that most runtimes read
    graph = model.graph
    for part in (graph, *graph.node, *graph.initializer, *graph.value_info, *graph.input, *graph.output):
        part.ClearField("metadata_props")
    onnx.checker.check_model(model, full_check=True)
    return model


@contextmanager
def _silence() -> Iterator[None]:
    """Keep the exporter's remarks on its own code, and on libraries that it could do without, to itself."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            warnings.filterwarnings("ignore", "# The axis name", UserWarning)  # of dimensions that two inputs share
            yield
    finally:
        logger.setLevel(level)


def _compare(policy: LearnedPolicy, model: onnx.ModelProto) -> float:
    """Return the largest difference of onnxruntime's actions from the policy's, over teams of several sizes.

    Raises:
        CheckpointError: it is more than `_TOLERANCE`, and than rounding makes in a network as steep as this.
    """
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    normalizer, rng, gru = policy.actor.normalizer, np.random.default_rng(0), policy.config.train.gru
    learned, exact, worst, rounding = policy.copy(), _Mean(deepcopy(policy.actor).double()), 0.0, 0.0
    for drones in (1, 2, policy.config.env.num_drones, 7):
        learned.reset()
        memory = {"memory": np.zeros((5, drones, gru), np.float32)} if gru else {}
        kept = [torch.zeros(5, drones, gru, dtype=torch.float64)] if gru else []
        # Some steps with a memory: a wrong `next_memory` shows in the next action only.
        for _ in range(3 if gru else 1):
            # Observations as training had them, or the comparison would be of clipped ones.
            spread = rng.standard_normal((5, drones, len(policy.observation_names)), np.float32)
            observation = normalizer.shift.numpy() + spread / normalizer.scale.numpy()
            action, *after = session.run(None, {"observation": observation} | memory)
            memory = {"memory": after[0]} if gru else {}
            flown = learned.act(observation)
            with torch.no_grad():
                found = exact(torch.from_numpy(observation).double(), *kept)
            double, *kept = found if gru else (found,)
            # Not Python's max, which drops NaN.
            worst = float(np.maximum(worst, np.abs(action - flown).max()))
            rounding = float(np.maximum(rounding, np.abs(double.numpy() - flown).max()))
    if not worst <= max(_TOLERANCE, 4 * rounding):
        raise CheckpointError(
            f"{policy.source} as an ONNX network differs by {worst:.1e} in its actions, where rounding makes "
            f"{rounding:.1e}; use other versions of torch, onnxscript or onnxruntime"
        )
    return worst


def make_contract(policy: LearnedPolicy) -> dict[str, Any]:
    """Return the contract of a policy, ready for JSON; docs/export.md explains every field.

    Raises:
        CheckpointError: this version observes or acts otherwise than the policy was trained to.
        ConfigError: the task is not known, or its system is impossible.
    """
    config, kind = policy.config, policy.config.train.actor
    # First: what follows describes the numbers of this version, not those that the policy was trained with.
    _check_names(policy)
    return {
        "format": CONTRACT_FORMAT,
        "task": config.task,
        "policy_hz": config.env.policy_hz,
        "observation": _describe_observation(policy),
        "action": _describe_action(policy),
        "frames": FRAMES,
        "inside": {
            "normaliser": _describe_normalizer(policy.actor.normalizer),
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
    observations = observation_names(config.control.action, find_task(config.task).extra(config), config.env.ages)
    for found, known, what in (
        (policy.action_names, actions, "actions"),
        (policy.observation_names, observations, "observations"),
    ):
        if found != known:
            raise CheckpointError(f"{policy.source} was trained with other {what} than this version has; train again")


def _describe_observation(policy: LearnedPolicy) -> dict[str, Any]:
    config, size = policy.config, len(policy.observation_names)
    parts, at = [], 0
    for part in list_components(config.control.action, find_task(config.task).extra(config)):
        described = {key: getattr(part, key) for key in ("name", "size", "frame", "unit", "meaning")}
        parts.append({"first": at, **described, "unit_size": float(observed_units(config, [part.unit])[0])})
        at += part.size
    return {
        "shape": ["batch", "drones", size],
        "dtype": "float32",
        "steps": len(config.env.ages),
        "ages": list(config.env.ages),
        "step_size": at,
        "units": config.env.units,
        "components": parts,
        "integral_limit": INTEGRAL_LIMIT,
        "names": list(policy.observation_names),
    }


def _describe_action(policy: LearnedPolicy) -> dict[str, Any]:
    control = policy.config.control
    # For each thrust among the numbers, in their order: lowest, at zero and largest of each drone.
    thrusts = iter(np.moveaxis(_measure_thrusts(policy.config), -1, 0).tolist())
    numbers = []
    for name, frame, unit, limit, meaning in ACTIONS[control.action].numbers:
        full = None if limit == THRUST else getattr(policy.config.acting, limit)
        is_factor = limit == FACTOR
        if full is None:
            low, zero, high = next(thrusts)
        else:
            low, zero, high = (1.0 / full, 1.0, full) if is_factor else (-full, 0.0, full)
        values = {"at_minus_one": low, "at_zero": zero, "at_one": high}
        scale = {"scale": "exponential" if is_factor else "linear"}
        numbers.append({"name": name, "frame": frame, "unit": unit, "meaning": meaning, **values, **scale})
    margins = Margins.of(control)
    kept: dict[str, Any] = {"margins": margins._asdict()} if any(margins) else {}
    if control.swing_shift:
        kept["swing_shift"] = control.swing_shift
    return kept | {
        "interface": control.action,
        "shape": ["batch", "drones", len(numbers)],
        "dtype": "float32",
        "range": [-1.0, 1.0],
        "numbers": numbers,
    }


def _measure_thrusts(config: Config) -> np.ndarray:
    """Return the thrusts (3, N, K) [N] that actions of -1, 0 and 1 set in a team at rest, by its interface."""
    system = config.system
    interface = ACTIONS[config.control.action](config.acting, 1.0 / config.sim.control_hz)
    e, n = 3, system.num_drones
    # One environment for each of -1, 0 and 1, in all numbers of all drones.
    action = np.broadcast_to(np.array([-1.0, 0.0, 1.0])[:, None, None], (e, n, len(interface.numbers))).copy()
    team = ControlContext(
        SystemState.zeros(e, n), Goal.zeros(e, n), Reference.zeros(e, n), Setpoint.zeros(e, n),
        np.tile(system.hook_force, (e, 1, 1)), np.zeros((e, n, 4)), make_gains(config.control, system),
    )  # fmt: skip
    interface.set_action(0, e, action, team)()
    return interface.thrusts(team)


def _describe_normalizer(normalizer: Normalizer) -> str:
    """Return in words what becomes of each observed number."""
    since = ", of earlier steps how it differs from the newest" if normalizer.steps > 1 else ""
    standardised = f"each number{since}, standardised, within ± {normalizer.clip:g} deviations"
    k = f"{normalizer.asinh:g}"
    return standardised + (f", then asinh({k} x / deviation) / asinh({k}) of it" if normalizer.asinh else "")


def _describe_formation(config: Config) -> list[dict[str, Any]]:
    """Return where each drone of the team that was trained rests, in the frame of a level payload [m, rad]."""
    system = config.system
    return [
        {
            "slot": system.slots[n].tolist(),
            "slot_azimuth": float(system.slot_azimuth[n]),
            "heading": float(system.heading[n]),
            "anchor": system.anchors[n].tolist(),
            "hook": system.hooks[n].tolist(),
            "cable_length": float(system.cable_length[n]),
        }
        for n in range(system.num_drones)
    ]
