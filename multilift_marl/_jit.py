"""Numba's compiler as this package uses it: no fast-math, no GIL, results kept on disk."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, TypeVarTuple, cast

from numba import config, njit, typeof

from multilift_marl._kernel_cache import make_cache

_UNCOMPILED: bool = config.DISABLE_JIT  # type: ignore[attr-defined]
F = TypeVar("F", bound=Callable[..., Any])
Arguments = TypeVarTuple("Arguments")


def kernel(function: F) -> F:
    """Compile a function to machine code at its first call.

    Arithmetic is exact IEEE, so results do not depend on how many environments are computed together.
    """
    dispatcher: Any = njit(nogil=True, error_model="numpy")(function)
    if not _UNCOMPILED:  # else it is the function itself
        dispatcher._cache = make_cache(function)
    return cast(F, dispatcher)


def bind(function: Callable[[*Arguments], object], *arguments: *Arguments) -> Callable[[], None]:
    """Return a call of a kernel with these very arguments, compiled now, without looking up their types at each call.

    That look-up costs more than many kernels do: a named tuple of ten arrays takes about 2 µs. The arrays must stay the
    same objects in memory; what is in them may change.
    """
    if _UNCOMPILED:
        return functools.partial(function, *arguments)  # type: ignore[return-value]
    types = tuple(typeof(argument) for argument in arguments)
    compiled: Any = function  # Numba's dispatcher
    compiled.compile(types)
    return functools.partial(compiled.overloads[types].entry_point, *arguments)
