"""Policies by name, and trained ones for use: NumPy in, NumPy out. torch is imported only where a checkpoint is."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from multilift_marl.agents.contract import AGAIN, Network, check_same_export, open_network, read_contract, read_fields
from multilift_marl.agents.meanings import changed_meanings, spell
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.errors import CheckpointError, ConfigError, nearest, pip_install, warn_once
from multilift_marl.plugins import identify, named
from multilift_marl.policies.baselines import SCRIPTED, check_interface, make_scripted
from multilift_marl.policies.policy import Policy
from multilift_marl.trust import find_foreign, review, trusting

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

_SHIPPED = Path(__file__).resolve().parents[1] / "policies"
_NEEDED = {"config": dict, "actor": dict, "observation_names": list, "action_names": list, "frames": int}
"""What a policy needs of a checkpoint."""
_NAMES = "baseline, module:Class, exported policy (.onnx), checkpoint (.pt), run folder or shipped policy"


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
        # The memory is of B teams: whatever axes come before the drones are one to the network.
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
        # Shallow: both have the same network; the memory is dropped, not copied.
        other = copy.copy(self)
        other.reset()
        return other

    def misfit(self, vec: MultiliftVec) -> str:
        """Return why the policy does not fit `vec`, as the rest of a sentence, "" if it does."""
        if reason := self.misfit_config(vec.config):
            return reason
        if difference := self.first_difference(vec.action_names, vec.observation_names):
            return (
                f"was trained in task {self.config.task} and cannot fly this {vec.task.name}: {difference}; fly what "
                "it was trained in, or another policy"
            )
        return ""

    def first_difference(self, actions: Iterable[str], observations: Iterable[str]) -> str:
        """Return which number of an action or an observation has another name than there, "" if none has."""
        difference = first_difference("actions", self.action_names, actions)
        return difference or first_difference("observations", self.observation_names, observations)

    def check(self, config: Config, role: str = "") -> None:
        """Refuse environments, by a ConfigError, of which the configuration alone tells that it cannot fly them.

        Warn of those in which its actions or observations mean something else than in its own, see `meanings`.

        Args:
            config: theirs.
            role: the key that names the policy, for messages.
        """
        if reason := self.misfit_config(config):
            raise ConfigError(f"the policy of {self.source} {reason}")
        if warning := self.warning(config):
            warn_once("agents", f"the policy of {self.source} {warning}")

    def warning(self, config: Config) -> str:
        """Return of what `check` warns, as the rest of a sentence, "" if of nothing."""
        changed = changed_meanings(self.config, config)
        own = " ".join(spell(key, self.config) for key in changed)
        return (
            f"was configured with {own}; the values here change what its actions and observations mean" if own else ""
        )

    def misfit_config(self, config: Config) -> str:
        """Return why the policy does not fit a configuration, as the rest of a sentence, "" if nothing tells so."""
        trained, asked = self.config.control.action, config.control.action
        if trained == asked:
            return ""
        return f"was trained with control.action={trained} and cannot fly {asked}; set control.action={trained}"

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget what was observed in the environments of the mask (E,) bool (None: all)."""
        if mask is None:
            # None rather than zeros: the next environments may be another number of teams.
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
        from multilift_marl.agents.networks import build_actor

        check_policy(content, source)
        # Before the configuration is built, which imports the modules that it names.
        review(content["config"], source)
        config = build_config(content["config"])
        super().__init__(config, content["observation_names"], content["action_names"], source)
        self.frames: int = content["frames"]
        size = (len(self.action_names), len(self.observation_names))
        with torch.random.fork_rng(devices=[]):  # initial weights, overwritten at once, must not cost random numbers
            self.actor = build_actor(config.train, torch.zeros(size), self.observation_names)
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
        CheckpointError: network or contract are missing, damaged or foreign, or do not fit each other.
        ConfigError: the configuration is of another version, or a module that it needs is missing.
        ModuleNotFoundError: onnxruntime is missing.
    """

    def __init__(self, path: Path):
        self.contract = read_contract(path)
        needed = read_fields(self.contract, path.with_suffix(".json"))
        review(needed.config, path)
        action = [number.name for number in needed.action.numbers]
        super().__init__(build_config(needed.config), needed.observation.names, action, str(path))
        memory = 0 if needed.network.memory is None else needed.network.memory.size
        if memory != (gru := self.config.train.gru):
            raise CheckpointError(f"{path} has a memory of {memory} numbers, its contract train.gru={gru}; {AGAIN}")
        session = open_network(path)  # which says what is wrong with a file that is damaged
        check_same_export(path, needed)
        self._network = Network(session, needed, str(path))

    def _act(self, observation: np.ndarray, memory: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        action, *after = self._network.run(observation, *(() if memory is None else (memory,)))
        return np.clip(action, -1, 1), after[0] if after else None


class Script(NamedTuple):
    """A baseline, or a class of one's own, by its name."""

    name: str
    config: None = None

    def bind(self, vec: MultiliftVec) -> Policy:
        """Return the policy for the environments, a ConfigError if it does not fit them."""
        return make_scripted(self.name, vec)

    def check(self, config: Config, role: str = "") -> None:
        """Do as `TrainedPolicy.check`."""
        check_interface(self.name, config.control.action, role)

    def warning(self, config: Config) -> str:
        """Return nothing: its actions and observations are those of the environments."""
        return ""

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
    if text in SCRIPTED:
        return Script(text)
    # Who names module:Class wants it to run; what only a file names has to be trusted, see `trust.review`.
    if ":" in text:
        named.add(identify(text.rpartition(":")[0]))
        return Script(text)
    known = text == "latest" or text.endswith((".onnx", ".pt")) or text in shipped_policies()
    if not known and not any(os.path.isdir(folder) for folder in (text, f"runs/{text}")):
        known_names = [*SCRIPTED, *shipped_policies(), *others]
        raise ConfigError(f"unknown {what} '{text}'{nearest(text, known_names)}: give a {_NAMES}")
    return load_policy(name)


def load_policy(name: str | Path, checkpoint: str = "best", trust: bool = False) -> TrainedPolicy:
    """Return a trained policy.

    Modules that it was trained with (`import`) must be imported before, or trusted: what a file names may be anybody's.

    Args:
        name: a run folder, its name, "latest", a checkpoint file, the .onnx file of an exported policy, or the name of
            a shipped policy ("hover").
        checkpoint: of a run, "best" (the last one where there is no best), "last", or a file.
        trust: whether the modules that it names may run.

    Raises:
        CheckpointError: missing, truncated or foreign.
        ConfigError: its configuration is of another version, a module that it needs is missing or may not run, or a
            checkpoint is asked for of what is no run.
        ModuleNotFoundError: a checkpoint needs torch, the `train` extra; an exported policy onnxruntime, `export`.
    """
    if checkpoint != "best" and (kind := _kind(str(name))) != "run":
        raise ConfigError(f"checkpoint={checkpoint} means nothing to the {kind} '{name}'; leave it out")
    with trusting(trust):
        return ExportedPolicy(Path(name)) if str(name).endswith(".onnx") else _load_learned(name, checkpoint)


def _load_learned(name: str | Path, checkpoint: str) -> LearnedPolicy:
    """Return the policy of a checkpoint, see `load_policy`."""
    file, folder = find_checkpoint(name, checkpoint)
    from multilift_marl.agents.checkpoint import load_checkpoint

    policy = LearnedPolicy(load_checkpoint(file), str(file))
    policy.folder = folder
    return policy


def find_checkpoint(name: str | Path, checkpoint: str = "best") -> tuple[Path, Path]:
    """Return the checkpoint file of a policy by name, and the folder that what is made of it belongs to.

    Raises:
        CheckpointError, ConfigError, ModuleNotFoundError: see `load_policy`.
    """
    text = str(name)
    try:
        from multilift_marl.agents.checkpoint import find_run
    except ModuleNotFoundError as error:
        message = f"ml.load_policy needs {error.name}: {pip_install('train')}"
        raise ModuleNotFoundError(message, name=error.name) from error
    kind = _kind(text)
    if kind == "shipped policy":
        return _SHIPPED / f"{text}.pt", Path("runs") / f"shipped-{text}"
    if kind == "file":
        return Path(name), Path(name).parent
    folder = find_run(name, others=shipped_policies())
    file = folder / "checkpoints" / f"{checkpoint}.pt" if checkpoint in ("best", "last") else Path(checkpoint)
    return file if file.is_file() or checkpoint != "best" else file.with_name("last.pt"), folder


def _kind(name: str) -> str:
    """Return what a name stands for: a file, a shipped policy, or a run."""
    if os.path.isfile(name) or name.endswith((".pt", ".onnx")):
        return "file"
    # A run in the current folder goes before a shipped policy of that name, another folder does not.
    own = os.path.isdir(os.path.join(name, "checkpoints"))
    return "shipped policy" if name in shipped_policies() and not own else "run"


def first_difference(kind: str, there: Iterable[str], here: Iterable[str]) -> str:
    """Return which of the names of numbers differs, of "actions" say, "" if none does."""
    for i, (mine, its) in enumerate(zip_longest(there, here, fillvalue="nothing")):
        if mine != its:
            return f"number {i} of the {kind} is {mine} there and {its} here"
    return ""


def check_policy(content: dict[str, Any], source: str) -> None:
    """Refuse a checkpoint of which a policy cannot be made, by a CheckpointError."""
    cure = "give a checkpoint of a training run"
    for key, kind in _NEEDED.items():
        if key not in content:
            raise CheckpointError(f"{source} holds no policy ('{key}' is missing); {cure}")
        # bool by itself, since True is an int to Python.
        if not isinstance(content[key], kind) or isinstance(content[key], bool):
            found = type(content[key]).__name__
            raise CheckpointError(f"{source} holds no policy ('{key}' is {found}, expected {kind.__name__}); {cure}")
    for key in ("observation_names", "action_names"):
        if not all(isinstance(name, str) for name in content[key]):
            raise CheckpointError(f"{source} holds no policy ('{key}' must be words); {cure}")
    if foreign := find_foreign(content["config"]):
        raise CheckpointError(f"{source} holds no policy ({foreign}); {cure}")


def shipped_policies() -> list[str]:
    """Return the names of the policies inside the package."""
    return sorted(path.stem for path in _SHIPPED.glob("*.pt"))


def strip_checkpoint(path: str | Path, out: str | Path) -> None:
    """Write the policy alone, without optimiser and environments, of the checkpoint `path` to `out`."""
    from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint

    content = load_checkpoint(path)
    save_checkpoint(Path(out), {key: content[key] for key in _NEEDED})
