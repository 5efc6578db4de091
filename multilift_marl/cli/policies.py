"""Policies by the names that commands take: scripts, one's own classes, trained ones."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple, Protocol

from multilift_marl.config.config import Config
from multilift_marl.control.policy import Policy
from multilift_marl.control.scripted import SCRIPTED, make_scripted
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, nearest

NAMES = "script, module:Class, exported policy (.onnx), checkpoint (.pt), run folder or shipped policy"


class NamedPolicy(Protocol):
    """What a name stands for, before it is bound to environments."""

    @property
    def config(self) -> Config | None:
        """The configuration that it was trained with, None for others."""

    def bind(self, vec: MultiliftVec) -> Policy:
        """Return the policy for the environments, a ConfigError if it does not fit them."""

    def misfit(self, vec: MultiliftVec) -> str:
        """Return why a trained policy cannot fly the environments, as the rest of a sentence, "" for others."""


class Scripted(NamedTuple):
    """A script, or a class of one's own."""

    name: str
    config: None = None

    def bind(self, vec: MultiliftVec) -> Policy:
        """Return the policy for the environments."""
        return make_scripted(self.name, vec)

    def misfit(self, vec: MultiliftVec) -> str:
        """Return nothing: `bind` tells."""
        return ""


def find_policy(name: str, what: str = "policy", others: Iterable[str] = ()) -> NamedPolicy:
    """Return the policy of a name, see `NAMES`.

    Args:
        name: of the policy.
        what: it is, for messages.
        others: further names that the caller knows, for messages.

    Raises:
        CheckpointError, ConfigError: there is none, or it cannot be loaded.
    """
    if name in SCRIPTED or ":" in name:
        return Scripted(name)
    if name.endswith((".onnx", ".pt")) or Path(name).is_dir() or _is_shipped(name):
        return _load(name)
    raise ConfigError(f"unknown {what} '{name}'{nearest(name, [*SCRIPTED, *others])}: give a {NAMES}")


def _is_shipped(name: str) -> bool:
    from multilift_marl.agents.policy import shipped_policies

    return name in shipped_policies()


def _load(name: str) -> NamedPolicy:
    if name.endswith(".onnx"):  # needs no torch
        from multilift_marl.agents.trained import ExportedPolicy

        return ExportedPolicy(Path(name))
    import torch

    from multilift_marl.agents.policy import load_policy

    torch.set_num_threads(1)  # for networks this small, more of them only wait for each other
    return load_policy(name)
