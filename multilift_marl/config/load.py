"""Configurations from names, files and overrides; their errors in one sentence; their explanation for --help."""

from __future__ import annotations

import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from multilift_marl.config.schema import Config, Section
from multilift_marl.errors import ConfigError, nearest

_PACKAGE = Path(__file__).resolve().parents[1]


def config_dir() -> Path:
    """Return the folder of shipped configurations: inside an installed package, beside it in a checkout."""
    installed = _PACKAGE / "configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"


def list_configs() -> list[str]:
    """Return the names of the shipped configurations."""
    return sorted(path.stem for path in config_dir().glob("*.yaml"))


def load_config(name: str | Path = "hover", overrides: Mapping[str, Any] | None = None) -> Config:
    """Return typed defaults < the configuration `name` < `overrides`.

    Args:
        name: a shipped configuration's name or the path of a YAML file.
        overrides: values by dotted name, such as {"payload.mass": 2.0}.

    Raises:
        ConfigError: an unknown name or key, a wrong type or a value out of range.
    """
    return build_config(_read(name), overrides, where=str(name))


def build_config(values: Mapping[str, Any], overrides: Mapping[str, Any] | None = None, where: str = "") -> Config:
    """Return the validated configuration of nested `values` with dotted `overrides` applied."""
    merged = _copy(values)
    for dotted, value in (overrides or {}).items():
        node, *parents = merged, *dotted.split(".")[:-1]
        for part in parents:
            node = node.setdefault(part, {})
            if not isinstance(node, dict):
                raise ConfigError(f"{dotted}: '{part}' is a value, not a section")
        node[dotted.split(".")[-1]] = value
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        raise ConfigError(_sentence(error.errors()[0], where)) from None


def parse_overrides(arguments: Iterable[str]) -> dict[str, Any]:
    """Return {"a.b": value} of command-line arguments a.b=value, read as YAML."""
    overrides = {}
    for argument in arguments:
        key, separator, text = argument.partition("=")
        if not separator or not key:
            raise ConfigError(f"'{argument}' is not of the form key=value, such as train.frames=2e6")
        try:
            overrides[key] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ConfigError(f"the value of {key}={text} is not valid YAML") from None
    return overrides


def dump_config(config: Config) -> str:
    """Return the resolved configuration as YAML, complete: it loads back to an equal one."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def explain() -> str:
    """Return every key with its default and meaning, for --help."""
    return "\n".join(f"  {key:<32} {_plain(default):<14} {text}" for key, default, text in _leaves(Config, ""))


def _plain(value: Any) -> str:
    if value is None:
        return "-"
    return str(list(value) if isinstance(value, tuple) else value)


def _leaves(section: type[Section], prefix: str) -> Iterator[tuple[str, Any, str]]:
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from _leaves(field.annotation, f"{prefix}{name}.")
        elif typing.get_origin(field.annotation) is dict:
            yield f"{prefix}{name}.<name>", None, field.description or ""
        else:
            yield prefix + name, field.default, field.description or ""


def _read(name: str | Path) -> dict[str, Any]:
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        path = config_dir() / f"{name}.yaml"
        if not path.is_file():
            raise ConfigError(f"no configuration named '{name}'{nearest(str(name), list_configs())}")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"no configuration file {path}: give the path of a YAML file or a shipped name") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"cannot read {path} as YAML: {' '.join(str(error).split())}") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds {type(values).__name__} where sections such as 'env:' are expected")
    return values


def _copy(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _copy(value) if isinstance(value, Mapping) else value for key, value in values.items()}


def _sentence(error: Mapping[str, Any], where: str) -> str:
    """Return one sentence for pydantic's first complaint."""
    path = [
        part
        for part in error["loc"]
        if isinstance(part, str) and not part.startswith(("function-", "tuple[", "constrained"))
    ]
    section: type[Section] = Config
    for part in path[:-1]:
        annotation = section.model_fields[part].annotation if part in section.model_fields else None
        if isinstance(annotation, type) and issubclass(annotation, Section):
            section = annotation
    path = _known_prefix(path)
    key = ".".join(path)
    source = f" (in {where})" if where.endswith((".yaml", ".yml")) else ""
    if error["type"] == "extra_forbidden":
        return f"unknown key '{key}'{source}{nearest(path[-1], section.model_fields)}"
    message = error["msg"].removeprefix("Value error, ").replace("Input should", "should")
    message = message.replace("should", "must").replace("Input must", "must")
    return f"{key}{source} {message}, but is {error['input']!r}"


def _known_prefix(path: list[str]) -> list[str]:
    """Drop what pydantic appends to the name of a key to tell the members of a union apart."""
    section, kept = Config, []
    for part in path:
        kept.append(part)
        annotation = section.model_fields[part].annotation if part in section.model_fields else None
        if not (isinstance(annotation, type) and issubclass(annotation, Section)):
            break
        section = annotation
    return kept
