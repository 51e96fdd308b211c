"""ROS 1 bags: finished or cut off, indexed or not; their messages stay as they are.

Bags are walked record by record; the messages of a chunk are counted by the INDEX records behind it, those of a
chunk without such, and of all chunks of a damaged bag, by unpacking it.
Format: https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import mmap
import re
import struct
from collections import Counter
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scanchain.errors import InputError, counted
from scanchain.logs.mcap.index import is_plausible_size
from scanchain.logs.mcap.records import Block, Channel, Contents, FileIndex, Message, unpack
from scanchain.logs.mcap.stream import messages_of

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, INDEX, CHUNK, CONNECTION = 2, 4, 5, 7
Data = mmap.mmap | memoryview | bytes
_NS = 1_000_000_000
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")  # seconds, nanoseconds
_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])  # of an INDEX, a message
_LONGEST_HEAD = 1 << 16  # longest head in bytes; a longer one is damage
_OPCODE = re.compile(rb"\x04\0\0\0op=[\x05\x07]")  # opcode of a chunk, a connection
_MOST_BEFORE = 256  # largest number of bytes of a head before its opcode


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

    def text(self, name: bytes) -> str:
        """A field that is text, empty where it is absent."""
        return self.fields.get(name, b"").decode("utf-8", "replace")


def read_record(data: Data, offset: int) -> Record | None:
    """The record that begins at the offset, None where none does."""
    begin = offset + _LENGTH.size
    length = _LENGTH.unpack_from(data, offset)[0] if begin <= len(data) else _LONGEST_HEAD + 1
    end = begin + length
    if end + _LENGTH.size > len(data) or length > _LONGEST_HEAD:
        return None
    fields = _read_fields(bytes(data[begin:end]))
    if fields is None or len(fields.get(b"op", b"")) != 1:
        return None
    data_begin = end + _LENGTH.size
    return Record(fields[b"op"][0], fields, offset, data_begin, data_begin + _LENGTH.unpack_from(data, end)[0])


def _define(index: FileIndex, record: Record, data: Data) -> None:
    """Add the channel of a connection unless it is known. Raises struct.error for one without its fields."""
    stated = _read_fields(bytes(data[record.begin : record.end]))
    if stated is None or b"message_definition" not in stated:
        raise struct.error("connection without its fields")
    number = record.number(b"conn")
    topic, type_name = record.text(b"topic"), stated.get(b"type", b"").decode("utf-8", "replace")
    definition = stated[b"message_definition"]
    channel = Channel((index.number, number), topic, "ros1", number + 1, type_name, "ros1msg", definition)
    index.channels.setdefault(number, channel)


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
        begin = offset + _LENGTH.size
        offset = begin + int.from_bytes(head[offset:begin], "little")
        name, equals, value = head[begin:offset].partition(b"=")
        if not equals or offset > len(head):
            return None
        fields[name] = value
    return fields


def index_ros1_bag(path: Path, number: int) -> FileIndex:
    """Index of a bag. Raises InputError for one that is empty, encrypted or of an old version."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{path}: is a bag of an old version; rosbag migrate makes one of version 2.0 of it")
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    index = FileIndex(path, number, data)
    index.make = partial(_contents, index)
    head = read_record(data, len(MAGIC))
    if head is not None and head.text(b"encryptor"):
        raise InputError(f"{path}: is encrypted ({head.text(b'encryptor')}); decrypt it first")
    _walk(index)
    is_sure = not index.damage
    index.blocks = [block if is_sure and block.counts else _counted(index, block) for block in index.blocks]
    index.counts = dict(index.indexed_counts())
    index.channels = {number: c for number, c in index.channels.items() if index.counts.get(number)}
    return index


def _walk(index: FileIndex) -> None:
    """Take in the chunks and connections one after the other, and go on behind damage."""
    data, offset = index.data, len(MAGIC)
    while offset < len(data):
        record = read_record(data, offset)
        if record is not None and (record.end == len(data) or read_record(data, record.end) is not None):
            _take(index, record)
            offset = record.end
            continue
        behind = next_record(data, offset, offset if record is None else record.end)
        limit = len(data) if behind is None else behind.offset
        if record is not None and (record.end <= limit or (behind is None and record.opcode == CHUNK)):
            _take(index, record)
        if behind is None:
            index.damage.append(f"{index.path}: cut off, or damaged to its end, at byte {offset}")
            return
        index.damage.append(
            f"{index.path}: the record at byte {offset} is damaged; reading went on at byte {behind.offset}"
        )
        offset = behind.offset


def _take(index: FileIndex, record: Record) -> None:
    try:
        if record.opcode == CONNECTION:
            _define(index, record, index.data)
        elif record.opcode == CHUNK:
            index.blocks.append(_chunk(index, record))
        elif record.opcode == INDEX and index.blocks:
            index.blocks[-1] = _indexed(index, record)
    except (struct.error, ValueError) as error:
        what = str(error) if isinstance(error, ValueError) else "is malformed"
        index.damage.append(f"{index.path}: the record at byte {record.offset} {what} and was left out")


def _chunk(index: FileIndex, record: Record) -> Block:
    """A chunk, its messages not counted. Raises struct.error or ValueError where its fields are none."""
    end = len(index.data)
    size, claimed = min(record.end, end) - record.begin, record.number(b"size")
    if not is_plausible_size(size, claimed):
        raise ValueError(f"claims to unpack from {size} to {claimed} bytes, more than is accepted,")
    name = record.text(b"compression")
    where = {"head": record.begin - record.offset, "is_cut": record.end > end}
    return Block(index.number, record.begin, size, "" if name == "none" else name, claimed, 0, 0, **where)


def _indexed(index: FileIndex, record: Record) -> Block:
    """The last chunk, with the messages of a connection that an INDEX lists."""
    block, entries = index.blocks[-1], np.frombuffer(index.data[record.begin : record.end], _ENTRY)
    if not len(entries):
        return block
    times_ns = entries["s"].astype(np.int64) * _NS + entries["ns"]
    start_ns, end_ns = int(times_ns.min()), int(times_ns.max())
    if block.counts:
        start_ns, end_ns = min(start_ns, block.start_ns), max(end_ns, block.end_ns)
    counts = block.counts | {record.number(b"conn"): len(entries)}
    return replace(block, start_ns=start_ns, end_ns=end_ns, counts=counts)


def _counted(index: FileIndex, block: Block) -> Block:
    """A chunk whose messages have been counted by unpacking it."""
    messages = messages_of(index, block)
    counts = Counter(message.channel.key[1] for message in messages)
    times_ns = [message.log_time_ns for message in messages] or [0]
    return replace(block, start_ns=min(times_ns), end_ns=max(times_ns), counts=dict(counts))


def _contents(index: FileIndex, block: Block, _: AbstractSet[int] | None) -> Contents:
    """The messages of a chunk; connections found there join the index."""
    name = f"{index.path}: the chunk at byte {block.offset}"
    messages: list[Message] = []
    undefined = offset = 0
    try:
        payload = unpack(index, block)
        while offset < len(payload):
            record = read_record(payload, offset)
            if record is None or record.end > len(payload):
                raise struct.error("record that is none, or beyond the end")
            offset = record.end
            if record.opcode == CONNECTION:
                _define(index, record, payload)
            elif record.opcode == MESSAGE:
                seconds, nanoseconds = _TIME.unpack(record.fields.get(b"time", b""))
                channel = index.channels.get(record.number(b"conn"))
                undefined += channel is None
                if channel is not None:
                    messages.append(
                        Message(channel, seconds * _NS + nanoseconds, payload[record.begin : record.end])
                    )
    except struct.error:
        damage = f"{name}: a record in it is malformed; what follows was left out"
        return Contents(messages, "" if block.is_cut else damage)
    lost = f"{name}: {counted(undefined, 'message')} of no known connection" if undefined else ""
    return Contents(messages, lost)
