"""``njit`` of this project: ``numba.njit`` with a cache on disk that several processes may fill at once."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import config
from numba.core.caching import FunctionCache


def _cache_by_source() -> None:
    """Keep compiled kernels in a folder of the user's cache that is named after their source.

    Numba looks at the file of a kernel only, not at those of the kernels that it calls: after a change to one of
    them, by an editor or an upgrade, a cache beside the source would go on with what was compiled before. A folder
    that is chosen by NUMBA_CACHE_DIR stays; where no folder can be made, Numba looks for a place as it is used to.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = root / "scanchain" / "kernels" / digest.hexdigest()[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue]


_cache_by_source()


class _SharedCache(FunctionCache):
    """Saves one at a time: Numba reads an index, adds to it and writes it back."""

    def save_overload(self, sig: Any, data: Any) -> None:
        folder = Path(self.cache_path)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "lock").open("w") as lock:
            fcntl.lockf(lock, fcntl.LOCK_EX)
            super().save_overload(sig, data)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` of a kernel, whose machine code is kept for later processes; it divides as NumPy does.

    A small kernel that only kernels call is best with ``inline="always"``: a quarter of a second less to compile.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        chosen: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True} | options
        kernel: Any = numba.njit(**chosen)(function)
        if not config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
            kernel._cache = _SharedCache(function)
        return kernel

    return compiled
