"""Trained policies, whatever computes their actions; exported ones, which need no torch."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.errors import CheckpointError, ConfigError, pip_install

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

FORMAT = "multilift_marl policy 1"  # of the contract beside an exported network


class TrainedPolicy:
    """A policy with the configuration that it was trained with; a subclass computes its actions.

    Args:
        config: that configuration.
        observation_names, action_names: what its inputs and outputs mean.
        source: where it comes from, for messages.

    Attributes:
        config, observation_names, action_names, source: as given.
    """

    def __init__(self, config: Config, observation_names: Iterable[str], action_names: Iterable[str], source: str):
        self.config, self.source = config, source
        self.observation_names, self.action_names = tuple(observation_names), tuple(action_names)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., N, A) float32 within [-1, 1] for observations (..., N, D).

        Raises:
            ValueError: observations of another size than the policy was trained with.
        """
        raise NotImplementedError

    def _checked(self, observation: np.ndarray) -> np.ndarray:
        observation = np.asarray(observation, np.float32)
        if observation.shape[-1] != len(self.observation_names):
            raise ValueError(
                f"observation has {observation.shape[-1]} numbers, the policy of {self.source} was trained with "
                f"{len(self.observation_names)}; use the environment configuration that it was trained in"
            )
        return observation

    def bind(self, vec: MultiliftVec) -> TrainedPolicy:
        """Return this policy, checked to fit the environments `vec`.

        Raises:
            ConfigError: it was trained with other actions or observations, see `misfit`.
        """
        if reason := self.misfit(vec):
            raise ConfigError(f"the policy of {self.source} {reason}")
        return self

    def misfit(self, vec: MultiliftVec) -> str:
        """Return why the policy cannot fly `vec`, as the rest of a sentence, "" if it can."""
        trained, asked = self.config.control.action, vec.config.control.action
        if trained != asked:
            return f"was trained with control.action={trained} and cannot fly {asked}; set control.action={trained}"
        parts = {"actions": (self.action_names, vec.action_names)}
        parts["observations"] = (self.observation_names, vec.observation_names)
        for kind, names in parts.items():
            for i, (mine, its) in enumerate(zip_longest(*names, fillvalue="nothing")):
                if mine != its:
                    return (
                        f"was trained in task {self.config.task} and cannot fly this {vec.task.name}: number {i} of "
                        f"the {kind} is {mine} there and {its} here; fly what it was trained in, or another policy"
                    )
        return ""

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget nothing: the policy has no memory of its own."""


class ExportedPolicy(TrainedPolicy):
    """An exported policy, flown by onnxruntime: the network's .onnx file with its contract, .json, beside it.

    Args:
        path: of the network.

    Attributes:
        contract: see docs/export.md.

    Raises:
        CheckpointError: network or contract are missing, damaged or foreign.
        ConfigError: the configuration is of another version, or a module that it needs is missing.
        ModuleNotFoundError: onnxruntime is missing.
    """

    def __init__(self, path: Path):
        self.contract = _read_contract(path)
        try:
            config, observation = self.contract["config"], self.contract["observation"]["names"]
            action = [number["name"] for number in self.contract["action"]["numbers"]]
        except (KeyError, TypeError) as error:
            raise CheckpointError(f"the contract beside {path} lacks {error}; export the policy again") from error
        super().__init__(build_config(config), observation, action, str(path))
        self._session = _open(path)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """See `TrainedPolicy.act`."""
        observation = self._checked(observation)
        teams = observation.reshape(-1, *observation.shape[-2:])
        (action,) = self._session.run(["action"], {"observation": teams})
        return np.clip(action, -1, 1).reshape(*observation.shape[:-1], -1)


def _read_contract(path: Path) -> dict[str, Any]:
    """Return the contract beside a network."""
    if not path.is_file():
        raise CheckpointError(f"no exported policy {path}: give the .onnx file that multilift_marl.export wrote")
    file = path.with_suffix(".json")
    again = "export the policy again, python -m multilift_marl.export run=<run>"
    try:
        contract = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CheckpointError(f"{path} has no contract {file.name} beside it; put it there, or {again}") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{file} is no contract of a policy; {again}") from error
    if not isinstance(contract, dict) or contract.get("format") != FORMAT:
        raise CheckpointError(f"{file} was not written by multilift_marl (or by another version); {again}")
    return contract


def _open(path: Path) -> Any:
    """Return onnxruntime's session of a network."""
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        message = f"{path} needs {error.name}: {pip_install('export')}"
        raise ModuleNotFoundError(message, name=error.name) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # for networks this small, more of them only wait for each other
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a kind of its own for everything that a file can lack
        raise CheckpointError(f"{path} is truncated or no ONNX network; export the policy again") from error
