"""A clock that stands still while kernels are compiled, once after an installation: it measures work alone."""

from __future__ import annotations

from time import perf_counter
from typing import Any

from numba.core import event


class _Compilation(event.Listener):
    """Time that compiling has taken in this process; kernels that call others compile these within themselves."""

    def __init__(self) -> None:
        self.depth = 0
        self.began_s = self.ended_s = 0.0

    def on_start(self, event: Any) -> None:
        if not self.depth:
            self.began_s = perf_counter()
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if not self.depth:
            self.ended_s += perf_counter() - self.began_s


_compilation = _Compilation()
event.register("numba:compile", _compilation)


def compiled_s() -> float:
    """Seconds that this process has spent compiling kernels; 0 where all came from the cache on disk."""
    return _compilation.ended_s + (perf_counter() - _compilation.began_s if _compilation.depth else 0.0)


def working_s() -> float:
    """Seconds as ``perf_counter`` has them, less those of compiling; only differences have a meaning."""
    return perf_counter() - compiled_s()
