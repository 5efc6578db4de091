"""Trained policies for other programs: the network as ONNX, and the contract of its inputs and outputs beside it."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import onnxscript  # noqa: F401 (torch's exporter works by it; so a missing one is named)
import torch
from torch import nn

from multilift_marl.agents.contract import make_contract
from multilift_marl.agents.networks import Actor
from multilift_marl.agents.policy import LearnedPolicy
from multilift_marl.agents.trained import TrainedPolicy
from multilift_marl.errors import ConfigError

NETWORK, CONTRACT = "policy.onnx", "policy.json"
_TOLERANCE = 1e-5  # of actions, between torch and onnxruntime
_TRACED = (2, 3)  # teams and drones to trace with: neither is 1, which the exporter would take for a constant


class _Mean(nn.Module):
    """The deterministic policy: observations (batch, drones, D) to actions (batch, drones, A) within [-1, 1]."""

    def __init__(self, actor: Actor):
        super().__init__()
        self.actor = actor
        self.training = False  # which the exporter asks for; of the actor there is one mode only

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.actor(observation)[0].clamp(-1, 1)


def export_policy(policy: TrainedPolicy, folder: str | Path) -> dict[str, Any]:
    """Write policy.onnx and policy.json into a folder, which is made where there is none.

    The network takes `observation` (batch, drones, D) float32 and returns `action` (batch, drones, A) in [-1, 1], for
    any batch and number of drones. What was written is compared with the policy before this returns.

    Args:
        policy: what to export.
        folder: where to.

    Returns:
        The contract, as in policy.json; see docs/export.md.

    Raises:
        CheckpointError, ConfigError: see `make_contract`; or the policy is an exported one.
        OSError: the folder cannot be written.
        RuntimeError: onnxruntime's actions are not the policy's.
    """
    if not isinstance(policy, LearnedPolicy):
        raise ConfigError(f"{policy.source} is exported already; give the run or the checkpoint that it comes from")
    contract = make_contract(policy)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    model = _convert(policy)
    onnx.save(model, str(folder / NETWORK))
    network = {
        "file": NETWORK,
        "input": "observation",
        "output": "action",
        "opset": model.opset_import[0].version,
        "largest_difference": _compare(policy, folder / NETWORK),
    }
    contract = {"network": network} | contract
    (folder / CONTRACT).write_text(json.dumps(contract, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return contract


def _convert(policy: LearnedPolicy) -> onnx.ModelProto:
    """Return the network as an ONNX model, without what the exporter notes about this machine's source files."""
    observation = torch.zeros(*_TRACED, len(policy.observation_names))
    free = {0: torch.export.Dim("batch"), 1: torch.export.Dim("drones")}
    with _silence(), torch.no_grad():
        program = torch.onnx.export(
            _Mean(policy.actor), (observation,), dynamo=True, dynamic_shapes={"observation": free},
            input_names=["observation"], output_names=["action"], verbose=False,
        )  # fmt: skip
    assert program is not None
    model = program.model_proto
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
            yield
    finally:
        logger.setLevel(level)


def _compare(policy: LearnedPolicy, path: Path) -> float:
    """Return the largest difference of onnxruntime's actions from the policy's, over teams of several sizes."""
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    normalizer, rng = policy.actor.normalizer, np.random.default_rng(0)
    worst = 0.0
    for drones in (1, 2, policy.config.env.num_drones, 7):
        spread = rng.standard_normal((5, drones, len(policy.observation_names)), np.float32)
        observation = normalizer.shift.numpy() + spread / normalizer.scale.numpy()
        (action,) = session.run(["action"], {"observation": observation})
        worst = max(worst, float(np.abs(action - policy.act(observation)).max()))
    if not worst <= _TOLERANCE:
        raise RuntimeError(
            f"{path} differs from {policy.source} by {worst:.1e} in its actions, more than {_TOLERANCE:.0e}; use other "
            "versions of torch, onnxscript or onnxruntime"
        )
    return worst
