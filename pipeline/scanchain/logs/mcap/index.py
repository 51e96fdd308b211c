"""Index of an MCAP file: its blocks of messages, channels and damage, by its summary or by walking its records.

A summary that agrees with its CRC and its statistics gives the position of every message; a damaged chunk shows
when it is unpacked. Files that were cut off, never finished or damaged there are walked: nine bytes a record and
a chunk's header are read, never its contents, and behind damage it goes on at the next record that is one.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import ChunkIndex, Statistics

from scanchain.errors import InputError
from scanchain.logs.files import RemoteFile
from scanchain.logs.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
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
    read_strings,
    records_of,
)
from scanchain.logs.mcap.resync import (
    CHUNK_HEAD,
    PRIVATE,
    is_end,
    next_record,
    record_end,
    sought_behind,
    states_length_twice,
)
from scanchain.source import Source
from scanchain.words import counted

_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)  # the closing magic included
_TAIL_BYTES = 65_536  # number of bytes of a remote file read at first; most summaries lie in it
_REPEATED = 4  # number of ranges of a remote file retained: the first blocks are read more than once
_LARGEST_CHUNK = 1 << 30  # largest size of a chunk in bytes; one beyond is damage
_MODEST_CHUNK = 1 << 25  # size in bytes up to which a chunk's stated size is accepted at any ratio
_MOST_TIMES = 20  # largest ratio of the unpacked to the stored size of a larger chunk
_LOOSE_BYTES = 1 << 20  # messages outside chunks are read in blocks of about this size


def claims_mcap(path: Path, head: bytes) -> bool:
    """True if a file begins as MCAP does, or is empty, which is refused as a file of MCAP."""
    return head.startswith(MAGIC) or not (head or path.is_dir())


def index_file(path: Path, number: int, source: Source | None = None) -> FileIndex:
    """Index of one file, the ``number``-th of a log. Raises InputError for what is no MCAP file at all.

    source : the original of a copy, named in messages; None for itself
    """
    data = _map(path)
    index = FileIndex(source or path, number, data)
    summary = _summary(lambda offset, size: data[offset : offset + size], len(data), needs_crc=True)
    return index if _take_summary(index, summary, len(data)) else walked(FileIndex(index.path, number, data))


def index_by_summary(file: RemoteFile, number: int) -> FileIndex | None:
    """Index of a remote file by its summary alone, in two or three requests; None where that is incomplete.

    Any other file has to be walked, which takes all its bytes.
    """
    index = FileIndex(file.address, number, b"", lru_cache(_REPEATED)(file.read))
    summary = _summary(file.read, file.size, needs_crc=False)
    return index if _take_summary(index, summary, file.size) else None


def walked(index: FileIndex) -> FileIndex:
    """The index, filled by walking the records of its file."""
    data, walk = index.data, _Walk(index)
    index.is_consistent = False
    sought: AbstractSet[int] = frozenset()
    offset, end = len(MAGIC), record_end(data, len(MAGIC))
    while not is_end(data, offset):
        following = record_end(data, end) if end else 0
        if end and (following or is_end(data, end)):
            walk.take(offset, end)
            offset, end = end, following
            continue
        sought = sought or sought_behind(data, offset)
        resumed = next_record(data, offset + 1, sought)
        if end and (states_length_twice(data, offset) or not 0 < resumed < end):
            walk.take(offset, end)
            offset = resumed if 0 < resumed < end else end
        if not resumed:
            break
        index.damage.append(
            f"{index.path}: the record at byte {offset} is damaged; reading went on at byte {resumed}"
        )
        walk.close(offset, complete=False)
        offset, end = resumed, record_end(data, resumed)
    walk.finish(offset)
    return index


def _summary(read: Callable[[int, int], bytes], size: int, *, needs_crc: bool) -> bytes:
    """The summary of a file of this size, to its end; empty where there is none or its CRC is wrong."""
    tail = read(max(size - _TAIL_BYTES, 0), min(size, _TAIL_BYTES))
    footer = tail[-_FOOTER_BYTES:]
    if len(footer) < _FOOTER_BYTES or not footer.endswith(MAGIC) or footer[0] != FOOTER:
        return b""
    begin, _, crc = struct.unpack_from("<QQI", footer, RECORD.size)
    if not 0 < begin <= size - len(footer) or (needs_crc and not crc):
        return b""
    missing = size - len(tail) - begin
    summary = read(begin, missing) + tail if missing > 0 else tail[-missing:]
    return summary if not crc or zlib.crc32(summary[: -len(MAGIC) - 4]) == crc else b""


def _take_summary(index: FileIndex, summary: bytes, size: int) -> bool:
    """Fill the index by the summary of a file of this size; False where that does not give every message."""
    statistics = None
    try:
        for opcode, begin, end in records_of(summary[: -len(MAGIC)]):
            body = ReadDataStream(BytesIO(summary[begin:end]))
            if opcode == SCHEMA:
                index.add_schema(summary, begin)
            elif opcode == CHANNEL:
                index.add_channel(summary, begin)
            elif opcode == CHUNK_INDEX:
                index.blocks.append(_indexed(ChunkIndex.read(body), index.number))
            elif opcode == STATISTICS:
                statistics = Statistics.read(body)
    except (McapError, struct.error, UnicodeDecodeError):
        return False
    if statistics is None or statistics.chunk_count != len(index.blocks):
        return False
    index.blocks.sort(key=lambda block: block.offset)
    index.counts, index.is_counted = dict(statistics.channel_message_counts), True
    is_complete = +Counter(index.counts) == index.indexed_counts()
    return is_complete and all(
        block.chunk_offset >= 0
        and block.offset + block.size <= size
        and is_plausible_size(block.size, block.uncompressed_size)
        for block in index.blocks
    )


def _indexed(chunk: ChunkIndex, file: int) -> Block:
    """A chunk by its index; where the next message index begins gives the number of a channel's messages."""
    end = chunk.chunk_start_offset + chunk.chunk_length
    stated = sorted((offset, channel) for channel, offset in chunk.message_index_offsets.items())
    ends = [*(offset for offset, _ in stated[1:]), end + chunk.message_index_length]
    begins = [offset + RECORD.size + 6 for offset, _ in stated]
    entries = tuple(
        Entry(channel, begin, (end - begin) // 16)
        for (_, channel), begin, end in zip(stated, begins, ends, strict=False)
        if end - begin >= 16
    )
    return Block(
        file,
        end - chunk.compressed_size,
        chunk.compressed_size,
        chunk.compression,
        chunk.uncompressed_size,
        None,
        chunk.message_start_time,
        chunk.message_end_time,
        entries,
    )


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


class _Walk:
    """Sorts records into an index; a chunk waits for its message index, loose messages for each other."""

    def __init__(self, index: FileIndex) -> None:
        self.index = index
        self.data = index.data
        self.defining = index  # what schemas and channels are defined in
        self.private: list[int] = []  # offsets of records of some application
        self.chunk: Block | None = None
        self.entries: list[Entry] = []
        self.loose_from = -1
        self.loose_times: list[int] = []
        self.loose_counts: Counter[int] = Counter()

    def take(self, offset: int, end: int) -> None:
        """Sort in the record of these bytes."""
        try:
            self._sort(self.data[offset], offset + RECORD.size, end)
        except (struct.error, UnicodeDecodeError):
            self.index.damage.append(
                f"{self.index.path}: the record at byte {offset} is malformed and was left out"
            )

    def finish(self, offset: int) -> None:
        """End the walk at this byte; of a chunk that is cut off there the beginning is retained."""
        index, size = self.index, len(self.data)
        is_whole = is_end(self.data, offset)
        self.close(offset, complete=is_whole)
        if not is_whole:
            where = f", inside the record at byte {offset}" if offset + RECORD.size <= size else ""
            index.damage.append(f"{index.path}: cut off at byte {size}{where}, without the closing magic")
            if where and self.data[offset] == CHUNK:
                self.take(offset, size)
                if self.chunk is not None:
                    self.chunk = replace(self.chunk, is_cut=True, crc=0)
                    self.close(offset, complete=False)
        if self.private:  # one of them may have been a chunk
            index.damage.append(
                f"{index.path}: passed over {counted(len(self.private), 'record')} of unknown kinds, "
                f"the first at byte {self.private[0]}"
            )

    def close(self, offset: int, *, complete: bool) -> None:
        """End the chunk or the run of loose messages at this byte; incomplete entries are discarded."""
        if self.chunk is not None:
            self.index.blocks.append(replace(self.chunk, entries=tuple(self.entries) if complete else ()))
        if self.loose_times:
            first, last = min(self.loose_times), max(self.loose_times)
            size = offset - self.loose_from
            entries = tuple(Entry(channel, -1, count) for channel, count in self.loose_counts.items())
            self.index.blocks.append(
                Block(self.index.number, self.loose_from, size, "", size, 0, first, last, entries, is_chunk=False)
            )
        self.chunk, self.entries = None, []
        self.loose_from, self.loose_times, self.loose_counts = -1, [], Counter()

    def _sort(self, opcode: int, body: int, end: int) -> None:
        if opcode == MESSAGE:
            self._message(body, end)
        elif opcode == MESSAGE_INDEX:
            self._entry(body, end)
        elif opcode == SCHEMA:
            self.defining.add_schema(self.data, body)
        elif opcode == CHANNEL:
            self.defining.add_channel(self.data, body)
        else:
            self.close(body - RECORD.size, complete=True)
            if opcode == CHUNK:
                self._chunk(body, end)
            elif opcode >= PRIVATE:
                self.private.append(body - RECORD.size)
            elif opcode == DATA_END:  # the summary behind it, damaged or unchecked, is the last resort
                uncertain = self.index.uncertain_channels
                self.defining = FileIndex(self.index.path, self.index.number, b"", channels=uncertain)

    def _message(self, body: int, end: int) -> None:
        offset = body - RECORD.size
        if self.chunk is not None:
            self.close(offset, complete=True)
        channel, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(self.data, body)
        if self.loose_from < 0:
            self.loose_from = offset
        self.loose_times.append(log_time_ns)
        self.loose_counts[channel] += 1
        if end - self.loose_from > _LOOSE_BYTES:
            self.close(end, complete=True)

    def _entry(self, body: int, end: int) -> None:
        channel, size = struct.unpack_from("<HI", self.data, body)
        if size > end - body - 6:
            raise struct.error("message index beyond its record")
        if self.chunk is None:
            self.index.note_damage(
                f"{self.index.path}: the chunk before the message index at byte {body} is missing"
            )
        elif size:
            self.entries.append(Entry(channel, body + 6, size // 16))

    def _chunk(self, body: int, end: int) -> None:
        start_ns, end_ns, uncompressed, crc = CHUNK_HEAD.unpack_from(self.data, body)
        (name,), records = read_strings(self.data, body + CHUNK_HEAD.size, 1)
        compression = name.decode()
        size = end - records - 8
        if is_plausible_size(size, uncompressed):
            number = self.index.number
            self.chunk = Block(number, records + 8, size, compression, uncompressed, crc, start_ns, end_ns)
            return
        self.index.damage.append(
            f"{self.index.path}: the chunk at byte {body - RECORD.size} claims to unpack from {size} to "
            f"{uncompressed} bytes, more than is accepted, and was left out"
        )


def is_plausible_size(size: int, uncompressed: int) -> bool:
    """True if a chunk of so many bytes may unpack to the size that its record states."""
    return uncompressed <= min(max(_MODEST_CHUNK, _MOST_TIMES * size), _LARGEST_CHUNK)
