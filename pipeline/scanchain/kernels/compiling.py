"""``njit`` of this project: ``numba.njit`` with a cache on disk that several processes may fill at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache

try:
    import fcntl
except ImportError:  # Windows: two processes that compile the same kernel for different types can exchange them
    fcntl = None


class _SharedCache(FunctionCache):
    """Saves one at a time: Numba reads an index, adds to it and writes it back."""

    def save_overload(self, sig: Any, data: Any) -> None:
        if fcntl is None:
            super().save_overload(sig, data)
            return
        folder = Path(self.cache_path)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "lock").open("w") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX)
            super().save_overload(sig, data)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` of a kernel, whose machine code is kept for later processes."""

    def compiled(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**options)(function)
        if not numba.config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
            kernel._cache = _SharedCache(function)
        return kernel

    return compiled
