"""What lies where in an MCAP file: its blocks of messages, channels and damage, found by walking the records.

A walk reads nine bytes a record and a chunk's header, never its contents, and needs no summary: files that were
cut off or never finished are indexed like any other. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import replace
from pathlib import Path

from pipeline.errors import InputError
from pipeline.logs.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
    STATISTICS,
    Block,
    Entry,
    FileIndex,
    read_string,
)

_CHUNK_HEAD = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC-32
_CHUNK_INDEX_HEAD = struct.Struct("<QQQ")  # start, end, byte of the chunk's record
_FOOTER = struct.Struct("<QQI")  # byte of the summary, byte of its offsets, CRC-32

_LARGEST_CHUNK = 1 << 30  # bytes; a size beyond is taken for damage, not believed
_LOOSE_BYTES = 1 << 20  # messages outside chunks are read in blocks of about this size


def index_file(path: Path, number: int) -> FileIndex:
    """Walk one file, the ``number``-th of a log. Raises InputError for what is no MCAP file at all."""
    index = FileIndex(path, number, _map(path))
    walk = _Walk(index)
    offset, end = len(MAGIC), len(index.data)
    while offset + RECORD.size <= end:
        opcode, length = RECORD.unpack_from(index.data, offset)
        following = offset + RECORD.size + length
        if following > end:
            following = _known_record(index.data, offset)
            if not following:
                index.damage.append(f"{path}: cut off at byte {end}, inside the record at byte {offset}")
                walk.cut(opcode, offset)
                return index
            index.damage.append(
                f"{path}: the record at byte {offset} claims {length} bytes, more than the file has; "
                f"reading went on at byte {following}"
            )
            walk.close(offset, complete=False)
        else:
            walk.take(opcode, offset, length)
        offset = following
    walk.close(offset, complete=True)
    if index.data[offset:] != MAGIC:
        index.damage.append(f"{path}: ends at byte {end} without the closing magic; the file was cut off")
    return index


class _Walk:
    """Sorts records into an index; a chunk waits for its message index, loose messages for each other."""

    def __init__(self, index: FileIndex) -> None:
        self.index = index
        self.chunk: Block | None = None
        self.entries: list[Entry] = []
        self.loose_from = -1
        self.loose_times: list[int] = []
        self.loose_counts: dict[int, int] = {}

    def take(self, opcode: int, offset: int, length: int) -> None:
        """Sort one whole record in."""
        try:
            self._sort(opcode, offset, offset + RECORD.size, length)
        except (struct.error, UnicodeDecodeError):
            self.index.damage.append(
                f"{self.index.path}: the record at byte {offset} is malformed and was left out"
            )

    def cut(self, opcode: int, offset: int) -> None:
        """End the walk inside a record; what is there of a chunk is kept."""
        self.close(offset, complete=False)
        if opcode == CHUNK:
            size = len(self.index.data) - offset - RECORD.size
            self.take(opcode, offset, size)
            if self.chunk is not None:
                self.chunk = replace(self.chunk, is_cut=True, crc=0)
                self.close(offset, complete=False)

    def close(self, offset: int, *, complete: bool) -> None:
        """End the chunk or the run of loose messages at this byte; incomplete entries are not believed."""
        if self.chunk is not None:
            entries = tuple(self.entries) if complete else ()
            self.index.blocks.append(replace(self.chunk, entries=entries))
        if self.loose_times:
            first, last = min(self.loose_times), max(self.loose_times)
            size = offset - self.loose_from
            entries = tuple(Entry(channel, -1, count) for channel, count in self.loose_counts.items())
            self.index.blocks.append(
                Block(self.index.number, self.loose_from, size, "", size, 0, first, last, entries, is_chunk=False)
            )
        self.chunk, self.entries = None, []
        self.loose_from, self.loose_times, self.loose_counts = -1, [], {}

    def _sort(self, opcode: int, offset: int, body: int, length: int) -> None:
        if opcode == MESSAGE:
            self._message(offset, body, length)
        elif opcode == MESSAGE_INDEX:
            self._entry(body, length)
        elif opcode == SCHEMA:
            self.index.add_schema(self.index.data, body)
        elif opcode == CHANNEL:
            self.index.add_channel(self.index.data, body)
        else:
            self.close(offset, complete=True)
            if opcode == CHUNK:
                self._chunk(offset, body, length)
            elif opcode == STATISTICS:
                self._statistics(body, length)
            elif opcode == FOOTER:
                self.index.has_summary = _FOOTER.unpack_from(self.index.data, body)[0] > 0
            elif opcode == HEADER:
                self.index.profile, body = read_string(self.index.data, body)
                self.index.library, _ = read_string(self.index.data, body)

    def _message(self, offset: int, body: int, length: int) -> None:
        if self.chunk is not None:
            self.close(offset, complete=True)
        if length < MESSAGE_HEAD.size:
            raise struct.error("message without its head")
        if self.loose_from < 0:
            self.loose_from = offset
        channel, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(self.index.data, body)
        self.loose_times.append(log_time_ns)
        self.loose_counts[channel] = self.loose_counts.get(channel, 0) + 1
        if body + length - self.loose_from > _LOOSE_BYTES:
            self.close(body + length, complete=True)

    def _entry(self, body: int, length: int) -> None:
        channel, size = struct.unpack_from("<HI", self.index.data, body)
        if size > length - 6:
            raise struct.error("message index beyond its record")
        if self.chunk is not None and size:
            self.entries.append(Entry(channel, body + 6, size // 16))

    def _chunk(self, offset: int, body: int, length: int) -> None:
        index = self.index
        start_ns, end_ns, uncompressed, crc = _CHUNK_HEAD.unpack_from(index.data, body)
        compression, records = read_string(index.data, body + _CHUNK_HEAD.size)
        (size,) = struct.unpack_from("<Q", index.data, records)
        available = body + length - records - 8
        at_end = body + length == len(index.data)
        if uncompressed > _LARGEST_CHUNK or (size > available and not at_end):
            index.damage.append(
                f"{index.path}: the chunk at byte {offset} lies about its size "
                f"({size} bytes stored, {uncompressed} unpacked) and was left out"
            )
            return
        size = min(size, available)
        self.chunk = Block(index.number, records + 8, size, compression, uncompressed, crc, start_ns, end_ns)

    def _statistics(self, body: int, length: int) -> None:
        data = self.index.data
        offset = body + struct.calcsize("<QHIIIIQQ")
        (size,) = struct.unpack_from("<I", data, offset)
        for entry in range(offset + 4, min(offset + 4 + size, body + length - 9), 10):
            number, count = struct.unpack_from("<HQ", data, entry)
            self.index.counts[number] = count
        self.index.is_counted = True


def _known_record(data: mmap.mmap | bytes, offset: int) -> int:
    """The byte of the first record behind ``offset`` that the summary vouches for; 0 where there is no summary."""
    tail = RECORD.size + _FOOTER.size + len(MAGIC)
    if data[-len(MAGIC) :] != MAGIC or len(data) < tail + len(MAGIC):
        return 0
    summary, _, _ = _FOOTER.unpack_from(data, len(data) - tail + RECORD.size)
    known = [summary] if offset < summary < len(data) else []
    position = summary
    while len(MAGIC) <= position <= len(data) - RECORD.size:
        opcode, length = RECORD.unpack_from(data, position)
        if opcode == CHUNK_INDEX and length >= _CHUNK_INDEX_HEAD.size:
            chunk = _CHUNK_INDEX_HEAD.unpack_from(data, position + RECORD.size)[2]
            if offset < chunk < summary and data[chunk] == CHUNK:
                known.append(chunk)
        position += RECORD.size + length
    return min(known, default=0)


def _map(path: Path) -> mmap.mmap:
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                raise InputError(f"{path}: is empty (0 bytes); record or copy it again")
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read ({reason}); check its permissions") from error
    if data[: len(MAGIC)] != MAGIC:
        raise InputError(f"{path}: is not an MCAP file (starts with {data[:8]!r}); see scanchain convert --help")
    return data
