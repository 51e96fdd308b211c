"""Index of an MCAP file: its blocks of messages, channels and damage, by its summary or by walking its records.

A summary that agrees with its CRC and its statistics gives the position of every message; a damaged chunk shows
when it is unpacked. Files that were cut off, never finished or damaged there are walked record by record, chunks
by their heads alone; behind damage the walk resumes at the next record that is one.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader

from scanchain.errors import InputError, counted
from scanchain.files import Source
from scanchain.logs.files import RemoteFile
from scanchain.logs.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    MAGIC,
    MALFORMED,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
    Block,
    Entry,
    FileIndex,
    read_definition,
)

HEADER, FOOTER, ATTACHMENT, METADATA, DATA_END = 1, 2, 9, 12, 15
_PRIVATE = 0x80  # opcodes from here on are those of applications
_LEAST_BYTES = {HEADER: 8, MESSAGE: MESSAGE_HEAD.size, ATTACHMENT: 36, METADATA: 8}  # of a record's body
_DATA_END = RECORD.pack(DATA_END, 4)
_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)  # the closing magic included
_TAIL_BYTES = 65_536  # number of bytes of a file read at first; most summaries lie in it
_REPEATED = 4  # number of ranges of a remote file retained: the first blocks are read more than once
_LONGEST_NAME = 16  # bytes; no name of a compression is longer
_LARGEST_CHUNK = 1 << 30  # largest size of a chunk in bytes; one beyond is damage
_MODEST_CHUNK = 1 << 25  # size in bytes up to which a chunk's stated size is accepted at any ratio
_MOST_TIMES = 20  # largest ratio of the unpacked to the stored size of a larger chunk
_LOOSE_BYTES = 1 << 20  # messages outside chunks are read in blocks of about this size
_WINDOW = 1 << 20  # bytes searched at once


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
    sought: tuple[int, ...] = ()
    chunk = 0  # the last one; records behind it may be none, met by a length that is wrong
    offset, end = len(MAGIC), _record_end(index, len(MAGIC))
    while end or not _is_whole_summary(index, offset):
        following = _record_end(index, end) if end else 0
        if end and (following or _is_end(data, end)) and not walk.is_shortened(offset, end):
            walk.take(offset, end)
            chunk = offset if data[offset] == CHUNK else chunk
            offset, end = end, following
            continue
        is_chunk = _chunk_at(index, offset) is not None
        sought = sought or _sought(index)
        searched = 1 + (chunk if sought == (CHUNK,) and not is_chunk else offset)
        resumed = _next_record(index, searched, sought) or max(data.rfind(_DATA_END, offset + 1), 0)
        if end and (is_chunk or not 0 < resumed < end):
            walk.take(offset, end)
            offset = end
        if not resumed:
            walk.cut_off(offset)
            break
        if resumed != offset:  # which is that of a chunk that is cut off
            where = min(offset, resumed)
            index.damage.append(
                f"{index.path}: the record at byte {where} is damaged; reading went on at byte {resumed}"
            )
            walk.close(where, complete=False)
        chunk = offset = resumed
        end = _record_end(index, offset)
    walk.close(offset, complete=True)
    if walk.private:
        index.damage.append(
            f"{index.path}: passed over {counted(len(walk.private), 'record')} of unknown kinds, "
            f"the first at byte {walk.private[0]}"
        )
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
    try:
        statistics = _fill(index, summary)
    except MALFORMED:
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


def _fill(index: FileIndex, summary: bytes) -> Statistics | None:
    """Take in the records up to the closing magic; the statistics among them. Raises one of MALFORMED."""
    statistics = None
    for record in StreamReader(BytesIO(summary), skip_magic=True, emit_chunks=True).records:
        if isinstance(record, Schema | Channel):
            index.define(record)
        elif isinstance(record, ChunkIndex):
            index.blocks.append(_indexed(record, index.number))
        elif isinstance(record, Statistics):
            statistics = record
    return statistics


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
    size, times_ns = chunk.compressed_size, (chunk.message_start_time, chunk.message_end_time)
    return Block(file, end - size, size, chunk.compression, chunk.uncompressed_size, None, *times_ns, entries)


def _is_whole_summary(index: FileIndex, offset: int) -> bool:
    """True if the data end here and a summary ends the file; its channels are taken in as a last resort."""
    if not _is_end(index.data, offset):
        return False
    uncertain = FileIndex(index.path, index.number, b"", channels=index.uncertain_channels)
    try:
        _fill(uncertain, index.data[offset:])
    except MALFORMED:
        return False
    return True


def _map(path: Path) -> mmap.mmap:
    try:
        with path.open("rb") as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except ValueError as error:
        raise InputError(f"{path}: is empty (0 bytes); record or copy it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    if data[: len(MAGIC)] != MAGIC:
        raise InputError(f"{path}: is not an MCAP file (starts with {data[:8]!r}); see scanchain convert --help")
    return data


class _Walk:
    """Sorts records into an index; a chunk waits for its message index, loose messages for each other."""

    def __init__(self, index: FileIndex) -> None:
        self.index = index
        self.chunk: Block | None = None
        self.entries: list[Entry] = []
        self.private: list[int] = []  # offsets of records of some application, or of damaged messages
        self.loose_from = -1
        self.loose_times: list[int] = []
        self.loose_counts: Counter[int] = Counter()
        self.loose_sizes: deque[int] = deque(maxlen=8)  # of the records met last

    def take(self, offset: int, end: int) -> None:
        """Sort in the record of these bytes."""
        data, opcode, body = self.index.data, self.index.data[offset], offset + RECORD.size
        chunk = _chunk_at(self.index, offset)
        if chunk is not None:
            self.close(offset, complete=True)
            self._take_chunk(chunk, offset)
        elif opcode == MESSAGE:
            self._take_message(offset, end)
        elif opcode == MESSAGE_INDEX and self.chunk is None:
            self.index.note_damage(
                f"{self.index.path}: the chunk before the message index at byte {offset} is missing"
            )
        elif opcode == MESSAGE_INDEX and end - body > 6:
            (channel,) = struct.unpack_from("<H", data, body)
            self.entries.append(Entry(channel, body + 6, (end - body - 6) // 16))
        elif opcode in (SCHEMA, CHANNEL):
            self.index.define(read_definition(opcode, data[body:end]))
        else:
            self.close(offset, complete=True)
            self.private += [offset] if opcode >= _PRIVATE else []

    def is_shortened(self, offset: int, end: int) -> bool:
        """True if a loose message ends in a whole one of a size met lately: so many bytes of it are missing."""
        data, sizes = self.index.data, [size for size in self.loose_sizes if size < end - offset]
        return data[offset] == MESSAGE and any(
            RECORD.unpack_from(data, end - size) == (MESSAGE, size - RECORD.size) for size in sizes
        )

    def cut_off(self, offset: int) -> None:
        """End the walk at the record that is not all there; of a chunk the beginning is retained."""
        index, size, is_end = self.index, len(self.index.data), _is_end(self.index.data, offset)
        self.close(offset, complete=is_end)
        where = f", inside the record at byte {offset}" if offset + RECORD.size <= size else ""
        index.damage.append(
            f"{index.path}: the summary at byte {offset} is damaged or cut off"
            if is_end
            else f"{index.path}: cut off at byte {size}{where}, without the closing magic"
        )
        chunk = _chunk_at(index, offset)
        if chunk is not None:
            self._take_chunk(chunk, offset)
            self.close(size, complete=False)

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

    def _take_message(self, offset: int, end: int) -> None:
        if self.chunk is not None:
            self.close(offset, complete=True)
        channel, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(self.index.data, offset + RECORD.size)
        if self.loose_from < 0:
            self.loose_from = offset
        if end - offset not in self.loose_sizes:
            self.loose_sizes.append(end - offset)
        self.loose_times.append(log_time_ns)
        self.loose_counts[channel] += 1
        if end - self.loose_from > _LOOSE_BYTES:
            self.close(end, complete=True)

    def _take_chunk(self, chunk: Block, offset: int) -> None:
        name = f"{self.index.path}: the chunk at byte {offset}"
        if self.index.data[offset] != CHUNK:
            self.index.damage.append(f"{name} is marked as another record; it was read all the same")
        if is_plausible_size(chunk.size, chunk.uncompressed_size):
            self.chunk = chunk
            return
        self.index.damage.append(
            f"{name} claims to unpack from {chunk.size} to {chunk.uncompressed_size} bytes, more than is "
            "accepted, and was left out"
        )


def is_plausible_size(size: int, uncompressed: int) -> bool:
    """True if a chunk of so many bytes may unpack to the size that its record states."""
    return uncompressed <= min(max(_MODEST_CHUNK, _MOST_TIMES * size), _LARGEST_CHUNK)


def _is_end(data: mmap.mmap | bytes, offset: int) -> bool:
    """True if the data end here; behind is at most a summary."""
    return data[offset : offset + len(_DATA_END)] == _DATA_END


def _record_end(index: FileIndex, offset: int) -> int:
    """The byte behind the record at ``offset``; 0 where there is none of the data section, or not all of one."""
    data, body = index.data, offset + RECORD.size
    if body > len(data):
        return 0
    opcode, length = RECORD.unpack_from(data, offset)
    end = body + length
    if end > len(data):
        return 0
    if _chunk_at(index, offset):
        return end
    if opcode == MESSAGE_INDEX:
        return end if length >= 6 and struct.unpack_from("<I", data, body + 2)[0] == length - 6 else 0
    if opcode in (SCHEMA, CHANNEL):
        try:
            read_definition(opcode, data[body:end])
        except MALFORMED:
            return 0
        return end
    return end if opcode >= _PRIVATE or length >= _LEAST_BYTES.get(opcode, len(data)) else 0


def _chunk_at(index: FileIndex, offset: int) -> Block | None:
    """The chunk whose record begins here, whatever its opcode; None where its length is not stated twice alike."""
    head = index.data[offset : offset + CHUNK_HEAD.size + _LONGEST_NAME + 8]
    if len(head) < CHUNK_HEAD.size + 8:
        return None
    _, length, *times_ns, uncompressed, crc, name = CHUNK_HEAD.unpack_from(head)
    begin = CHUNK_HEAD.size + name + 8
    if begin > len(head):
        return None
    (size,) = struct.unpack_from("<Q", head, begin - 8)
    if size != length + RECORD.size - begin:
        return None
    compression = head[CHUNK_HEAD.size : begin - 8].decode("utf-8", "replace")
    there = len(index.data) - offset - begin
    where = index.number, offset + begin, min(size, there)
    return Block(*where, compression, uncompressed, crc, *times_ns, is_cut=size > there)


def _sought(index: FileIndex) -> tuple[int, ...]:
    """Opcodes of the records that are searched behind damage.

    No message is searched outside of the chunks of a file that has them: what is left of a damaged chunk,
    unchecked, is not taken for messages.
    """
    is_chunked = index.blocks or _next_record(index, len(MAGIC), (CHUNK, MESSAGE_INDEX))
    return (CHUNK,) if is_chunked else (SCHEMA, CHANNEL, MESSAGE)


def _next_record(index: FileIndex, offset: int, sought: tuple[int, ...]) -> int:
    """The first byte from ``offset`` on at which such a record begins, a chunk even if cut off; 0 for none."""
    data = index.data
    for begin in range(offset, len(data) - RECORD.size, _WINDOW):
        window = np.frombuffer(data, np.uint8, min(_WINDOW + 8, len(data) - begin), begin)
        likely = np.isin(window[:-8], sought) & ((window[6:-2] | window[7:-1] | window[8:]) == 0)
        for candidate in (begin + np.flatnonzero(likely)).tolist():
            end = _record_end(index, candidate)
            is_sure = data[candidate] == MESSAGE_INDEX or _is_end(data, end)
            if _chunk_at(index, candidate) or (end and (is_sure or _record_end(index, end))):
                return candidate
    return 0
