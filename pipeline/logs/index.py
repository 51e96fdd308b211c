"""What lies where in an MCAP file: its blocks of messages, channels and damage, found by walking the records.

A walk reads nine bytes a record and a chunk's header, never its contents, and needs no summary: files that were
cut off or never finished are indexed like any other. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END, STATISTICS, FOOTER = 0x03, 0x04, 0x05, 0x06, 0x0F, 0x0B, 0x02
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC-32

_LARGEST_CHUNK = 1 << 30  # bytes; a size beyond is taken for damage, not believed
_LOOSE_BYTES = 1 << 20  # messages outside chunks are read in blocks of about this size


@dataclass(frozen=True, slots=True)
class Channel:
    """A stream of messages: ``key`` is unique over all files of a log."""

    key: tuple[int, int]
    topic: str
    encoding: str
    type_name: str
    schema_encoding: str


@dataclass(frozen=True, slots=True)
class Block:
    """A run of records: a chunk, or messages outside of any chunk (``compression`` empty, ``crc`` 0)."""

    file: int
    offset: int
    size: int
    compression: str
    uncompressed_size: int
    crc: int
    start_ns: int
    end_ns: int


@dataclass(slots=True)
class FileIndex:
    """Everything the walk found in one file; ``counts`` are messages by channel id, empty if nowhere written."""

    path: Path
    number: int
    data: mmap.mmap
    blocks: list[Block] = field(default_factory=list)
    schemas: dict[int, tuple[str, str]] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    has_summary: bool = False


def index_file(path: Path, number: int) -> FileIndex:
    """Walk one file, the ``number``-th of a log. Raises InputError for what is no MCAP file at all."""
    index = FileIndex(path, number, _map(path))
    walk = _Walk(index)
    offset = len(MAGIC)
    while offset + RECORD.size <= len(index.data):
        opcode, length = RECORD.unpack_from(index.data, offset)
        body = offset + RECORD.size
        if body + length > len(index.data):
            index.damage.append(f"{path}: cut off at byte {len(index.data)}, inside the record at byte {offset}")
            walk.close(offset)
            return index
        try:
            walk.take(opcode, offset, body, length)
        except (struct.error, UnicodeDecodeError):
            index.damage.append(f"{path}: the record at byte {offset} is malformed and was left out")
        offset = body + length
    walk.close(offset)
    if index.data[offset:] != MAGIC:
        index.damage.append(f"{path}: ends at byte {len(index.data)} without the closing magic; the file was cut off")
    return index


def read_schema(body: memoryview | mmap.mmap, offset: int) -> tuple[int, str, str]:
    """Id, name and encoding of the schema record whose body starts at the offset."""
    (number,) = struct.unpack_from("<H", body, offset)
    name, offset = _string(body, offset + 2)
    encoding, _ = _string(body, offset)
    return number, name, encoding


def read_channel(
    body: memoryview | mmap.mmap, offset: int, file: int, schemas: dict[int, tuple[str, str]]
) -> tuple[int, Channel]:
    """Id and channel of the channel record whose body starts at the offset."""
    number, schema = struct.unpack_from("<HH", body, offset)
    topic, offset = _string(body, offset + 4)
    encoding, _ = _string(body, offset)
    type_name, schema_encoding = schemas.get(schema, ("", ""))
    return number, Channel((file, number), topic, encoding, type_name, schema_encoding)


class _Walk:
    """Sorts records into an index; loose messages are gathered into blocks."""

    def __init__(self, index: FileIndex) -> None:
        self.index = index
        self.loose_from = -1
        self.loose_times: list[int] = []

    def take(self, opcode: int, offset: int, body: int, length: int) -> None:
        index = self.index
        if opcode == CHUNK:
            self.close(offset)
            self._chunk(body, length)
        elif opcode == MESSAGE:
            if self.loose_from < 0:
                self.loose_from = offset
            self.loose_times.append(MESSAGE_HEAD.unpack_from(index.data, body)[2])
            if body + length - self.loose_from > _LOOSE_BYTES:
                self.close(body + length)
        elif opcode == SCHEMA:
            number, name, encoding = read_schema(index.data, body)
            index.schemas[number] = (name, encoding)
        elif opcode == CHANNEL:
            number, channel = read_channel(index.data, body, index.number, index.schemas)
            index.channels[number] = channel
        elif opcode == STATISTICS:
            index.has_summary = True
            self._statistics(body)
        elif opcode in (DATA_END, FOOTER):
            self.close(offset)

    def close(self, offset: int) -> None:
        """End the block of loose messages at this byte."""
        if self.loose_times:
            size = offset - self.loose_from
            self.index.blocks.append(
                Block(
                    self.index.number, self.loose_from, size, "", size, 0,
                    min(self.loose_times), max(self.loose_times),
                )
            )  # fmt: skip
        self.loose_from, self.loose_times = -1, []

    def _chunk(self, body: int, length: int) -> None:
        index = self.index
        start_ns, end_ns, uncompressed, crc = _CHUNK_HEAD.unpack_from(index.data, body)
        compression, records = _string(index.data, body + _CHUNK_HEAD.size)
        (size,) = struct.unpack_from("<Q", index.data, records)
        offset = records + 8
        if offset + size > body + length or uncompressed > _LARGEST_CHUNK:
            index.damage.append(
                f"{index.path}: the chunk at byte {body} lies about its size "
                f"({size} bytes stored, {uncompressed} unpacked) and was left out"
            )
            return
        index.blocks.append(Block(index.number, offset, size, compression, uncompressed, crc, start_ns, end_ns))

    def _statistics(self, body: int) -> None:
        data = self.index.data
        offset = body + struct.calcsize("<QHIIIIQQ")
        (size,) = struct.unpack_from("<I", data, offset)
        for entry in range(offset + 4, offset + 4 + size, 10):
            number, count = struct.unpack_from("<HQ", data, entry)
            self.index.counts[number] = count


def _map(path: Path) -> mmap.mmap:
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    if path.is_dir():
        raise InputError(f"{path}: is a directory; name the .mcap files in it")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: is empty (0 bytes); record or copy it again")
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    if data[: len(MAGIC)] != MAGIC:
        raise InputError(
            f"{path}: is not an MCAP file (starts with {data[:8]!r}); convert it with: scanchain convert {path} OUT.mcap"
        )
    return data


def _string(data: memoryview | mmap.mmap, offset: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, offset)
    end = offset + 4 + length
    if end > len(data):
        raise struct.error("string beyond the end")
    return bytes(data[offset + 4 : end]).decode(), end
