"""Code of one's own, without a fork: modules named by `import`, entry points of packages, classes by module:Class."""

from __future__ import annotations

import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from multilift_marl.errors import ConfigError, nearest

_PACKAGE = str(Path(__file__).parent)
GROUP = "multilift_marl.tasks"  # entry points of installed packages
registers: list[Callable[[Any], object]] = []  # what takes the tasks of entry points, see `tasks/__init__.py`
_imported: dict[str, ModuleType] = {}  # by the last part of their name
_loading: set[str] = set()  # values of entry points whose modules, while they run, may ask for what others bring
named: set[str] = set()
"""Modules, see `identify`, and clusters that the user has named or trusts; others that files name wait (`trust.py`)."""
STORED = "train.residual", "train.dagger.teacher"  # keys by which a run names a class
refused: dict[str, str] = {}
"""Classes and clusters that only a file names, with the sentence that says so."""


def import_module(reference: str, key: str = "import") -> tuple[ModuleType, str]:
    """Import a module of one's own.

    A module of the current folder goes before one that is installed. A file is imported under its own name, that of a
    package's file begins with the package's; it can import what lies beside it. A file that is missing, because a run
    has moved to another machine, say, stands for a module of the same name that was imported before.

    Args:
        reference: a module's name, or the path of its .py file or of a package's folder.
        key: of the configuration, for messages.

    Returns:
        The module, and the reference by which it is found from any folder: a path, or the name of an installed module.

    Raises:
        ConfigError: it is missing, fails, or has the name of another module.
    """
    named.add(identify(reference))
    path = find_file(reference)
    if path is None and is_path(reference):
        return _stand_in(reference, key)
    name = reference if path is None else module_name(path)[1]
    try:
        module = importlib.import_module(name) if path is None else _import_file(path)
    except (Exception, SystemExit) as error:  # a user's code may raise anything
        absent = isinstance(error, ModuleNotFoundError) and error.name and f"{name}.".startswith(f"{error.name}.")
        if absent and path is None:
            raise ConfigError(
                f"{key}={reference}: there is no such module, neither in this folder nor installed; give the path of "
                "its .py file"
            ) from error
        raise ConfigError(f"{key}={reference} cannot be imported: {describe_error(error)}") from error
    if path is not None and not is_from(module, path):
        raise ConfigError(
            f"{key}={reference} has the name of another module, {getattr(module, '__file__', None) or name}; rename it"
        )
    _imported[name.rpartition(".")[2]] = module
    return module, reference if path is None else str(path)


def import_modules(references: Any) -> Any:
    """Import modules of one's own; return their references for a configuration, see `import_module`, each once.

    What is neither a name nor a list of names is returned as it is, for the configuration to refuse.
    """
    names = (references,) if isinstance(references, str) else () if references is None else references
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        return references
    found = [import_module(name) for name in names]
    return tuple({module.__name__: reference for module, reference in found}.values())


def find_callable(reference: str, key: str) -> Callable[..., Any]:
    """Return what module:name refers to, a class or a function; `key` is for messages.

    Raises:
        ConfigError: see `import_module`; the module holds no such class; or only a file names it, see `trust.review`.
    """
    if key in STORED and reference in refused:
        raise ConfigError(refused[reference])
    place, _, name = reference.rpartition(":")
    if not place or not name:
        raise ConfigError(f"{key}={reference} is not of the form module:Class, such as my_policies:Hold")
    module, _ = import_module(place, key)
    found = getattr(module, name, None)
    if not callable(found):
        known = [each for each, value in vars(module).items() if isinstance(value, type)]
        raise ConfigError(f"{key}={reference}: {place} holds no class '{name}'{nearest(name, known)}")
    return found


@cache
def load_entry_points() -> dict[str, str]:
    """Load the entry points of the group `multilift_marl.tasks`: tasks, or modules that register what they bring.

    Returns:
        Why some could not be loaded, by name; those are warned of, too.
    """
    failures = {}
    for point in entry_points(group=GROUP):
        if point.value in _loading:
            continue
        _loading.add(point.value)
        try:
            _register(point.load())
        except (Exception, SystemExit) as error:  # a broken package must not keep others from working
            failures[point.name] = f"{_origin(point)} cannot be loaded: {describe_error(error)}"
            warnings.warn(failures[point.name], stacklevel=2)
        finally:
            _loading.discard(point.value)
    return failures


def describe_unknown(name: str, unknown: str) -> str:
    """Return what is wrong where nothing of a `name` is registered, with what failed of the packages that may have it.

    Args:
        name: a task's, a configuration's or a vehicle's.
        unknown: the sentence that says so, which holds where no entry point has the name.
    """
    failures = load_entry_points()
    return failures.get(name) or "; ".join((unknown, *failures.values()))


def describe_error(error: BaseException) -> str:
    """Return in a phrase what a user's code raised, and where."""
    if isinstance(error, SyntaxError):
        file, line, text = error.filename, error.lineno, error.msg
    else:
        frames = traceback.extract_tb(error.__traceback__)
        theirs = [frame for frame in frames if not frame.filename.startswith((_PACKAGE, "<"))]
        last = (theirs or frames)[-1]
        file, line, text = last.filename, last.lineno, " ".join(str(error).split())
        if not theirs and len(frames) == 1:  # of the call itself, such as a wrong number of arguments
            return f"{type(error).__name__} ({text})"
    return f"{type(error).__name__} in {Path(file or '?').name}, line {line}{f' ({text})' if text else ''}"


def describe_unregistered(name: str) -> str:
    """Return what to do about an imported task of this name that is not registered; "" if there is none."""
    for module in _imported.values():
        for each in vars(module).values():
            own = isinstance(each, type) and each.__module__ == module.__name__ and hasattr(each, "REWARD")
            if own and vars(each).get("name") == name:
                file = Path(getattr(module, "__file__", None) or module.__name__).name
                return f"; class {each.__name__} of {file} is not registered: put @ml.register_task above it"
    return ""


def _register(found: Any) -> None:
    if not isinstance(found, ModuleType):
        for register in registers:
            register(found)


def _origin(point: EntryPoint) -> str:
    package = point.dist.name if point.dist is not None else "an installed package"
    return f"the {'task' if point.attr else 'module'} '{point.name}' of {package} ({point.value})"


def identify(reference: str) -> str:
    """Return what a module is known by, however it is spelled: its file, links followed, or its name."""
    path = find_file(reference)
    return reference if path is None else os.path.realpath(path)


def is_path(reference: str) -> bool:
    """Return whether a reference is a path rather than the name of a module."""
    return reference.endswith(".py") or "/" in reference


def find_file(reference: str, folder: Path | None = None) -> Path | None:
    """Return the file of a module in a folder, by default the current one, or by path; None if there is none."""
    here = Path.cwd() if folder is None else folder
    if is_path(reference):
        try:
            path = Path(os.path.abspath(here / os.path.expanduser(reference)))
        except ValueError:  # of a user's name with a NUL
            return None
        path = path / "__init__.py" if os.path.isdir(path) else path
        return path if os.path.isfile(path) else None
    base = here.joinpath(*reference.split("."))
    for path in (base / "__init__.py", base.parent / f"{base.name}.py"):
        if os.path.isfile(path):
            name = module_name(path)[1]
            # A folder that is given may itself be within a package.
            if name == reference or (folder is not None and name.endswith(f".{reference}")):
                return path
    return None


def module_name(path: Path) -> tuple[Path, str]:
    """Return the folder from which a file is imported, and the name of its module there."""
    folder, parts = path.parent, [] if path.stem == "__init__" else [path.stem]
    while (folder / "__init__.py").is_file():
        folder, parts = folder.parent, [folder.name, *parts]
    return folder, ".".join(parts)


def _import_file(path: Path) -> ModuleType:
    """Import a file, whose folder goes first meanwhile, and last on Python's path from then on."""
    folder, name = module_name(path)
    importlib.invalidate_caches()  # the file may be new
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))
        if str(folder) not in sys.path:
            sys.path.append(str(folder))


def is_from(module: ModuleType, path: Path) -> bool:
    """Return whether a module was imported from a file."""
    file = getattr(module, "__file__", None)
    return file is not None and os.path.exists(file) and os.path.samefile(file, path)


def _stand_in(reference: str, key: str) -> tuple[ModuleType, str]:
    """Return the imported module that has the name of a missing file, see `import_module`."""
    path = Path(reference)
    name = path.parent.name if path.stem == "__init__" else path.stem
    module = _imported.get(name) or sys.modules.get(name)
    file = getattr(module, "__file__", None)
    if module is None or file is None:
        raise ConfigError(
            f"{key}={reference} is missing; put the file back, or say where it is by {key}=<folder>/{path.name}"
        )
    return module, file
