"""The messages of a block: decompressed, checked and cut apart."""

from __future__ import annotations

import bz2
import mmap
import struct
import zlib
from collections.abc import Set as AbstractSet
from io import BytesIO

import lz4.frame
import zstandard

from scanchain.errors import one_line
from scanchain.logs.mcap.records import (
    CHANNEL,
    MESSAGE,
    MESSAGE_HEAD,
    SCHEMA,
    Block,
    Contents,
    FileIndex,
    Message,
    records_of,
)
from scanchain.words import counted


class DamagedBlockError(Exception):
    """A block whose contents cannot be trusted; the message says which and why."""


def read_block(index: FileIndex, block: Block, wanted: AbstractSet[int] | None = None) -> Contents:
    """The messages of a block, of all channels or of those wanted; channels found there join the index.

    Raises DamagedBlockError where a whole block does not unpack to what its header says.
    """
    if index.make is not None:
        return index.make(block, wanted)
    payload = unpack(index, block)
    messages: list[Message] = []
    met = undefined = 0
    try:
        for opcode, begin, end in records_of(payload):
            if opcode == SCHEMA:
                index.add_schema(payload, begin)
            elif opcode == CHANNEL:
                index.add_channel(payload, begin)
            elif opcode == MESSAGE:
                number, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(payload, begin)
                met += 1
                channel = index.channels.get(number)
                undefined += channel is None
                if channel is not None and (wanted is None or number in wanted):
                    messages.append(Message(channel, log_time_ns, payload[begin + MESSAGE_HEAD.size : end]))
            else:
                raise struct.error("record of no kind that a chunk may hold")
    except (struct.error, UnicodeDecodeError):
        damage = "a record in it is malformed; what follows was left out"
        return Contents(messages, "" if block.is_cut else f"{_name(index, block)}: {damage}")
    stated = sum(entry.messages for entry in block.entries)
    damage = f"holds {met} of the {stated} indexed messages" if met < stated else ""
    if undefined:
        damage = f"{counted(undefined, 'message')} of a channel that nothing defines"
    return Contents(messages, damage and f"{_name(index, block)}: {damage}")


def unpack(index: FileIndex, block: Block) -> memoryview:
    """The records of a block; of one that is cut off those that are there, unchecked. Raises DamagedBlockError."""
    stored, crc = index.stored(block)
    size = block.uncompressed_size
    try:
        payload = _decompressed(stored, block.compression, size, is_cut=block.is_cut)
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError, OSError, ValueError) as error:
        if block.is_cut:
            return memoryview(b"")
        raise DamagedBlockError(
            f"{_name(index, block)}: does not unpack ({one_line(error) or type(error).__name__})"
        ) from error
    if not block.is_cut and len(payload) != size:
        raise DamagedBlockError(f"{_name(index, block)}: unpacks to {len(payload)} bytes instead of {size}")
    if not block.is_cut and crc and zlib.crc32(payload) != crc:
        raise DamagedBlockError(f"{_name(index, block)}: its CRC is wrong")
    return memoryview(payload)


def release(index: FileIndex, block: Block) -> None:
    """Release a block's bytes of the file, so that memory does not grow with what has been read."""
    if isinstance(index.data, mmap.mmap) and hasattr(index.data, "madvise"):
        begin = block.offset - block.offset % mmap.PAGESIZE
        index.data.madvise(mmap.MADV_DONTNEED, begin, block.offset + block.size - begin)


def _decompressed(stored: memoryview, compression: str, size: int, *, is_cut: bool) -> bytes | memoryview:
    """At most so many bytes; of what is cut off as many as there are."""
    if not size or compression == "":
        return stored if size else b""
    if compression == "zstd" and is_cut:
        with zstandard.ZstdDecompressor().stream_reader(BytesIO(stored)) as reader:
            return reader.read(size)
    if compression == "zstd":
        if zstandard.frame_content_size(stored) not in (-1, size):
            raise ValueError("it lies about the size it unpacks to")
        return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size)
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(stored, max_length=size)
    raise ValueError(f"compression {compression!r} is not known; none, lz4 and zstd are")


def _name(index: FileIndex, block: Block) -> str:
    return f"{index.path}: the {'chunk' if block.is_chunk else 'run of messages'} at byte {block.offset}"
