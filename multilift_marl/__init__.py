"""Multi-agent reinforcement learning for cooperative aerial transport on MuJoCo."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from multilift_marl import _interrupt, _renamed, sim  # noqa: F401 (_interrupt first: Ctrl-C may come while the rest is imported)
from multilift_marl.config.load import load_config, register_config
from multilift_marl.envs.core import make_vec
from multilift_marl.envs.gymnasium_env import register as _register_with_gymnasium
from multilift_marl.envs.multilift_v0 import parallel_env
from multilift_marl.envs.multilift_v0 import register as _register_with_pettingzoo
from multilift_marl.errors import pip_install
from multilift_marl.rig.vehicles import register_vehicle
from multilift_marl.tasks import list_tasks, register_task

if TYPE_CHECKING:
    from multilift_marl.agents.policy import load_policy
    from multilift_marl.envs.torchrl_env import torchrl_env
else:
    _NEED_TORCH = {
        "load_policy": "multilift_marl.agents.policy",
        "torchrl_env": "multilift_marl.envs.torchrl_env",
    }

    def __getattr__(name: str) -> Any:
        """Import what needs torch only when it is asked for."""
        if name in _NEED_TORCH:
            from importlib import import_module

            try:
                return getattr(import_module(_NEED_TORCH[name]), name)
            except ModuleNotFoundError as error:
                cure = pip_install("train")
                raise ModuleNotFoundError(f"ml.{name} needs {error.name}: {cure}", name=error.name) from error
        raise AttributeError(f"module 'multilift_marl' has no attribute '{name}'")


try:
    __version__ = version("multilift_marl")
except PackageNotFoundError:  # a clone that is not installed
    __version__ = "0+unknown"
__all__ = [
    "list_tasks",
    "load_config",
    "load_policy",
    "make_vec",
    "parallel_env",
    "register_config",
    "register_task",
    "register_vehicle",
    "sim",
    "torchrl_env",
]

_renamed.install()
_register_with_gymnasium()
_register_with_pettingzoo()
