"""Where compiled kernels are kept: in a folder named by a digest of all that they come from.

Numba's own cache looks at the file of the kernel alone, not at those of the functions and constants that it uses. Here
each module's kernels have a folder, named by a digest of the module and all modules of the package that it imports; a
kernel from elsewhere (a task of one's own) is named by a digest of all that it is made of.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from enum import Enum, EnumType
from functools import cache
from pathlib import Path
from types import CellType, CodeType, ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

PACKAGE = Path(__file__).parents[1]
KEPT = 20  # folders of a module's former sources
KEPT_COMPOSED = 100  # files of each composed kernel, which may be of former sources or of other tables
_IMPORT = re.compile(
    r"^\s*(?:from (multilift_marl[\w.]*) import ([\w, ]+|\([^)]+\))|import (multilift_marl[\w.]*))", re.M
)


@cache
def _imports(module: str) -> tuple[Path, frozenset[str]] | None:
    """Return the file of a module of the package, and the names of those it imports; None if there is no such file."""
    path = PACKAGE.parent.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not path.is_file():
        return None
    names = set[str]()
    for source, members, whole in _IMPORT.findall(path.read_text(encoding="utf-8")):
        # A name after `import` may be a module or not: `_imports` finds no file for the latter.
        names |= {source or whole, *(f"{source}.{member}" for member in re.findall(r"\w+", members))}
    return path, frozenset(names)


@cache
def sources_digest(module: str) -> str:
    """Return a digest of the sources of a module of the package and of all modules of the package that it imports.

    A module from elsewhere may use any of them.
    """
    if not module.startswith(f"{PACKAGE.name}."):
        sources = sorted(PACKAGE.rglob("*.py"))
        return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:16]
    # All that it imports, and what that imports: a constant far below is compiled into the kernel.
    found, waiting = dict[str, Path](), [module]
    while waiting:
        name = waiting.pop()
        entry = None if name in found else _imports(name)
        if entry is not None:
            found[name] = entry[0]
            waiting.extend(entry[1])
    digest = hashlib.sha256()
    for name in sorted(found):
        digest.update(name.encode() + found[name].read_bytes())
    return digest.hexdigest()[:16]


@cache
def homes() -> list[Path]:
    """Return where folders of kernels may be, whether they can be written or read alone.

    It is `NUMBA_CACHE_DIR` where that is set, else the package's own `__pycache__` and the user's cache.
    """
    asked = os.environ.get("NUMBA_CACHE_DIR")
    homes = [Path(asked)] if asked else [PACKAGE / "__pycache__"]
    if not asked:
        with contextlib.suppress(RuntimeError):  # a user without a home
            # For packages in a place that only an administrator writes to.
            homes.append(_user_cache())
    return [home / "multilift_marl-kernels" for home in homes]


@cache
def _home() -> Path | None:
    """Return the first home where folders of kernels can be made; None if nowhere."""
    for folder in homes():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:  # read-only or full
            continue
        return folder
    return None


@cache
def cache_folder(module: str) -> Path | None:
    """Return the folder of a module's kernels, those of today's sources; None if they cannot be kept."""
    home = _home()
    if home is None:
        return None
    folder = home / _folder_name(module)
    try:
        made = not folder.is_dir()
        folder.mkdir(exist_ok=True)
        if made:
            _forget_others(home, _short_name(module), folder)
    except OSError:  # written when there is something to write
        pass
    return folder


@cache
def other_folders(module: str) -> tuple[Path, ...]:
    """Return the folders from which a module's kernels can be read alone."""
    folders = [home / _folder_name(module) for home in homes() if home != _home()]
    return tuple(folder for folder in folders if folder.is_dir())


def _folder_name(module: str) -> str:
    return f"{_short_name(module)}-{sources_digest(module)}"


def _short_name(module: str) -> str:
    own = f"{PACKAGE.name}."
    return module.removeprefix(own) if module.startswith(own) else "other"


def _user_cache() -> Path:
    """Return the folder for caches of this user."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _forget_others(home: Path, name: str, current: Path) -> None:
    """Delete the folders of a module's former sources but the newest."""
    with contextlib.suppress(OSError):
        others = sorted((f for f in home.glob(f"{name}-*") if f != current), key=lambda f: f.stat().st_mtime)
        for folder in others[:-KEPT]:
            shutil.rmtree(folder, ignore_errors=True)


def forget_composed(newest: Path) -> None:
    """Delete the files of a composed kernel but the newest: its folder does not change with what it is composed of."""
    with contextlib.suppress(OSError):
        files = newest.parent.glob(f"{newest.name.rpartition('-')[0]}-*.kernel")
        for path in sorted(files, key=lambda file: file.stat().st_mtime)[:-KEPT_COMPOSED]:
            path.unlink(missing_ok=True)


@cache
def foreign_digest(function: Callable[..., Any]) -> str:
    """Return a digest of what a kernel outside the package is made of; "" for the package's own.

    That is its code and its file, those of the kernels that it names, the files of the modules beside it that it names,
    and the constants, be they global or of the function that made the kernel.
    """
    files, contents = set[str](), set[str]()
    _collect(function, set(), files, contents)
    if not files:
        return ""
    digest = hashlib.sha256("\0".join(sorted(contents)).encode())
    for file in sorted(files):
        with contextlib.suppress(OSError):  # typed in, not read from a file
            digest.update(Path(file).read_bytes())
    return digest.hexdigest()


def code_names(code: CodeType) -> Iterator[str]:
    """Return the names in a code object and in those within it, with words in quotes, as `getattr` takes them."""
    yield from code.co_names
    yield from code.co_freevars
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from code_names(constant)
        elif isinstance(constant, str) and constant.isidentifier():
            yield constant


def used_values(function: Callable[..., Any]) -> list[tuple[str, Any]]:
    """Return what a function takes from outside itself, by name: globals, its closure, members of modules and tuples.

    Of a closure that is what the function that made it had; of modules what the code names of them, NumPy's left out.
    """
    names = set(code_names(function.__code__))
    # A cell may be empty still: of a function that is defined further down, or calls itself.
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    outside = function.__globals__ | {name: cell.cell_contents for name, cell in cells if cell != CellType()}
    waiting: list[tuple[str, Any]] = [(name, outside[name]) for name in sorted(names & outside.keys())]
    found, modules = list[tuple[str, Any]](), set[ModuleType]()
    while waiting:
        name, value = waiting.pop()
        found.append((name, value))
        if isinstance(value, ModuleType) and value not in modules and value.__name__.partition(".")[0] != "numpy":
            modules.add(value)
            waiting += [(f"{name}.{each}", getattr(value, each)) for each in sorted(names) if hasattr(value, each)]
        elif isinstance(value, tuple):
            waiting += [(f"{name}[{i}]", each) for i, each in enumerate(value)]
    return found


def _collect(function: Callable[..., Any], seen: set[Any], files: set[str], contents: set[str]) -> None:
    """Add the files outside the package that a function depends on, its code, and the constants that it names."""
    file = function.__code__.co_filename
    if function in seen or PACKAGE in Path(file).parents:
        return
    seen.add(function)
    files.add(file)
    contents.add(f"{function.__module__} {_code_text(function.__code__)}")
    for name, value in used_values(function):
        if isinstance(value, Dispatcher):
            _collect(value.py_func, seen, files, contents)
        elif isinstance(value, ModuleType):
            beside = getattr(value, "__file__", None)
            if beside and Path(beside).parent == Path(file).parent:
                files.add(beside)
        elif isinstance(value, np.ndarray):
            contents.add(f"{name} {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}")
        elif isinstance(value, bool | int | float | complex | str | np.generic | Enum):
            contents.add(f"{name} {value!r}")
        elif isinstance(value, tuple):
            # A named tuple by its fields; its values are in the list, too, one by one.
            contents.add(f"{name} {type(value).__name__} {getattr(value, '_fields', len(value))}")
        elif isinstance(value, EnumType):
            contents.add(f"{name} {list(value)!r}")


def _code_text(code: CodeType) -> str:
    """Return what a code object does, as text: two functions of one place may differ, typed in one after the other."""
    constants = [_code_text(each) if isinstance(each, CodeType) else repr(each) for each in code.co_consts]
    return f"{code.co_qualname} {code.co_code.hex()} {code.co_names} {code.co_varnames} {code.co_freevars} {constants}"
