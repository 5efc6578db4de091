"""Values as they are stored: lists for NumPy's arrays; by one name where a key has two.

`train.base_policy` is `train.residual`, by which it is stored.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from multilift_marl.errors import ConfigError, shorten

_ALIASES = {"train.base_policy": "train.residual"}


def stored_names(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return configuration values, nested, by dotted names or both, by the names that are stored, see `plain_values`.

    Call it before `review`, which looks for the stored names.

    Raises:
        ConfigError: a key is given by both of its names, or see `plain_values`.
    """
    renamed = plain_values(values)
    for alias, key in _ALIASES.items():
        section, name, stored = *alias.split("."), key.rpartition(".")[2]
        if isinstance(nested := renamed.get(section), Mapping):
            renamed[section] = _rename(nested, name, stored, alias, key)
        renamed = _rename(renamed, alias, key, alias, key)
    return renamed


def plain_values(value: Any) -> Any:
    """Return a value, or nested values, in which NumPy's arrays are lists, and its numbers Python's.

    Raises:
        ConfigError: bytes or a set, which validation would take for text and for a list in any order.
    """
    if isinstance(value, bytes | bytearray | set | frozenset):
        kind = "text" if isinstance(value, bytes | bytearray) else "a list"
        raise ConfigError(f"a configuration holds no {type(value).__name__}: give {kind}, not {shorten(repr(value))}")
    if isinstance(value, Mapping):
        return {key: plain_values(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(each) for each in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _rename(values: Mapping[Any, Any], name: str, stored: str, alias: str, key: str) -> dict[Any, Any]:
    if name in values and stored in values:
        raise ConfigError(f"{alias} and {key} are two names of one key, and both are given; leave out one of them")
    return {stored if each == name else each: value for each, value in values.items()}
