"""What a task's class declares, checked when it is registered: mistakes are named before kernels are compiled."""

from __future__ import annotations

import ast
import inspect
import re
from collections import Counter
from collections.abc import Iterator
from difflib import get_close_matches
from textwrap import dedent
from types import FunctionType
from typing import TYPE_CHECKING, Any

from multilift_marl.errors import ConfigError, nearest, shorten
from multilift_marl.kernels.cache import used_values
from multilift_marl.kernels.compiler import Kernel
from multilift_marl.kernels.jit import is_kernel, is_plain, takes
from multilift_marl.mdp.failures import CAUSES
from multilift_marl.mdp.observations import FRAMES, Component, list_components
from multilift_marl.mdp.rewards import Term
from multilift_marl.schema.values import Section

if TYPE_CHECKING:
    from multilift_marl.tasks.base import Task

_MOTION = (
    "payload_position", "payload_velocity", "payload_body_rates", "drone_position",
    "drone_rotation", "drone_velocity", "drone_body_rates", "cable_tension",
)  # fmt: skip
_SIMULATED = (
    *(f"{state}.{name}" for state in ("state", "estimated") for name in _MOTION), "payload_estimate", "payload",
    *(f"parameters.{name}" for name in ("payload_mass", "payload_inertia", "vehicle_mass")),
)  # fmt: skip
"""Fields of the view that the simulation writes anew in every step, or has read before the episode: what a kernel
writes there moves nothing. Rotors, broken cables, a point payload's attitude and `disturbances` are the task's own."""


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
        yield f"Options is {_text(task.Options)}; derive a class of typed fields from schema.values.Section"
    if not isinstance(task.REWARD, dict):
        yield f"REWARD is {_text(task.REWARD)}; give a dict of rewards.Term by name"
    for name, term in task.REWARD.items():
        if not _is_word(name):
            yield f"REWARD holds {_text(name)}; give words of letters, digits and _"
        if name == "total":
            yield "REWARD holds 'total', the name of the sum of all terms in the records of training; give it another"
        if not isinstance(term, Term):
            yield f"REWARD['{name}'] is {_text(term)}; give Term(weight, kernel, margin=...)"
        if term.unit != "deg" and any(mark in term.unit for mark in ("deg", "°")):
            yield f"REWARD['{name}'] has margins of unit '{term.unit}', of which none is converted; 'deg' alone is"
        margins = [f"margin {i + 1}" for i in range(len(term.margins))]
        if why := _misfit(term.value, "e", "v", *margins):
            yield f"REWARD['{name}'].value is {why}"
    if not isinstance(task.KERNELS, Kernels):
        yield f"KERNELS is {_text(task.KERNELS)}; give tasks.base.Kernels(...)"
    for name, kernel in task.KERNELS._asdict().items():
        if kernel is None and name != "is_good":
            continue
        if name == "plan" and (why := _misfit(kernel, "e", "v")):
            yield f"KERNELS.plan is {why}"
        if name != "plan" and not is_kernel(kernel, 2):
            yield f"KERNELS.{name} is {_text(kernel)}; give a function of (e, v) with @inlined"
    yield from _find_failure_problems(task.FAILURES)
    yield from _find_strays(task)
    for where in ("EXTRA", "EXTRA_STATE"):
        yield from _find_component_problems(getattr(task, where), where)
    common = {part.name for part in list_components("reference")}
    for part in task.EXTRA:
        if part.name in common:
            yield f"EXTRA has a component '{part.name}', as observations of all tasks do; give it another name"
    for kernel, lost in _kernels(task):
        for function in _own_functions(kernel) if not is_plain(kernel) else ():
            for written in _find_lost_writes(function, lost):
                yield (
                    f"{function.__name__} writes {written}, which is overwritten or never read; move what can be moved "
                    "by `goal`, and start elsewhere by `start`"
                )


def _kernels(task: Any) -> Iterator[tuple[Any, tuple[str, ...]]]:
    """Yield the kernels of a task, with fields of the view that what they write into is lost: see `_SIMULATED`."""
    measured = tuple(f"errors.{name}" for name in ("position", "rotation", "distance", "angle"))
    for name, kernel in task.KERNELS._asdict().items():
        early = {"plan": ("terms", *measured), "check": ("terms",)}.get(name, ())
        yield kernel, (*_SIMULATED, *early)
    parts = [part.value for part in (*task.REWARD.values(), *task.EXTRA, *task.EXTRA_STATE)]
    for value in (*parts, *task.own_failures().values()):
        yield value, _SIMULATED


def _find_failure_problems(names: Any) -> Iterator[str]:
    if not isinstance(names, tuple | dict):
        yield f"FAILURES is {_text(names)}; give a tuple of names, ('hit_wall',) for one, or a dict of functions"
    for name in names:
        if not _is_word(name):
            yield f"FAILURES holds {_text(name)}; give words of letters, digits and _"
        if name in CAUSES:
            yield f"FAILURES holds '{name}', a cause that all tasks have; give it another name, or write that cause"
    for name, count in Counter(list(names)).items():
        if count > 1:
            yield f"FAILURES holds '{name}' twice; take one out"
    for name, value in names.items() if isinstance(names, dict) else ():
        if why := _misfit(value, "e", "v"):
            yield f"FAILURES['{name}'] is {why}"


def _is_word(name: object) -> bool:
    return isinstance(name, str) and re.fullmatch(r"\w+", name) is not None


def _misfit(value: Any, *arguments: str) -> str:
    """Return why a value is neither a kernel of these arguments nor a NumPy function; empty if it is one."""
    whole = [name for name in arguments if name not in ("e", "n")]
    if is_kernel(value, len(arguments)) or (is_plain(value) and takes(value, len(whole))):
        return ""
    wanted = f"give a function of ({', '.join(arguments)}) with @inlined, or a NumPy function of ({', '.join(whole)})"
    return f"{_text(value)}; {wanted}"


def _find_strays(task: Any) -> Iterator[str]:
    """Yield attributes of a class that nothing reads, but that look as if they were meant for what is read."""
    from multilift_marl.tasks.base import Kernels, Task

    tables = [name for name in dir(Task) if name.isupper()] + ["Options"]
    methods = [name for name in dir(Task) if inspect.isfunction(getattr(Task, name)) and not name.startswith("_")]
    known = {*dir(Task), *Task.__annotations__}
    own = {name: value for kind in task.__mro__ if kind not in Task.__mro__ for name, value in vars(kind).items()}
    for name, value in own.items():
        if name in known or name.startswith("_"):
            continue
        if name in Kernels._fields and _looks_like_kernel(value):
            yield f"{name} is no attribute of a task; give KERNELS = Kernels({name}=...)"
        near = [each for each in tables if each.casefold() == name.casefold()]
        near = near or get_close_matches(name, tables if name.isupper() else [], n=1, cutoff=0.8)
        near = near or get_close_matches(name, methods if inspect.isfunction(value) else [], n=1, cutoff=0.85)
        if near:
            yield f"{name} is no attribute of a task; did you mean '{near[0]}'?"


def _looks_like_kernel(value: Any) -> bool:
    """Return whether a value is compiled for kernels, or a function or method of (e, v) or (v) as they are."""
    function = getattr(value, "__func__", value)
    if isinstance(function, Kernel):
        return True
    return inspect.isfunction(function) and [*inspect.signature(function).parameters][-1:] == ["v"]


def _own_functions(kernel: Any) -> list[FunctionType]:
    """Return the functions of a kernel, and of those that it uses, that are none of the package's."""
    found, waiting = dict[FunctionType, None](), [getattr(kernel, "py_func", kernel)]
    while waiting:
        function = waiting.pop()
        if isinstance(function, FunctionType) and function not in found and not _is_ours(function):
            found[function] = None
            waiting += [getattr(value, "py_func", value) for _, value in used_values(function)]
    return list(found)


def _is_ours(function: FunctionType) -> bool:
    return f"{function.__module__}.".startswith("multilift_marl.")


def _find_lost_writes(function: FunctionType, lost: tuple[str, ...]) -> Iterator[str]:
    """Yield what code writes of fields of the view that are `lost`, such as `v.state.payload_position`.

    Names of parts of the view, `state = v.state`, are followed; what other functions get by an argument is not.
    """
    try:
        tree = ast.parse(dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):  # typed in
        return
    names = dict[str, str]()
    written = list[ast.expr]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            if (
                len(node.targets) == 1
                and isinstance(node.targets[0], ast.Name)
                and isinstance(node.value, ast.Attribute)
            ):
                names[node.targets[0].id] = ast.unparse(node.value)
            written += [each for target in node.targets for each in ast.walk(target) if isinstance(each, ast.Subscript)]
        elif isinstance(node, ast.AugAssign):
            written.append(node.target)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("put", "putmat"):
            written += node.args[:1]
    for place in written:
        while isinstance(place, ast.Subscript):
            place = place.value
        first, *rest = ast.unparse(place).split(".")
        path = ".".join([names.get(first, first), *rest])
        if any(f"{path.partition('.')[2]}.".startswith(f"{field}.") for field in lost):
            yield path


def _find_component_problems(parts: Any, where: str) -> Iterator[str]:
    if not isinstance(parts, tuple):
        yield f"{where} is {_text(parts)}; give a tuple of observations.Component, (Component(...),) for one"
    for part in parts:
        if not isinstance(part, Component):
            yield f"{where} holds {_text(part)}; give observations.Component(...)"
        if not _is_word(part.name):
            yield f"{where} has a component {_text(part.name)}; give words of letters, digits and _"
        if part.frame not in (*FRAMES, "-"):
            yield f"component '{part.name}' has an unknown frame '{part.frame}'{nearest(part.frame, [*FRAMES, '-'])}"
        turned = "slot" if where == "EXTRA" else "target"
        if part.is_turned and part.frame in ("slot", "target") and part.frame != turned:
            yield (
                f"component '{part.name}' of {where} is turned into the {turned} frame, not '{part.frame}'; say "
                f"'{turned}', or turn it in its kernel and set turned=False"
            )
        if isinstance(part.size, bool) or not isinstance(part.size, int) or part.size < 1:
            yield f"component '{part.name}' has size {_text(part.size)}; give how many numbers it has, 1 or more"
        if why := _misfit(part.value, "e", "n", "v"):
            yield f"component '{part.name}' has value {why}"
    for name, count in Counter(part.name for part in parts).items():
        if count > 1:
            yield f"{where} has {count} components '{name}'; give each a name of its own"


def _text(value: object) -> str:
    return shorten(repr(getattr(value, "py_func", value)))
