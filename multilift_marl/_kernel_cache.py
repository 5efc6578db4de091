"""Compiled kernels on disk: one file for each kernel and its types, in a folder named by the sources they come from.

Numba's own cache looks at the file of the kernel alone, not at those of the functions and constants that it uses; it
keeps an index that two processes must not write at once; and it trusts what it reads. Here each module's kernels have a
folder, named by a digest of the module and all modules of the package that it imports; a kernel from elsewhere (a task
of one's own) is named by a digest of its own source; files are written whole and renamed, and one whose checksum is
wrong counts as missing.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numba.core.caching import Cache as NumbaCache
from numba.core.caching import CompileResultCacheImpl, NullCache, _CacheLocator
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.core.types import BaseNamedTuple

from multilift_marl._compiler import is_inner, rebuild_inner
from multilift_marl._files import write_whole
from multilift_marl._precompile import end, wait_for
from multilift_marl.errors import warn_once

PACKAGE = Path(__file__).parent
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
def _home() -> Path | None:
    """Return where folders of kernels can be made; None, and a warning, if nowhere.

    It is `NUMBA_CACHE_DIR` where that is set, else the package's own `__pycache__`, else the user's cache.
    """
    asked = os.environ.get("NUMBA_CACHE_DIR")
    homes = [Path(asked)] if asked else [PACKAGE / "__pycache__", _user_cache()]
    for home in homes:
        folder = home / "multilift_marl-kernels"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except (OSError, RuntimeError):  # read-only, full, no home
            continue
        return folder
    warn_once(
        "kernels",
        f"compiled kernels cannot be kept: {' and '.join(str(home) for home in homes)} cannot be written; every start "
        "compiles anew, up to a minute. Set NUMBA_CACHE_DIR to a folder that can be",
    )
    return None


@cache
def cache_folder(module: str) -> Path | None:
    """Return the folder of a module's kernels, those of today's sources; None if they cannot be kept."""
    home = _home()
    if home is None:
        return None
    own = f"{PACKAGE.name}."
    name = module.removeprefix(own) if module.startswith(own) else "other"
    folder = home / f"{name}-{sources_digest(module)}"
    try:
        made = not folder.is_dir()
        folder.mkdir(exist_ok=True)
        if made:
            _forget_others(home, name, folder)
    except OSError:  # written when there is something to write
        pass
    return folder


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


def _forget_composed(newest: Path) -> None:
    """Delete the files of a composed kernel but the newest: its folder does not change with what it is composed of."""
    with contextlib.suppress(OSError):
        files = newest.parent.glob(f"{newest.name.rpartition('-')[0]}-*.kernel")
        for path in sorted(files, key=lambda file: file.stat().st_mtime)[:-KEPT_COMPOSED]:
            path.unlink(missing_ok=True)


class _Nowhere(_CacheLocator):
    """What Numba asks for the place of its own files, of which there are none."""

    def __init__(self, function: Callable[..., Any], file: str):
        self._name = f"{function.__qualname__}{file}"

    def ensure_cache_path(self) -> None:
        """Do nothing."""

    def get_cache_path(self) -> str:
        """Return no path."""
        return ""

    def get_source_stamp(self) -> str:
        """Return no stamp."""
        return ""

    def get_disambiguator(self) -> str:
        """Return a name."""
        return self._name

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Nowhere:
        """Return the locator of a function."""
        return cls(function, file)


class _Results(CompileResultCacheImpl):  # how Numba turns a compiled function into what can be pickled, and back
    _locator_classes = (_Nowhere,)  # type: ignore[assignment]


class KernelCache(NumbaCache):
    """The files of one kernel, with the interface of `numba.core.caching.Cache`."""

    _impl_class = _Results  # type: ignore[assignment]

    def __init__(self, function: Callable[..., Any], folder: Path):
        super().__init__(function)
        self._folder, self._function = folder, function
        self._cache_path = str(folder)

    def path(self, sig: Any, target_context: Any) -> Path:
        """Return the file of what Python calls with these types."""
        return self._path(self._index_key(sig, target_context.codegen()))

    def _path(self, key: Any) -> Path:
        """Return the file of a signature: kernel, types, processor and Python in its name."""
        code = self._function.__code__
        written = getattr(self._function, "_sources", "")  # see `_jit.compose`
        kind = "inner" if is_inner() else ""
        parts = (repr(key), repr(_fields(key[0])), sys.version, foreign_digest(self._function), written, kind)
        digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
        name = "".join(c if c.isalnum() else "_" for c in self._function.__qualname__)[-40:]
        return self._folder / f"{name}-{code.co_firstlineno}-{digest}.kernel"

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what was compiled for these types; None, and a line that says so, if it must be compiled now."""
        if not self._enabled:
            return None
        key = self._index_key(sig, target_context.codegen())
        found = self._read(key, target_context)
        if is_inner():
            return found
        if found is None and wait_for(self._path(key), self._function.__name__):
            found = self._read(key, target_context)
        if found is None:
            warn_once("kernels", "compiling kernels of the simulation for the first time, which takes up to a minute")
        return found

    def _read(self, key: Any, target_context: Any) -> Any:
        """Return what was compiled, None if nothing sound is there."""
        try:
            checksum, content = _split(self._path(key).read_bytes())
            if hashlib.sha256(content).digest() != checksum:
                return None
            stored, data = pickle.loads(content)
            rebuild = rebuild_inner if is_inner() else self._impl.rebuild
            return rebuild(target_context, data) if stored == key else None
        except Exception:  # missing, unreadable, or from another version of Numba: compile again
            return None

    def _save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled; what cannot be written is not kept."""
        if not is_inner():
            end()
        if not self._impl.check_cachable(data):
            return
        key = self._index_key(sig, data.codegen)
        content = dumps((key, self._impl.reduce(data)))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)  # others may have deleted it
            path = self._path(key)
            write_whole(path, hashlib.sha256(content).digest() + content, flush=False)
            if hasattr(self._function, "_sources"):
                _forget_composed(path)
        except OSError as error:
            reason = f"{error.strerror}; compiled anew next time"
            warn_once("kernels", f"compiled kernels cannot be kept in {self._folder}: {reason}")

    def flush(self) -> None:
        """Forget nothing: a file belongs to one version of the sources."""


def make_cache(function: Callable[..., Any]) -> KernelCache | NullCache:
    """Return where a kernel's compiled versions are kept."""
    folder = cache_folder(function.__module__)
    return NullCache() if folder is None else KernelCache(function, folder)


def _fields(types: Iterable[Any]) -> list[Any]:
    """Return the names of the fields of named tuples among Numba's types, which neither their names nor keys state."""
    records: list[Any] = [each for each in types if isinstance(each, BaseNamedTuple)]
    return [(record.fields, _fields(record.types)) for record in records]


def _split(content: bytes) -> tuple[bytes, bytes]:
    size = hashlib.sha256().digest_size
    return content[:size], content[size:]


@cache
def foreign_digest(function: Callable[..., Any]) -> str:
    """Return a digest of what a kernel outside the package is made of; "" for the package's own.

    That is its file, the files of the kernels that it names, of the modules beside it that it names, and the constants.
    """
    files, constants = set[str](), set[str]()
    _collect(function, set(), files, constants)
    if not files:
        return ""
    digest = hashlib.sha256("\0".join(sorted(constants)).encode())
    for file in sorted(files):
        with contextlib.suppress(OSError):  # typed in, not read from a file
            digest.update(Path(file).read_bytes())
    return digest.hexdigest()


def _collect(function: Callable[..., Any], seen: set[Any], files: set[str], constants: set[str]) -> None:
    """Add the files outside the package that a function depends on, and the values of the constants that it names."""
    file = function.__code__.co_filename
    if function in seen or PACKAGE in Path(file).parents:
        return
    seen.add(function)
    files.add(file)
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            _collect(value.py_func, seen, files, constants)
        elif isinstance(value, ModuleType):
            beside = getattr(value, "__file__", None)
            if beside and Path(beside).parent == Path(file).parent:
                files.add(beside)
        elif isinstance(value, np.ndarray):
            constants.add(f"{name} {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}")
        elif isinstance(value, bool | int | float | complex | str | tuple):
            constants.add(f"{name} {value!r}")
