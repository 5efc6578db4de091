"""How Numba compiles the kernels of this package: in less time than by itself, to the same arithmetic.

Numba makes of every function machine code that Python can call. Of a kernel that only other kernels call, an inner one,
that is wasted: it is merged into its callers. Here inner kernels stay LLVM's intermediate code until Python asks for
them, and passes of the optimiser are left out that serve the counting of references, which kernels do without.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite.binding import parse_bitcode  # type: ignore[import-untyped]
from numba import typeof
from numba.core import sigutils
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.registry import CPUDispatcher

Wanted = tuple[Any, tuple[Any, ...]]
"""A kernel and the types that it is called with."""
_recorded: list[Wanted] | None = None  # while calls are recorded
_interpreting = 0
_compiling = 0  # kernels whose compilation has begun, one for the sake of another; under Numba's lock


def is_inner() -> bool:
    """Return whether what is looked up now is for a kernel that is being compiled."""
    return _compiling > 0


class Library(JITCodeLibrary):
    """The machine code of a kernel that Python calls.

    Attributes:
        quick: whether to optimise less.
    """

    quick = False

    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave this to the optimisation of the whole."""
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        self._optimize(**({"opt": 1} if self.quick else {}))

    def _optimize(self, **options: Any) -> None:
        """Run the passes of the module, with options of Numba's choice of them."""
        passes = self._codegen._module_pass_manager(**options)
        manager, *builder = passes if isinstance(passes, tuple) else (passes,)  # a manager alone before Numba 0.62
        manager.run(self._final_module, *builder)


class InnerLibrary(Library):
    """The intermediate code of an inner kernel."""

    def _optimize_final_module(self) -> None:
        """Make it smaller before callers, each of which optimises it again, take it in."""
        self._optimize(loop_vectorize=False, slp_vectorize=False, cost="cheap")

    def _finalize_final_module(self) -> None:
        """Make no machine code."""
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """Return what `rebuild_inner` makes a library of."""
        return self.name, "inner", self._get_module_for_linking().as_bitcode()


class _QuickLibrary(Library):
    quick = True


class _Pipeline(Compiler):
    """Numba's compiler, with libraries of ours."""

    library_type: type[Library] = Library

    def compile_extra(self, func: Any) -> Any:
        kind = InnerLibrary if self.state.flags.no_compile else self.library_type
        self.state.library = kind(self.state.targetctx.codegen(), func.__qualname__)
        self.state.library.enable_object_caching()
        return super().compile_extra(func)


class _QuickPipeline(_Pipeline):
    library_type = _QuickLibrary


class _KernelCompiler(_FunctionCompiler):
    """Compiles a kernel for types, as an inner one where this happens for another kernel."""

    def compile(self, args: Any, return_type: Any) -> Any:
        global _compiling
        collecting = gc.isenabled()
        gc.disable()  # it would look through all that the compiler holds, again and again
        _compiling += 1
        try:
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
        if _compiling > 1:
            flags.no_compile = flags.no_cpython_wrapper = True
        return flags


class _Inner:
    """What stands for the machine code of an inner kernel."""


def rebuild_inner(target_context: Any, data: tuple[Any, ...]) -> Any:
    """Return the inner kernel that `CompileResult._reduce` took apart."""
    (name, _, bitcode), fndesc, environment, signature, objectmode, lifted, annotation, reload_init, referenced = data
    library = InnerLibrary(target_context.codegen(), name)
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
        quick: optimise less, where the kernel is about as fast then (within 2 % for observations, rewards, errors).
    """

    def __init__(self, py_func: Any, locals: Any = None, targetoptions: Any = None, quick: bool = False):
        pipeline = _QuickPipeline if quick else _Pipeline
        super().__init__(py_func, locals or {}, targetoptions, pipeline)
        self._compiler: Any = _KernelCompiler(py_func, self.targetdescr, self.targetoptions, self.locals, pipeline)

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
                del self.overloads[tuple(args)]
        return super().compile(sig)


@contextmanager
def recorded() -> Iterator[list[Wanted]]:
    """Let kernels run as Python, and return those that Python calls, in order; each once, however it ends."""
    global _recorded
    calls: list[Wanted] = []
    _recorded = calls
    calling: Any = Kernel
    calling.__call__ = _interpret
    try:
        yield calls
    finally:
        del calling.__call__  # then it is Numba's again
        _recorded = None
        calls[:] = dict.fromkeys(calls)


def record(kernel: Any, types: tuple[Any, ...]) -> bool:
    """Return whether calls are recorded; if so, do that for a kernel."""
    if _recorded is None:
        return False
    _recorded.append((kernel, types))
    return True


def _interpret(kernel: Any, *arguments: Any) -> Any:
    """Run a kernel as Python; what it calls runs as Python, too."""
    global _interpreting
    if not _interpreting:
        record(kernel, tuple(typeof(argument) for argument in arguments))
    _interpreting += 1
    try:
        return kernel.py_func(*arguments)
    finally:
        _interpreting -= 1
