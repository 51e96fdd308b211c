"""Compilation of kernels, once after an installation: announced, and subtracted from the measured times."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from numba.core import event

_WARNING = "compiling kernels, once after an installation: the first calls take up to a minute in all"


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
            logging.getLogger("scanchain").warning(_WARNING)

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if not self.depth:
            self.ended_s += perf_counter() - self.began_s


_compilation = _Compilation()
event.register("numba:compile", _compilation)


def warn_of_compilation() -> None:
    """Log a warning when kernels are next compiled, so that callers of the Python API know of the delay."""
    _compilation.is_silent = False


def compiled_s() -> float:
    """Seconds that this process has spent compiling kernels; 0 where all came from the cache on disk."""
    return _compilation.ended_s + (perf_counter() - _compilation.began_s if _compilation.depth else 0.0)


def working_s() -> float:
    """Seconds as ``perf_counter`` has them, less those of compiling; only differences have a meaning."""
    now_s = perf_counter()
    return (_compilation.began_s if _compilation.depth else now_s) - _compilation.ended_s


@contextmanager
def announcing_compilation(say: Callable[[str], None], beside: Sequence[str] = ()) -> Iterator[None]:
    """Name each module of kernels when its compilation begins; kernels from the cache on disk are not named.

    beside : arguments of ``python -m`` of a process that meanwhile compiles what this one will need later
    """
    announcer = _Announcer(say, beside)
    try:
        with event.install_listener("numba:compile", announcer):
            yield
    finally:
        if announcer.process is not None:
            announcer.process.kill()
            announcer.process.wait()


class _Announcer(event.Listener):
    def __init__(self, say: Callable[[str], None], beside: Sequence[str]) -> None:
        self.say, self.beside = say, beside
        self.modules: set[str] = set()
        self.process: subprocess.Popen[bytes] | None = None

    def on_start(self, event: Any) -> None:
        module = event.data["dispatcher"].py_func.__module__
        if not module.startswith("scanchain.") or module in self.modules:
            return
        if not self.modules:
            self.say("compiling, once after the installation:")
            if self.beside:
                command = [sys.executable, "-P", "-m", *self.beside]
                nothing = subprocess.DEVNULL
                self.process = subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing)
        self.modules.add(module)
        self.say(f"  {module.removeprefix('scanchain.')}")

    def on_end(self, event: Any) -> None:
        pass
