"""Suites of the benchmark: fixed tasks on fixed episodes, from their definition (benchmark_v1.yaml) and its digest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config
from multilift_marl.schema.yaml_text import read_yaml
from multilift_marl.tasks import find_task

DEFINITION = Path(__file__).with_name("benchmark_v1.yaml")
SUITES = ("standard", "realistic", "shifts")
_NOT_OF_TASKS = {"train": None, "eval": None, "import": None, "seed": None, "env": {"num_envs", "num_threads"}}
"""What of a configuration says nothing of the episodes of an evaluation: whole sections, or some of their keys."""


class Shift(NamedTuple):
    """A change: configuration values, and what is fixed of the hidden parameters, as factors of the nominal ones."""

    title: str
    overrides: dict[str, Any]
    factors: dict[str, Any]


class BenchmarkTask(NamedTuple):
    """What a policy is evaluated on."""

    name: str
    config: Config
    factors: dict[str, Any]
    """Of hidden parameters, see `run_episodes`."""
    error: str
    """The metric of the error."""
    baseline: str
    """The best one, by its name."""
    shipped: str | None
    """The shipped policy that was trained on it."""

    def definition(self) -> dict[str, Any]:
        """Return what makes its episodes: all that differs from the schema's defaults."""
        defaults = Config.model_validate({"task": self.config.task}).model_dump(mode="json")
        values = self.config.model_dump(mode="json")
        changed = _differences(values, defaults, _NOT_OF_TASKS)
        return {"task": self.config.task, "values": changed, "factors": self.factors, "error": self.error}


class Suite(NamedTuple):
    """Tasks and their episodes."""

    title: str
    """Of the benchmark, with its version: "multilift-bench v1"; what is not that says so."""
    name: str
    seed: int
    episodes: int
    """Of each task, to be complete."""
    tasks: tuple[BenchmarkTask, ...]
    digest: str
    """SHA-256 of seed, episodes and the definitions of all tasks; a key of the schema that is added later leaves it."""


def load_suite(name: str) -> Suite:
    """Return one of `SUITES`.

    Raises:
        ConfigError: a shipped configuration was made invalid.
    """
    content = _read()
    suite = content["suites"][name]
    tasks = [_make_task(title, values, Shift("", {}, {})) for title, values in suite["tasks"].items()]
    if "each" in suite:
        ((title, values),) = suite["tasks"].items()
        drones = tasks[0].config.env.num_drones
        changes = [change for part in suite["each"] for change in list_shifts(drones, part)]
        tasks = [_make_task(f"{title}, {change.title}", values, change) for change in changes]
    definitions = {task.name: task.definition() for task in tasks}
    told = {"seed": content["seed"], "episodes": suite["episodes"], "tasks": definitions}
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    title = content["name"] + ("" if digest == content["digests"][name] else ", modified")
    return Suite(title, name, content["seed"], suite["episodes"], tuple(tasks), digest)


def list_shifts(num_drones: int, part: str = "shifts") -> list[Shift]:
    """Return the changes for a team of so many drones; of `shifts` the first is none.

    Args:
        num_drones: of the team.
        part: "shifts", hidden from the drones, or "rigs", which are known to them.
    """
    found = []
    for title, values in _read()[part].items():
        overrides, factors = dict(values.get("overrides", {})), dict(values.get("factors", {}))
        if "drones" in values:
            overrides["env.num_drones"] = num_drones + values["drones"]
        for parameter, factor in values.get("first_drone", {}).items():
            factors[parameter] = [factor] + [1.0] * (num_drones - 1)
        found.append(Shift(title, overrides, factors))
    return found


@cache
def _read() -> dict[str, Any]:
    return read_yaml(DEFINITION)


def _make_task(name: str, values: Mapping[str, Any], change: Shift) -> BenchmarkTask:
    config = load_config(values["config"], values.get("overrides", {}) | change.overrides)
    error = find_task(config.task).ERROR
    return BenchmarkTask(name, config, change.factors, error, values["baseline"], values.get("shipped"))


def _differences(values: Mapping[str, Any], defaults: Mapping[str, Any], without: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that are not the defaults, by section."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        default, left_out = defaults.get(key), without.get(key, ())
        if left_out is None or value == default:
            continue
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            value = _differences(value, default, dict.fromkeys(left_out))
        if value != {}:
            found[key] = value
    return found
