"""What a task's class declares, checked when it is registered: mistakes are named before kernels are compiled."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from multilift_marl._jit import is_kernel
from multilift_marl.config.values import Section
from multilift_marl.errors import ConfigError, nearest, shorten
from multilift_marl.tasks.observations import FRAMES, Component, list_components
from multilift_marl.tasks.rewards import Term

if TYPE_CHECKING:
    from multilift_marl.tasks.base import Task


def check_declared(task: type[Task]) -> None:
    """Check the class attributes of a task of one's own.

    Raises:
        ConfigError: one that is no value for it; the first is named.
    """
    for problem in _find_problems(task):
        raise ConfigError(f"task {task.name}: {problem}")


def _find_problems(task: Any) -> Iterator[str]:
    """Yield what is wrong and how to mend it."""
    from multilift_marl.tasks.base import Kernels, Task

    if task.start is Task.start and task.draw_start is Task.draw_start:
        yield "it has no start(self, env, rng, mass), which says how an episode begins; add it"
    if not (isinstance(task.Options, type) and issubclass(task.Options, Section)):
        yield f"Options is {_text(task.Options)}; derive a class of typed fields from config.values.Section"
    if not isinstance(task.REWARD, dict):
        yield f"REWARD is {_text(task.REWARD)}; give a dict of rewards.Term by name"
    for name, term in task.REWARD.items():
        if not isinstance(term, Term):
            yield f"REWARD['{name}'] is {_text(term)}; give Term(weight, kernel, margin=...)"
        if not is_kernel(term.value, 2 + len(term.margins)):
            wanted = ", ".join(["e", "v", *(f"margin {i + 1}" for i in range(len(term.margins)))])
            yield f"REWARD['{name}'].value is {_text(term.value)}; give a function of ({wanted}) with @inlined"
    if not isinstance(task.KERNELS, Kernels):
        yield f"KERNELS is {_text(task.KERNELS)}; give tasks.base.Kernels(...)"
    for name, kernel in task.KERNELS._asdict().items():
        if not is_kernel(kernel, 2) and (kernel is not None or name == "is_good"):
            yield f"KERNELS.{name} is {_text(kernel)}; give a function of (e, v) with @inlined"
    for where in ("EXTRA", "EXTRA_STATE"):
        yield from _find_component_problems(getattr(task, where), where)
    common = {part.name for part in list_components("reference")}
    for part in task.EXTRA:
        if part.name in common:
            yield f"EXTRA has a component '{part.name}', as observations of all tasks do; give it another name"


def _find_component_problems(parts: Any, where: str) -> Iterator[str]:
    if not isinstance(parts, tuple):
        yield f"{where} is {_text(parts)}; give a tuple of observations.Component, (Component(...),) for one"
    for part in parts:
        if not isinstance(part, Component):
            yield f"{where} holds {_text(part)}; give observations.Component(...)"
        if part.frame not in (*FRAMES, "-"):
            yield f"component '{part.name}' has an unknown frame '{part.frame}'{nearest(part.frame, [*FRAMES, '-'])}"
        if isinstance(part.size, bool) or not isinstance(part.size, int) or part.size < 1:
            yield f"component '{part.name}' has size {_text(part.size)}; give how many numbers it has, 1 or more"
        if not is_kernel(part.value, 3):
            yield f"component '{part.name}' has value {_text(part.value)}; give a function of (e, n, v) with @inlined"
    for name, count in Counter(part.name for part in parts).items():
        if count > 1:
            yield f"{where} has {count} components '{name}'; give each a name of its own"


def _text(value: object) -> str:
    return shorten(repr(getattr(value, "py_func", value)))
