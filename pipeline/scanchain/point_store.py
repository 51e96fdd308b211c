"""Points of scans in a file instead of memory, so that memory does not grow with the length of the log."""

from __future__ import annotations

import os
import tempfile
import threading
import weakref
import zlib
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.data import RaySpan
from scanchain.errors import InputError
from scanchain.files import BLOCK_BYTES

_NUMBER = np.dtype("<f4")  # as lidars give them


class PointStore:
    """Append-only store of the points of scans.

    dimension : 2 or 3, of the points
    rows : number of points in it
    waiting : bytes of the last of them, not yet written to the file
    crc : CRC-32 of the bytes written
    """

    def __init__(self, dimension: int, path: Path | None = None) -> None:
        """Path : of the file; None for a temporary file, deleted when the process ends."""
        self.dimension = dimension
        self.rows = 0
        self.waiting = bytearray()
        self.crc = 0
        self._take(_nameless() if path is None else path.open("w+b", buffering=0))

    def add(self, points: NDArray[np.floating], spans: tuple[RaySpan, ...] = ()) -> StoredPoints:
        """Append points (N, d), meters. Raises OSError where the disk is full."""
        stored = StoredPoints(self, self.rows, len(points), spans)
        self.waiting += points.astype(_NUMBER).tobytes()
        self.rows += len(points)
        if len(self.waiting) >= BLOCK_BYTES:
            self.flush()
        return stored

    def flush(self) -> None:
        """Write the buffered points. Raises OSError where the disk is full."""
        if self.waiting:
            self.file.seek(self.rows * self._row_bytes - len(self.waiting))
        while self.waiting:
            written = self.waiting[: self.file.write(self.waiting)]
            self.crc = zlib.crc32(written, self.crc)
            del self.waiting[: len(written)]

    def read(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, d) points from one row on, in any thread. Raises InputError if the file is too short."""
        result = np.empty((count, self.dimension), _NUMBER)
        rest = result.reshape(-1).view(np.uint8).data
        with self.lock:
            self.flush()
            self.file.seek(first * self._row_bytes)
            while rest:
                size = self.file.readinto(rest)
                if not size:
                    raise InputError(f"{self.file.name}: ends before point {first + count}; run again")
                rest = rest[size:]
        return result

    def reopen(self, path: Path) -> None:
        """Reopen the file that another process wrote, truncated to the rows of this state."""
        size, crc = self.rows * self._row_bytes, 0
        if path.is_file() and path.stat().st_size >= size:
            os.truncate(path, size)
            with path.open("rb") as file:
                while part := file.read(BLOCK_BYTES):
                    crc = zlib.crc32(part, crc)
        if not path.is_file() or path.stat().st_size != size or crc != self.crc:
            raise InputError(f"{path}: is missing, too short or damaged; run without --resume")
        self._take(path.open("r+b", buffering=0))

    def close(self) -> None:
        """Close the file; nothing can be read any more."""
        try:
            self.flush()
        finally:
            self.file.close()

    def __reduce__(self) -> tuple[object, ...]:
        """Pickled with all its points; unpickled, they lie in a file without a name."""
        return _restored, (self.dimension, self.read(0, self.rows))

    def _take(self, file: FileIO) -> None:
        """Use a file, which is closed when the store is garbage-collected."""
        self.file, self.lock = file, threading.Lock()
        weakref.finalize(self, file.close)

    @property
    def _row_bytes(self) -> int:
        return self.dimension * _NUMBER.itemsize


@dataclass(frozen=True, slots=True)
class StoredPoints:
    """The points of one scan, ``count`` rows of a store from the ``first`` on, and the origins of their rays."""

    store: PointStore
    first: int
    count: int
    spans: tuple[RaySpan, ...] = ()

    def read(self) -> NDArray[np.float64]:
        """(count, d) meters."""
        return self.store.read(self.first, self.count).astype(np.float64)


def _restored(dimension: int, points: NDArray[np.float32]) -> PointStore:
    store = PointStore(dimension)
    store.add(points)
    return store


def _nameless() -> FileIO:
    return tempfile.TemporaryFile(buffering=0)
