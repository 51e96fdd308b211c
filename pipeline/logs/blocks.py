"""The messages of a block: decompressed, checked and cut apart."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import lz4.frame
import zstandard

from pipeline.logs.index import (
    CHANNEL,
    MESSAGE,
    MESSAGE_HEAD,
    RECORD,
    SCHEMA,
    Block,
    Channel,
    FileIndex,
    read_channel,
    read_schema,
)


class DamagedBlockError(Exception):
    """A block whose contents cannot be trusted; the message says which and why."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message: its channel, when it was logged, and its bytes."""

    channel: Channel
    log_time_ns: int
    data: memoryview


def read_block(index: FileIndex, block: Block) -> list[Message]:
    """All messages of a block, in the order of the file; channels met on the way join the index.

    Raises DamagedBlockError where the block does not unpack to what its header says.
    """
    payload = memoryview(_unpack(index, block))
    messages: list[Message] = []
    offset, end = 0, len(payload)
    while offset + RECORD.size <= end:
        opcode, length = RECORD.unpack_from(payload, offset)
        offset += RECORD.size
        if offset + length > end:
            raise DamagedBlockError(f"{_name(index, block)}: a record reaches beyond the end of it")
        if opcode == MESSAGE:
            number, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(payload, offset)
            channel = index.channels.get(number)
            if channel is None:
                raise DamagedBlockError(f"{_name(index, block)}: a message names channel {number}, which is unknown")
            messages.append(
                Message(channel, log_time_ns, payload[offset + MESSAGE_HEAD.size : offset + length])
            )
        elif opcode == SCHEMA:
            number, name, encoding = read_schema(payload, offset)
            index.schemas.setdefault(number, (name, encoding))
        elif opcode == CHANNEL:
            number, channel = read_channel(payload, offset, index.number, index.schemas)
            index.channels.setdefault(number, channel)
        offset += length
    return messages


def _unpack(index: FileIndex, block: Block) -> bytes:
    stored = index.data[block.offset : block.offset + block.size]
    try:
        if block.compression == "zstd":
            payload = zstandard.ZstdDecompressor().decompress(stored, max_output_size=block.uncompressed_size)
        elif block.compression == "lz4":
            payload = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=block.uncompressed_size)
        elif block.compression == "":
            payload = stored
        else:
            raise DamagedBlockError(f"{_name(index, block)}: compression {block.compression!r} is not known")
    except (zstandard.ZstdError, RuntimeError) as error:
        raise DamagedBlockError(f"{_name(index, block)}: does not unpack ({error})") from error
    if len(payload) != block.uncompressed_size:
        raise DamagedBlockError(
            f"{_name(index, block)}: unpacks to {len(payload)} bytes instead of {block.uncompressed_size}"
        )
    if block.crc and zlib.crc32(payload) != block.crc:
        raise DamagedBlockError(f"{_name(index, block)}: its CRC is wrong")
    return payload


def _name(index: FileIndex, block: Block) -> str:
    return f"{index.path}: the chunk at byte {block.offset}"
