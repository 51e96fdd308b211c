"""Record boundaries of an MCAP file, and resynchronization behind damage."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Set as AbstractSet

import numpy as np

from scanchain.logs.mcap.records import CHANNEL, CHUNK, FOOTER, MAGIC, MESSAGE, MESSAGE_INDEX, RECORD, SCHEMA

ATTACHMENT = 9
PRIVATE = 0x80  # opcodes from here on are those of applications
CHUNK_HEAD = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC-32

_LEAST_BYTES = (0, 8, 20, 14, 16, 22, 40, 6, 64, 36, 48, 46, 8, 20, 17, 4)  # of a record's body, by opcode
_FIXED = {FOOTER, 14, 15}  # opcodes of records of exactly that size: footer, summary offset, end of data
_PARTS = {  # fixed bytes, then parts behind their length
    1: (0, 2), 3: (2, 3), 4: (4, 3), 8: (32, 1), 9: (16, 2), 10: (40, 2), 11: (42, 1), 12: (0, 2), 13: (16, 1),
}  # fmt: skip
_MOST_BEHIND = 256  # bytes behind these; a longer rest is that of another record with a damaged opcode
_COMPRESSIONS = 64  # bytes; no name of a compression is longer
_COMPRESSED = (b"\4\0\0\0zstd", b"\3\0\0\0lz4")
_ANY = frozenset(range(1, len(_LEAST_BYTES)))
_OUTSIDE_CHUNKS = _ANY - {SCHEMA, CHANNEL, MESSAGE}  # of a file that keeps its messages in chunks
_WINDOW = 1 << 20  # bytes searched at once


def record_end(data: mmap.mmap | bytes, offset: int) -> int:
    """The byte behind the record at ``offset``; 0 where there is none, or not all of one."""
    if offset + RECORD.size > len(data):
        return 0
    opcode, length = RECORD.unpack_from(data, offset)
    end = offset + RECORD.size + length
    if end > len(data) or opcode >= PRIVATE:
        return end if end <= len(data) else 0
    least = _LEAST_BYTES[opcode] if opcode in _ANY else len(data)
    if length < least or (opcode in _FIXED and length > least) or not _has_parts(data, offset, end):
        return 0
    return end if states_length_twice(data, offset) or opcode not in (CHUNK, MESSAGE_INDEX) else 0


def states_length_twice(data: mmap.mmap | bytes, offset: int) -> bool:
    """True if the record at ``offset`` states its length twice, and both agree."""
    opcode, length = RECORD.unpack_from(data, offset)
    body = offset + RECORD.size
    if opcode == MESSAGE_INDEX:
        return length >= 6 and struct.unpack_from("<I", data, body + 2)[0] == length - 6
    if opcode != CHUNK or length < CHUNK_HEAD.size + 12:
        return opcode == FOOTER
    (name,) = struct.unpack_from("<I", data, body + CHUNK_HEAD.size)
    size_at = CHUNK_HEAD.size + 4 + name
    if name > _COMPRESSIONS or size_at + 8 > length:
        return False
    return struct.unpack_from("<Q", data, body + size_at)[0] == length - size_at - 8


def sought_behind(data: mmap.mmap | bytes, offset: int) -> AbstractSet[int]:
    """Opcodes of the records that are searched behind damage.

    No message is searched outside of the chunks of a file that has them: what is left of a damaged chunk,
    unchecked, is not taken for messages.
    """
    begun = any(_begins_chunk(data, at) for at in (offset, record_end(data, offset)))
    return _OUTSIDE_CHUNKS if begun or next_record(data, len(MAGIC), {CHUNK, MESSAGE_INDEX}) else _ANY


def next_record(data: mmap.mmap | bytes, offset: int, sought: AbstractSet[int]) -> int:
    """The first byte from ``offset`` on at which a record begins that others follow; 0 where there is none."""
    for begin in range(offset, len(data) - RECORD.size, _WINDOW):
        window = np.frombuffer(data, np.uint8, min(_WINDOW + 8, len(data) - begin), begin)
        opcodes, high = window[:-8], (window[6:-2] | window[7:-1] | window[8:])
        likely = np.flatnonzero((opcodes > 0) & (opcodes < len(_LEAST_BYTES)) & (high == 0))
        for candidate in (begin + likely).tolist():
            if data[candidate] in sought and _is_start(data, candidate):
                return candidate
    return 0


def is_end(data: mmap.mmap | bytes, offset: int) -> bool:
    """True if only the closing magic is left."""
    return offset == len(data) - len(MAGIC) and data[offset:] == MAGIC


def _has_parts(data: mmap.mmap | bytes, offset: int, end: int) -> bool:
    """True if the strings and other parts that a record begins with end inside it, and near its end."""
    if data[offset] not in _PARTS:
        return True
    fixed, count = _PARTS[data[offset]]
    at = offset + RECORD.size + fixed
    for _ in range(count):
        if at + 4 > end:
            return False
        at += 4 + struct.unpack_from("<I", data, at)[0]
    if data[offset] == ATTACHMENT and at + 8 <= end:
        at += 8 + struct.unpack_from("<Q", data, at)[0]
    return at <= end <= at + _MOST_BEHIND


def _begins_chunk(data: mmap.mmap | bytes, offset: int) -> bool:
    """True if a compressed chunk, maybe cut off, begins here."""
    name = offset + RECORD.size + CHUNK_HEAD.size
    return data[offset : offset + 1] == bytes([CHUNK]) and data[name : name + 8].startswith(_COMPRESSED)


def _is_start(data: mmap.mmap | bytes, offset: int) -> bool:
    end = record_end(data, offset)
    return end > 0 and (states_length_twice(data, offset) or is_end(data, end) or record_end(data, end) > 0)
