"""Index of a remote MCAP file from its summary alone: two or three requests.

A file whose summary is absent, damaged, or does not give the position of every message has to be walked, which
takes all its bytes. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator

from scanchain.logs.files import RemoteFile
from scanchain.logs.mcap.index import FOOTER_BODY, is_plausible_size
from scanchain.logs.mcap.read_ahead import ReadAhead
from scanchain.logs.mcap.records import (
    CHANNEL,
    CHUNK_INDEX,
    FOOTER,
    MAGIC,
    RECORD,
    SCHEMA,
    STATISTICS,
    Block,
    Entry,
    FileIndex,
    read_string,
)

_TAIL_BYTES = 65_536  # number of bytes read at first; most summaries lie in it
_FOOTER_BYTES = RECORD.size + FOOTER_BODY.size
_CHUNK_INDEX_HEAD = struct.Struct("<QQQQI")  # start, end, offset and length of the chunk, bytes of the map
_INDEX_OFFSET = struct.Struct("<HQ")  # channel, offset of its message index record
_SIZES = struct.Struct("<QQ")  # compressed, uncompressed
_ENTRY_HEAD = RECORD.size + 6  # of a message index record, before its pairs of 16 bytes
_COUNT = struct.Struct("<HQ")


def index_by_summary(file: RemoteFile, number: int) -> FileIndex | None:
    """Index by a file's summary, the ``number``-th of a log; None where that is incomplete."""
    try:
        summary = _summary(file)
        return None if summary is None else _index(file, number, summary)
    except (struct.error, UnicodeDecodeError):
        return None


def _summary(file: RemoteFile) -> bytes | None:
    """The records of the summary section, None where there is none or its CRC is wrong."""
    tail_at = max(file.size - _TAIL_BYTES, 0)
    tail = file.read(tail_at, file.size - tail_at)
    footer_at = file.size - len(MAGIC) - _FOOTER_BYTES
    footer = tail[footer_at - tail_at :] if footer_at >= tail_at else b""
    if not footer.endswith(MAGIC) or footer[0] != FOOTER:
        return None
    begin, _, crc = FOOTER_BODY.unpack_from(footer, RECORD.size)
    if not 0 < begin <= footer_at:
        return None
    summary = tail[begin - tail_at :] if begin >= tail_at else file.read(begin, tail_at - begin) + tail
    checked = len(summary) - len(MAGIC) - 4
    return summary[: footer_at - begin] if not crc or zlib.crc32(summary[:checked]) == crc else None


def _index(file: RemoteFile, number: int, summary: bytes) -> FileIndex | None:
    index = FileIndex(file.address, number, b"", ReadAhead(file.read))
    chunks_stated = -1
    for opcode, body in _records(summary):
        if opcode == SCHEMA:
            index.add_schema(summary, body)
        elif opcode == CHANNEL:
            index.add_channel(summary, body)
        elif opcode == CHUNK_INDEX:
            index.blocks.append(_block(number, summary, body))
        elif opcode == STATISTICS:
            chunks_stated, index.counts = _statistics(summary, body)
            index.is_counted = True
    index.blocks.sort(key=lambda block: block.offset)
    return index if _is_complete(index, file.size, chunks_stated) else None


def _records(summary: bytes) -> Iterator[tuple[int, int]]:
    """Opcode and first byte of the body of each record. Raises struct.error for one that is cut off."""
    offset = 0
    while offset < len(summary):
        opcode, length = RECORD.unpack_from(summary, offset)
        yield opcode, offset + RECORD.size
        offset += RECORD.size + length
    if offset > len(summary):
        raise struct.error("record beyond the end")


def _block(number: int, summary: bytes, body: int) -> Block:
    """A chunk; its number of messages of a channel follows from the offset of the next message index."""
    start_ns, end_ns, chunk, length, size = _CHUNK_INDEX_HEAD.unpack_from(summary, body)
    at = body + _CHUNK_INDEX_HEAD.size
    stated = [_INDEX_OFFSET.unpack_from(summary, place) for place in range(at, at + size, _INDEX_OFFSET.size)]
    (indexed,) = struct.unpack_from("<Q", summary, at + size)
    compression, at = read_string(summary, at + size + 8)
    compressed, uncompressed = _SIZES.unpack_from(summary, at)
    offsets = sorted((offset, channel) for channel, offset in stated)
    ends = [*(offset for offset, _ in offsets[1:]), chunk + length + indexed]
    entries = tuple(
        Entry(channel, offset + _ENTRY_HEAD, (end - offset - _ENTRY_HEAD) // 16)
        for (offset, channel), end in zip(offsets, ends[: len(offsets)], strict=True)
    )
    entries = tuple(entry for entry in entries if entry.messages)
    payload = chunk + length - compressed
    return Block(number, payload, compressed, compression, uncompressed, None, start_ns, end_ns, entries)


def _statistics(summary: bytes, body: int) -> tuple[int, dict[int, int]]:
    """Number of chunks, and of messages by channel."""
    (chunks,) = struct.unpack_from("<I", summary, body + 22)
    (size,) = struct.unpack_from("<I", summary, body + 42)
    return chunks, dict(_COUNT.unpack_from(summary, at) for at in range(body + 46, body + 46 + size, _COUNT.size))


def _is_complete(index: FileIndex, size: int, chunks_stated: int) -> bool:
    """True if every chunk lies in the file, has a plausible size, and no message lies elsewhere."""
    if chunks_stated != len(index.blocks) or any(block.chunk_offset < 0 for block in index.blocks):
        return False
    if any(
        block.offset + block.size > size or not is_plausible_size(block.size, block.uncompressed_size)
        for block in index.blocks
    ):
        return False
    totals: Counter[int] = Counter()
    for block in index.blocks:
        totals.update({entry.channel: entry.messages for entry in block.entries})
    index.is_consistent = dict(totals) == {channel: count for channel, count in index.counts.items() if count}
    return index.is_consistent or not all(block.entries for block in index.blocks)
