"""The tasks: one file, one line here, one configuration each."""

from __future__ import annotations

from multilift_marl.errors import ConfigError, nearest
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.hover import Hover
from multilift_marl.tasks.land import Land
from multilift_marl.tasks.takeoff import Takeoff

TASKS: dict[str, type[Task]] = {"hover": Hover, "land": Land, "takeoff": Takeoff}


def list_tasks() -> list[str]:
    """Return the names of all tasks."""
    return sorted(TASKS)


def find_task(name: str) -> type[Task]:
    """Return the class of a task by name.

    Raises:
        ConfigError: there is no such task.
    """
    if name not in TASKS:
        raise ConfigError(f"unknown task '{name}'{nearest(name, TASKS)}")
    return TASKS[name]
