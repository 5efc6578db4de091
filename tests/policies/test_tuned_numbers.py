"""Numbers that were tuned, not derived: gains of scripts, phases, weights of rewards, what tasks are by default.

Recorded results and shipped policies hold for these alone. Whoever changes one evaluates anew what it was tuned for,
and then writes them down again: `python tests/policies/test_tuned_numbers.py`.
"""

from __future__ import annotations

import importlib
import json
import re
import sys
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from multilift_marl.policies.tuned import tuned_policy
from multilift_marl.schema.training import TUNED
from multilift_marl.tasks import TASKS

FILE = Path(__file__).with_name("tuned_numbers.json")
MODULES = (
    "control.disturbance", "control.gains", "control.redistribution", "deploy.ros.failsafe", "mdp.ground",
    "planning.targets", "planning.trajectory", "policies.formation", "policies.hold", "policies.payload_geometric",
    "sensing.communication", "sensing.load_sensing", "sensing.loss_detection", "tasks.land", "tasks.takeoff",
)  # fmt: skip
SHIPPED = ("hover", "pose", "track", "takeoff", "land", "recover", "loss", "gate")
PARTS = (*MODULES, *(f"gains {name}" for name in TUNED), *(f"task {name}" for name in SHIPPED))


def as_json(value: Any) -> Any:
    """Return numbers, texts, and tuples and dictionaries of them, as JSON holds them; None for all else."""
    if isinstance(value, bool | int | float | str):
        return value if value == value else None  # NaN
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        parts = [as_json(each) for each in value]
        return None if None in parts else parts
    if isinstance(value, dict):
        parts = {str(key): as_json(each) for key, each in value.items()}
        return None if None in parts.values() else parts
    return None


def constants_of(owner: Any) -> dict[str, Any]:
    """Return what has a name in capitals and holds numbers."""
    named = {name: value for name, value in vars(owner).items() if re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name)}
    found = {name: as_json(value) for name, value in named.items() if not isinstance(value, str | bool)}
    return {name: value for name, value in found.items() if value is not None}


def numbers_of(module: str) -> dict[str, Any]:
    """Return the constants of a module and of its classes, and the defaults of its tuples and data classes."""
    loaded = importlib.import_module(f"multilift_marl.{module}")
    found = constants_of(loaded)
    for name, value in vars(loaded).items():
        if isinstance(value, type) and value.__module__ == loaded.__name__:
            found |= {f"{name}.{part}": each for part, each in constants_of(value).items()}
            defaults = dict(getattr(value, "_field_defaults", {}))
            if is_dataclass(value):
                defaults = {field.name: field.default for field in fields(value) if field.default is not MISSING}
            if defaults and as_json(defaults) is not None:
                found[name] = as_json(defaults)
    return found


def numbers_of_task(name: str) -> dict[str, Any]:
    """Return weights and margins of a task's reward, and what its options are by default."""
    task = TASKS[name]
    reward = {key: [term.weight, as_json(term.margin), term.unit] for key, term in task.REWARD.items()}
    return {"reward": reward, "options": task.Options().model_dump(mode="json")}


def collect() -> dict[str, Any]:
    """Return all of them."""
    return {part: numbers_of_part(part) for part in PARTS}


def numbers_of_part(part: str) -> dict[str, Any]:
    """Return the numbers of a module, of the task after "task ", or of the linear policy after "gains "."""
    kind, _, name = part.rpartition(" ")
    if kind == "gains":
        return {"GAINS": as_json(tuned_policy(name).GAINS)}
    return numbers_of_task(name) if kind == "task" else numbers_of(name)


@pytest.mark.parametrize("part", PARTS)
def test_tuned_numbers_are_those_that_results_were_recorded_with(part):
    written = json.loads(FILE.read_text(encoding="utf-8"))[part]
    found = json.loads(json.dumps(numbers_of_part(part)))
    for name, value in written.items():  # what is new is written down when it is tuned
        here = {key: found[name].get(key) for key in value} if name in ("options", "reward") else found.get(name)
        assert here == value, f"{name} has changed: evaluate anew what depends on it, then run {Path(__file__).name}"


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    parts = []
    for part, numbers in collect().items():
        lines = [f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in sorted(numbers.items())]
        parts.append(f" {json.dumps(part)}: {{\n" + ",\n".join(lines) + "\n }")
    FILE.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")
