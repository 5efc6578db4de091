"""Files that a configuration refers to: absolute paths, with a hash of what they hold."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from multilift_marl.errors import ConfigError, reason, shorten
from multilift_marl.schema.yaml_text import parse_yaml

FILE_KEYS = (
    "task_options.file", "task_options.waypoints", "payload.mesh", "scene.obstacles.mesh", "vehicle.preset",
    "train.init",
)  # fmt: skip
MAX_BYTES = 100_000_000  # of a file
_MARK = "#sha256="
_DIGITS = 16  # of the hash


def pin_overrides(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values of a configuration, nested or by dotted name, in which all files are pinned; see `pin_file`."""
    return change_files(values, _pin)


def pin_options(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return task options in which files are pinned; see `pin_file`."""
    return change_files(values, _pin, "task_options.")


def pin_vehicles(preset: str | tuple[str, ...]) -> str | tuple[str, ...]:
    """Return names of vehicles, of which those that are files are pinned; see `pin_file`."""
    key = "vehicle.preset"
    return _pin(key, preset) if isinstance(preset, str) else tuple(_pin(key, each) for each in preset)


def pin_text(value: Any) -> Any:
    """Return the pinned reference to a file where a value is one, text; others as they are. See `pin_file`."""
    return pin_file(value) if isinstance(value, str) else value


def pin_policy(reference: str | None) -> str | None:
    """Return a reference to a policy, pinned where it is a checkpoint file; see `pin_file`.

    Names of runs and shipped policies are left as they are: training pins what they stand for (`agents/initial.py`).
    """
    return pin_file(reference) if reference is not None and reference.endswith(".pt") else reference


def _pin(key: str, reference: str) -> str:
    return reference if key == "vehicle.preset" and not is_vehicle_file(reference) else pin_file(reference)


def change_files(
    values: Mapping[str, Any], change: Callable[[str, str], str], prefix: str = "", keys: Collection[str] = FILE_KEYS
) -> dict[str, Any]:
    """Return values of a configuration in which each reference to a file is changed.

    Those of `scene.obstacles`, `train.overrides`, `train.rigs` and `train.stages` count, too.

    Args:
        values: nested or by dotted name.
        change: takes the key and the reference, and returns another.
        prefix: of the names of `values`.
        keys: what hold references.
    """
    changed: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        inside = "" if name in ("train.overrides", "train.stages.overrides") else f"{name}."
        if isinstance(value, Mapping):
            changed[key] = change_files(value, change, inside, keys)
        elif name in ("scene.obstacles", "train.rigs", "train.stages") and isinstance(value, list | tuple):
            start = "" if name == "train.rigs" else f"{name}."
            changed[key] = [
                change_files(each, change, start, keys) if isinstance(each, Mapping) else each for each in value
            ]
        elif name in keys and isinstance(value, list | tuple):
            changed[key] = [change(name, each) if isinstance(each, str) else each for each in value]
        else:
            changed[key] = change(name, value) if name in keys and isinstance(value, str) else value
    return changed


def is_pinned(reference: str) -> bool:
    """Return whether a reference has the hash of what it refers to."""
    return _MARK in reference


def is_yaml(reference: str | Path) -> bool:
    """Return whether a reference, pinned or not, is the path of a YAML file rather than a name."""
    return str(reference).partition(_MARK)[0].endswith((".yaml", ".yml"))


def is_vehicle_file(reference: str | Path) -> bool:
    """Return whether a reference, pinned or not, is the path of a file of a vehicle rather than its name."""
    return is_yaml(reference) or str(reference).partition(_MARK)[0].lower().endswith((".urdf", ".xacro", ".sdf"))


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
        ValueError: there cannot be such a file, or it cannot be read or is too large.
    """
    if is_pinned(reference):
        return reference
    try:
        path = Path(reference).expanduser().resolve()
        return f"{path}{_MARK}{_hash(_read(path))}" if path.is_file() else str(path)
    except (OSError, RuntimeError, ValueError) as error:  # of names too long, ~nobody, and names with a NUL
        raise ValueError(f"must name a file that can be read ({reason(error)})") from None


def read_pinned(key: str, reference: str, most: int = MAX_BYTES) -> tuple[Path, bytes]:
    """Return the path and the content of a file that `pin_file` referred to.

    Args:
        key: of the configuration, for messages.
        reference: what `pin_file` returned.
        most: bytes that the file may have.

    Raises:
        ConfigError: the file is missing, too large, or no longer holds what it held.
    """
    name, _, expected = reference.partition(_MARK)
    path = Path(name)
    try:
        content = _read(path, most) if path.is_file() else None
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {key}={shorten(name)} ({reason(error)}); give the path of another") from error
    if content is None:
        raise ConfigError(f"{key}={name} is missing; put the file back, or give the path of another")
    if expected and _hash(content) != expected:
        raise ConfigError(
            f"{key}={name} has changed since this configuration was made (its sha256 began with {expected}); put the "
            f"old file back, or give {key}={name} anew to fly the new one"
        )
    return path, content


def _read(path: Path, most: int = MAX_BYTES) -> bytes:
    if path.stat().st_size > most:
        raise ValueError(f"it is larger than {most // 10**6} MB")
    return path.read_bytes()


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGITS]
