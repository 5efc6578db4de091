"""Former names of modules, kept for one minor version: importing one gives the module by its name of today."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType

_ROOMS = {
    "_jit": "kernels.jit",
    "config.files": "schema.files",
    "config.schema": "schema.sections",
    "config.train_schema": "schema.training",
    "config.validate": "schema.validate",
    "config.values": "schema.values",
    "config.yaml_text": "schema.yaml_text",
    "control.estimator": "sensing.estimator",
    "control.payload_geometric": "policies.payload_geometric",
    "control.policy": "policies.policy",
    "control.scripted": "policies.baselines",
    "control.scripted_formation": "policies.formation",
    "control.scripted_hold": "policies.hold",
    "control.tuned": "policies.tuned",
    "evaluation.apart": "evaluation.parallel",
    "px4": "deploy.px4",
    "ros": "deploy.ros",
    "sim.sensors": "sensing.sensors",
    "sitl": "deploy.sitl",
    "tasks.communication": "sensing.communication",
    "tasks.failures": "mdp.failures",
    "tasks.global_state": "mdp.global_state",
    "tasks.ground": "mdp.ground",
    "tasks.load_sensing": "sensing.load_sensing",
    "tasks.observations": "mdp.observations",
    "tasks.paths": "planning.paths",
    "tasks.rewards": "mdp.rewards",
    "tasks.sensing": "sensing.measurement",
    "tasks.starts": "mdp.initial_states",
    "tasks.targets": "planning.targets",
    "tasks.trajectory": "planning.trajectory",
    "tasks.view": "mdp.env_data",
    "view": "viewer",
}
RENAMED = {f"{__package__}.{old}": f"{__package__}.{new}" for old, new in _ROOMS.items()}


class _Alias(Loader):
    """Loads a module under its former name, too.

    Args:
        name: of today.
    """

    def __init__(self, name: str):
        self._name = name

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module itself."""
        module = import_module(self._name)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing but give the module its own specification back, in whose place the import has put the alias's."""
        module.__spec__ = self._spec


class _Finder(MetaPathFinder):
    """Finds modules of the package by their former names."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how a module of a former name is imported; None of all others, and of commands: Python runs those."""
        parts = fullname.split(".")
        if parts[0] != __package__ or parts[-1] == "__main__":
            return None
        for count in range(len(parts), 1, -1):
            if (name := RENAMED.get(".".join(parts[:count]))) is not None:
                name = ".".join([name, *parts[count:]])
                found = find_spec(name)
                return found and ModuleSpec(
                    fullname, _Alias(name), is_package=found.submodule_search_locations is not None
                )
        return None


def install() -> None:
    """Let Python find modules by their former names."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
