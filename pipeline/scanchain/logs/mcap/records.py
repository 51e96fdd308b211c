"""Records of MCAP files: their heads, the schemas and channels they define, the messages of a block.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
from collections.abc import Set as AbstractSet
from io import BytesIO

import mcap.records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from scanchain.errors import counted
from scanchain.logs.index import Block, Channel, Contents, FileIndex, Message, name_of_block, unpack

RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_HEAD = struct.Struct("<BQQQQII")  # record, start, end, uncompressed size, CRC-32, length of a name
MALFORMED = (McapError, struct.error, UnicodeDecodeError)  # raised for bytes that are no record
_MOST_TRAILING = 256  # bytes allowed after a definition; more indicate another record with a damaged opcode


def definition(opcode: int, body: bytes) -> mcap.records.Schema | mcap.records.Channel:
    """Schema or channel defined by a record. Raises one of MALFORMED."""
    stream = ReadDataStream(BytesIO(body))
    record = (mcap.records.Schema if opcode == Opcode.SCHEMA else mcap.records.Channel).read(stream)
    if stream.count + _MOST_TRAILING < len(body):
        raise struct.error("definition of another length than its record")
    return record


def define(index: FileIndex, record: mcap.records.Schema | mcap.records.Channel) -> None:
    """Add a schema or a channel to the index; a channel that is fully known is not replaced."""
    if isinstance(record, mcap.records.Schema):
        index.schemas[record.id] = (record.name, record.encoding, record.data)
    elif not index.knows(record.id):
        schema = index.schemas.get(record.schema_id, ("", "", b""))
        key = (index.number, record.id)
        index.channels[record.id] = Channel(key, record.topic, record.message_encoding, record.schema_id, *schema)


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
