"""Numba's compiler as this package uses it: no fast-math, no GIL, results kept on disk."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit, typeof

kernel = njit(cache=True, nogil=True, error_model="numpy")
"""Compiles a function to machine code at its first call. Arithmetic is exact IEEE, so results do not depend on how
many environments are computed together."""


_WITHOUT_KERNELS = ("agents", "cli", "envs", "evaluation", "rendering", "view", "__init__.py")


def bind(function: Any, *arguments: Any) -> Callable[[], None]:
    """Return a call of a kernel with these very arguments, compiled now, without looking up their types at each call.

    That look-up costs more than many kernels do: a named tuple of ten arrays takes about 2 µs. The arrays must stay the
    same objects in memory; what is in them may change.
    """
    types = tuple(typeof(argument) for argument in arguments)
    function.compile(types)
    return functools.partial(function.overloads[types].entry_point, *arguments)


def _drop_stale_kernels() -> None:
    """Delete compiled kernels when any source that they may depend on has changed.

    Numba looks only at the file of the kernel itself, not at those of the functions and constants that it uses.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        if source.relative_to(package).parts[0] not in _WITHOUT_KERNELS:
            digest.update(source.read_bytes())
    stamp = package / "__pycache__" / "kernels.sha256"
    try:
        if stamp.is_file() and stamp.read_text() == digest.hexdigest():
            return
        for index in package.rglob("__pycache__/*.nbi"):
            index.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest.hexdigest())
    except OSError:  # installed read-only: Numba then keeps its cache in the user's own folder
        return


_drop_stale_kernels()
