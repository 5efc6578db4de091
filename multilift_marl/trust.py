"""What a file may run: of the modules and clusters that it names, those that the user names himself or trusts."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.metadata import entry_points
from typing import Any

from multilift_marl import plugins
from multilift_marl.errors import ConfigError, shorten

_OWN_CLUSTERS = ("auto", "local", "")  # values of `train.ray` by which a file chooses none
_PLAIN = (str, int, float, bool, type(None))  # types of values that a stored configuration holds
_MOST_DEPTH = 30
_trusted: ContextVar[bool] = ContextVar("trusted", default=False)


@contextmanager
def trusting(trust: bool) -> Iterator[None]:
    """Let files run what they name meanwhile, if `trust`."""
    before = _trusted.set(trust or _trusted.get())
    try:
        yield
    finally:
        _trusted.reset(before)


def review(values: Any, source: object) -> None:
    """Refuse modules that a stored configuration names, where nobody else does; call it before `build_config`.

    A module may run that the user has named in this process (`import=`, `policy=module:Class`) or trusts, that is
    imported already, or that is part of an installed package with an entry point of `plugins.GROUP`. A class that
    `train.residual` or `train.dagger.teacher` names is refused when it is needed, by `plugins.find_callable`: those
    who fly do not need it. So is a cluster that `train.ray` names, by `check_cluster`: what it returns is
    unpickled, and so may run anything.

    Args:
        values: the stored configuration, nested; of any content.
        source: the file that it comes from, for messages.

    Raises:
        ConfigError: a module that may not run, or a value of a type that is not known here, see `find_foreign`.
    """
    if foreign := find_foreign(values):
        raise ConfigError(
            f"{shorten(str(source), 300)} is no configuration ({foreign}); keep to text, numbers, lists and sections"
        )
    if not isinstance(values, dict):
        return
    train = values.get("train")
    train = train if isinstance(train, Mapping) else {}
    rigs, stages = (each if isinstance(each := train.get(key), list | tuple) else () for key in ("rigs", "stages"))
    changes = [stage.get("overrides") for stage in stages if isinstance(stage, Mapping)]
    for part in (values, train.get("overrides"), *rigs, *changes):
        for reference in _references(part):
            if not _may_run(reference) and not _is_imported(reference):
                raise ConfigError(explain_refusal("import", reference, reference, source))
    dagger = train.get("dagger")
    teacher = dagger.get("teacher") if isinstance(dagger, Mapping) else None
    for key, name in zip(plugins.STORED, (train.get("residual"), teacher), strict=True):
        if isinstance(name, str) and ":" in name:
            module = name.rpartition(":")[0]
            if _may_run(module):
                plugins.refused.pop(name, None)
            else:
                plugins.refused[name] = explain_refusal(key, name, module, source)
    if isinstance(address := train.get("ray"), str) and address not in _OWN_CLUSTERS:
        key = _cluster(address)
        if _trusted.get():
            name_cluster(address)
        elif key not in plugins.named:
            plugins.refused[key] = (
                f"{shorten(str(source), 300)} has {shorten(key, 300)}, which was not joined: what workers there return "
                f"may be anybody's code; name it yourself by {shorten(key, 300)}, or give trust=true"
            )


def find_foreign(values: Any, name: str = "config", depth: int = 0) -> str:
    """Return what a stored configuration holds that none of this package does, "" if nothing.

    Validation would take more than is reviewed: a set for a list, bytes for text.

    Args:
        values: the configuration, nested; of any content.
        name: its key, for the answer.
        depth: of that in the configuration.
    """
    kind = type(values)
    if kind in _PLAIN:
        return ""
    if kind not in (dict, list, tuple):
        return f"{name} is of type {kind.__name__}"
    if depth > _MOST_DEPTH:
        return f"config is nested more than {_MOST_DEPTH} deep"
    for key, value in values.items() if kind is dict else enumerate(values):
        if kind is dict and type(key) is not str:
            return f"{name} has the key {shorten(repr(key))}, which is no text"
        if found := find_foreign(value, f"{name}.{key}", depth + 1):
            return found
    return ""


def name_cluster(address: str) -> None:
    """Note a cluster that the user names or trusts, and so may be joined."""
    plugins.named.add(_cluster(address))
    plugins.refused.pop(_cluster(address), None)


def check_cluster(address: str) -> None:
    """Refuse, by a ConfigError, a cluster that only a file names, see `review`; call it before it is joined."""
    if why := plugins.refused.get(_cluster(address)):
        raise ConfigError(why)


def _cluster(address: str) -> str:
    """Return what a cluster is known by among what is named or refused."""
    return f"train.ray={address}"


def explain_refusal(key: str, reference: str, module: str, source: object) -> str:
    """Return in a sentence why a reference was not run, and what to do."""
    return (
        f"{shorten(str(source), 300)} has {key}={shorten(reference, 300)}, which was not run: the code that a file "
        f"names may be anybody's; read it, then name it yourself by import={shorten(module, 300)}, or give trust=true; "
        "in Python import it first, or use load_config or load_policy(..., trust=True)"
    )


def _references(part: Any) -> list[str]:
    """Return the modules that a section names; what is wrong there is refused when it is validated."""
    names = part.get("import") if isinstance(part, Mapping) else None
    names = names if isinstance(names, list | tuple) else [names]
    return [name for name in names if isinstance(name, str)]


def _may_run(reference: str) -> bool:
    """Return whether the user has named a module, trusts it, or has installed it as a plugin."""
    if _trusted.get():
        plugins.named.add(plugins.identify(reference))
    return plugins.identify(reference) in plugins.named or _is_plugin(reference)


def _is_imported(reference: str) -> bool:
    """Return whether to import a module is to run nothing: it was imported, or its file is missing."""
    path = plugins.find_file(reference)
    if path is None:
        return plugins.is_path(reference) or reference in sys.modules
    module = sys.modules.get(plugins.module_name(path)[1])
    return module is not None and plugins.is_from(module, path)


def _is_plugin(reference: str) -> bool:
    """Return whether a module belongs to an installed package that has entry points of this one."""
    package = reference.partition(".")[0]
    if plugins.is_path(reference) or plugins.find_file(reference) or plugins.find_file(package):
        return False
    return any(point.module.partition(".")[0] == package for point in entry_points(group=plugins.GROUP))
