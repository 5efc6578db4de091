"""What goes over what: values of a configuration over others, and over what it changes in training alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_SYSTEM = ("sim", "vehicle", "payload", "cable", "control", "wind")  # what a rig keeps in another task, beside its size
_FREE = ("reward", "task_options")
"""Sections of free names: an empty mapping asks for none of them, where elsewhere it asks for nothing."""


def give_way(values: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a configuration, less what it changes in training alone of what is asked for.

    Args:
        values: by section.
        asked: by section or dotted name; what it says of `train` itself is no matter here.
    """
    train = values.get("train")
    if not isinstance(train, Mapping):
        return dict(values)
    names = [
        name
        for name, value in leaves(asked)
        if name.partition(".")[0] != "train" and (name in _FREE or not is_empty(value))
    ]
    kept = dict(train)
    if isinstance(overrides := kept.get("overrides"), Mapping):
        kept["overrides"] = without(overrides, names)
    if isinstance(rigs := kept.get("rigs"), list | tuple):
        kept["rigs"] = [without(rig, names) if isinstance(rig, Mapping) else rig for rig in rigs]
    if isinstance(stages := kept.get("stages"), list | tuple):
        kept["stages"] = [
            {**stage, "overrides": without(changes, names)}
            if isinstance(stage, Mapping) and isinstance(changes := stage.get("overrides"), Mapping)
            else stage
            for stage in stages
        ]
    return {**values, "train": kept}


def is_empty(value: Any) -> bool:
    """Return whether a value is a mapping of nothing."""
    return isinstance(value, Mapping) and not value


def without(overrides: Mapping[str, Any], asked: list[str]) -> dict[str, Any]:
    """Return overrides as they are, but for those that are asked for; of a term's numbers each for itself."""
    kept = {}
    for key, value in overrides.items():
        parts = {name: part for name, part in leaves({key: value}) if not _is_asked(name, asked)}
        if len(parts) == len(list(leaves({key: value}))):
            kept[key] = value
        else:
            kept |= parts
    return kept


def _is_asked(name: str, asked: list[str]) -> bool:
    return any(f"{name}.".startswith(f"{each}.") for each in asked)


def leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested sections by dotted name; a reward term's bare number is its weight."""
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{name}.")
        elif name.startswith("reward.") and name.count(".") == 1 and isinstance(value, int | float | str):
            yield f"{name}.weight", value
        else:
            yield name, value


def system_part(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a configuration says of the system, whatever its task."""
    part = {key: values[key] for key in (*_SYSTEM, "import") if key in values}
    if isinstance(env := values.get("env"), Mapping) and "num_drones" in env:
        part["env"] = {"num_drones": env["num_drones"]}
    return part


def _is_number(value: Any) -> bool:
    return not isinstance(value, Mapping) and value is not None


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `changes`, section by section; of a reward term a bare number is the weight alone."""
    merged = dict(base)
    for key, value in changes.items():
        if key == "reward" and isinstance(value, Mapping):
            value = {term: {"weight": own} if _is_number(own) else own for term, own in value.items()}
        known = merged.get(key)
        if str(key).startswith("reward.") and isinstance(known, Mapping) and _is_number(value):  # in train.overrides
            value = {"weight": value}
        if key == "overrides" and isinstance(known, Mapping) and isinstance(value, Mapping):
            known = without(known, [name for name, _ in leaves(value)])  # however each of them is written
        merged[key] = merge(known if isinstance(known, Mapping) else {}, value) if isinstance(value, Mapping) else value
    return merged
