"""The keys of a configuration: their defaults and meanings, and what one that is not known may stand for."""

from __future__ import annotations

import typing
from collections.abc import Iterable, Iterator
from functools import reduce
from typing import Any

from multilift_marl.config.config import Config
from multilift_marl.errors import ConfigError, called_elsewhere, nearest
from multilift_marl.schema.values import Section


def check_names(given: Iterable[str], own: Iterable[str]) -> None:
    """Refuse the first name that `find_unknown` finds.

    Raises:
        ConfigError: an unknown name.
    """
    if unknown := find_unknown(given, own):
        raise ConfigError(f"unknown key '{unknown[0]}'{unknown[1]}")


def find_unknown(given: Iterable[str], own: Iterable[str]) -> tuple[str, str] | None:
    """Return the first name without a dot that is neither a caller's own nor a section or value of a configuration.

    Args:
        given: the names; those with a dot are left to `build_config`.
        own: of the caller's arguments.

    Returns:
        The name and a hint, None if all are known. The hint knows every key, too: frames is near train.frames.
    """
    top = {*Config.model_fields, *own}
    keys: dict[str, list[str]] = {}
    meanings = {key: text for key, _, text in list_keys(Config)}
    for key in meanings:
        keys.setdefault(key.rpartition(".")[2], []).append(key)
    keys = {name: homes for name, homes in keys.items() if name != "<name>"} | {name: [name] for name in top}
    whole = {key.replace(".", "_"): key for key in meanings}
    for name in given:
        if "." not in name and name not in top:
            if name in whole:  # payload_mass is payload.mass, not its randomization
                return name, f"; did you mean '{whole[name]}'?"
            if (here := called_elsewhere(name)) in keys:
                key = keys[here][0]
                return name, f"; did you mean '{key}'" + (f" ({meanings[key]})?" if key in meanings else "?")
            hint = nearest(name, keys, lambda near: "' or '".join(keys[near]))
            return name, hint if "did you mean" in hint else nearest(name, top)
    return None


def explain(section: type[Section] | Section = Config, prefix: str = "") -> str:
    """Return every key of a section with its default and meaning, for --help.

    Of a section with values these are shown, and the default behind the meaning where it is another.
    """
    kind = section if isinstance(section, type) else type(section)
    lines = []
    for key, default, text in list_keys(kind, prefix):
        value = default
        if isinstance(section, Section):
            path = key.removeprefix(prefix).removesuffix(".<name>")  # of names that are free: all of them
            value = reduce(getattr, path.split("."), section)
        changed = "" if value == default else f" (default {_plain(default)})"
        lines.append(f"  {key:<32} {_plain(value):<14} {text}{changed}")
    return "\n".join(lines)


def list_keys(section: type[Section], prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield name, default and meaning of every key of a section, <name> for names that are free."""
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from list_keys(field.annotation, f"{prefix}{name}.")
        elif typing.get_origin(field.annotation) is dict:
            yield f"{prefix}{name}.<name>", {}, field.description or ""
        else:
            yield prefix + name, field.default, field.description or ""


def _plain(value: Any) -> str:
    if value is None or value == {}:
        return "-"
    return str(list(value) if isinstance(value, tuple) else value)
