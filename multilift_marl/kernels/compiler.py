"""How Numba compiles the kernels of this package: in less time than by itself, to the same arithmetic.

Numba makes of every function machine code that Python can call. Of a kernel that only other kernels call, an inner one,
that is wasted: it is merged into its callers. Here inner kernels stay LLVM's intermediate code until Python asks for
them, and passes of the optimiser are left out that serve the counting of references, which kernels do without.

Comments say how much processor time each of these saves at a cold first step of `hover`, which takes 23 s with all of
them: means of two or three starts beside six, on a busy machine, where single ones differ by 2 s.
"""

from __future__ import annotations

import gc
import hashlib
import pickle
import sys
from collections.abc import Callable, Iterable
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import llvmlite  # type: ignore[import-untyped]
import numba
from llvmlite.binding import parse_bitcode  # type: ignore[import-untyped]
from numba.core import config, sigutils
from numba.core.caching import Cache as NumbaCache
from numba.core.caching import CompileResultCacheImpl, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numba.core.types import BaseNamedTuple

from multilift_marl._files import write_whole
from multilift_marl.errors import warn_once
from multilift_marl.kernels.cache import cache_folder, foreign_digest, forget_composed, homes, other_folders
from multilift_marl.kernels.progress import progress

_LIBRARIES = "numba", "llvmlite", "numpy", "multilift_marl"
_SETTINGS = ("BOUNDSCHECK", "OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "DEBUGINFO_DEFAULT")  # of Numba, by NUMBA_<name>

_compiling = 0  # kernels whose compilation has begun, one for the sake of another; under Numba's lock


def is_inner() -> bool:
    """Return whether what is looked up now is for a kernel that is being compiled."""
    return _compiling > 0


class Library(JITCodeLibrary):
    """The machine code of a kernel that Python calls."""

    # Without Numba's two other rounds of passes, this one and the one below: 3.7 s less, of `gate` 4.7 s.
    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave this to the optimisation of the whole."""
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """Run the passes once; Numba runs cheaper ones before, for references, which are not counted here."""
        passes = self._codegen._module_pass_manager()
        manager, *builder = passes if isinstance(passes, tuple) else (passes,)  # a manager alone before Numba 0.62
        manager.run(self._final_module, *builder)


class InnerLibrary(Library):
    """The intermediate code of an inner kernel."""

    # No machine code of inner kernels, and no wrappers of them for Python: 8 s less.
    def _finalize_final_module(self) -> None:
        """Make no machine code."""
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """Return what `rebuild_inner` makes a library of."""
        return self.name, "inner", self._get_module_for_linking().as_bitcode()


class _Pipeline(Compiler):
    """Numba's compiler, with libraries of ours."""

    def compile_extra(self, func: Any) -> Any:
        kind = InnerLibrary if self.state.flags.no_compile else Library
        self.state.library = kind(self.state.targetctx.codegen(), func.__qualname__)
        self.state.library.enable_object_caching()
        return super().compile_extra(func)


class _KernelCompiler(_FunctionCompiler):
    """Compiles a kernel for types, as an inner one where this happens for another kernel."""

    def compile(self, args: Any, return_type: Any) -> Any:
        global _compiling
        collecting = gc.isenabled()
        gc.disable()  # 1.5 s less: it would look through all that the compiler holds, again and again
        _compiling += 1
        try:
            # Numba asks for inner kernels' types from in here, by their own `compile`: hence the count.
            found: Any = super().compile(args, return_type)
        finally:
            _compiling -= 1
            if collecting:
                gc.enable()
        if is_inner():
            return as_inner(found)
        for environment in found._find_referenced_environments():  # of inner kernels
            found.library.codegen.set_env(environment.env_name, environment)
        return found

    def _customize_flags(self, flags: Any) -> Any:
        # The outermost is the one that Python asked for.
        if _compiling > 1:
            flags.no_compile = flags.no_cpython_wrapper = True
        return flags


class _Inner:
    """What stands for the machine code of an inner kernel."""


def rebuild_inner(target_context: Any, data: tuple[Any, ...]) -> Any:
    """Return the inner kernel that `CompileResult._reduce` took apart."""
    (name, _, bitcode), fndesc, environment, signature, objectmode, lifted, annotation, reload_init, referenced = data
    library = InnerLibrary(target_context.codegen(), name)
    # Callers link `_shared_module` in.
    library._final_module = library._shared_module = parse_bitcode(bitcode)
    library._finalized = True
    result: Any = CompileResult  # whose fields Numba does not type
    return result(
        typing_context=target_context.typing_context, target_context=target_context, entry_point=_Inner(),
        typing_error=None, type_annotation=annotation, signature=signature, objectmode=objectmode, lifted=lifted,
        fndesc=fndesc, library=library, call_helper=None, environment=environment, metadata=None,
        reload_init=reload_init, referenced_envs=referenced,
    )  # fmt: skip


def as_inner(compiled: Any) -> Any:
    """Return what was compiled as what callers can be compiled with."""
    token = _Inner()
    compiled.target_context.insert_user_function(token, compiled.fndesc, [compiled.library])
    return compiled._replace(entry_point=token)


class Kernel(CPUDispatcher):
    """A compiled function.

    Args:
        py_func, locals, targetoptions: as Numba takes them.
    """

    def __init__(self, py_func: Any, locals: Any = None, targetoptions: Any = None):
        super().__init__(py_func, locals or {}, targetoptions, _Pipeline)
        self._compiler: Any = _KernelCompiler(py_func, self.targetdescr, self.targetoptions, self.locals, _Pipeline)

    def add_overload(self, cres: Any) -> None:
        """Keep what was compiled; Python finds what has machine code alone."""
        if isinstance(cres.entry_point, _Inner):
            self.overloads[tuple(cres.signature.args)] = cres
        else:
            super().add_overload(cres)

    def compile(self, sig: Any) -> Any:
        """Compile for types, unless that was done; as Python calls it where no kernel asks."""
        args, _ = sigutils.normalize_signature(sig)
        if not is_inner():
            known: Any = self.overloads.get(tuple(args))
            if known is not None and isinstance(known.entry_point, _Inner):
                # As an inner one it has no machine code: it is compiled again, for Python.
                del self.overloads[tuple(args)]
        return super().compile(sig)


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
    """The files of one kernel, with the interface of `numba.core.caching.Cache`.

    Args:
        function: the kernel.
        folder: where they are kept; None: nowhere.
        others: where they are looked for, too.
    """

    _impl_class = _Results  # type: ignore[assignment]

    def __init__(self, function: Callable[..., Any], folder: Path | None, others: tuple[Path, ...] = ()):
        super().__init__(function)
        self._folder, self._function = folder, function
        self._folders = others if folder is None else (folder, *others)
        self._cache_path = str(folder)

    def _name_file(self, key: Any) -> str:
        """Return the name of a signature's file, which holds kernel, types, processor and compiler."""
        code = self._function.__code__
        written = getattr(self._function, "_sources", "")  # see `jit.compose`
        kind = "inner" if is_inner() else ""
        # Not Python's `hash`, which differs from process to process.
        parts = (repr(key), repr(_fields(key[0])), _compiler_name(), foreign_digest(self._function), written, kind)
        digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
        name = "".join(c if c.isalnum() else "_" for c in self._function.__qualname__)[-40:]
        return f"{name}-{code.co_firstlineno}-{digest}.kernel"

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what was compiled for these types; None, and a line that says so, if it must be compiled now."""
        if not self._enabled:
            return None
        key = self._index_key(sig, target_context.codegen())
        found = self._read(key, target_context)
        if found is not None or is_inner():
            return found
        if self._folder is None:
            places = " and ".join(str(home.parent) for home in homes())
            warn_once(
                "kernels",
                f"compiled kernels cannot be kept: {places} cannot be written; every start compiles anew, up to a "
                "minute. Set NUMBA_CACHE_DIR to a folder that can be",
            )
            return None
        warn_once("kernels", "compiling kernels of the simulation for the first time, which takes up to a minute")
        progress.begin(self._function.__name__)
        return None

    def _read(self, key: Any, target_context: Any) -> Any:
        """Return what was compiled, None if nothing sound is there."""
        name = self._name_file(key)
        found = (self._read_file(folder / name, key, target_context) for folder in self._folders)
        return next((each for each in found if each is not None), None)

    def _read_file(self, path: Path, key: Any, target_context: Any) -> Any:
        try:
            checksum, content = _split(path.read_bytes())
            if hashlib.sha256(content).digest() != checksum:
                return None
            stored, data = _Unpickler(BytesIO(content)).load()
            rebuild = rebuild_inner if is_inner() else self._impl.rebuild
            return rebuild(target_context, data) if stored == key else None
        except Exception:  # missing or unreadable: compile again
            return None

    def _save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled; what cannot be written is not kept."""
        if not is_inner():
            progress.end()
        # A C function's address is that of this process. (Numba's own check of this warns by the kernel's file.)
        if self._folder is None or data.library.has_dynamic_globals:
            return
        key = self._index_key(sig, data.codegen)
        content = dumps((key, self._impl.reduce(data)))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)  # others may have deleted it
            path = self._folder / self._name_file(key)
            write_whole(path, hashlib.sha256(content).digest() + content, flush=False)
            if hasattr(self._function, "_sources"):
                forget_composed(path)
        except OSError as error:
            reason = f"{error.strerror}; compiled anew next time"
            warn_once("kernels", f"compiled kernels cannot be kept in {self._folder}: {reason}")

    def flush(self) -> None:
        """Forget nothing: a file belongs to one version of the sources."""


class _Unpickler(pickle.Unpickler):
    """Reads what was compiled, and imports nothing of a user's for it: a module of that name may be another's."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what is stored by name; of modules that are neither imported nor libraries, raise an error."""
        if module not in sys.modules and module.partition(".")[0] not in _LIBRARIES:
            raise pickle.UnpicklingError(f"{module} is not imported")
        return super().find_class(module, name)


def make_cache(function: Callable[..., Any]) -> KernelCache:
    """Return where a kernel's compiled versions are kept and looked for."""
    return KernelCache(function, cache_folder(function.__module__), other_folders(function.__module__))


@cache
def _compiler_name() -> str:
    """Return what machine code depends on beside its source and the processor: versions, and settings of Numba."""
    settings = [f"{name}={getattr(config, name, None)!s}" for name in _SETTINGS]
    return " ".join([sys.version, numba.__version__, llvmlite.__version__, *settings])


def _fields(types: Iterable[Any]) -> list[Any]:
    """Return modules and fields of named tuples among Numba's types, which neither their names nor keys state."""
    records: list[Any] = [each for each in types if isinstance(each, BaseNamedTuple)]
    kinds = [(record.instance_class, record) for record in records]
    return [(kind.__module__, kind.__qualname__, each.fields, _fields(each.types)) for kind, each in kinds]


def _split(content: bytes) -> tuple[bytes, bytes]:
    size = hashlib.sha256().digest_size
    return content[:size], content[size:]
