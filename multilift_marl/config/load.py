"""Configurations from names, files and overrides."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from multilift_marl.config.aliases import plain_values, stored_names
from multilift_marl.config.config import Config
from multilift_marl.config.keys import find_unknown, list_keys
from multilift_marl.config.precedence import give_way, is_empty, merge, system_part
from multilift_marl.errors import ConfigError, UnknownKeywordError, nearest, reason, shorten
from multilift_marl.plugins import (
    describe_unknown,
    describe_unregistered,
    find_file,
    identify,
    import_modules,
    load_entry_points,
    named,
    refused,
)
from multilift_marl.schema.files import FILE_KEYS, as_mapping, change_files, is_yaml
from multilift_marl.schema.validate import validate
from multilift_marl.schema.yaml_text import parse_yaml, read_yaml, write_yaml
from multilift_marl.trust import name_cluster, review, trusting

_MOST_SECTIONS = 5  # of a key's name; what is deeper is unknown anyway
_PACKAGE = Path(__file__).resolve().parents[1]
CONFIGS: dict[str, Path | Mapping[str, Any]] = {}
"""Configurations of one's own by name, see `register_config`."""


def config_dir() -> Path:
    """Return the folder of shipped configurations: inside an installed package, beside it in a checkout."""
    installed = _PACKAGE / "configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"


def list_configs() -> list[str]:
    """Return the names of the shipped configurations, those in a folder with it: "hover", "rigs/falcon3"."""
    folder = config_dir()
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))


def register_config(name: str, source: str | Path | Mapping[str, Any]) -> None:
    """Make a configuration of one's own known by name: a rig, a preset of a task.

    Args:
        name: not that of a shipped configuration; of one's own, the latest counts.
        source: the path of its YAML file, or its values by section.

    Raises:
        ConfigError: the name is taken, or there is no such file.
    """
    if name in list_configs() or is_yaml(name):
        raise ConfigError(f"a configuration of one's own cannot have the name '{name}': choose one that is not taken")
    if not isinstance(source, Mapping):
        source = Path(source).absolute()
        # For a mistake in it to show here, and not where it is first used.
        _read(source)
    CONFIGS[name] = source


def state_task(task: str, source: str | Path | Mapping[str, Any]) -> Path | Mapping[str, Any]:
    """Return the configuration of a task, a YAML file or its values, such that it says which task it is of.

    Raises:
        ConfigError: it says another, or there is no such file.
    """
    if isinstance(source, Mapping):
        values = source
    else:
        source = Path(source).absolute()
        # Bases, too, for a mistake in them to show here.
        _read(source)
        values = _read_file(source)
    if (stated := values.get("task", task)) != task:
        where = "its configuration" if isinstance(source, Mapping) else source
        raise ConfigError(
            f"{where} is of task={shorten(stated)}, not of the task '{task}' that it is registered with; leave out its "
            "key task"
        )
    return source if "task" in values else {"task": task, **values}


def load_config(name: str | Path = "hover", overrides: Mapping[str, Any] | None = None, trust: bool = False) -> Config:
    """Return typed defaults < the configuration `name` < `overrides`.

    Where `overrides` name a `task` other than its own, that task's configuration (typed defaults if it has none) takes
    its place, and of `name` only the system counts, which goes over it: env.num_drones, sim, vehicle, payload, cable,
    control and wind. So a rig can be given any task.

    What is overridden goes before what the configuration changes in training alone, `train.overrides` and `train.rigs`,
    unless these are overridden, too; so does what a configuration says itself before those of its bases.

    A configuration may name others below it, `base: rigs/auto6` or a list: its own values go over theirs; of bases with
    another task only the system counts.

    Args:
        name: a shipped configuration's name, one's own, or the path of a YAML file.
        overrides: values by dotted name, such as {"payload.mass": 2.0}; mappings add to what is there, but an empty one
            drops it where names are free: {"train.overrides": {}}, {"task_options": {}}, {"reward": {}}.
        trust: whether the file may run the modules that it names by `import`, beside those that `overrides` name.

    Raises:
        ConfigError: an unknown name or key, a wrong type, a value out of range, or a module that may not run.
    """
    overrides = stored_names(overrides or {})
    import_modules(overrides.get("import"))  # they may bring the configuration
    with trusting(trust):
        values = _read(name)
        if (task := overrides.get("task", values.get("task"))) != values.get("task"):
            values = _set_system(_read_preset(task), system_part(values))
    return build_config(give_way(values, overrides), overrides, where=str(name))


def load_rig(name: str | Path, task: str | Path, overrides: Mapping[str, Any]) -> Config:
    """Return the configuration `task` with the system of the configuration `name` over it, then `overrides`.

    Where `task` is the name of a task rather than of a configuration, `load_config` does so.

    Raises:
        ConfigError: see `load_config`.
    """
    overrides = stored_names(overrides)
    import_modules(overrides.get("import"))
    values = _set_system(_read(task), system_part(_read(name)))
    return build_config(give_way(values, overrides), overrides, where=f"{task}, {name}")


def build_config(values: Mapping[str, Any], overrides: Mapping[str, Any] | None = None, where: str = "") -> Config:
    """Return the validated configuration of nested `values` with dotted `overrides` applied.

    Args:
        values: by section, as in a YAML file.
        overrides: by dotted name.
        where: the file that the values come from, for messages.

    Raises:
        ConfigError: an unknown key, a wrong type or a value out of range.
    """
    merged, overrides = merge({}, plain_values(values)), stored_names(overrides or {})
    free = {name.removesuffix(".<name>") for name, _, _ in list_keys(Config) if name.endswith(".<name>")}
    for dotted, value in overrides.items():
        _note_named(dotted, value)
        *sections, key = dotted.split(".", _MOST_SECTIONS)
        change, node = {key: value}, merged
        # Down to the section that holds the key: no value may be in the way of it.
        for part in sections:
            node = node.get(part, {})
            if not isinstance(node, Mapping):
                raise ConfigError(f"{dotted}: '{part}' is a value, not a section")
        if dotted in free and is_empty(value):
            node.pop(key, None)
        for part in reversed(sections):
            change = {part: change}
        merged = merge(merged, change)
    if "import" in merged:
        merged["import"] = _import_all(values.get("import"), overrides.get("import"))
    return validate(Config, merged, where=where)


def choose_config(name: str | Path | None, own: Config | None, overrides: Mapping[str, Any]) -> Config:
    """Return what a policy is to fly in: the configuration `name`, its `own` where that is None, or hover.

    With another `task` than its own, it brings its system as `load_config` does, and how it observes.

    Raises:
        ConfigError: see `load_config`.
    """
    if name is not None or own is None:
        return load_config("hover" if name is None else name, overrides)
    values = own.model_dump()
    if (task := overrides.get("task", own.task)) != own.task:
        import_modules(overrides.get("import"))  # they may bring the task
        observed = {key: values["env"][key] for key in ("history", "units")}
        values = _set_system(_read_preset(task), merge(system_part(values), {"env": observed}))
    return build_config(values, overrides)


def resolve_config(
    task: str | Config, *, num_envs: int | None = None, num_threads: int | None = None,
    num_drones: int | None = None, seed: int | None = None, **overrides: Any,
) -> Config:  # fmt: skip
    """Return the configuration that every API builds from; None means the configured value.

    Raises:
        ConfigError: see `load_config`; or one value was given twice, differently.
    """
    named = {"env.num_envs": num_envs, "env.num_threads": num_threads, "env.num_drones": num_drones, "seed": seed}
    if unknown := find_unknown(overrides, [key.rpartition(".")[2] for key in named]):
        name, hint = unknown
        raise UnknownKeywordError(f"unknown key '{name}' (unexpected keyword argument '{name}'){hint}")
    for key, value in named.items():
        if value is not None and overrides.setdefault(key, value) != value:
            short = key.rpartition(".")[2]
            raise ConfigError(f"{short}={value!r} and {key}={overrides[key]!r} were both given; leave out one of them")
    if not isinstance(task, Config):
        return load_config(task, overrides)
    return build_config(task.model_dump(include=task.model_fields_set), overrides)  # what is stated stays known as such


def parse_overrides(arguments: Iterable[str], names: Collection[str] = ()) -> dict[str, Any]:
    """Return {"a.b": value} of command-line arguments a.b=value, read as YAML.

    Args:
        arguments: of the command line.
        names: keys whose values are names, of files and runs say: text as it is.

    Raises:
        ConfigError: an argument of another form, a key given twice, an empty name, or a value that is no YAML.
    """
    overrides: dict[str, Any] = {}
    for argument in arguments:
        key, separator, text = argument.partition("=")
        if not separator or not key:
            raise ConfigError(f"'{argument}' is not of the form key=value, such as train.frames=2e6")
        if key in overrides:
            raise ConfigError(f"{key} is given twice; leave out one of them")
        if key in names:
            if not text.strip():
                raise ConfigError(f"{key}= is empty; give a name behind it, or leave it out")
            overrides[key] = text
            continue
        try:
            overrides[key] = parse_yaml(text)
        except ValueError as error:
            raise ConfigError(f"the value of {key}={shorten(text)} is not valid YAML: {error}") from None
    return overrides


def dump_config(config: Config) -> str:
    """Return the resolved configuration as YAML, complete: it loads back to an equal one."""
    return write_yaml(config.model_dump(mode="json"))


def _read(name: str | Path, above: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the values of a configuration with those of its bases below them; `above` names what is based on it."""
    path = Path(name)
    if not is_yaml(path):
        path = config_dir() / f"{name}.yaml"
        if not os.path.isfile(path):
            return _read_own(str(name), above)
    return _add_bases(_read_file(path), (*above, str(path)))


def _read_file(path: Path) -> dict[str, Any]:
    """Return what a YAML file says itself, with what lies beside it by absolute paths; its bases are not read."""
    try:
        values = read_yaml(path)
    # A ConfigError is a ValueError, too, but not one of those that are caught below.
    except ConfigError:
        raise
    except FileNotFoundError:
        known = {each.as_posix(): each.as_posix() for each in path.parent.glob("*.y*ml")}
        known |= {f"{each}.yaml": each for each in (*list_configs(), *CONFIGS)}
        close = get_close_matches(path.as_posix(), known, n=1, cutoff=0.7)
        hint = f"; did you mean '{known[close[0]]}'?" if close else ""
        raise ConfigError(
            f"no configuration file {path}: give the path of a YAML file or a shipped name{hint}"
        ) from None
    except (OSError, ValueError) as error:  # ValueError: what is no YAML, and names with a NUL
        raise ConfigError(f"cannot read {shorten(path, 300)} as YAML: {reason(error)}") from None
    # A path counts from the folder of the file that states it.
    values = stored_names(as_mapping(values, path, "sections such as 'env:'"))
    located = _locate(values, path.absolute().parent)
    review(located, path)
    return located


def _add_bases(values: dict[str, Any], above: tuple[str, ...]) -> dict[str, Any]:
    """Return the values of `base`, one configuration or several, with a configuration's own `values` over them.

    The task is its own, else that of its first base; bases with another task give their system only, those without
    one all that they say.

    Args:
        values: of a configuration.
        above: the configurations that led here, itself the last.

    Raises:
        ConfigError: no name, an unknown one, or a configuration that is its own base.
    """
    own = dict(values)
    names = own.pop("base", [])
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        raise ConfigError(
            f"base in {above[-1]} must be the name of a configuration or a list of names, but is {names!r}"
        )
    merged: dict[str, Any] = {}
    for name in names:
        if _identify(name) in [_identify(each) for each in above]:
            short = Path(name).name if is_yaml(name) else name
            raise ConfigError(f"{above[-1]} is based on {short}, which is based on it; take one of the two bases out")
        part = _read(name, above)
        task = own.get("task", merged.get("task", part.get("task")))
        merged = merge(merged, part if part.get("task", task) == task else system_part(part))
    return merge(give_way(merged, own), own)


def _identify(name: str) -> str:
    """Return what a configuration is known by, however it is written: its file, links followed, or its name."""
    source = Path(name) if is_yaml(name) else CONFIGS.get(name, config_dir() / f"{name}.yaml")
    try:
        return os.path.realpath(source) if isinstance(source, Path) else name
    except ValueError:  # of a name with a NUL: refused where it is read
        return name


def _read_own(name: str, above: tuple[str, ...]) -> dict[str, Any]:
    """Return the values of a registered configuration."""
    if name not in CONFIGS:
        load_entry_points()
    if name not in CONFIGS:
        otherwise = "; one's own needs import=<module>, or is a file"
        hint = describe_unregistered(name) or nearest(name, [*list_configs(), *CONFIGS], otherwise=otherwise)
        raise ConfigError(describe_unknown(name, f"no configuration named '{shorten(name)}'{hint}"))
    source = CONFIGS[name]
    return _read(source, above) if isinstance(source, Path) else _add_bases(stored_names(source), (*above, name))


def _read_preset(task: Any) -> dict[str, Any]:
    """Return the configuration that has the name of a task, {} if there is none."""
    if not isinstance(task, str):
        return {}
    if task not in CONFIGS and task not in list_configs():
        load_entry_points()
    return _read(task) if task in CONFIGS or task in list_configs() else {}


def _set_system(values: Mapping[str, Any], system: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a configuration with a system over them."""
    return merge(give_way(values, system), system)


def _locate(values: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the values of a file in `folder` with modules, files and bases that lie beside it as absolute paths."""

    def find_beside(key: str, reference: str) -> str:
        if key == "base":
            return str(folder / reference) if is_yaml(reference) else reference
        path = find_file(reference, folder) if key == "import" else folder / reference
        try:
            return str(path) if path is not None and path.is_file() else reference
        except (OSError, ValueError):  # of names too long, and names with a NUL: refused where they are read
            return reference

    return change_files(values, find_beside, keys=(*FILE_KEYS, "import", "base"))


def _import_all(stored: Any, more: Any) -> Any:
    """Return the references of all modules, those asked for now imported first: they stand in for missing files."""
    asked = import_modules(more), import_modules(stored)
    wrong = [references for references in asked if not isinstance(references, tuple)]
    return wrong[0] if wrong else import_modules([*asked[1], *asked[0]])


def _note_named(key: str, value: Any) -> None:
    """Note a class of one's own for `train.residual` and a cluster that are given now, and so may run or be joined."""
    if key == "train" and isinstance(value, Mapping):
        for part in ("residual", "ray"):
            _note_named(f"train.{part}", value.get(part))
    elif key == "train.residual" and isinstance(value, str) and ":" in value:
        named.add(identify(value.rpartition(":")[0]))
        refused.pop(value, None)
    elif key == "train.ray" and isinstance(value, str):
        name_cluster(value)
