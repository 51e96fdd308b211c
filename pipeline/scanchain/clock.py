"""Compilation of kernels, once after an installation: announced, and subtracted from the measured times."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from numba.core import event

_WARNING = "compiling kernels, once after an installation: the first calls take up to a minute in all"


class _Compilation(event.Listener):
    """Listener to compilation in this process: measures its time, calls back with the module of each kernel.

    Compilations are nested: a kernel compiles those that it calls. Garbage collection is off meanwhile, since most
    of what a compiler allocates stays in use.
    """

    def __init__(self) -> None:
        self.depth = 0
        self.began_s = self.ended_s = 0.0
        self.is_silent = True
        self.is_collecting = False
        self.told: list[Callable[[str], None]] = []

    def on_start(self, event: Any) -> None:
        if not self.depth:
            self.began_s, self.is_collecting = perf_counter(), gc.isenabled()
            gc.disable()
        self.depth += 1
        module = event.data["dispatcher"].py_func.__module__
        if not module.startswith("scanchain."):
            return
        if not self.is_silent:
            self.is_silent = True
            logging.getLogger("scanchain").warning(_WARNING)
        for tell in self.told:
            tell(module)

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if not self.depth:
            self.ended_s += perf_counter() - self.began_s
            if self.is_collecting:
                gc.enable()


_compilation = _Compilation()
event.register("numba:compile", _compilation)


@contextmanager
def standing_still() -> Iterator[None]:
    """Count the time spent within as compilation, which other processes do."""
    began_s = perf_counter()
    try:
        yield
    finally:
        _compilation.ended_s += perf_counter() - began_s


def warn_of_compilation() -> None:
    """Log a warning when kernels are next compiled, so that callers of the Python API know of the delay."""
    _compilation.is_silent = False


def compiled_s() -> float:
    """Seconds that this process has spent compiling kernels; 0 where all came from the cache on disk."""
    return _compilation.ended_s + (perf_counter() - _compilation.began_s if _compilation.depth else 0.0)


def working_s() -> float:
    """Seconds of ``perf_counter`` minus the time of compilation; only differences are meaningful."""
    now_s = perf_counter()
    return (_compilation.began_s if _compilation.depth else now_s) - _compilation.ended_s


@contextmanager
def announcing_compilation(say: Callable[[str], None]) -> Iterator[None]:
    """Name each module of kernels when its compilation begins; kernels from the cache on disk are not named."""
    modules: set[str] = set()

    def tell(module: str) -> None:
        if not modules:
            say("compiling, once after the installation:")
        if module not in modules:
            modules.add(module)
            say(f"  {module.removeprefix('scanchain.')}")

    _compilation.told.append(tell)
    try:
        yield
    finally:
        _compilation.told.remove(tell)
