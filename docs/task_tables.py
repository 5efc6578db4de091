"""Write the tables of docs/tasks.md from the code: observations, and options, components and rewards of each task.

Run: python docs/task_tables.py      (replaces what stands between the markers of docs/tasks.md)
"""

from __future__ import annotations

import re
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo

from multilift_marl.config.load import list_configs, load_config
from multilift_marl.mdp.global_state import DRONE_HIDDEN, DRONE_STATE, HIDDEN, STATE
from multilift_marl.mdp.observations import OBSERVATION, Component
from multilift_marl.mdp.rewards import Term, describe
from multilift_marl.tasks import TASKS
from multilift_marl.tasks.base import Task

PAGE = Path(__file__).parent / "tasks.md"
_COMPONENTS = ("component", "size", "frame", "unit", "meaning")
_REWARD = ("reward", "weight", "margin", "meaning")
_MARKED = re.compile(r"(<!-- table of (\w+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    head = list(columns)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"|{'|'.join(line)}|" for line in lines)


def number(value: Any) -> str:
    """Return a default as it would be typed on the command line; a range of one number as that number."""
    if isinstance(value, tuple):
        same = len(value) == 1 or (len(value) == 2 and value[0] == value[1])
        return number(value[0]) if same else f"[{','.join(number(each) for each in value)}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return value if isinstance(value, str) else f"{value:g}"


def option_row(name: str, field: FieldInfo) -> tuple[str, ...]:
    """Return name, default with its unit, and meaning of an option; a unit leads its description in brackets."""
    unit, meaning = re.fullmatch(r"(?:\[([^\]]+)\] )?(.*)", field.description or "").groups()
    choices = typing.get_args(field.annotation) if typing.get_origin(field.annotation) is typing.Literal else ()
    meaning += f" ({', '.join(choices)})" if choices else ""
    return f"`{name}`", number(field.default) + (f" {unit}" if unit and unit != "-" else ""), meaning


def component_row(part: Component) -> tuple[str, ...]:
    """Return the row of a component."""
    return f"`{part.name}`", str(part.size), part.frame, part.unit, part.meaning


def reward_row(name: str, term: Term) -> tuple[str, ...]:
    """Return name, weight, margins and meaning of a reward term."""
    margins = ", ".join(f"{margin:g}" for margin in term.margins)
    unit = f" {term.unit}" if margins and term.unit != "-" else ""
    return f"`{name}`", f"{term.weight:g}", f"{margins}{unit}", describe(term.value)


def names(parts: Iterable[Component]) -> str:
    """Return the names of components, with their sizes above one, and their frames but for the target's."""
    found = []
    for part in parts:
        notes = [str(part.size)] if part.size > 1 else []
        notes += [part.frame] if part.frame not in ("-", "target") else []
        found.append(f"`{part.name}`" + (f" ({', '.join(notes)})" if notes else ""))
    return ", ".join(found)


def shared() -> list[tuple[str, Term]]:
    """Return the reward terms that all tasks have, with one weight and one margin."""
    first, *others = (task.REWARD for task in TASKS.values())
    return [item for item in first.items() if all(item in other.items() for other in others)]


def listed(columns: tuple[str, ...], rows: Iterable[tuple[str, ...]], known: set[tuple[str, str]]) -> list[str]:
    """Return a table of the rows whose names and meanings are new, and a sentence with the values of the others.

    Args:
        columns: of the table; the first is a name, the last a meaning.
        rows: of the table.
        known: names and meanings of earlier tasks; new ones are added.
    """
    new = [row for row in rows if (row[0], row[-1]) not in known]
    again = [f"{row[0]} {', '.join(filter(None, row[1:-1]))}" for row in rows if (row[0], row[-1]) in known]
    known |= {(row[0], row[-1]) for row in new}
    parts = [table(columns, new)] if new else []
    return parts + ([f"{columns[0].capitalize()}s as above: {'; '.join(again)}."] if again else [])


def section(name: str, task: type[Task], recipes: list[str], known: set[tuple[str, str]]) -> str:
    """Return the section of a task; see `listed`."""
    links = ", ".join(f"[`{each}`](../configs/{each}.yaml)" for each in recipes)
    parts = [f"### {name}", f"[{name}.md]({name}.md); configurations {links}."]
    options = [option_row(key, field) for key, field in task.Options.model_fields.items()]
    parts += listed(("option", "default", "meaning"), options, known)
    if task.EXTRA:
        parts.append(table(_COMPONENTS, map(component_row, task.EXTRA)))
    if task.EXTRA_STATE:
        same = [part.name for part in task.EXTRA_STATE] == [part.name for part in task.EXTRA]
        parts.append(f"The global state has {'them' if same else names(task.EXTRA_STATE)}, too.")
    rewards = [reward_row(*item) for item in task.REWARD.items() if item not in shared()]
    parts += listed(_REWARD, rewards, known)
    return "\n\n".join(parts)


def recipes() -> dict[str, list[str]]:
    """Return the names of the shipped configurations of each task."""
    found: dict[str, list[str]] = {name: [] for name in TASKS}
    for name in list_configs():
        if "/" not in name:
            found[load_config(name).task].append(name)
    return found


def contents() -> dict[str, str]:
    """Return what stands between the markers, by name."""
    state = [("payload, target, hidden quantities", names(STATE)), ("of each drone", names(DRONE_STATE))]
    state += [("where randomised", names(HIDDEN.values())), ("the same of each drone", names(DRONE_HIDDEN.values()))]
    of_task, known = recipes(), set[tuple[str, str]]()
    return {
        "observations": table(_COMPONENTS, map(component_row, OBSERVATION)),
        "state": table(("global state", "components (size, frame)"), state),
        "rewards": table(_REWARD, [reward_row(*item) for item in shared()]),
        "tasks": "\n\n".join(section(name, task, of_task[name], known) for name, task in sorted(TASKS.items())),
    }


def fill(text: str) -> str:
    """Return the page with its tables written anew."""
    found = contents()
    return _MARKED.sub(lambda mark: f"{mark[1]}{found[mark[2]]}\n{mark[3]}", text)


if __name__ == "__main__":
    PAGE.write_text(fill(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
