"""Trained policies for use: NumPy in, NumPy out, torch inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from multilift_marl.agents.checkpoint import check_like, load_checkpoint, save_checkpoint
from multilift_marl.agents.networks import Actor
from multilift_marl.agents.trained import ExportedPolicy, TrainedPolicy
from multilift_marl.config.load import build_config
from multilift_marl.errors import CheckpointError

_SHIPPED = Path(__file__).resolve().parents[1] / "policies"
_KEPT = {"config": dict, "actor": dict, "observation_names": list, "action_names": list, "frames": int}
"""What a policy needs of a checkpoint."""


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
        check_policy(content, source)
        names = content["observation_names"], content["action_names"]
        super().__init__(build_config(content["config"]), *names, source)
        self.frames = content["frames"]
        size, train = (len(self.observation_names), len(self.action_names)), self.config.train
        with torch.random.fork_rng(devices=[]):  # initial weights, overwritten at once, must not cost random numbers
            self.actor = Actor(train.actor, *size, train.hidden, train.initial_std, torch.zeros(size[1], size[0]))
        try:
            check_like(content["actor"], self.actor.state_dict(), "actor")
        except ValueError as error:
            raise CheckpointError(
                f"{source} holds other weights than its network has ({error}); train again"
            ) from error
        self.actor.load_state_dict(content["actor"])

    @torch.no_grad()
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the mean action (..., N, A) float32 within [-1, 1] for observations (..., N, D).

        Raises:
            ValueError: observations of another size than the policy was trained with.
        """
        return self.actor(torch.from_numpy(self._checked(observation)))[0].clamp(-1, 1).numpy()


def load_policy(name: str | Path) -> TrainedPolicy:
    """Return a trained policy.

    Args:
        name: a run folder (its best checkpoint is taken), a checkpoint file, the .onnx file of an exported policy, or
            the name of a shipped policy ("hover").

    Raises:
        CheckpointError: missing, truncated or foreign.
        ConfigError: its configuration is of another version, or a module that it needs is missing.
        ModuleNotFoundError: an exported policy needs onnxruntime, the `export` extra.
    """
    path = Path(name)
    if path.suffix == ".onnx":
        return ExportedPolicy(path)
    if path.is_dir():
        best = path / "checkpoints" / "best.pt"
        path = best if best.is_file() else path / "checkpoints" / "last.pt"
    elif not path.is_file() and (_SHIPPED / f"{name}.pt").is_file():
        path = _SHIPPED / f"{name}.pt"
    content = load_checkpoint(path)
    return LearnedPolicy(content, str(path))


def check_policy(content: dict[str, Any], source: str) -> None:
    """Refuse a checkpoint of which a policy cannot be made, by a CheckpointError."""
    cure = "give a checkpoint of a training run"
    for key, kind in _KEPT.items():
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
    content = load_checkpoint(path)
    save_checkpoint(Path(out), {key: content[key] for key in _KEPT})
