"""ROS 1 bags: finished or cut off, indexed or not; their messages stay as they are.

The records are walked as those of an MCAP file are, and what is damaged is passed over likewise.
Format: https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import mmap
import re
import struct
from collections import Counter
from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from scanchain.errors import InputError, counted
from scanchain.logs.mcap.index import is_plausible_size
from scanchain.logs.mcap.records import Block, Channel, Contents, Entry, FileIndex, Message, unpack
from scanchain.logs.mcap.selection import messages_of

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
T = TypeVar("T", int, NDArray[np.int64])
Data = mmap.mmap | memoryview | bytes
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")  # seconds, nanoseconds
_LONGEST_HEAD = 1 << 16  # longest head in bytes; a longer one is damage
_OPCODE = re.compile(rb"\x04\0\0\0op=[\x04\x05\x07]")  # opcode of an index, a chunk, a connection
_MOST_BEFORE = 256  # largest number of bytes of a head before its opcode

_INDEX_TIMES = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])


class Record(NamedTuple):
    """A record: its fields by name, and where it begins, its data begin and it ends, maybe beyond the file."""

    opcode: int
    fields: dict[bytes, bytes]
    offset: int
    begin: int
    end: int

    def number(self, name: bytes) -> int:
        """A field that is a whole number. Raises struct.error where it is absent or of another size."""
        return _LENGTH.unpack(self.fields.get(name, b""))[0]

    def time_ns(self, name: bytes) -> int:
        """A field that is a time. Raises struct.error where it is absent or of another size."""
        return as_ns(*_TIME.unpack(self.fields.get(name, b"")))

    def text(self, name: bytes) -> str:
        """A field that is text, empty where it is absent."""
        return self.fields.get(name, b"").decode("utf-8", "replace")


def as_ns(seconds: T, nanoseconds: T) -> T:
    """Times of ROS in nanoseconds."""
    return seconds * 1_000_000_000 + nanoseconds


def read_record(data: Data, offset: int) -> Record | None:
    """The record that begins at the offset, None where none does."""
    head = _sized(data, offset)
    if head is None or head.end + _LENGTH.size > len(data) or head.end - head.begin > _LONGEST_HEAD:
        return None
    fields = _read_fields(bytes(data[head.begin : head.end]))
    (size,) = _LENGTH.unpack_from(data, head.end)
    if fields is None or len(fields.get(b"op", b"")) != 1:
        return None
    begin = head.end + _LENGTH.size
    return Record(fields[b"op"][0], fields, offset, begin, begin + size)


def channel_of(file: int, record: Record, data: Data) -> Channel:
    """The channel that a connection record defines. Raises struct.error for one without its fields."""
    stated = _read_fields(bytes(data[record.begin : record.end]))
    if stated is None or b"message_definition" not in stated:
        raise struct.error("connection without its fields")
    number = record.number(b"conn")
    topic, type_name = record.text(b"topic"), stated.get(b"type", b"").decode("utf-8", "replace")
    definition = stated[b"message_definition"]
    return Channel((file, number), topic, "ros1", number + 1, type_name, "ros1msg", definition)


def whole_records(data: Data) -> Iterator[Record]:
    """One record after the other. Raises struct.error at bytes that are no record, or not all of one."""
    offset = 0
    while offset < len(data):
        record = read_record(data, offset)
        if record is None or record.end > len(data):
            raise struct.error("record that is none, or beyond the end")
        yield record
        offset = record.end


def next_record(data: Data, offset: int, stated_end: int) -> Record | None:
    """The first record behind the offset that may stand outside of a chunk; None where there is none.

    stated_end : byte at which the damaged record ends if its length is right; no connection before it is taken, as
        chunks hold such too
    """
    for match in _OPCODE.finditer(data, offset + 1):
        for begin in range(match.start() - _LENGTH.size, max(offset, match.start() - _MOST_BEFORE), -1):
            record = read_record(data, begin)
            if record is None or record.begin < match.end() or record.end > len(data):
                continue
            if record.opcode != CONNECTION or begin >= stated_end:
                return record
    return None


def _read_fields(head: bytes) -> dict[bytes, bytes] | None:
    """The fields of a record's head by name, None where it is not made of fields."""
    fields: dict[bytes, bytes] = {}
    offset = 0
    while offset < len(head):
        field = _sized(head, offset)
        if field is None or field.end > len(head):
            return None
        name, equals, value = head[field.begin : field.end].partition(b"=")
        if not equals:
            return None
        fields[name] = value
        offset = field.end
    return fields


class _Span(NamedTuple):
    begin: int
    end: int


def _sized(data: Data, offset: int) -> _Span | None:
    """Span of the bytes behind their own length."""
    if offset + _LENGTH.size > len(data):
        return None
    begin = offset + _LENGTH.size
    return _Span(begin, begin + _LENGTH.unpack_from(data, offset)[0])


def claims_ros1_bag(_: Path, head: bytes) -> bool:
    """True if a file begins as a bag of any version does."""
    return head.startswith(b"#ROSBAG")


def index_ros1_bag(path: Path, number: int) -> FileIndex:
    """Index of a bag. Raises InputError for one that is empty, encrypted or of an old version."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{path}: is a bag of an old version; rosbag migrate makes one of version 2.0 of it")
        index = FileIndex(path, number, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    bag = _Bag(index)
    index.make = bag.make
    bag.walk()
    bag.finish()
    return index


class _Bag:
    """Sorts the records of a bag into its index; a chunk waits for the indexes that follow it."""

    def __init__(self, index: FileIndex) -> None:
        self.index = index
        self.chunk: Block | None = None
        self.entries: list[Entry] = []
        self.times_ns: list[int] = []
        self.is_sure = True  # of the entries
        self.stated: Counter[int] = Counter()  # messages by connection, as the bag itself counts them

    def walk(self) -> None:
        """Take in one record after the other, and go on behind damage."""
        data, offset = self.index.data, len(MAGIC)
        while offset < len(data):
            record = read_record(data, offset)
            if record is not None and (record.end == len(data) or read_record(data, record.end) is not None):
                self._take(record)
                offset = record.end
                continue
            behind = next_record(data, offset, offset if record is None else record.end)
            limit = len(data) if behind is None else behind.offset
            if record is not None and (record.end <= limit or (behind is None and record.opcode == CHUNK)):
                self._take(record)
            self._close(complete=False)
            if behind is None:
                self.index.damage.append(f"{self.index.path}: cut off, or damaged to its end, at byte {offset}")
                return
            self.index.damage.append(
                f"{self.index.path}: the record at byte {offset} is damaged; "
                f"reading went on at byte {behind.offset}"
            )
            offset = behind.offset
        self._close(complete=True)

    def finish(self) -> None:
        """Count the messages, opening the chunks without a complete index."""
        index = self.index
        is_inconsistent = bool(self.stated) and self.stated != index.indexed_counts()
        index.blocks = [
            self._unpacked(block) if is_inconsistent or not self._is_known(block) else block
            for block in index.blocks
        ]
        index.counts = dict(index.indexed_counts())
        index.channels = {number: c for number, c in index.channels.items() if index.counts.get(number)}
        index.is_counted = True

    def make(self, block: Block, wanted: AbstractSet[int] | None) -> Contents:
        """The messages of a chunk; connections found there join the index."""
        name = f"{self.index.path}: the chunk at byte {block.offset}"
        messages: list[Message] = []
        undefined = 0
        try:
            payload = unpack(self.index, block)
            for record in whole_records(payload):
                if record.opcode == CONNECTION:
                    self._define(channel_of(self.index.number, record, payload))
                elif record.opcode == MESSAGE:
                    number, time_ns = record.number(b"conn"), record.time_ns(b"time")
                    channel = self.index.channels.get(number)
                    undefined += channel is None
                    if channel is not None and (wanted is None or number in wanted):
                        messages.append(Message(channel, time_ns, payload[record.begin : record.end]))
        except struct.error:
            damage = f"{name}: a record in it is malformed; what follows was left out"
            return Contents(messages, "" if block.is_cut else damage)
        return Contents(
            messages, f"{name}: {counted(undefined, 'message')} of no known connection" if undefined else ""
        )

    def _is_known(self, block: Block) -> bool:
        """True if the counts of a chunk are known, and all its connections are."""
        return bool(block.entries) and all(entry.channel in self.index.channels for entry in block.entries)

    def _take(self, record: Record) -> None:
        try:
            self._sort(record)
        except (struct.error, ValueError):
            self.index.damage.append(
                f"{self.index.path}: the record at byte {record.offset} is malformed and was left out"
            )
            self.is_sure = False

    def _sort(self, record: Record) -> None:
        if record.opcode == INDEX:
            self._index(record)
            return
        self._close(complete=True)
        if record.opcode == CHUNK:
            self._chunk(record)
        elif record.opcode == CONNECTION:
            self._define(channel_of(self.index.number, record, memoryview(self.index.data)))
        elif record.opcode == CHUNK_INFO:
            pairs = np.frombuffer(self.index.data, "<u4", 2 * record.number(b"count"), record.begin)
            for number, count in pairs.reshape(-1, 2).tolist():
                self.stated[number] += count
        elif record.opcode == HEADER and record.text(b"encryptor"):
            raise InputError(f"{self.index.path}: is encrypted ({record.text(b'encryptor')}); decrypt it first")

    def _chunk(self, record: Record) -> None:
        index, end = self.index, len(self.index.data)
        size, claimed = min(record.end, end) - record.begin, record.number(b"size")
        if not is_plausible_size(size, claimed):
            index.damage.append(
                f"{index.path}: the chunk at byte {record.offset} claims to unpack from {size} to {claimed} "
                "bytes, more than is accepted, and was left out"
            )
            return
        name = record.text(b"compression")
        compression = "" if name == "none" else name
        is_cut = record.end > end
        self.chunk = Block(index.number, record.begin, size, compression, claimed, 0, 0, 0, is_cut=is_cut)

    def _index(self, record: Record) -> None:
        """Add the number and times of a connection's messages in the chunk before."""
        times = np.frombuffer(self.index.data, _INDEX_TIMES, record.number(b"count"), record.begin)
        if len(times) and self.chunk is not None:
            self.entries.append(Entry(record.number(b"conn"), -1, len(times)))
            times_ns = as_ns(times["s"].astype(np.int64), times["ns"])
            self.times_ns += [int(times_ns.min()), int(times_ns.max())]

    def _define(self, channel: Channel) -> None:
        self.index.channels.setdefault(channel.key[1], channel)

    def _close(self, *, complete: bool) -> None:
        """End the chunk; an index that does not cover all of its messages is discarded."""
        if self.chunk is not None:
            block = self.chunk
            if complete and self.is_sure and self.entries:
                first_ns, last_ns = min(self.times_ns), max(self.times_ns)
                block = replace(block, start_ns=first_ns, end_ns=last_ns, entries=tuple(self.entries))
            self.index.blocks.append(block)
        self.chunk, self.entries, self.times_ns, self.is_sure = None, [], [], True

    def _unpacked(self, block: Block) -> Block:
        """A chunk whose messages have been counted by unpacking it."""
        messages = messages_of(self.index, block)
        counts = Counter(message.channel.key[1] for message in messages)
        times_ns = [message.log_time_ns for message in messages] or [0]
        entries = tuple(Entry(number, -1, count) for number, count in counts.items())
        return replace(block, start_ns=min(times_ns), end_ns=max(times_ns), entries=entries)
