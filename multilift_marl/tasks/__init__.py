"""The tasks: one file, one line here, one configuration each."""

from __future__ import annotations

from multilift_marl.errors import ConfigError, nearest
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.gate import Gate
from multilift_marl.tasks.hover import Hover
from multilift_marl.tasks.land import Land
from multilift_marl.tasks.loss import Loss
from multilift_marl.tasks.pose import Pose
from multilift_marl.tasks.recover import Recover
from multilift_marl.tasks.takeoff import Takeoff
from multilift_marl.tasks.track import Track

TASKS: dict[str, type[Task]] = {
    "gate": Gate,
    "hover": Hover,
    "land": Land,
    "loss": Loss,
    "pose": Pose,
    "recover": Recover,
    "takeoff": Takeoff,
    "track": Track,
}


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
