"""MCAP files, indexed by their summary or by walking their records; and conversion to a temporary one.

A summary that agrees with its CRC and its statistics states the position of every message; damaged chunks are
detected when they are decompressed. Files without such a summary (truncated, unfinished or damaged) are walked
record by record, chunks by their heads alone; after damage the walk resumes at the next valid record.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections import Counter, deque
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC as MAGIC

from scanchain.errors import InputError, counted
from scanchain.files import BLOCK_BYTES, Source
from scanchain.logs.files import RemoteFile
from scanchain.logs.formats import Format
from scanchain.logs.index import (
    Block,
    Channel,
    Contents,
    FileIndex,
    Message,
    most_decompressed,
    name_of_block,
    unpack,
)  # fmt: skip
from scanchain.logs.writer import LogWriter

RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_HEAD = struct.Struct("<BQQQQII")  # record, start, end, uncompressed size, CRC-32, length of a name
MALFORMED = (McapError, struct.error, UnicodeDecodeError)  # raised for bytes that are no record

# smallest number of bytes of a record's body, by the specification
_LEAST_BYTES = {Opcode.HEADER: 8, Opcode.MESSAGE: MESSAGE_HEAD.size, Opcode.ATTACHMENT: 36, Opcode.METADATA: 8}
_DATA_END = RECORD.pack(Opcode.DATA_END, 4)
_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)  # the closing magic included


def index_file(path: Path, number: int) -> FileIndex:
    """Index of a file, the ``number``-th of a log. Raises InputError if it is no MCAP file."""
    try:
        with path.open("rb") as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except ValueError as error:
        raise InputError(f"{path}: is empty (0 bytes); record or copy it again") from error
    if data[: len(MAGIC)] != MAGIC:
        raise InputError(f"{path}: is not an MCAP file (starts with {data[:8]!r}); see scanchain convert --help")
    index = empty_index(path, number, data)
    if not _add_summary(index, len(data), needs_crc=True):
        index = empty_index(path, number, data)
        index.is_consistent = False
        Walk(index).walk()
    return index


def index_by_summary(file: RemoteFile, number: int) -> FileIndex | None:
    """Index of a remote file by its summary alone, in two or three requests; None if that is incomplete.

    Walking a file would read all its bytes.
    """
    fetch = lru_cache(4)(file.read)  # the first blocks are read more than once
    index = empty_index(file.address, number, fetch=fetch)
    return index if _add_summary(index, file.size, needs_crc=False) else None


def empty_index(
    path: Source, number: int, data: mmap.mmap | bytes = b"", fetch: Callable[[int, int], bytes] | None = None
) -> FileIndex:
    """Index of an MCAP file to which no record has been added yet."""
    index = FileIndex(path, number, data, fetch)
    index.contents = contents
    return index


def _add_summary(index: FileIndex, size: int, *, needs_crc: bool) -> bool:
    """Add the records of a file's summary; False if it does not state the position of every message."""
    # most summaries fit, so one request suffices
    tail = bytes(index.bytes_at(max(size - 65_536, 0), min(size, 65_536)))
    footer = tail[-_FOOTER_BYTES:]
    if len(footer) < _FOOTER_BYTES or not footer.endswith(MAGIC) or footer[0] != Opcode.FOOTER:
        return False
    begin, _, crc = struct.unpack_from("<QQI", footer, RECORD.size)
    if not 0 < begin <= size - len(footer) or (needs_crc and not crc):
        return False
    missing = size - len(tail) - begin
    summary = bytes(index.bytes_at(begin, missing)) + tail if missing > 0 else tail[-missing:]
    if crc and zlib.crc32(summary[: -len(MAGIC) - 4]) != crc:
        return False
    try:
        statistics = _add_records(index, summary)
    except MALFORMED:
        return False
    if statistics is None or statistics.chunk_count != len(index.blocks):
        return False
    index.blocks.sort(key=lambda block: block.offset)
    index.counts = dict(statistics.channel_message_counts)
    is_complete = +Counter(index.counts) == index.indexed_counts()
    return is_complete and all(
        block.offset >= block.head
        and block.offset + block.size <= size
        and block.uncompressed_size <= most_decompressed(block.size)
        for block in index.blocks
    )


def _add_records(index: FileIndex, summary: bytes) -> Statistics | None:
    """Add the records up to the closing magic and return the statistics among them. Raises one of MALFORMED."""
    statistics = None
    for record in StreamReader(BytesIO(summary), skip_magic=True, emit_chunks=True).records:
        if isinstance(record, Schema | ChannelRecord):
            define(index, record)
        elif isinstance(record, ChunkIndex):
            index.blocks.append(_indexed(record, index.number))
        elif isinstance(record, Statistics):
            statistics = record
    return statistics


def _indexed(chunk: ChunkIndex, file: int) -> Block:
    """Block of a chunk by its index; messages are counted by the sizes of the message indexes."""
    end = chunk.chunk_start_offset + chunk.chunk_length
    stated = sorted((offset, channel) for channel, offset in chunk.message_index_offsets.items())
    ends = [*(offset for offset, _ in stated[1:]), end + chunk.message_index_length]
    counts = {
        channel: (following - offset - RECORD.size - 6) // 16
        for (offset, channel), following in zip(stated, ends, strict=False)
        if following - offset > RECORD.size + 6
    }
    size, times_ns = chunk.compressed_size, (chunk.message_start_time, chunk.message_end_time)
    head = CHUNK_HEAD.size + len(chunk.compression.encode()) + 8
    return Block(file, end - size, size, chunk.compression, chunk.uncompressed_size, *times_ns, counts, head)


class Walk:
    """Adds the records of a file to its index; the last chunk or sequence of loose messages stays open."""

    def __init__(self, index: FileIndex) -> None:
        self.index = index
        self.data = index.data
        self.open: Block | None = None  # the last chunk or sequence of loose messages
        self.times_ns: list[int] = []  # of its loose messages
        self.loose_sizes: deque[int] = deque(maxlen=8)  # of the last records

    def walk(self) -> None:
        """Add every record, and the damage."""
        index, data = self.index, self.data
        opcodes: tuple[int, ...] = ()
        offset, end = len(MAGIC), _record_end(index, len(MAGIC))
        while end or not self._ends_with_summary(offset):
            following = _record_end(index, end) if end else 0
            if end and (following or _is_end(data, end)) and not self._is_shortened(offset, end):
                self._add(offset, end)
                offset, end = end, following
                continue
            opcodes = opcodes or _opcodes_after_damage(index)
            resumed = _next_record(index, offset + 1, opcodes) or max(data.rfind(_DATA_END, offset + 1), 0)
            if end and (_chunk_at(index, offset) or not 0 < resumed < end):
                self._add(offset, end)
                offset = end
            if not resumed:
                self._truncate(offset)
                break
            if resumed != offset:  # equal for a truncated chunk
                where = min(offset, resumed)
                index.damage.append(
                    f"{index.path}: the record at byte {where} is damaged; reading resumes at byte {resumed}"
                )
                self._close(where, complete=False)
            offset, end = resumed, _record_end(index, resumed)
        self._close(offset, complete=True)

    def _ends_with_summary(self, offset: int) -> bool:
        """True if the data end here and a summary follows, whose channels are added as uncertain ones."""
        uncertain = FileIndex(self.index.path, self.index.number, channels=self.index.uncertain_channels)
        with suppress(*MALFORMED):
            if _is_end(self.data, offset):
                _add_records(uncertain, self.data[offset:])
                return True
        return False

    def _add(self, offset: int, end: int) -> None:
        """Add the record in a range of bytes."""
        index, body = self.index, offset + RECORD.size
        opcode, chunk = self.data[offset], _chunk_at(index, offset)
        if chunk is not None:
            self._add_chunk(chunk, offset)
        elif opcode == Opcode.MESSAGE:
            self._add_message(offset, end)
        elif opcode == Opcode.MESSAGE_INDEX and (self.open is None or not self.open.head):
            index.add_damage(f"{index.path}: the chunk before the message index at byte {offset} is missing")
        elif opcode == Opcode.MESSAGE_INDEX and self.open is not None:
            (channel,) = struct.unpack_from("<H", self.data, body)
            if count := (end - body - 6) // 16:
                self.open.counts[channel] = self.open.counts.get(channel, 0) + count
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            define(index, definition(opcode, self.data[body:end]))
        else:
            self._close(offset, complete=True)

    def _add_message(self, offset: int, end: int) -> None:
        if self.open is None or self.open.head or end - self.open.offset > BLOCK_BYTES:
            self._close(offset, complete=True)
            self.open = Block(self.index.number, offset, 0, "", 0, 0, 0, Counter())
        channel, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(self.data, offset + RECORD.size)
        self.open.counts[channel] += 1
        self.times_ns.append(log_time_ns)
        if end - offset not in self.loose_sizes:
            self.loose_sizes.append(end - offset)

    def _is_shortened(self, offset: int, end: int) -> bool:
        """True if a loose message lacks bytes: a complete message of a recent size ends at the same byte."""
        return self.data[offset] == Opcode.MESSAGE and any(
            RECORD.unpack_from(self.data, end - size) == (Opcode.MESSAGE, size - RECORD.size)
            for size in self.loose_sizes
            if size < end - offset
        )

    def _add_chunk(self, chunk: Block, offset: int) -> None:
        self._close(offset, complete=True)
        name = f"{self.index.path}: the chunk at byte {offset}"
        if self.data[offset] != Opcode.CHUNK:
            self.index.damage.append(f"{name} has another opcode; it is read as a chunk")
        if chunk.uncompressed_size <= most_decompressed(chunk.size):
            self.open = chunk
            return
        self.index.damage.append(
            f"{name} states that its {chunk.size} bytes decompress to {chunk.uncompressed_size}, more than is "
            "accepted; it is skipped"
        )

    def _truncate(self, offset: int) -> None:
        """End the walk at an incomplete record; of a chunk the beginning is read."""
        path, size, is_end = self.index.path, len(self.data), _is_end(self.data, offset)
        self._close(offset, complete=is_end)
        where = f", inside the record at byte {offset}" if offset + RECORD.size <= size else ""
        self.index.damage.append(
            f"{path}: the summary at byte {offset} is damaged or truncated"
            if is_end
            else f"{path}: truncated at byte {size}{where}, without the closing magic"
        )
        chunk = _chunk_at(self.index, offset)
        if chunk is not None:
            self._add_chunk(chunk, offset)
            self._close(size, complete=False)
            if (blocks := self.index.blocks) and blocks[-1].is_cut:  # its head states the end of what is lost, too
                read, _ = contents(self.index, blocks[-1], None)
                times_ns = (message.log_time_ns for message in read)
                blocks[-1] = replace(blocks[-1], end_ns=max(times_ns, default=blocks[-1].end_ns))

    def _close(self, offset: int, *, complete: bool) -> None:
        """Add the open chunk or loose messages, which end here, to the index; without incomplete counts."""
        block, self.open = self.open, None
        if block is not None and block.head:
            self.index.blocks.append(block if complete else replace(block, counts={}))
        elif block is not None:
            size, span = offset - block.offset, {"start_ns": min(self.times_ns), "end_ns": max(self.times_ns)}
            self.index.blocks.append(replace(block, size=size, uncompressed_size=size, **span))
            self.times_ns = []


def _is_end(data: mmap.mmap | bytes, offset: int) -> bool:
    """True if the data section ends here; at most a summary follows."""
    return data[offset : offset + len(_DATA_END)] == _DATA_END


def _record_end(index: FileIndex, offset: int) -> int:
    """End of the record of the data section at ``offset``; 0 if there is none, or an incomplete one."""
    data, body = index.data, offset + RECORD.size
    if body > len(data):
        return 0
    opcode, length = RECORD.unpack_from(data, offset)
    end = body + length
    if end > len(data):
        return 0
    if _chunk_at(index, offset):
        return end
    if opcode == Opcode.MESSAGE_INDEX:
        return end if length >= 6 and struct.unpack_from("<I", data, body + 2)[0] == length - 6 else 0
    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        try:
            definition(opcode, data[body:end])
        except MALFORMED:
            return 0
        return end
    return end if length >= _LEAST_BYTES.get(opcode, len(data)) else 0


def _chunk_at(index: FileIndex, offset: int) -> Block | None:
    """Block of the chunk that begins here, whatever its opcode; None unless its two stated lengths agree."""
    # the name of a compression has 3 or 4 bytes, here at most 16
    head = index.data[offset : offset + CHUNK_HEAD.size + 16 + 8]
    if len(head) < CHUNK_HEAD.size + 8:
        return None
    _, length, *times_ns, uncompressed, _, name = CHUNK_HEAD.unpack_from(head)
    begin = CHUNK_HEAD.size + name + 8
    if begin > len(head):
        return None
    (size,) = struct.unpack_from("<Q", head, begin - 8)
    if size != length + RECORD.size - begin:
        return None
    compression = head[CHUNK_HEAD.size : begin - 8].decode("utf-8", "replace")
    remaining = len(index.data) - offset - begin
    where = index.number, offset + begin, min(size, remaining)
    return Block(*where, compression, uncompressed, *times_ns, head=begin, is_cut=size > remaining)


def _opcodes_after_damage(index: FileIndex) -> tuple[int, ...]:
    """Opcodes of records at which reading may resume.

    In a file with chunks these are chunks only: the rest of a damaged chunk could be mistaken for messages.
    """
    is_chunked = index.blocks or _next_record(index, len(MAGIC), (Opcode.CHUNK, Opcode.MESSAGE_INDEX))
    return (Opcode.CHUNK,) if is_chunked else (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)


def _next_record(index: FileIndex, offset: int, opcodes: tuple[int, ...]) -> int:
    """First byte from ``offset`` on where a record with such an opcode, or a truncated chunk, begins; else 0."""
    data = index.data
    for begin in range(offset, len(data) - RECORD.size, BLOCK_BYTES):
        window = np.frombuffer(data, np.uint8, min(BLOCK_BYTES + 8, len(data) - begin), begin)
        likely = np.isin(window[:-8], opcodes) & ((window[6:-2] | window[7:-1] | window[8:]) == 0)
        for candidate in (begin + np.flatnonzero(likely)).tolist():
            end = _record_end(index, candidate)
            is_sure = data[candidate] == Opcode.MESSAGE_INDEX or _is_end(data, end)
            if _chunk_at(index, candidate) or (end and (is_sure or _record_end(index, end))):
                return candidate
    return 0


def contents(index: FileIndex, block: Block, wanted: AbstractSet[int] | None) -> Contents:
    """Messages of a block of the wanted channels, None for all; channels defined in it are added to the index."""
    payload = unpack(index, block, lambda head: CHUNK_HEAD.unpack_from(head)[5])
    messages: list[Message] = []
    read = undefined = end = 0
    try:
        while end < len(payload):
            opcode, length = RECORD.unpack_from(payload, end)
            begin, end = end + RECORD.size, end + RECORD.size + length
            if end > len(payload):
                raise struct.error("record beyond the end")
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                define(index, definition(opcode, bytes(payload[begin:end])))
            elif opcode == Opcode.MESSAGE:
                number, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(payload, begin)
                read += 1
                channel = index.channels.get(number)
                undefined += channel is None
                if channel is not None and (wanted is None or number in wanted):
                    messages.append(Message(channel, log_time_ns, payload[begin + MESSAGE_HEAD.size : end]))
            else:
                raise struct.error("record of no kind that a chunk may hold")
    except MALFORMED:
        damage = "a record in it is malformed; the rest of it is skipped"
        return Contents(messages, "" if block.is_cut else f"{name_of_block(index, block)}: {damage}")
    stated = sum(block.counts.values())
    damage = f"contains {read} of {stated} indexed messages" if read < stated else ""
    if undefined:
        damage = f"{counted(undefined, 'message')} of an undefined channel"
    return Contents(messages, damage and f"{name_of_block(index, block)}: {damage}")


def definition(opcode: int, body: bytes) -> Schema | ChannelRecord:
    """Schema or channel defined by a record. Raises one of MALFORMED."""
    stream = ReadDataStream(BytesIO(body))
    record = (Schema if opcode == Opcode.SCHEMA else ChannelRecord).read(stream)
    if stream.count + 256 < len(body):  # more indicate another record with a damaged opcode
        raise struct.error("definition of another length than its record")
    return record


def define(index: FileIndex, record: Schema | ChannelRecord) -> None:
    """Add a schema or a channel to the index; a channel that is fully known is not replaced."""
    if isinstance(record, Schema):
        index.schemas[record.id] = (record.name, record.encoding, record.data)
    elif not index.knows(record.id):
        schema = index.schemas.get(record.schema_id, ("", "", b""))
        key = (index.number, record.id)
        index.channels[record.id] = Channel(key, record.topic, record.message_encoding, record.schema_id, *schema)


def temporary_index(path: Path, number: int, write: Callable[[LogWriter], None]) -> FileIndex:
    """Index of the messages that ``write`` converts from a path, as the ``number``-th file of a log."""
    with TemporaryDirectory(prefix="scanchain-", ignore_cleanup_errors=True) as folder:
        copy = Path(folder) / "log.mcap"
        try:
            with LogWriter(copy) as log:
                write(log)
        except OSError as error:
            raise InputError(f"{copy}: {path} cannot be converted there ({error.strerror}); set TMPDIR") from error
        index = index_file(copy, number)  # memory-maps the file, so it may be deleted
    index.path = path
    return index


FORMAT = Format(
    "mcap", "MCAP", lambda _, head: head.startswith(MAGIC), lambda path, number, _: index_file(path, number),
    (".mcap",), "parts",
)  # fmt: skip
