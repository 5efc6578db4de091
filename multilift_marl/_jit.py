"""Numba's compiler as this package uses it: no fast-math, no GIL, results kept on disk."""

from __future__ import annotations

import fcntl
import functools
import hashlib
import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar, TypeVarTuple, cast

from numba import njit, typeof

F = TypeVar("F", bound=Callable[..., Any])
Arguments = TypeVarTuple("Arguments")
_PACKAGE = Path(__file__).parent
_STAMP = _PACKAGE / "__pycache__" / "kernels.sha256"
_WITHOUT_KERNELS = ("agents", "cli", "envs", "evaluation", "rendering", "view", "__init__.py")


def kernel(function: F) -> F:
    """Compile a function to machine code at its first call.

    Arithmetic is exact IEEE, so results do not depend on how many environments are computed together.
    """
    dispatcher: Any = njit(cache=True, nogil=True, error_model="numpy")(function)
    if (cache := getattr(dispatcher, "_cache", None)) is not None:  # none where Numba is switched off
        cache._cache_file.save = functools.partial(_save_in_turn, cache._cache_file, cache._cache_file.save)
    return cast(F, dispatcher)


def _save_in_turn(files: Any, save: Callable[[Any, Any], None], key: Any, data: Any) -> None:
    """Add to the cache while no other process does.

    Numba numbers a kernel's files by an index that it reads first: two processes that compile different signatures at
    once would write the same file, and one would later be taken for the other. Nothing is added by a process that began
    with other sources than there are now.
    """
    with ExitStack() as held:
        try:
            lock = held.enter_context(open(os.path.join(files._cache_path, "kernels.lock"), "w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:  # a file system that knows no locks
            pass
        if not _STAMP.is_file() or _STAMP.read_text() == _SOURCES:
            save(key, data)


def bind(function: Callable[[*Arguments], object], *arguments: *Arguments) -> Callable[[], None]:
    """Return a call of a kernel with these very arguments, compiled now, without looking up their types at each call.

    That look-up costs more than many kernels do: a named tuple of ten arrays takes about 2 µs. The arrays must stay the
    same objects in memory; what is in them may change.
    """
    types = tuple(typeof(argument) for argument in arguments)
    compiled: Any = function  # Numba's dispatcher
    compiled.compile(types)
    return functools.partial(compiled.overloads[types].entry_point, *arguments)


def compiled() -> bool:
    """Return whether the simulation was ever compiled, as far as the package's own folder knows."""
    return any((_PACKAGE / "sim" / "__pycache__").glob("*.nbi"))


def _digest() -> str:
    """Return a number of all sources that kernels may depend on."""
    digest = hashlib.sha256()
    for source in sorted(_PACKAGE.rglob("*.py")):
        if source.relative_to(_PACKAGE).parts[0] not in _WITHOUT_KERNELS:
            digest.update(source.read_bytes())
    return digest.hexdigest()


def _drop_stale_kernels() -> None:
    """Delete compiled kernels when any source that they may depend on has changed.

    Numba looks only at the file of the kernel itself, not at those of the functions and constants that it uses. Indices
    go and data, too: an index written anew might find old data.
    """
    try:
        if _STAMP.is_file() and _STAMP.read_text() == _SOURCES:
            return
        for file in _PACKAGE.rglob("__pycache__/*.nb[ci]"):
            file.unlink(missing_ok=True)
        _STAMP.parent.mkdir(exist_ok=True)
        _STAMP.write_text(_SOURCES)
    except OSError:  # installed read-only: Numba then keeps its cache in the user's own folder
        return


_SOURCES = _digest()
_drop_stale_kernels()
