"""Policies by name, and trained ones for use: NumPy in, NumPy out. torch is imported only where a checkpoint is."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Iterable
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.control.policy import Policy
from multilift_marl.control.scripted import SCRIPTED, make_scripted
from multilift_marl.errors import CheckpointError, ConfigError, nearest, pip_install

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

CONTRACT_FORMAT = "multilift_marl policy 1"  # of the contract beside an exported network
_SHIPPED = Path(__file__).resolve().parents[1] / "policies"
_NEEDED = {"config": dict, "actor": dict, "observation_names": list, "action_names": list, "frames": int}
"""What a policy needs of a checkpoint."""
_NAMES = "script, module:Class, exported policy (.onnx), checkpoint (.pt), run folder or shipped policy"


class TrainedPolicy:
    """A policy with the configuration that it was trained with; a subclass computes its actions.

    Args:
        config: that configuration.
        observation_names, action_names: what its inputs and outputs mean.
        source: where it comes from, for messages.

    Attributes:
        config, observation_names, action_names, source: as given.
        folder: that what is made of the policy belongs to, its run's.
    """

    def __init__(self, config: Config, observation_names: Iterable[str], action_names: Iterable[str], source: str):
        self.config = config
        self.source = source
        self.observation_names = tuple(observation_names)
        self.action_names = tuple(action_names)
        self.folder = Path(source).parent
        self._memory: np.ndarray | None = None  # (B, N, H) of a policy with a GRU

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., N, A) float32 within [-1, 1] for observations (..., N, D).

        A policy with a GRU remembers what it has observed since `reset`: ask it once in each policy step.

        Raises:
            ValueError: observations of another size than the policy was trained with, or of other environments or
                drones than it remembers.
        """
        observation = self._checked(observation)
        teams = observation.reshape(-1, *observation.shape[-2:])
        if self.config.train.gru == 0:
            action, _ = self._act(teams, None)
        else:
            if self._memory is None:
                self._memory = np.zeros((*teams.shape[:-1], self.config.train.gru), np.float32)
            if self._memory.shape[:-1] != teams.shape[:-1]:
                raise ValueError(
                    f"the policy of {self.source} remembers (environments, drones) {self._memory.shape[:-1]}, but "
                    f"observes {teams.shape[:-1]}; call reset() before other environments, or bind(vec) for a copy"
                )
            action, self._memory = self._act(teams, self._memory)
        return action.reshape(*observation.shape[:-1], len(self.action_names))

    def _act(self, observation: np.ndarray, memory: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Return actions (B, N, A) for observations (B, N, D), and the memory (B, N, H) of a policy with a GRU."""
        raise NotImplementedError

    def _checked(self, observation: np.ndarray) -> np.ndarray:
        observation = np.asarray(observation, np.float32)
        if observation.shape[-1] != len(self.observation_names):
            raise ValueError(
                f"observation has {observation.shape[-1]} numbers, the policy of {self.source} was trained with "
                f"{len(self.observation_names)}; use the environment configuration that it was trained in"
            )
        return observation

    def bind(self, vec: MultiliftVec) -> Self:
        """Return this policy, with a memory of its own, checked to fit the environments `vec`.

        Raises:
            ConfigError: it was trained with other actions or observations, see `misfit`.
        """
        if reason := self.misfit(vec):
            raise ConfigError(f"the policy of {self.source} {reason}")
        return self.copy()

    def copy(self) -> Self:
        """Return this policy with a memory of its own, empty."""
        other = copy.copy(self)
        other.reset()
        return other

    def misfit(self, vec: MultiliftVec) -> str:
        """Return why the policy does not fit `vec`, as the rest of a sentence, "" if it does."""
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
        """Forget what was observed in the environments of the mask (E,) bool (None: all)."""
        if mask is None:
            self._memory = None
        elif self._memory is not None:
            self._memory[np.asarray(mask, bool)] = 0.0


class LearnedPolicy(TrainedPolicy):
    """The deterministic policy of a checkpoint, the same network for every drone and any number of them.

    Args:
        content: of a checkpoint; see `load_policy`.
        source: where it comes from, for messages.

    Attributes:
        config: the configuration it was trained with.
        observation_names, action_names: what its inputs and outputs mean.
        frames: environment steps that it was trained for.
        source: as given.
        actor: the network.

    Raises:
        CheckpointError: a part is missing or of another type, or the weights are of another network or not finite.
        ConfigError: the configuration is of another version.
    """

    def __init__(self, content: dict[str, Any], source: str):
        import torch

        from multilift_marl.agents.checkpoint import check_like
        from multilift_marl.agents.networks import Actor

        check_policy(content, source)
        config = build_config(content["config"])
        super().__init__(config, content["observation_names"], content["action_names"], source)
        self.frames: int = content["frames"]
        size = (len(self.observation_names), len(self.action_names))
        train = config.train
        with torch.random.fork_rng(devices=[]):  # initial weights, overwritten at once, must not cost random numbers
            base = torch.zeros(size[1], size[0])
            self.actor = Actor(train.actor, *size, train.hidden, train.initial_std, base, train.gru, train.asinh)
        try:
            check_like(content["actor"], self.actor.state_dict(), "actor")
        except ValueError as error:
            raise CheckpointError(
                f"{source} holds other weights than its network has ({error}); train again"
            ) from error
        self.actor.load_state_dict(content["actor"])

    def _act(self, observation: np.ndarray, memory: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        import torch

        with torch.no_grad():
            observed, held = torch.from_numpy(observation), None
            if memory is not None:
                held = self.actor.remember(observed, torch.from_numpy(memory))
            action = self.actor(observed, held)[0].clamp(-1, 1)
        return action.numpy(), None if held is None else held.numpy()


class ExportedPolicy(TrainedPolicy):
    """An exported policy, run by onnxruntime: the network's .onnx file with its contract, .json, beside it.

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

    def _act(self, observation: np.ndarray, memory: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        given = {"observation": observation} | ({} if memory is None else {"memory": memory})
        action, *after = self._session.run(None, given)
        return np.clip(action, -1, 1), after[0] if after else None


class Script(NamedTuple):
    """A script, or a class of one's own, by its name."""

    name: str
    config: None = None

    def bind(self, vec: MultiliftVec) -> Policy:
        """Return the policy for the environments, a ConfigError if it does not fit them."""
        return make_scripted(self.name, vec)

    def misfit(self, vec: MultiliftVec) -> str:
        """Return nothing: `bind` refuses what does not fit."""
        return ""


NamedPolicy = Script | TrainedPolicy
"""What a name stands for. `bind` makes a `Policy` of it, `misfit` says why not."""


def find_policy(name: str | Path, what: str = "policy", others: Iterable[str] = ()) -> NamedPolicy:
    """Return the policy of a name: the one look-up of this package.

    Args:
        name: a script, a class of one's own (module:Class), or what `load_policy` takes.
        what: it is, for messages.
        others: further names that the caller knows, for messages.

    Raises:
        CheckpointError, ConfigError: there is none, or it cannot be loaded.
    """
    text = str(name)
    if text in SCRIPTED or ":" in text:
        return Script(text)
    known = text == "latest" or text.endswith((".onnx", ".pt")) or text in shipped_policies()
    if not known and not any(os.path.isdir(folder) for folder in (text, f"runs/{text}")):
        raise ConfigError(f"unknown {what} '{text}'{nearest(text, [*SCRIPTED, *others])}: give a {_NAMES}")
    return load_policy(name)


def load_policy(name: str | Path, checkpoint: str = "best") -> TrainedPolicy:
    """Return a trained policy.

    Args:
        name: a run folder, its name, "latest", a checkpoint file, the .onnx file of an exported policy, or the name of
            a shipped policy ("hover").
        checkpoint: of a run, "best" (the last one where there is no best), "last", or a file.

    Raises:
        CheckpointError: missing, truncated or foreign.
        ConfigError: its configuration is of another version, or a module that it needs is missing.
        ModuleNotFoundError: a checkpoint needs torch, the `train` extra; an exported policy onnxruntime, `export`.
    """
    text = str(name)
    if text.endswith(".onnx"):
        return ExportedPolicy(Path(name))
    try:
        from multilift_marl.agents.checkpoint import find_run, load_checkpoint
    except ModuleNotFoundError as error:
        message = f"ml.load_policy needs {error.name}: {pip_install('train')}"
        raise ModuleNotFoundError(message, name=error.name) from error
    if text in shipped_policies() and not os.path.exists(text):
        if checkpoint != "best":
            raise ConfigError(f"checkpoint={checkpoint} means nothing to the shipped policy '{text}'; leave it out")
        folder = Path("runs") / f"shipped-{text}"
        file = _SHIPPED / f"{text}.pt"
    elif os.path.isfile(text) or text.endswith(".pt"):
        file = Path(name)
        folder = file.parent
    else:
        folder = find_run(name)
        file = folder / "checkpoints" / f"{checkpoint}.pt" if checkpoint in ("best", "last") else Path(checkpoint)
        if checkpoint == "best" and not file.is_file():
            file = file.with_name("last.pt")
    policy = LearnedPolicy(load_checkpoint(file), str(file))
    policy.folder = folder
    return policy


def check_policy(content: dict[str, Any], source: str) -> None:
    """Refuse a checkpoint of which a policy cannot be made, by a CheckpointError."""
    cure = "give a checkpoint of a training run"
    for key, kind in _NEEDED.items():
        if key not in content:
            raise CheckpointError(f"{source} holds no policy ('{key}' is missing); {cure}")
        if not isinstance(content[key], kind) or isinstance(content[key], bool):
            found = type(content[key]).__name__
            raise CheckpointError(f"{source} holds no policy ('{key}' is {found}, expected {kind.__name__}); {cure}")
    for key in ("observation_names", "action_names"):
        if not all(isinstance(name, str) for name in content[key]):
            raise CheckpointError(f"{source} holds no policy ('{key}' must be words); {cure}")


def shipped_policies() -> list[str]:
    """Return the names of the policies inside the package."""
    return sorted(path.stem for path in _SHIPPED.glob("*.pt"))


def strip_checkpoint(path: str | Path, out: str | Path) -> None:
    """Write the policy alone, without optimiser and environments, of the checkpoint `path` to `out`."""
    from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint

    content = load_checkpoint(path)
    save_checkpoint(Path(out), {key: content[key] for key in _NEEDED})


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
    if not isinstance(contract, dict) or contract.get("format") != CONTRACT_FORMAT:
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
