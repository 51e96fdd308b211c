"""The records of a ROS 1 bag, each a head of named fields and some data, and where one begins behind damage.

Format: https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from scanchain.logs.mcap.records import Channel

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7

T = TypeVar("T", int, NDArray[np.int64])
Data = mmap.mmap | memoryview | bytes

_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")  # seconds, nanoseconds
_LONGEST_HEAD = 1 << 16  # bytes; a longer one is damage
_OPCODE = re.compile(rb"\x04\0\0\0op=[\x04\x05\x07]")  # of an index, a chunk, a connection
_MOST_BEFORE = 256  # bytes of a head before its opcode


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
    told = _read_fields(bytes(data[record.begin : record.end]))
    if told is None or b"message_definition" not in told:
        raise struct.error("connection without its fields")
    number = record.number(b"conn")
    topic, type_name = record.text(b"topic"), told.get(b"type", b"").decode("utf-8", "replace")
    definition = told[b"message_definition"]
    return Channel((file, number), topic, "ros1", number + 1, type_name, "ros1msg", definition)


def whole_records(data: Data) -> Iterator[Record]:
    """One record after the other. Raises struct.error where what follows is none, or not all of one."""
    offset = 0
    while offset < len(data):
        record = read_record(data, offset)
        if record is None or record.end > len(data):
            raise struct.error("record that is none, or beyond the end")
        yield record
        offset = record.end


def next_record(data: Data, offset: int, believed: int) -> Record | None:
    """The first record behind the offset that may stand outside of a chunk; None where there is none.

    believed : byte at which the damaged record ends if it tells the truth; no connection before it is taken, as
        chunks hold such too
    """
    for match in _OPCODE.finditer(data, offset + 1):
        for begin in range(match.start() - _LENGTH.size, max(offset, match.start() - _MOST_BEFORE), -1):
            record = read_record(data, begin)
            if record is None or record.begin < match.end() or record.end > len(data):
                continue
            if record.opcode != CONNECTION or begin >= believed:
                return record
    return None


def _read_fields(head: bytes) -> dict[bytes, bytes] | None:
    """The fields of a head by name, None where it is not made of fields."""
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
    """Where the bytes lie that have their length before them."""
    if offset + _LENGTH.size > len(data):
        return None
    begin = offset + _LENGTH.size
    return _Span(begin, begin + _LENGTH.unpack_from(data, offset)[0])
