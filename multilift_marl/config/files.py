"""Files that a configuration refers to: absolute paths, with a hash of what they hold."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from multilift_marl.config.yaml_text import parse_yaml
from multilift_marl.errors import ConfigError, reason, shorten

_MARK = "#sha256="
_DIGITS = 16  # of the hash


def pin_files(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return task options, or overrides of them, in which `file` is pinned; see `pin_file`."""
    pinned = dict(values)
    for key in ("file", "task_options.file"):
        if isinstance(pinned.get(key), str):
            pinned[key] = pin_file(pinned[key])
    return pinned


def pin_vehicles(preset: str | tuple[str, ...]) -> str | tuple[str, ...]:
    """Return names of vehicles, of which those that are YAML files are pinned; see `pin_file`."""
    if not isinstance(preset, str):
        return tuple(pin_file(each) if is_yaml(each) else each for each in preset)
    return pin_file(preset) if is_yaml(preset) else preset


def is_yaml(reference: str | Path) -> bool:
    """Return whether a reference, pinned or not, is the path of a YAML file rather than a name."""
    return str(reference).partition(_MARK)[0].endswith((".yaml", ".yml"))


def parse_mapping(content: bytes, source: Path, expected: str) -> dict[str, Any]:
    """Return the keys and values of a YAML file.

    Args:
        content: of the file.
        source: its path, for messages.
        expected: what it should hold, for messages.

    Raises:
        ConfigError: it holds something else.
    """
    try:
        values = parse_yaml(content.decode())
    except ValueError as error:
        raise ConfigError(f"cannot read {shorten(source, 300)} as YAML: {reason(error)}") from None
    return as_mapping(values, source, expected)


def as_mapping(values: Any, source: Path, expected: str) -> dict[str, Any]:
    """Return what a YAML file holds, {} if nothing; a ConfigError if that is no mapping. See `parse_mapping`."""
    if not isinstance(values, dict | None):
        raise ConfigError(f"{source} holds {type(values).__name__} where {expected} are expected")
    return values or {}


def pin_file(reference: str) -> str:
    """Return the absolute path of a file with the hash of its content: "/home/me/path.csv#sha256=1f3a…".

    A run folder or a checkpoint then names what was used, wherever it is read. A reference that has a hash is returned
    as it is; one of a file that is missing has none.

    Raises:
        ValueError: there cannot be such a file, or it cannot be read.
    """
    if _MARK in reference:
        return reference
    try:
        path = Path(reference).expanduser().resolve()
        return f"{path}{_MARK}{_hash(path.read_bytes())}" if path.is_file() else str(path)
    except (OSError, RuntimeError, ValueError) as error:  # of names too long, ~nobody, and names with a NUL
        raise ValueError(f"must name a file that can be read ({reason(error)})") from None


def read_pinned(key: str, reference: str) -> tuple[Path, bytes]:
    """Return the path and the content of a file that `pin_file` referred to.

    Args:
        key: of the configuration, for messages.
        reference: what `pin_file` returned.

    Raises:
        ConfigError: the file is missing, or no longer holds what it held.
    """
    name, _, expected = reference.partition(_MARK)
    path = Path(name)
    try:
        content = path.read_bytes() if path.is_file() else None
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {key}={shorten(name)} ({reason(error)}); give the path of another") from error
    if content is None:
        raise ConfigError(f"{key}={name} is missing; put the file back, or give the path of another by {key}=<path>")
    if expected and _hash(content) != expected:
        raise ConfigError(
            f"{key}={name} has changed since this configuration was made (its sha256 began with {expected}); put the "
            f"old file back, or give {key}={name} anew to fly the new one"
        )
    return path, content


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
