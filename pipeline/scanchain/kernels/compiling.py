"""``njit`` of this project: ``numba.njit`` with an on-disk cache that several processes may write concurrently."""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba import config
from numba.core.caching import FunctionCache, IndexDataCacheFile

_CRC_BYTES = 4


@cache
def digest_of_sources() -> str:
    """SHA-256 of the sources of all kernels, in hexadecimal."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _cache_by_source() -> None:
    """Cache compiled kernels in a folder of the user's cache that is named after the hash of their sources.

    Numba checks the file of a kernel only, not those of the kernels that it calls: after a change to one of
    them, by an editor or an upgrade, a cache next to the source would keep using the outdated code. A folder
    set by NUMBA_CACHE_DIR is respected; where no folder can be made, or others may write to it (what is read
    is executed), Numba chooses the location by its own rules.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
        folder = root / "scanchain" / "kernels" / digest_of_sources()[:16]
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except (OSError, RuntimeError):  # RuntimeError for a user without a home
        return
    is_own = hasattr(os, "geteuid") and status.st_uid == os.geteuid()  # cannot be determined on Windows
    if is_own and not status.st_mode & 0o022 and os.access(folder, os.W_OK):
        config.CACHE_DIR = str(folder)  # pyright: ignore[reportAttributeAccessIssue]


_cache_by_source()


@cache
def _warn(why: str) -> None:
    """Warn once why kernels are not cached."""
    told = "compiled kernels are not kept, every process compiles them again: %s; set NUMBA_CACHE_DIR to a folder"
    logging.getLogger("scanchain").warning(told, why)


class _CheckedFiles(IndexDataCacheFile):
    """One file per function and signature, with a checksum; no index as in Numba, which processes would share."""

    def save(self, key: Any, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(self._path_of(key)) as file:
            file.write(content + zlib.crc32(content).to_bytes(_CRC_BYTES, "little"))

    def load(self, key: Any) -> Any:
        try:
            data = Path(self._path_of(key)).read_bytes()
        except OSError:
            return None
        crc = int.from_bytes(data[-_CRC_BYTES:], "little")
        is_whole = len(data) > _CRC_BYTES and zlib.crc32(data[:-_CRC_BYTES]) == crc
        return pickle.loads(data) if is_whole else None

    def _path_of(self, key: Any) -> str:
        known = hashlib.sha256(repr((self._version, self._source_stamp, key)).encode())
        return self._data_path(self._data_name(int(known.hexdigest()[:16], 16)))


class _Cache(FunctionCache):
    """Cache of compiled code; warns once where it cannot be written."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _CheckedFiles(self.cache_path, self._impl.filename_base, stamp)

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn(f"{self.cache_path}: {error.strerror or error}")


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` of a kernel, whose machine code is cached for later processes; it divides as NumPy does.

    A small kernel that only kernels call should use ``inline="always"``: it compiles 0.25 s faster.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        chosen: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True} | options
        kernel: Any = numba.njit(**chosen)(function)
        if not config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
            try:
                kernel._cache = _Cache(function)
            except RuntimeError:
                _warn("Numba finds no folder that takes them")
        return kernel

    return compiled
