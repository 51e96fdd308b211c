"""Index of an MCAP file: its blocks of messages, channels and damage, found by walking its records or its summary.

A walk reads nine bytes a record and a chunk's header, never its contents, and needs no summary: files that were
cut off or never finished are indexed like any other. Behind damage it goes on at the next record that is one.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections import Counter
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from scanchain.errors import InputError
from scanchain.logs.files import RemoteFile
from scanchain.logs.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
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
    read_strings,
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
    index = FileIndex(source or path, number, _map(path))
    data, walk = index.data, _Walk(index, index.data)
    sought: AbstractSet[int] = frozenset()
    offset, end = len(MAGIC), record_end(index.data, len(MAGIC))
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


def index_by_summary(file: RemoteFile, number: int) -> FileIndex | None:
    """Index of a remote file by its summary alone, in two or three requests; None where that is incomplete.

    A file whose summary is absent, damaged, or does not give the position of every message has to be walked, which
    takes all its bytes.
    """
    tail = file.read(max(file.size - _TAIL_BYTES, 0), min(file.size, _TAIL_BYTES))
    footer = tail[-_FOOTER_BYTES:]
    if len(footer) < _FOOTER_BYTES or not footer.endswith(MAGIC) or footer[0] != FOOTER:
        return None
    (begin,) = struct.unpack_from("<Q", footer, RECORD.size)
    if not 0 < begin <= file.size - len(footer):
        return None
    missing = file.size - len(tail) - begin
    summary = file.read(begin, missing) + tail if missing > 0 else tail[-missing:]
    if not _agrees(summary, 0):
        return None
    index = FileIndex(file.address, number, b"", lru_cache(_REPEATED)(file.read))
    walk, offset = _Walk(index, summary), 0
    while 0 <= offset < len(summary) - len(footer):
        end = record_end(summary, offset)
        walk.take(offset, end)
        offset = end or -1
    walk.check_claims()
    index.blocks.sort(key=lambda block: block.offset)
    is_inside = all(block.chunk_offset >= 0 and block.offset + block.size <= file.size for block in index.blocks)
    is_complete = index.is_counted and not index.damage and offset == len(summary) - len(footer)
    return index if is_inside and is_complete else None


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

    def __init__(self, index: FileIndex, data: mmap.mmap | bytes) -> None:
        self.index = index
        self.data = data
        self.defining = index  # what schemas and channels are defined in
        self.chunks_stated = 0  # by the statistics
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
        self.check_claims()

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

    def check_claims(self) -> None:
        """Accept the counts of blocks by channel where they add up to the statistics; note where they do not."""
        index, totals = self.index, self.index.indexed_counts()
        stated = {number: count for number, count in index.counts.items() if count}
        chunks = sum(block.is_chunk for block in index.blocks)
        index.is_consistent = index.is_counted and stated == dict(totals) and chunks == self.chunks_stated
        is_indexed = all(block.entries for block in index.blocks)
        if index.is_counted and not index.is_consistent and (is_indexed or chunks != self.chunks_stated):
            index.damage.append(
                f"{index.path}: its {counted(chunks, 'chunk')} and {counted(totals.total(), 'indexed message')} "
                f"are not the {self.chunks_stated} and {sum(stated.values())} of its statistics"
            )
        if self.private and not index.is_counted:  # one of them may have been a chunk
            index.damage.append(
                f"{index.path}: passed over {counted(len(self.private), 'record')} of unknown kinds, "
                f"the first at byte {self.private[0]}"
            )

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
            self._frame(opcode, body, end)

    def _frame(self, opcode: int, body: int, end: int) -> None:
        """The chunks, and the records that begin, end and describe the file."""
        index = self.index
        if opcode == CHUNK:
            self._chunk(body, end)
        elif opcode == CHUNK_INDEX and index.fetch is not None:
            index.blocks.append(self._indexed(body))
        elif opcode == STATISTICS and self.defining is index:
            self._statistics(body, end)
        elif opcode == DATA_END:
            self._begin_summary(end)
        elif opcode == HEADER:
            (profile, library), _ = read_strings(self.data, body, 2)
            index.profile, index.library = profile.decode(), library.decode()
        elif opcode >= PRIVATE:
            self.private.append(body - RECORD.size)

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

    def _indexed(self, body: int) -> Block:
        """A chunk by its index; where the next message index begins states the number of a channel's messages."""
        start_ns, end_ns, chunk, length, size = struct.unpack_from("<QQQQI", self.data, body)
        at = body + 36
        stated = sorted(struct.unpack_from("<HQ", self.data, place)[::-1] for place in range(at, at + size, 10))
        (indexed,) = struct.unpack_from("<Q", self.data, at + size)
        (name,), at = read_strings(self.data, at + size + 8, 1)
        compressed, uncompressed = struct.unpack_from("<QQ", self.data, at)
        if not is_plausible_size(compressed, uncompressed):
            raise struct.error("chunk of an implausible size")
        begins = [offset + RECORD.size + 6 for offset, _ in stated]
        ends = [*(offset for offset, _ in stated[1:]), chunk + length + indexed]
        entries = tuple(
            Entry(channel, begin, (end - begin) // 16)
            for (_, channel), begin, end in zip(stated, begins, ends[: len(stated)], strict=True)
            if end - begin >= 16
        )
        payload, number = chunk + length - compressed, self.index.number
        return Block(number, payload, compressed, name.decode(), uncompressed, None, start_ns, end_ns, entries)

    def _statistics(self, body: int, end: int) -> None:
        (self.chunks_stated,) = struct.unpack_from("<I", self.data, body + 22)
        (size,) = struct.unpack_from("<I", self.data, body + 42)
        for entry in range(body + 46, min(body + 46 + size, end - 9), 10):
            number, count = struct.unpack_from("<HQ", self.data, entry)
            self.index.counts[number] = count
        self.index.is_counted = True

    def _begin_summary(self, summary: int) -> None:
        """Take in what the summary from this byte on defines; by itself where it is damaged."""
        index, footer = self.index, len(self.data) - _FOOTER_BYTES
        is_there = footer >= summary and self.data[-len(MAGIC) :] == MAGIC and self.data[footer] == FOOTER
        self.defining = index
        if is_there and _agrees(self.data, summary):
            return
        if is_there:
            index.damage.append(f"{index.path}: the summary at byte {summary} has a wrong CRC and was discarded")
        self.defining = FileIndex(index.path, index.number, b"", schemas=dict(index.schemas))
        index.uncertain_channels = self.defining.channels


def _agrees(data: mmap.mmap | bytes, summary: int) -> bool:
    """True if the summary from this byte to the end of the file agrees with its CRC, or has none."""
    crc_at = len(data) - len(MAGIC) - 4
    (crc,) = struct.unpack_from("<I", data, crc_at)
    return not crc or zlib.crc32(data[summary:crc_at]) == crc


def is_plausible_size(size: int, uncompressed: int) -> bool:
    """True if a chunk of so many bytes may unpack to the size that its record states."""
    return uncompressed <= min(max(_MODEST_CHUNK, _MOST_TIMES * size), _LARGEST_CHUNK)
