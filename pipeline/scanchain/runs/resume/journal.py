"""steps.journal: every step of a run, on disk soon after it is computed, for resuming after a crash."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from scanchain.runs.step_table import StepRow, StepTable

JOURNAL_FILE = "steps.journal"
_HEAD = struct.Struct("<II")  # bytes of the record that follows, and their CRC-32
_ARRAYS = (np.ndarray, np.generic)


class Journal:
    """Appends a record a step; a context. ``flush`` hands those that wait to the system.

    A record is its length and CRC-32 (both uint32, little-endian), then a StepRow in MessagePack.
    """

    def __init__(self, path: Path, *, after_bytes: int = 0) -> None:
        """after_bytes : of an existing journal that are retained."""
        self.file = os.open(path, os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        os.ftruncate(self.file, after_bytes)
        os.lseek(self.file, after_bytes, os.SEEK_SET)
        self.waiting = bytearray()
        self.encoder = msgspec.msgpack.Encoder(enc_hook=_plain)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.flush()
        finally:
            os.close(self.file)

    def append(self, row: StepRow) -> None:
        """Take one step, which waits to be written."""
        body = self.encoder.encode(row)
        self.waiting += _HEAD.pack(len(body), zlib.crc32(body))
        self.waiting += body

    def flush(self) -> None:
        """Write the steps that wait. Raises OSError where the disk is full."""
        while self.waiting:
            del self.waiting[: os.write(self.file, self.waiting)]


def read_journal(folder: Path, limit: int | None = None) -> tuple[StepTable, int]:
    """The steps of a killed run, and the number of bytes of the journal they take.

    folder : of the run, named ``NAME.partial-PID``; limit : steps that are read at most
    The last record of a killed run may be torn: reading ends before the first that is not whole. ``write`` of the
    table makes a steps.parquet, ``odometry`` and ``best_known`` are its trajectories.
    """
    data = (folder / JOURNAL_FILE).read_bytes()
    decoder = msgspec.msgpack.Decoder(StepRow, dec_hook=_array)
    steps, place = StepTable(), 0
    while place + _HEAD.size <= len(data) and (limit is None or len(steps) < limit):
        size, crc = _HEAD.unpack_from(data, place)
        body = data[place + _HEAD.size : place + _HEAD.size + size]
        if len(body) < size or zlib.crc32(body) != crc:
            break
        steps.add(decoder.decode(body))
        place += _HEAD.size + size
    return steps, place


def _plain(value: Any) -> Any:
    if isinstance(value, _ARRAYS):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} does not belong into a journal")


def _array(kind: Any, value: Any) -> Any:
    return np.array(value, np.float64)
