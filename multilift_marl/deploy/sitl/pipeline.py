"""The file of a pipeline: which processes it has, and the command of each."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from multilift_marl.command import CommandOptions, make_out, spell_arguments, split_options
from multilift_marl.config.keys import check_names
from multilift_marl.config.load import load_config
from multilift_marl.deploy.px4.__main__ import Options as FlightOptions
from multilift_marl.deploy.ros.__main__ import OF_ROLES, USUAL, check_role
from multilift_marl.deploy.ros.__main__ import Options as NodeOptions
from multilift_marl.deploy.sitl.view import ViewOptions, of_flight
from multilift_marl.errors import ConfigError, reason, shorten
from multilift_marl.policies.baselines import SCRIPTED
from multilift_marl.schema.files import as_mapping
from multilift_marl.schema.validate import validate
from multilift_marl.schema.yaml_text import read_yaml
from multilift_marl.trust import trusting

Keys = dict[str, Any]
_RUN_CODE = {"import", "trust", "px4", "residual", "base_policy", "ray"}
"""Keys that name what is run, beside `policy=module:Class`."""
_SHARED = ("seed", "domain", "ros", "names", "allow_network")  # in which nodes that fly a team agree with it


class Options(CommandOptions):
    """Keys of the command, which its file has, too."""

    file: str | None = Field(None, description="YAML file with the keys below; key=value arguments go over it")
    flight: Keys | None = Field(
        None, description="keys of multilift_marl.px4; policy=none live=true names=report unless it says otherwise"
    )
    simulation: Keys | None = Field(
        None, description="in place of a flight of PX4s: keys of multilift_marl.ros; policy=none likewise"
    )
    nodes: dict[Annotated[str, Field(pattern="^[a-z][a-z0-9_]{0,30}$")], Keys] = Field(
        {}, description="keys of multilift_marl.ros, of each a role; seed and domain as above unless they say otherwise"
    )
    view: Keys | None = Field(
        None, description="show it in the browser: keys of multilift_marl.view, such as port; the rig is the flight's"
    )
    common: Keys = Field({}, description="keys of all processes, where they do not say otherwise")
    bag: str | None = Field(None, description="folder of a ROS 2 bag of the flight")
    out: str | None = Field(None, description="folder for a log of each process; None: runs/sitl-...")


def prepare_commands(values: Mapping[str, Any]) -> tuple[dict[str, list[str]], Path]:
    """Return the command of each process by its name, see `list_commands`, and the folder for logs, which is made.

    Args:
        values: arguments by dotted name, as `read_options` takes them.

    Raises:
        ConfigError: see `read_options` and `list_commands`, or the folder cannot be written to.
    """
    options = read_options(values)
    given = None if options.out is None else str(Path(options.out).expanduser())
    with trusting(options.trust):
        list_commands(options, Path(given or "runs"))  # refuses what is wrong, before there is a folder
        out = make_out(given, Path("runs"), "sitl-")
        return list_commands(options, out), out


def read_options(values: Mapping[str, Any]) -> Options:
    """Return the options of arguments by dotted name, over those of the file that they name.

    Raises:
        ConfigError: a file that cannot be read, names code that nobody trusts, or has wrong keys.
    """
    name = values.get("file")
    merged = {} if name is None else _read_file(Path(str(name)).expanduser())
    if values.get("trust") is not True:
        _refuse_code(merged, str(name))
    for dotted, value in values.items():
        *sections, key = dotted.split(".", 2 if dotted.startswith("nodes.") else 1)
        place = merged
        for section in sections:
            if place.get(section) is None:
                place[section] = {}
            place = place[section]
            if not isinstance(place, dict):
                raise ConfigError(f"{dotted}: '{section}' is a value, not a section")
        place[key] = value
    return validate(Options, merged, where=str(name))


def list_commands(options: Options, out: Path) -> dict[str, list[str]]:
    """Return the command of each process by its name, that of the flight or simulation first, of the view last.

    Args:
        options: of the pipeline.
        out: folder for what the flight writes.

    Raises:
        ConfigError: neither flight nor simulation, or both; a wrong key or value of one.
    """
    if (options.flight is None) == (options.simulation is None):
        raise ConfigError("give either flight or simulation, the team that nodes fly, in file=<YAML file>; see --help")
    common: Keys = {"trust": True} if options.trust else {}
    common |= options.common
    usual = _usual(options, out)
    if options.flight is None:
        own: type[CommandOptions] = NodeOptions
        first = _merge(own, usual, _of_role("simulation", _merge(own, common)), options.simulation or {})
        commands = {"simulation": _command("simulation", "ros", own, first)}
    else:
        own, first = FlightOptions, _merge(FlightOptions, usual, common, options.flight)
        commands = {"flight": _command("flight", "px4", own, first)}
    shared = {key: first[key] for key in _SHARED if key in first}
    for name, values in options.nodes.items():
        if name in ("flight", "simulation", "view"):
            raise ConfigError(f"nodes.{name} has the name of another process; give it another one")
        if (role := values.get("role", "simulation")) == "simulation":
            raise ConfigError(f"nodes.{name} needs a role, such as policy; a simulation is a section of its own")
        merged = _of_role(role, _merge(NodeOptions, common, shared)) | _merge(NodeOptions, values)
        commands[name] = _command(f"nodes.{name}", "ros", NodeOptions, merged)
    if options.view is not None:
        merged = _merge(ViewOptions, of_flight(first, own.model_fields), options.view, {"live": True})
        commands["view"] = _command("view", "view", ViewOptions, merged)
    return commands


def _usual(options: Options, out: Path) -> Keys:
    """Return values of the flight or simulation that its section need not give."""
    if options.flight is not None:
        return {"policy": "none", "live": True, "names": "report", "out": str(out / "flight"), "bag": options.bag}
    if options.bag is not None:
        raise ConfigError("bag is of a flight, and a simulation writes none; leave it out")
    if any(values.get("role", "policy") != "policy" for values in options.nodes.values()):
        return {"policy": "none", "names": "report"}  # those of all roles but that
    return {"policy": "none"}


def _of_role(role: Any, values: Keys) -> Keys:
    """Return the values, given to all processes, that mean something to a role."""
    return {key: value for key, value in values.items() if role in OF_ROLES.get(key, (role,))}


def _command(name: str, module: str, options: type[CommandOptions], values: Keys) -> list[str]:
    """Return the command of a process, whose values are checked first."""
    try:
        check_names(values, options.model_fields)
        _, overrides = split_options(options, values)
        if module == "ros":
            check_role(str(values.get("role", "simulation")), values)
        trained = values.get("policy") not in (None, "none", *SCRIPTED)
        config = values.get("config") or (None if trained else "hover")
        if config is not None:  # that of a trained policy is found by the process
            load_config(config, USUAL.get(str(values.get("role")), {}) | overrides)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    return [sys.executable, "-m", f"multilift_marl.{module}", *spell_arguments(options, values)]


def _merge(options: type[CommandOptions], *parts: Mapping[str, Any]) -> Keys:
    """Return the values of a process by dotted name; those of later parts go over those of earlier ones."""
    merged: Keys = {}
    for part in parts:
        merged |= _flatten(part, options)
    return merged


def _flatten(values: Mapping[str, Any], options: type[CommandOptions], prefix: str = "") -> Keys:
    """Return values by dotted name; mappings that a command has as one value stay whole."""
    flat: Keys = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        whole = not isinstance(value, Mapping) or not value or name in options.model_fields
        flat |= {name: value} if whole else _flatten(value, options, f"{name}.")
    return flat


def _read_file(path: Path) -> dict[str, Any]:
    try:
        return as_mapping(read_yaml(path), path, "sections such as 'nodes:'")
    except ConfigError:  # a ValueError, too
        raise
    except FileNotFoundError:
        raise ConfigError(f"no file {shorten(path, 300)}; give the path of a YAML file, see --help") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {shorten(path, 300)} as YAML: {reason(error)}") from None


def _refuse_code(values: Mapping[str, Any], source: str) -> None:
    """Refuse what a file would have run: others may have written it."""
    for key, value in _leaves(values):
        name = key.rpartition(".")[2]
        if name in _RUN_CODE or (name == "policy" and ":" in str(value)):
            raise ConfigError(
                f"{shorten(source, 300)} has {shorten(key)}={shorten(value)}, which was not run: the code that a file "
                f"names may be anybody's; read it, then give {shorten(key)}=<value> as an argument, or trust=true"
            )


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield values that are no mappings by dotted name."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
