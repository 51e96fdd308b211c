"""A clock that stands still while kernels are compiled, once after an installation: it measures work alone."""

from __future__ import annotations

import logging
from time import perf_counter
from typing import Any

from numba.core import event

_TOLD = "compiling kernels, once after an installation: the first calls take up to a minute in all"


class _Compilation(event.Listener):
    """Time that compiling has taken in this process; kernels that call others compile these within themselves."""

    def __init__(self) -> None:
        self.depth = 0
        self.began_s = self.ended_s = 0.0
        self.is_silent = True

    def on_start(self, event: Any) -> None:
        if not self.depth:
            self.began_s = perf_counter()
        self.depth += 1
        if not self.is_silent and event.data["dispatcher"].py_func.__module__.startswith("scanchain."):
            self.is_silent = True
            logging.getLogger("scanchain").warning(_TOLD)

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if not self.depth:
            self.ended_s += perf_counter() - self.began_s


_compilation = _Compilation()
event.register("numba:compile", _compilation)


def tell_compilation() -> None:
    """Log a warning when kernels are next compiled: a caller of the Python API would wait in silence."""
    _compilation.is_silent = False


def compiled_s() -> float:
    """Seconds that this process has spent compiling kernels; 0 where all came from the cache on disk."""
    return _compilation.ended_s + (perf_counter() - _compilation.began_s if _compilation.depth else 0.0)


def working_s() -> float:
    """Seconds as ``perf_counter`` has them, less those of compiling; only differences have a meaning."""
    return perf_counter() - compiled_s()
