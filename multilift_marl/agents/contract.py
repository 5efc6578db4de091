"""What an exported policy needs of its contract, and the network that the contract describes; see docs/export.md."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from multilift_marl.errors import CheckpointError, pip_install, reason, shorten

CONTRACT_FORMAT = "multilift_marl policy 1"
AGAIN = "export the policy again, python -m multilift_marl.export run=<run>"
_FLOATS = "tensor(float)"  # as onnxruntime calls an array of float32
_PROBES = (1, 1), (2, 3)  # teams and drones that a network is tried with
_TOO_NEW = re.compile(
    r"Unsupported model IR version: (\d+), max supported IR version: (\d+)|Opset (\d+) is under development.*till "
    r"opset (\d+)",
    re.DOTALL,
)
"""What onnxruntime says of a network that it is too old for."""


class _Part(BaseModel):
    """A part of a contract, of which other fields are not needed here."""

    model_config = ConfigDict(strict=True, frozen=True)


class _Memory(_Part):
    input: str
    output: str
    size: Annotated[int, Field(gt=0)]


class _Network(_Part):
    sha256: str | None = None
    """Of the file; contracts of earlier versions do not state it."""
    input: str
    output: str
    memory: _Memory | None = None


class _Observation(_Part):
    names: Annotated[list[str], Field(min_length=1)]


class _Number(_Part):
    name: str


class _Action(_Part):
    numbers: Annotated[list[_Number], Field(min_length=1)]


class Contract(_Part):
    """What is needed of a contract to fly its policy."""

    network: _Network
    observation: _Observation
    action: _Action
    config: dict[str, Any]


def read_fields(contract: dict[str, Any], file: Path) -> Contract:
    """Return what is needed of a contract, a CheckpointError where it is missing or of another type."""
    try:
        return Contract.model_validate(contract)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise CheckpointError(f"{file} is no contract of a policy ({where}: {first['msg']}); {AGAIN}") from None


def open_network(path: Path) -> Any:
    """Return onnxruntime's session of an exported network, a CheckpointError if it cannot be read."""
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
        if newer := _TOO_NEW.search(str(error)):
            kind, found, most = ("IR version", *newer.groups()[:2]) if newer[1] else ("opset", *newer.groups()[2:])
            raise CheckpointError(
                f"{path} has {kind} {found} of ONNX, and onnxruntime {onnxruntime.__version__} reads up to {most}; "
                "upgrade onnxruntime, or export with an older opset: python -m multilift_marl.export run=<run> opset=18"
            ) from error
        raise CheckpointError(f"{path} is truncated or no ONNX network; export the policy again") from error


def check_same_export(path: Path, contract: Contract) -> None:
    """Refuse, by a CheckpointError, a network that is not the one that a contract describes."""
    stated = contract.network.sha256
    if stated is not None and hashlib.sha256(path.read_bytes()).hexdigest() != stated:
        raise CheckpointError(
            f"{path} and {path.with_suffix('.json').name} beside it are of different exports; {AGAIN}"
        )


class Network:
    """An exported network, which takes and returns what its contract says.

    Args:
        session: onnxruntime's.
        contract: of the network.
        source: where it comes from, for messages.

    Raises:
        CheckpointError: it takes or returns something else, or fails.
    """

    def __init__(self, session: Any, contract: Contract, source: str):
        self._session, self._source = session, source
        named, memory = contract.network, contract.network.memory
        inputs, outputs = {named.input: len(contract.observation.names)}, {named.output: len(contract.action.numbers)}
        if memory is not None:
            inputs[memory.input] = outputs[memory.output] = memory.size
        self._inputs, self._outputs = inputs, outputs
        self._check("takes", session.get_inputs(), inputs)
        self._check("returns", session.get_outputs(), outputs)
        for teams, drones in _PROBES:
            given = [np.zeros((teams, drones, size), np.float32) for size in inputs.values()]
            self.run(*given)

    def _check(self, does: str, found: Any, expected: dict[str, int]) -> None:
        """Compare what the network takes or returns with sizes by name; names of sizes stand for any."""
        if [each.name for each in found] != list(expected):
            names = [shorten(", ".join(part) or "nothing") for part in ([each.name for each in found], expected)]
            raise self._error(f"{does} {names[0]}, but its contract says {names[1]}")
        for each in found:
            size = each.shape[-1] if len(each.shape) == 3 else None
            if each.type != _FLOATS or size is None or (isinstance(size, int) and size != expected[each.name]):
                raise self._error(
                    f"{does} {each.name} of type {each.type} and shape {each.shape}, but its contract says float32 "
                    f"and (batch, drones, {expected[each.name]})"
                )

    def run(self, *given: np.ndarray) -> list[np.ndarray]:
        """Return the action (B, N, A), and the memory after it where there is one, for an observation and a memory.

        Raises:
            CheckpointError: the network fails, or returns what its contract does not say.
            ValueError: an observation that is not finite.
        """
        try:
            found: list[np.ndarray] = self._session.run(
                list(self._outputs), dict(zip(self._inputs, given, strict=True))
            )
        except Exception as error:  # onnxruntime has a kind of its own for everything that a node can lack
            raise self._error(f"fails in onnxruntime ({shorten(reason(error), 200)})") from error
        for (name, size), array in zip(self._outputs.items(), found, strict=True):
            expected = (*given[0].shape[:2], size)
            if array.shape != expected:
                raise self._error(f"returns {name} of shape {array.shape} in place of {expected}")
            if not np.isfinite(array).all():
                if not all(np.isfinite(each).all() for each in given):
                    raise ValueError(f"{self._source} observes a number that is not finite; look for NaN before it")
                raise self._error(f"returns {name} that is not finite")
        return found

    def _error(self, what: str) -> CheckpointError:
        return CheckpointError(f"{self._source} {what}; {AGAIN}")


def read_contract(path: Path) -> dict[str, Any]:
    """Return the contract beside a network."""
    if not path.is_file():
        raise CheckpointError(f"no exported policy {path}: give the .onnx file that multilift_marl.export wrote")
    file = path.with_suffix(".json")
    try:
        contract = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CheckpointError(f"{path} has no contract {file.name} beside it; put it there, or {AGAIN}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file} is no contract of a policy ({reason(error)}); {AGAIN}") from error
    if not isinstance(contract, dict) or contract.get("format") != CONTRACT_FORMAT:
        raise CheckpointError(f"{file} was not written by multilift_marl (or by another version); {AGAIN}")
    return contract
