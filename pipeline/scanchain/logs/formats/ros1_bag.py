"""ROS 1 bags, complete or truncated, indexed or not; their messages are not converted.

Bags are walked record by record. The messages of a chunk are counted by the INDEX records after it if the end of
the bag states the same counts; otherwise, and in a damaged bag, by decompressing it. Where opcode and fields of a
record disagree, the fields determine its type.
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
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from scanchain.config import LogConfig
from scanchain.errors import InputError, counted
from scanchain.logs.formats import Format
from scanchain.logs.index import Block, Channel, Contents, FileIndex, Message, most_decompressed, unpack
from scanchain.logs.stream import messages_of

MAGIC = b"#ROSBAG V2.0\n"


class Op(IntEnum):
    """Opcodes of records."""

    MESSAGE = 2
    HEADER = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


Data = mmap.mmap | memoryview | bytes
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")  # seconds, nanoseconds
_COUNT = struct.Struct("<II")  # connection, number of its messages
_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])  # of an INDEX, a message
_LONGEST_HEAD = 1 << 16  # bytes; a longer head of a record is damage
_FIELDS: dict[int, bytes] = {  # a field that identifies each type of record; "count" is checked last
    Op.MESSAGE: b"time", Op.HEADER: b"index_pos", Op.CHUNK: b"compression", Op.CHUNK_INFO: b"chunk_pos",
    Op.CONNECTION: b"topic", Op.INDEX: b"count",
}  # fmt: skip
_OUTSIDE = re.compile(rb"\x04\0\0\0op=[\x05\x07]")  # opcode of a chunk, a connection
_INSIDE = re.compile(rb"\x04\0\0\0op=[\x02\x07]")  # of a chunk: opcode of a message, a connection


class Record(NamedTuple):
    """A record: its fields by name, the bytes at which it and its data begin, and its end, even after the file's.

    opcode : by the fields; the one stated in the file may differ
    """

    opcode: int
    fields: dict[bytes, bytes]
    offset: int
    begin: int
    end: int

    def number(self, name: bytes) -> int:
        """Value of an integer field. Raises struct.error if it is absent or of another size."""
        return _LENGTH.unpack(self.fields.get(name, b""))[0]

    def text(self, name: bytes) -> str:
        """Value of a text field, empty if it is absent."""
        return self.fields.get(name, b"").decode("utf-8", "replace")


def read_record(data: Data, offset: int) -> Record | None:
    """Record that begins at the offset, None if there is none."""
    begin = offset + _LENGTH.size
    length = _LENGTH.unpack_from(data, offset)[0] if begin <= len(data) else _LONGEST_HEAD + 1
    end = begin + length
    if end + _LENGTH.size > len(data) or length > _LONGEST_HEAD:
        return None
    fields = _read_fields(bytes(data[begin:end]))
    if fields is None:
        return None
    opcode = fields.get(b"op", b"\0")[0] if fields.get(b"op") else 0
    if _FIELDS.get(opcode) not in fields:
        opcode = next((each for each, name in _FIELDS.items() if name in fields), 0)
    data_begin = end + _LENGTH.size
    data_end = data_begin + _LENGTH.unpack_from(data, end)[0]
    return Record(opcode, fields, offset, data_begin, data_end) if opcode else None


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


def read_records(
    data: Data, offset: int, opcodes: re.Pattern[bytes], gaps: list[tuple[int, int]]
) -> Iterator[Record]:
    """Successive records; damaged ranges are added to ``gaps``, and reading resumes at the next match."""
    record = read_record(data, offset)
    while offset < len(data):
        following = None if record is None else read_record(data, record.end)
        if record is not None and (following is not None or record.end == len(data)):
            yield record
            offset, record = record.end, following
            continue
        resumed = next_record(data, offset, offset if record is None else record.end, opcodes)
        limit = len(data) if resumed is None else resumed.offset
        if record is not None and (record.end <= limit or (resumed is None and record.opcode == Op.CHUNK)):
            yield record
        gaps.append((offset, limit))
        offset, record = limit, resumed


def next_record(data: Data, offset: int, stated_end: int, opcodes: re.Pattern[bytes]) -> Record | None:
    """The first record after the offset whose opcode matches; None where there is none.

    stated_end : byte at which the damaged record ends if its length is right; connections before it are ignored,
        because chunks contain connections too
    """
    for match in opcodes.finditer(data, offset + 1):
        # a head has at most 256 bytes before its opcode
        for begin in range(match.start() - _LENGTH.size, max(offset, match.start() - 256), -1):
            record = read_record(data, begin)
            if record is None or record.begin < match.end() or record.end > len(data):
                continue
            if record.opcode != Op.CONNECTION or begin >= stated_end:
                return record
    return None


def _read_fields(head: bytes) -> dict[bytes, bytes] | None:
    """Fields of a record's header by name, None if it is not a list of fields."""
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


def index_ros1_bag(path: Path, number: int, _: LogConfig) -> FileIndex:
    """Index of a bag. Raises InputError for one that is empty, encrypted or of an old version."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{path}: is a bag of an old version; convert it with rosbag migrate")
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    index = FileIndex(path, number, data)
    index.contents = _contents
    head = read_record(data, len(MAGIC))
    if head is not None and head.text(b"encryptor"):
        raise InputError(f"{path}: is encrypted ({head.text(b'encryptor')}); decrypt it first")
    stated = _walk(index)
    chunks = 0 if head is None else int.from_bytes(head.fields.get(b"chunk_count", b""), "little")
    if len(index.blocks) < max(chunks, len(stated)):
        index.damage.append(f"{path}: has {len(index.blocks)} of {counted(max(chunks, len(stated)), 'chunk')}")
    _count(index, stated)
    index.counts = dict(index.indexed_counts())
    index.channels = {number: c for number, c in index.channels.items() if index.counts.get(number)}
    return index


def _walk(index: FileIndex) -> dict[int, dict[int, int]]:
    """Add chunks and connections to the index; return the message counts that the end of the bag states.

    They are by the byte where a chunk begins, then by connection.
    """
    gaps: list[tuple[int, int]] = []
    stated: dict[int, dict[int, int]] = {}
    for record in read_records(index.data, len(MAGIC), _OUTSIDE, gaps):
        try:
            if record.fields.get(b"op") != bytes([record.opcode]):
                name = f"{index.path}: the record at byte {record.offset}"
                index.damage.append(f"{name} has an opcode that contradicts its fields; it is read by the fields")
            _add_record(index, record, stated)
        except (struct.error, ValueError) as error:
            what = str(error) if isinstance(error, ValueError) else "is malformed"
            index.damage.append(f"{index.path}: the record at byte {record.offset} {what}; it is skipped")
    for begin, end in gaps:
        cut = f"{index.path}: truncated, or damaged to its end, at byte {begin}"
        resumed = f"{index.path}: the record at byte {begin} is damaged; reading resumes at byte {end}"
        index.damage.append(cut if end == len(index.data) else resumed)
    return stated


def _add_record(index: FileIndex, record: Record, stated: dict[int, dict[int, int]]) -> None:
    """Add a record to the index. Raises struct.error or ValueError if it is malformed."""
    if record.opcode == Op.CONNECTION:
        _define(index, record, index.data)
    elif record.opcode == Op.CHUNK:
        index.blocks.append(_chunk(index, record))
    elif record.opcode == Op.INDEX and index.blocks:
        index.blocks[-1] = _indexed(index, record)
    elif record.opcode == Op.CHUNK_INFO:
        counts = _COUNT.iter_unpack(index.data[record.begin : record.end])
        begin = int.from_bytes(record.fields[b"chunk_pos"], "little")
        stated[begin] = {connection: count for connection, count in counts if count}


def _count(index: FileIndex, stated: dict[int, dict[int, int]]) -> None:
    """Count messages by decompressing chunks whose INDEX records are absent or contradict the end of the bag.

    In a damaged bag these are all chunks. If an undamaged bag states no counts at its end, all chunks are read for
    any topic.
    """
    is_undamaged = not index.damage
    index.is_consistent = bool(stated) or not is_undamaged
    for place, block in enumerate(index.blocks):
        begin = block.offset - block.head
        is_contradicted = bool(stated) and stated.get(begin) != block.counts
        if is_contradicted and is_undamaged:
            name = f"{index.path}: the chunk at byte {begin}"
            index.damage.append(f"{name} has a damaged index; its messages are counted by decompressing it")
        if is_contradicted or not (is_undamaged and block.counts):
            index.blocks[place] = _counted(index, block)


def _chunk(index: FileIndex, record: Record) -> Block:
    """Block of a chunk, its messages not yet counted. Raises struct.error or ValueError if it is malformed."""
    end = len(index.data)
    size, claimed = min(record.end, end) - record.begin, record.number(b"size")
    if claimed > most_decompressed(size):
        raise ValueError(f"states that its {size} bytes decompress to {claimed} bytes, more than is accepted")
    name = record.text(b"compression")
    where = {"head": record.begin - record.offset, "is_cut": record.end > end}
    return Block(index.number, record.begin, size, "" if name == "none" else name, claimed, 0, 0, **where)


def _indexed(index: FileIndex, record: Record) -> Block:
    """Block of the last chunk, updated by the messages of a connection that an INDEX record lists."""
    block, entries = index.blocks[-1], np.frombuffer(index.data[record.begin : record.end], _ENTRY)
    if not len(entries):
        return block
    times_ns = entries["s"].astype(np.int64) * 1_000_000_000 + entries["ns"]
    start_ns, end_ns = int(times_ns.min()), int(times_ns.max())
    if block.counts:
        start_ns, end_ns = min(start_ns, block.start_ns), max(end_ns, block.end_ns)
    counts = block.counts | {record.number(b"conn"): len(entries)}
    return replace(block, start_ns=start_ns, end_ns=end_ns, counts=counts)


def _counted(index: FileIndex, block: Block) -> Block:
    """Block of a chunk whose messages have been counted by decompressing it."""
    messages = messages_of(index, block)
    counts = Counter(message.channel.key[1] for message in messages)
    times_ns = [message.log_time_ns for message in messages] or [0]
    return replace(block, start_ns=min(times_ns), end_ns=max(times_ns), counts=dict(counts))


def _contents(index: FileIndex, block: Block, _: AbstractSet[int] | None) -> Contents:
    """Messages of a chunk; connections found in it are added to the index."""
    name = f"{index.path}: the chunk at byte {block.offset}"
    messages: list[Message] = []
    read = Counter[int]()
    gaps: list[tuple[int, int]] = []
    undefined = malformed = 0
    payload = unpack(index, block)
    for record in read_records(payload, 0, _INSIDE, gaps):
        try:
            if record.opcode == Op.CONNECTION:
                _define(index, record, payload)
            elif record.opcode == Op.MESSAGE:
                seconds, nanoseconds = _TIME.unpack(record.fields.get(b"time", b""))
                number = record.number(b"conn")
                read[number] += 1
                channel = index.channels.get(number)
                undefined += channel is None
                if channel is not None:
                    messages.append(
                        Message(channel, seconds * 1_000_000_000 + nanoseconds, payload[record.begin : record.end])
                    )
        except struct.error:
            malformed += 1
    lost = sum(max(count - read[number], 0) for number, count in block.counts.items())
    if (malformed or gaps) and not block.is_cut:
        return Contents(messages, f"{name}: malformed records in it are skipped")
    if undefined:
        return Contents(messages, f"{name}: {counted(undefined, 'message')} of an unknown connection")
    return Contents(messages, f"{name}: {counted(lost, 'indexed message')} missing in it" if lost else "")


FORMAT = Format(
    "ros1", "a ROS 1 .bag", lambda _, head: head.startswith(b"#ROSBAG"), index_ros1_bag, (".bag",), "parts"
)
