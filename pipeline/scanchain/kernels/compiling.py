"""``njit`` of this project: kernels are compiled once, by one process, and kept in a cache on disk.

Numba optimizes each function before it is linked into those that call it, where it is optimized again, and emits
machine code for each, for its own behind ``np.empty`` or ``max``, too. Here a function is optimized and emitted
once, in the kernels that Python calls: a first run compiles two fifths less.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numba
from llvmlite import binding as llvm
from numba import config, jit, types  # pyright: ignore[reportPrivateImportUsage]
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.environment import Environment
from numba.core.registry import CPUDispatcher
from numba.core.target_extension import jit_registry
from numba.core.typed_passes import (
    AnnotateTypes,
    InlineOverloads,
    NopythonRewrites,
    NoPythonSupportedFeatureValidation,
)

from scanchain.kernels.compiler_shortcuts import shortcuts

try:
    import fcntl
except ImportError:  # Windows: processes that compile the same kernel at once do so twice
    fcntl = None

_PATIENCE_S = 120.0  # after which a kernel is compiled here too, whatever the other process is at
_POLL_S = 0.01
_OVERLOADS = "generic"  # key of the decorator of Numba's functions for NumPy's, looked up before "cpu"
_NEEDLESS = (  # passes over closures and whole-array expressions, which kernels are without, and for messages
    AnnotateTypes,
    InlineOverloads,
    NopythonRewrites,
)
_ENVIRONMENT = "_ZN08NumbaEnv"  # begin of the name of the variable that Numba sets of each function it has loaded


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` of a kernel that Python and other kernels call."""

    def compiled(function: Callable[..., Any]) -> Any:
        if config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
            return function
        return Kernel(function, options)

    return compiled


class _Quiet(CPUDispatcher):
    """A function that is compiled without collecting garbage: a compiler makes much that lasts."""

    _cache: Any
    _compiler: Any

    def compile(self, sig: Any) -> Any:
        with global_compiler_lock:
            if _OVERLOADS in jit_registry:  # within the compilation of another
                return super().compile(sig)
            is_collecting = gc.isenabled()
            gc.disable()
            jit_registry[_OVERLOADS] = _overload
            try:
                with shortcuts():
                    return super().compile(sig)
            finally:
                del jit_registry[_OVERLOADS]
                if is_collecting:
                    gc.enable()


class Kernel(_Quiet):
    """A kernel as Python calls it: machine code of ``inner``, with which kernels that call it are linked."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        options = {"nopython": True, "boundscheck": None, "no_cfunc_wrapper": True, **options}
        super().__init__(function, targetoptions=options)
        self._cache = SharedCache(function)
        inner = {**options, "no_cpython_wrapper": True}
        self.inner = _Quiet(function, targetoptions=inner, pipeline_class=_InnerCompiler)
        self.inner._cache = _InnerCache(function)
        self.inner._compiler._customize_flags = _Flags
        self._compiler = _EntryCompiler(self.inner, self._compiler)

    def compile_inner(self, *arguments: Any) -> None:
        """Compile the kernel as kernels call it, for such arguments."""
        self.inner.compile(tuple(map(numba.typeof, arguments)))

    def __reduce__(self) -> Any:
        return self.__qualname__  # pickled by its name

    @property
    def _numba_type_(self) -> types.Dispatcher:
        return types.Dispatcher(self.inner)


class _Flags(Flags):
    """Options of a compilation, compared at each call that Numba resolves, without a property for each option."""

    _DEFAULTS = MappingProxyType({name: option.default for name, option in Flags.options.items()})

    def values(self) -> dict[str, Any]:
        return {**self._DEFAULTS, **self._values}


class _InnerLibrary(JITCodeLibrary):
    """A function and all that it calls as they were written, to be linked into kernels that Python calls."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def finalize(self) -> None:
        self._raise_if_finalized()
        whole = self._final_module
        for library in dict.fromkeys(self._linking_libraries):
            whole.link_in(library._get_module_for_linking(), preserve=True)
        for function in whole.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.external:
                function.linkage = "linkonce_odr"
        self._shared_module = whole
        self._final_module = _environments_of(self, whole)
        self._finalize_final_module()


@register_pass(mutates_CFG=False, analysis_only=True)
class _IntoInnerLibrary(FunctionPass):
    _name = "into_inner_library"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> Any:
        state.library = _InnerLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return False


class _InnerCompiler(CompilerBase):
    """Numba's compiler, which hands its code to a library of our own."""

    def define_pipelines(self) -> list[Any]:
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [each for each in passes.passes if each[0] not in _NEEDLESS]
        passes.add_pass_after(_IntoInnerLibrary, NoPythonSupportedFeatureValidation)
        passes.finalize()
        return [passes]


def _overload(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.jit`` of Numba's function for one of NumPy's or Python's, compiled as kernels that kernels call."""
    options["no_cfunc_wrapper"] = True
    return jit(**options, pipeline_class=_InnerCompiler)


class _EntryLibrary(JITCodeLibrary):
    """Machine code of a kernel that Python calls and of all that it calls, optimized together."""

    def _optimize_final_module(self) -> None:
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)

    def _get_module_for_linking(self) -> Any:
        """Names instead of code, which nothing links: there Numba sees which symbols a file of the cache has."""
        names = [function.name for function in self.get_defined_functions()]
        named = [f'define void @"{name}"() {{ ret void }}' for name in names]
        return _environments_of(self, self._final_module, named)


def _environments_of(library: Any, module: Any, code: Sequence[str] = ()) -> Any:
    """A module of the variables that Numba sets when it has loaded a function, and of further code."""
    variables = [str(each) for each in module.global_variables if each.name.startswith(_ENVIRONMENT)]
    return llvm.parse_assembly(
        "\n".join([str(library._codegen._create_empty_module(library.name)), *variables, *code])
    )


class _EntryCompiler:
    """Links what a kernel consists of with the wrapper by which Python calls it."""

    def __init__(self, inner: CPUDispatcher, compiler: Any) -> None:
        self._inner = inner
        self.fold_argument_types, self.pysig = compiler.fold_argument_types, compiler.pysig

    def compile(self, arguments: tuple[types.Type, ...], _: Any) -> Any:
        self._inner.compile(arguments)
        inner = self._inner.overloads[arguments]
        context, function = inner.target_context.subtarget(enable_nrt=True), copy(inner.fndesc)
        function.env_name += ".entry"  # with the constants of the wrapper, which the inner function's is without
        environment = Environment.from_fndesc(function)
        library = _EntryLibrary(context.codegen(), function.qualname)
        library.enable_object_caching()
        library.add_linking_library(inner.library)
        is_nogil = bool(self._inner.targetoptions.get("nogil"))
        context.create_cpython_wrapper(library, function, environment, None, is_nogil)
        entry = context.get_executable(library, function, environment)
        return inner._replace(
            library=library, fndesc=function, environment=environment, entry_point=entry, metadata={}
        )


class SharedCache(FunctionCache):
    """Numba's cache of a kernel on disk, locked from the look-up of what is not there until it is saved.

    A process that needs what another one is compiling waits for it. The lock is of the kernel, whatever the types
    of its arguments: Numba saves first the index of a kernel, then what was compiled, and two processes that do so
    at once exchange what belongs to different types. No kernel calls itself, by whatever detour, so that processes
    do not wait for each other in a circle.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._lock_file = Path(self.cache_path) / f"{self._impl.filename_base}.lock"
        self._locked: Any = None
        self._depth = 0  # of compilations under way in this process, for several types

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The kernel for these types, once no other process compiles it; None where it is to be compiled here."""
        found = super().load_overload(sig, target_context)
        if found is None:
            self._lock()
            found = super().load_overload(sig, target_context)  # compiled by another process meanwhile
            if found is not None:
                self._unlock()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save what was compiled and release the kernel."""
        try:
            super().save_overload(sig, data)
        finally:
            self._unlock()

    def _lock(self) -> None:
        """Wait for other processes; a lock goes with the process that holds it."""
        self._depth += 1
        if self._depth > 1:
            return
        with suppress(OSError):  # without a lock where there is no place for one
            self._impl.locator.ensure_cache_path()
            self._locked = self._lock_file.open("w")
            until = time.monotonic() + _PATIENCE_S
            while not _took(self._locked) and time.monotonic() < until:
                time.sleep(_POLL_S)

    def _unlock(self) -> None:
        self._depth = max(self._depth - 1, 0)
        if not self._depth and self._locked is not None:
            self._locked.close()
            self._locked = None


class _InnerFiles(CompileResultCacheImpl):
    @property
    def filename_base(self) -> str:
        return f"{super().filename_base}-inner"


class _InnerCache(SharedCache):
    """Files of a kernel as other kernels call it, beside those of the kernel as Python calls it."""

    _impl_class = _InnerFiles


def _took(file: Any) -> bool:
    """True if the lock of a file is this process's now; of one that cannot be locked, too."""
    if fcntl is None:
        return True
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True
