"""The policy that training starts from (`train.init`): found, pinned, checked to agree, and taken over."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from multilift_marl.agents.checkpoint import check_like, parse_checkpoint
from multilift_marl.agents.mappo import Learner
from multilift_marl.agents.meanings import spell
from multilift_marl.agents.policy import LearnedPolicy, find_checkpoint, shipped_policies
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.control.action_interface import THRUST
from multilift_marl.control.actions import ACTIONS
from multilift_marl.errors import ConfigError
from multilift_marl.mdp.observations import observation_names
from multilift_marl.policies.baselines import SCRIPTED
from multilift_marl.schema.files import is_pinned, pin_file, read_pinned
from multilift_marl.schema.training import TUNED
from multilift_marl.tasks import find_task

_KEY = "train.init"
_MEANINGS = ("control.action", "env.units")
_NETWORK = ("train.actor", "train.hidden", "train.gru", "train.asinh", "train.observe", "train.changes")


class Initial(NamedTuple):
    """A policy that training starts from."""

    name: str
    """As the user gave it, or short for its pinned file."""
    policy: LearnedPolicy
    critic: Any
    """Weights and statistics of the critic that its checkpoint holds, None if it holds none."""

    def check(self, configs: Sequence[Config]) -> None:
        """Refuse environments and networks that do not agree with the policy's, before they are made.

        Args:
            configs: of the environments, one of each rig.

        Raises:
            ConfigError: naming the first difference: the key or number, there and here.
        """
        there = self.policy.config
        for here in configs:
            self._check_meanings(there, here)
        self._check_networks([key for key in _NETWORK if spell(key, there) != spell(key, configs[0])], configs[0])

    def take_over(self, learner: Learner, here: Config) -> str:
        """Give a learner the policy's weights and statistics, the critic's where they fit; return what was given.

        The matrix of the base policy is the origin's, too, also where the same base policy has another one for this
        rig: the team begins by acting exactly as the policy did.

        Raises:
            ConfigError: the learner corrects another base policy.
        """
        known = self.policy.config.train.residual == here.train.residual
        # Another base policy is the same one if its matrix is.
        if not known and not torch.equal(self.policy.actor.base, learner.actor.base):
            self._check_networks(["train.residual"], here)
        learner.actor.load_state_dict(self.policy.actor.state_dict())
        if self.critic is None:
            return "actor; it holds no critic"
        try:
            check_like(self.critic, learner.critic.state_dict(), "critic")
        except ValueError:
            return "actor; its critic is of another shape"
        learner.critic.load_state_dict(self.critic)
        return "actor and critic"

    def _check_meanings(self, there: Config, here: Config) -> None:
        """Refuse environments in which a number that is observed, or of an action, has another meaning."""
        for key in _MEANINGS:
            self._compare("was trained with", key, there, here)
        action, task = here.control.action, find_task(here.task)
        names = [number.name for number in ACTIONS[action].numbers]
        observed = observation_names(action, task.extra(here), here.env.ages)
        if difference := self.policy.first_difference(names, observed):
            raise ConfigError(
                f"{_KEY}={self.name} was trained in task {there.task} and cannot start a training in this "
                f"{here.task}: {difference}; start from another policy, or observe and act as there"
            )
        for i, number in enumerate(ACTIONS[action].numbers):
            if number.limit != THRUST:
                what = f"acts by number {i}, {number.name}, in units of"
                self._compare(what, f"control.{number.limit}", there, here)

    def _compare(self, what: str, key: str, there: Config, here: Config) -> None:
        found, wanted = (spell(key, config) for config in (there, here))
        if found != wanted:
            raise ConfigError(f"{_KEY}={self.name} {what} {found} there and {wanted} here; set {found}")

    def _check_networks(self, differing: list[str], here: Config) -> None:
        """Refuse the first of the keys in which the networks differ, by a sentence that mends all."""
        there = self.policy.config
        if differing:
            if there.train.residual != here.train.residual and "train.residual" not in differing:
                differing = [*differing, "train.residual"]
            cure = " ".join(spell(key, there) for key in differing)
            first = differing[0]
            raise ConfigError(
                f"{_KEY}={self.name} has another network: {spell(first, there)} there and {spell(first, here)} here; "
                f"set {cure}"
            )


def find_initial(config: Config) -> tuple[Config, Initial | None]:
    """Return the policy of `train.init`, None if it names none, and a configuration that has its file pinned.

    Of a file that is anybody's, weights and numbers are all that is used.

    Raises:
        CheckpointError: there is no such run or file; or it is damaged, or holds no policy.
        ConfigError: it is no trained policy; its file is missing or has changed; or its configuration is of another
            version, or names a module that may not run, see `trust.review`.
    """
    if (name := config.train.init) is None:
        return config, None
    reference = name if is_pinned(name) else _pin(name)
    path, data = read_pinned(_KEY, reference)
    content = parse_checkpoint(data, path)
    known = short_name(reference) if reference == name else name
    initial = Initial(known, LearnedPolicy(content, str(path)), content.get("critic"))
    return build_config(config.model_dump(), {_KEY: reference}), initial


def _pin(name: str) -> str:
    """Return the pinned checkpoint file of a policy by name."""
    shipped = shipped_policies()
    if (name in SCRIPTED or name in TUNED) and name not in shipped:
        raise ConfigError(f"{_KEY}={name} is a baseline and has no weights; set train.residual={name} to correct it")
    if name.endswith(".onnx"):
        raise ConfigError(
            f"{_KEY}={name} is an exported network, which cannot be trained; give the run or the checkpoint that it "
            "comes from"
        )
    if ".py:" in name:
        raise ConfigError(f"{_KEY}={name} is a class and has no weights; give a run, a shipped policy or a .pt file")
    return pin_file(str(find_checkpoint(name)[0]))


def short_name(reference: str) -> str:
    """Return what a policy is called in tables: the name of its run, else that of its file."""
    path = Path(reference.partition("#sha256=")[0])
    return path.parent.parent.name if path.parent.name == "checkpoints" else path.stem
