"""The tasks: one file, one line here, one configuration each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from multilift_marl.config.load import register_config, state_task
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.plugins import describe_unknown, describe_unregistered, load_entry_points, registers
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.gate import Gate
from multilift_marl.tasks.hover import Hover
from multilift_marl.tasks.land import Land
from multilift_marl.tasks.loss import Loss
from multilift_marl.tasks.navigate import Navigate
from multilift_marl.tasks.pose import Pose
from multilift_marl.tasks.recover import Recover
from multilift_marl.tasks.regroup import Regroup
from multilift_marl.tasks.takeoff import Takeoff
from multilift_marl.tasks.task_checks import check_declared
from multilift_marl.tasks.track import Track

TASKS: dict[str, type[Task]] = {
    "gate": Gate,
    "hover": Hover,
    "land": Land,
    "loss": Loss,
    "navigate": Navigate,
    "pose": Pose,
    "recover": Recover,
    "regroup": Regroup,
    "takeoff": Takeoff,
    "track": Track,
}


_SHIPPED = frozenset(TASKS)
T = TypeVar("T", bound=type[Task])


def register_task(task: T, config: str | Path | Mapping[str, Any] | None = None) -> T:
    """Make a task of one's own known by its `name`; also as a decorator of the class.

    Args:
        task: the class; of several with one name, the latest counts.
        config: its configuration, which is then known by the same name, and needs no key `task`: a YAML file, or values
            by section; None for typed defaults.

    Returns:
        The class.

    Raises:
        ConfigError: no task, one without a name, or with that of a shipped task or configuration, one that declares
            what cannot be, see `check_declared`, or a configuration of another task.
    """
    name = getattr(task, "name", None)
    if not (isinstance(task, type) and issubclass(task, Task) and isinstance(name, str)):
        raise ConfigError(f"{task!r} is no task that could be registered: derive a class from Task and give it a name")
    if name in _SHIPPED and task is not TASKS[name]:
        raise ConfigError(f"a task of one's own cannot have the name '{name}': choose one that is not taken")
    if name not in _SHIPPED:
        check_declared(task)
        register_config(name, state_task(name, {} if config is None else config))
    TASKS[name] = task
    return task


def _register_found(task: Any) -> None:
    """Register what an entry point is, unless its module has done so, with a configuration perhaps."""
    if not any(task is known for known in TASKS.values()):
        register_task(task)


registers.append(_register_found)


def list_tasks() -> list[str]:
    """Return the names of all tasks, those of installed packages (entry points) with them."""
    load_entry_points()
    return sorted(TASKS)


def find_task(name: str) -> type[Task]:
    """Return the class of a task by name, of installed packages too.

    Raises:
        ConfigError: there is no such task, or the package that has it fails.
    """
    if name not in TASKS:
        load_entry_points()
    if name not in TASKS:
        cure = describe_unregistered(name) or nearest(name, TASKS, otherwise="; one's own needs import=<module>")
        raise ConfigError(describe_unknown(name, f"unknown task '{name}'{cure}"))
    return TASKS[name]
