"""``njit`` of this project: each kernel is compiled once and by one process, and kept in a cache on disk."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache

try:
    import fcntl
except ImportError:  # Windows: processes that compile the same kernel at once do so twice
    fcntl = None

_PATIENCE_S = 120.0  # after which a kernel is compiled here too, whatever the other process is at
_POLL_S = 0.01


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with a cache that processes share.

    Private kernels have no entry point for Python: where arguments are tuples of arrays, it takes long to compile.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        is_private = function.__name__.startswith("_")
        options.update(no_cfunc_wrapper=True, no_cpython_wrapper=is_private)
        kernel: Any = numba.njit(**options)(function)
        kernel._cache = SharedCache(function)
        return kernel

    return compiled


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
