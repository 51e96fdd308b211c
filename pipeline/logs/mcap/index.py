"""Index of an MCAP file: its blocks of messages, channels and damage, found by walking the records.

A walk reads nine bytes a record and a chunk's header, never its contents, and needs no summary: files that were
cut off or never finished are indexed like any other. Behind damage it goes on at the next record that is one.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scanchain.errors import InputError
from scanchain.logs.mcap.records import (
    CHANNEL,
    CHUNK,
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
    read_string,
)
from scanchain.logs.mcap.resync import CHUNK_HEAD, PRIVATE, Resync, is_end, record_end, states_length_twice
from scanchain.source import Source
from scanchain.words import counted

FOOTER_BODY = struct.Struct("<QQI")  # byte of the summary, byte of its offsets, CRC-32
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
    data, walk, resync = index.data, Walk(index), Resync(index.data)
    offset, end = len(MAGIC), record_end(index.data, len(MAGIC))
    while not is_end(data, offset):
        following = record_end(data, end) if end else 0
        if end and (following or is_end(data, end)):
            walk.take(offset)
            offset, end = end, following
            continue
        resumed = resync.behind(offset)
        if end and (states_length_twice(data, offset) or not 0 < resumed < end):
            walk.take(offset)
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


class Walk:
    """Sorts records into an index; a chunk waits for its message index, loose messages for each other."""

    def __init__(self, index: FileIndex) -> None:
        self.index = index
        self.is_inconsistent = False  # in a summary of a wrong CRC
        self.chunks_stated = 0  # by the statistics
        self.private: list[int] = []  # offsets of records of some application
        self.chunk: Block | None = None
        self.entries: list[Entry] = []
        self.loose_from = -1
        self.loose_times: list[int] = []
        self.loose_counts: dict[int, int] = {}

    def take(self, offset: int) -> None:
        """Sort one whole record in."""
        opcode, length = RECORD.unpack_from(self.index.data, offset)
        self._take(opcode, offset, length)

    def finish(self, offset: int) -> None:
        """End the walk at this byte; of a chunk that is cut off there the beginning is retained."""
        index, size = self.index, len(self.index.data)
        if is_end(index.data, offset):
            self.close(offset, complete=True)
        else:
            self.close(offset, complete=False)
            self._cut(offset, size)
        check_claims(index, self.chunks_stated, self.private)

    def _cut(self, offset: int, size: int) -> None:
        where = f", inside the record at byte {offset}" if offset + RECORD.size <= size else ""
        self.index.damage.append(f"{self.index.path}: cut off at byte {size}{where}, without the closing magic")
        if not where or self.index.data[offset] != CHUNK:
            return
        self._take(CHUNK, offset, size - offset - RECORD.size)
        if self.chunk is not None:
            self.chunk = replace(self.chunk, is_cut=True, crc=0)
            self.close(offset, complete=False)

    def close(self, offset: int, *, complete: bool) -> None:
        """End the chunk or the run of loose messages at this byte; incomplete entries are discarded."""
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

    def _take(self, opcode: int, offset: int, length: int) -> None:
        try:
            self._sort(opcode, offset, offset + RECORD.size, length)
        except (struct.error, UnicodeDecodeError):
            self.index.damage.append(
                f"{self.index.path}: the record at byte {offset} is malformed and was left out"
            )

    def _sort(self, opcode: int, offset: int, body: int, length: int) -> None:
        if self.is_inconsistent and opcode in (SCHEMA, CHANNEL, STATISTICS):
            self.index.damaged_summary.append((opcode, body))
            return
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
            else:
                self._frame(opcode, body, length)

    def _frame(self, opcode: int, body: int, length: int) -> None:
        """The records that begin and end the file and its parts."""
        if opcode == DATA_END:
            self.is_inconsistent = not _is_summary_intact(self.index, body + length)
        elif opcode == HEADER:
            self.index.profile, body = read_string(self.index.data, body)
            self.index.library, _ = read_string(self.index.data, body)
        elif opcode >= PRIVATE:
            self.private.append(body - RECORD.size)

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
        if self.chunk is None:
            self.index.note_damage(
                f"{self.index.path}: the chunk before the message index at byte {body} is missing"
            )
        elif size:
            self.entries.append(Entry(channel, body + 6, size // 16))

    def _chunk(self, offset: int, body: int, length: int) -> None:
        index = self.index
        start_ns, end_ns, uncompressed, crc = CHUNK_HEAD.unpack_from(index.data, body)
        compression, records = read_string(index.data, body + CHUNK_HEAD.size)
        size = body + length - records - 8
        if not is_plausible_size(size, uncompressed):
            index.damage.append(
                f"{index.path}: the chunk at byte {offset} claims to unpack from {size} to {uncompressed} bytes, "
                f"more than is accepted, and was left out"
            )
            return
        self.chunk = Block(index.number, records + 8, size, compression, uncompressed, crc, start_ns, end_ns)

    def _statistics(self, body: int, length: int) -> None:
        data = self.index.data
        offset = body + struct.calcsize("<QHIIIIQQ")
        (size,) = struct.unpack_from("<I", data, offset)
        for entry in range(offset + 4, min(offset + 4 + size, body + length - 9), 10):
            number, count = struct.unpack_from("<HQ", data, entry)
            self.index.counts[number] = count
        (self.chunks_stated,) = struct.unpack_from("<I", data, body + 22)
        self.index.is_counted = True


def is_plausible_size(size: int, uncompressed: int) -> bool:
    """True if a chunk of so many bytes may unpack to the size that its record states."""
    return uncompressed <= min(max(_MODEST_CHUNK, _MOST_TIMES * size), _LARGEST_CHUNK)


def _is_summary_intact(index: FileIndex, summary: int) -> bool:
    """True if the summary from this byte on agrees with its CRC, or has none; else it is noted as damage."""
    data = index.data
    footer = len(data) - len(MAGIC) - FOOTER_BODY.size - RECORD.size
    if footer < summary or data[-len(MAGIC) :] != MAGIC or data[footer] != FOOTER:
        return False
    crc = FOOTER_BODY.unpack_from(data, footer + RECORD.size)[2]
    if not crc or zlib.crc32(data[summary : footer + RECORD.size + FOOTER_BODY.size - 4]) == crc:
        return True
    index.damage.append(f"{index.path}: the summary at byte {summary} has a wrong CRC and was discarded")
    return False


def check_claims(index: FileIndex, chunks_stated: int, private: Sequence[int]) -> None:
    """Accept the counts of blocks by channel where they add up to the statistics; note where they do not.

    chunks_stated : by the statistics; private : where records of unknown kinds lie
    """
    totals: Counter[int] = Counter()
    for entry in (entry for block in index.blocks for entry in block.entries):
        totals[entry.channel] += entry.messages
    stated = {number: count for number, count in index.counts.items() if count}
    chunks = sum(block.is_chunk for block in index.blocks)
    index.is_consistent = index.is_counted and stated == dict(totals) and chunks == chunks_stated
    is_indexed = all(block.entries for block in index.blocks)
    if index.is_counted and not index.is_consistent and (is_indexed or chunks != chunks_stated):
        index.damage.append(
            f"{index.path}: its {counted(chunks, 'chunk')} and {counted(totals.total(), 'indexed message')} "
            f"are not the {chunks_stated} and {sum(stated.values())} of its statistics"
        )
    if private and not index.is_counted:  # one of them may have been a chunk
        index.damage.append(
            f"{index.path}: passed over {counted(len(private), 'record')} of unknown kinds, "
            f"the first at byte {private[0]}"
        )
