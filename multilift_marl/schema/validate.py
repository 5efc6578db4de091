"""Pydantic's validation with its complaints put into one sentence: the key, what it must be, what it is."""

from __future__ import annotations

import re
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from multilift_marl.errors import ConfigError, nearest, shorten
from multilift_marl.schema.values import Section

_LARGEST = {
    "m": 1e4,
    "m/s": 60.0,
    "m/s²": 1000.0,
    "rad/s": 100.0,
    "rad": 1e4,
    "deg": 1e4,
    "s": 1e6,
    "kg": 1e7,
    "N": 1e9,
}
"""Of options of tasks, by unit; simulations diverge where bodies reach 100 m/s."""
S = TypeVar("S", bound=Section)


def validate(model: type[S], values: Mapping[str, Any], prefix: str = "", where: str = "") -> S:
    """Return `values` as a `model`.

    Args:
        model: the section's type.
        values: its values, nested.
        prefix: name of the section, for messages.
        where: the file that the values come from, for messages.

    Raises:
        ConfigError: an unknown key, a wrong type or a value out of range.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(_sentence(error.errors(), model, prefix, where)) from None


def check_magnitudes(options: Section, prefix: str) -> None:
    """Refuse numbers that are finite, but of no use to a simulation of teams, by the units that descriptions state.

    Args:
        options: a section whose descriptions begin with units, "[m/s] largest speed".
        prefix: its name, for messages.

    Raises:
        ConfigError: the first number that is too large.
    """
    for name, field in type(options).model_fields.items():
        unit = re.match(r"\[([^]]+)\]", field.description or "")
        largest = _LARGEST.get(unit[1]) if unit else None
        value = getattr(options, name)
        numbers = [each for each in (value if isinstance(value, tuple) else (value,)) if isinstance(each, int | float)]
        if unit and largest is not None and any(abs(number) > largest for number in numbers):
            text = list(value) if isinstance(value, tuple) else value
            raise ConfigError(f"{prefix}.{name} must be within ± {largest:g} {unit[1]}, but is {text}")


def _sentence(errors: list[Any], model: type[Section], prefix: str, where: str) -> str:
    """Return one sentence for the first key that pydantic complains about."""
    section, path, annotation = _find_key(errors[0]["loc"], model)
    about = [error for error in errors if _find_key(error["loc"], model)[1] == path]
    about = [error for error in about if error["type"] != "tuple_type"] or about  # those: a list of lists was tried
    error = max(about, key=lambda error: len(error["loc"]))  # the deepest: an element rather than its list
    key = ".".join(([prefix] if prefix else []) + path)
    source = f" (in {where})" if where.endswith((".yaml", ".yml")) else ""
    kind, value = error["type"], error["input"]
    if kind == "extra_forbidden":
        home = key.removesuffix(path[-1])
        return f"unknown key '{key}'{source}{nearest(path[-1], section.model_fields, lambda near: home + near)}"
    if kind == "too_short":
        return f"{key}{source} must not be empty"
    if kind == "missing" and isinstance(error["loc"][-1], str):
        return f"{key}{source} is missing; give it a value"
    if kind in ("missing", "too_long"):
        missing = [1 + each["loc"][-1] for each in about if each["type"] == "missing"]
        count = error["ctx"]["max_length"] if kind == "too_long" else max(missing)
        return f"{key}{source} must be a list of {count} numbers, but is {shorten(repr(value))}"
    if kind == "tuple_type":
        return f"{key}{source} must be {_list_in_words(annotation)}, but is {shorten(repr(value))}"
    if kind in ("model_type", "dict_type", "model_attributes_type"):
        return f"{key}{source} must be a section with keys of its own, but is {shorten(repr(value))}"
    message = error["msg"].removeprefix("Value error, ").replace("Input should", "must").replace("should", "must")
    notes = "".join(getattr(error.get("ctx", {}).get("error"), "__notes__", ()))  # of `Between`
    return f"{key}{source} {message}, but is {shorten(repr(value))}{notes}"


def _list_in_words(annotation: Any) -> str:
    """Return what the first kind of list in an annotation holds."""
    waiting = [annotation]
    while waiting:
        kind = waiting.pop(0)
        inner = typing.get_args(kind)
        if typing.get_origin(kind) is tuple:
            return "a list" if Ellipsis in inner else f"a list of {len(inner)} numbers"
        waiting.extend(inner)
    return "a list"


def _element(annotation: Any) -> Any:
    """Return what a list in an annotation holds if it holds sections or lists, None if it holds others."""
    inner = typing.get_args(annotation)
    if typing.get_origin(annotation) is tuple:
        return inner[0] if _is_section(inner[0]) or _is_list(inner[0]) else None
    return next((found for each in inner if (found := _element(each))), None)


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Section)


def _is_list(annotation: Any) -> bool:
    return typing.get_origin(annotation) is tuple or any(_is_list(each) for each in typing.get_args(annotation))


def _find_key(location: tuple[Any, ...], model: type[Section]) -> tuple[type[Section], list[str], Any]:
    """Return section, path and annotation of the key in pydantic's location, which goes on into unions and lists."""
    section, path, parts = model, [], [str(part) for part in location]
    annotation: Any = None
    while parts:
        path.append(parts.pop(0))
        annotation = section.model_fields[path[-1]].annotation if path[-1] in section.model_fields else None
        if typing.get_origin(annotation) is dict and parts:  # of names that are free
            path.append(parts.pop(0))
            annotation = typing.get_args(annotation)[1]
        if parts and parts[0].isdigit() and (element := _element(annotation)):  # of a list of sections or lists
            path[-1] += f"[{parts.pop(0)}]"
            annotation = element
        if not _is_section(annotation):
            break
        section = annotation
    return section, path, annotation
