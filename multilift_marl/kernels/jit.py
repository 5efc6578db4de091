"""Numba's compiler as this package uses it: no fast-math, no GIL, results kept on disk."""

from __future__ import annotations

import hashlib
import inspect
import linecache
import re
from collections.abc import Callable, Mapping
from functools import cache, partial
from operator import itemgetter
from typing import Any, TypeVar, TypeVarTuple, cast

from numba import config, int64, typeof
from numba.core.errors import NumbaError

from multilift_marl.errors import ConfigError
from multilift_marl.kernels.cache import sources_digest
from multilift_marl.kernels.compiler import Kernel, make_cache

_UNCOMPILED: bool = config.DISABLE_JIT  # type: ignore[attr-defined]
FORMER_FIELDS = {
    "hulls": "obstacles.vertices",
    "load": "payload_estimate",
    "loads": "disturbances",
    "nominal": "rig",
    "seen": "estimated",
    "seen_errors": "estimated_errors",
    "true_load": "payload",
}
"""Fields of `mdp.env_data.View` by their former names."""
F = TypeVar("F", bound=Callable[..., Any])
Arguments = TypeVarTuple("Arguments")


def kernel(function: F) -> F:
    """Compile a function to machine code at its first call.

    Arithmetic is exact IEEE, so results do not depend on how many environments are computed together. A kernel of this
    package makes no arrays, and returns none: without the counting of references that this would need, kernels compile
    faster.
    """
    return _compile(function)


def drawing(function: F) -> F:
    """Do as `kernel`, for a function that Python calls with a generator of random numbers: its references are counted.

    Otherwise each call would keep its generator alive, 2.9 kB.
    """
    return _compile(function, makes_arrays=True)


def inlined(function: F) -> F:
    """Do as `kernel`, and merge the function into those that call it.

    A call that is not merged passes every number of every array in its arguments, those of named tuples too.
    """
    return _compile(function, inline="always")


def _is_ours(module: str) -> bool:
    return module.startswith("multilift_marl.")


def _compile(function: F, makes_arrays: bool | None = None, **options: Any) -> F:
    """Compile a function; only those of other packages may make arrays."""
    if makes_arrays is None:
        makes_arrays = not _is_ours(function.__module__)
    if _UNCOMPILED:
        function._is_kernel = True  # type: ignore[attr-defined]
        return function
    # Without _nrt, the runtime that counts references: 4 s less of a cold first step, see `compiler.py`.
    # nogil: shards run at the same time. error_model: a division by zero gives inf or NaN; Python's would test every
    # divisor and raise.
    flags: dict[str, Any] = {"nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    dispatcher: Any = Kernel(function, targetoptions={**flags, "_nrt": makes_arrays, **options})
    dispatcher._cache = make_cache(function)
    return cast(F, dispatcher)


def is_plain(function: Any) -> bool:
    """Return whether a value can be called and is no kernel: no decorator of this module has made it one."""
    return callable(function) and not (isinstance(function, Kernel) or hasattr(function, "_is_kernel"))


def is_kernel(function: Any, arguments: int) -> bool:
    """Return whether a function is a kernel that others can call by so many arguments."""
    return not is_plain(function) and takes(function, arguments)


def takes(function: Any, arguments: int) -> bool:
    """Return whether a value can be called by so many arguments."""
    if not callable(function):
        return False
    try:
        inspect.signature(getattr(function, "py_func", function)).bind(*range(arguments))
    except TypeError:
        return False
    return True


def compose(name: str, source: str, functions: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    """Compile the function `name` that `source` defines and that calls `functions` by their names.

    Numba resolves functions by name when it compiles, so a loop over the entries of a table is written out.

    Args:
        name: of the function.
        source: its definition.
        functions: what it calls, by the names in `source`.
    """
    return _compose(name, source, tuple(sorted(functions.items(), key=itemgetter(0))))


@cache
def _compose(name: str, source: str, functions: tuple[tuple[str, Callable[..., Any]], ...]) -> Callable[..., Any]:
    """Do as `compose`; environments of one kind share the compiled function."""
    file = f"<{name} {hashlib.sha256(source.encode()).hexdigest()[:12]}>"
    scope: dict[str, Any] = dict(functions)
    exec(compile(source, file, "exec"), scope)
    linecache.cache[file] = len(source), None, source.splitlines(keepends=True), file  # for tracebacks
    function = scope[name]
    # Not that of the scope, which has none: the cache names its folder by it.
    function.__module__ = __name__
    modules = sorted({each.__module__ for _, each in functions})
    ours = [module for module in modules if _is_ours(module)]
    digests = [sources_digest(module) for module in ours]
    named = [f"{key} {each.__module__}.{each.__qualname__}" for key, each in functions]
    function._sources = "\0".join([source, *digests, *named])  # read by the cache
    return _compile(function, makes_arrays=not {*ours, "math"}.issuperset(modules))


def _compiled(kernel: Any, types: tuple[Any, ...]) -> Callable[..., Any]:
    """Return what a kernel is for these types."""
    try:
        kernel.compile(types)
    except NumbaError as error:  # a mistake in what a user wrote: Numba's text has a hundred lines
        raise ConfigError(f"kernel {kernel.__name__} cannot be compiled: {_explain(str(error))}") from error
    return kernel.overloads[types].entry_point


def _explain(text: str) -> str:
    """Return what Numba complains of in one line: its first sentence, without the fields of named tuples, and where."""
    # Numba may colour its messages.
    text = re.sub(r"\x1b\[\d*m", "", text)
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("Failed in ")]
    message = lines[0] if lines else "for a reason that Numba does not name"
    message = re.sub(r"( of type \w+)\(.*", r"\1", message)
    if (field := re.search(r"attribute '(\w+)'.*View", message)) and field[1] in FORMER_FIELDS:
        message = f"{message}, which is {FORMER_FIELDS[field[1]]} now"
    if called := re.search(r"^ >>> (.*)$", text, re.MULTILINE):
        message = f"{message} {called[1]}"
    places = re.findall(r'File "(.+)", line (\d+):', text)
    if not places:
        return message
    file, line = places[-1]
    quoted = re.findall(r"^(.*\S.*)\n *\^", text, re.MULTILINE)
    source = quoted[-1] if quoted else linecache.getline(file, int(line))
    return f"{message} ({file}, line {line}: {source.strip()})"


def bind(function: Callable[[*Arguments], object], *arguments: *Arguments) -> Callable[[], None]:
    """Return a call of a kernel with these very arguments, compiled now, without looking up their types at each call.

    That look-up costs more than many kernels do: a named tuple of ten arrays takes about 2 µs. The arrays must stay the
    same objects in memory; what is in them may change.
    """
    call = partial(function, *arguments)
    if not _UNCOMPILED:
        types = tuple(typeof(argument) for argument in arguments)
        call = partial(_compiled(function, types), *arguments)
    call.__name__ = function.__name__  # type: ignore[attr-defined]
    return call  # type: ignore[return-value]


def kernel_name(call: Callable[[], None]) -> str:
    """Return the name of the kernel of a call that `bind` returned, in words."""
    return str(getattr(call, "__name__", "")).replace("_", " ")


def prebind(function: Callable[..., object], *arguments: Any) -> Callable[[int, int], None]:
    """Do as `bind` for a kernel whose first two arguments, the environments `lo` to `hi`, are still to be given."""
    if not _UNCOMPILED:
        types = (int64, int64, *(typeof(argument) for argument in arguments))
        function = _compiled(function, types)

    def call(lo: int, hi: int) -> None:
        function(lo, hi, *arguments)

    return call
