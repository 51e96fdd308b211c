"""Index of an MCAP file: channels, blocks of messages, damage."""

from __future__ import annotations

import mmap
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

from scanchain.source import Source
from scanchain.words import counted

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 2, 3, 4, 5, 6, 7, 8
STATISTICS, DATA_END = 0x0B, 0x0F
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time

_CRC = struct.Struct("<I")
_CRC_AT = RECORD.size + 24  # of a chunk record
_LONGEST_STRING = 1 << 24  # longest name or definition in bytes; a longer one is damage

Bytes: TypeAlias = memoryview | mmap.mmap | bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A stream of messages: ``key`` (file, id) is unique over all files of a log; ``schema`` 0 means none.

    ``definition`` defines the type, in the language ``schema_encoding``.
    """

    key: tuple[int, int]
    topic: str
    encoding: str
    schema: int
    type_name: str
    schema_encoding: str
    definition: bytes = b""


class Message(NamedTuple):
    """One message: its channel, log time, and bytes; ``defect`` says why there are none."""

    channel: Channel
    log_time_ns: int
    data: memoryview
    defect: str = ""


class Contents(NamedTuple):
    """The messages of a block in the order of the file; ``damage`` describes what is missing behind them."""

    messages: list[Message]
    damage: str


class Entry(NamedTuple):
    """Number of a channel's messages in a chunk; their (log time, offset) pairs lie at byte ``offset``."""

    channel: int
    offset: int
    messages: int


@dataclass(frozen=True, slots=True)
class Block:
    """A run of records: a chunk, or messages outside of any chunk.

    Attributes
    ----------
    file, offset, size : where its bytes lie; ``is_cut`` where the file ends inside them
    compression, uncompressed_size, crc : as the chunk states; crc 0 means unchecked, None that the chunk's head
        has to be read for it
    start_ns, end_ns : log time of the first and last message
    entries : the channels in it; empty where the file does not state them
    """

    file: int
    offset: int
    size: int
    compression: str
    uncompressed_size: int
    crc: int | None
    start_ns: int
    end_ns: int
    entries: tuple[Entry, ...] = ()
    is_chunk: bool = True
    is_cut: bool = False

    @property
    def chunk_offset(self) -> int:
        """Offset of a chunk's record, its head included."""
        return self.offset - (_CRC_AT + 16 + len(self.compression) if self.is_chunk else 0)

    @property
    def may_be_empty(self) -> bool:
        """True if its times are those that writers give a chunk without any message."""
        return (self.start_ns == self.end_ns == 0 and not self.entries) or self.start_ns > self.end_ns


@dataclass(slots=True)
class FileIndex:
    """Index of one file.

    Attributes
    ----------
    number : its place among the files of the log
    data : the bytes of an MCAP file; ``fetch`` reads those of a remote one, by offset and size; of another
        format ``make`` makes the contents of a block, of all channels or of those wanted
    counts : messages by channel id; ``is_counted`` once they are complete
    uncertain_channels : those of a summary that was not accepted, for channels defined nowhere else
    is_consistent : whether the channels that blocks state were checked
    """

    path: Source
    number: int
    data: mmap.mmap | bytes
    fetch: Callable[[int, int], bytes] | None = None
    make: Callable[[Block, AbstractSet[int] | None], Contents] | None = None
    blocks: list[Block] = field(default_factory=list)
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    is_counted: bool = False
    takes_rate: bool = False
    is_consistent: bool = True
    uncertain_channels: dict[int, Channel] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def stored(self, block: Block) -> tuple[memoryview, int]:
        """A block's bytes as the file holds them, and the CRC-32 of the unpacked bytes, 0 for unchecked."""
        if block.crc is not None:
            return self.bytes_at(block.offset, block.size), block.crc
        head = block.offset - block.chunk_offset
        record = self.bytes_at(block.chunk_offset, head + block.size)
        return record[head:], _CRC.unpack_from(record, _CRC_AT)[0]

    def bytes_at(self, offset: int, size: int) -> memoryview:
        """A part of an MCAP file, wherever it lies."""
        if self.fetch is not None:
            return memoryview(self.fetch(offset, size))
        return memoryview(self.data)[offset : offset + size]

    def add_schema(self, body: Bytes, offset: int) -> None:
        """Take in the schema record whose body starts at the offset."""
        (number,) = struct.unpack_from("<H", body, offset)
        (name, encoding, definition), _ = read_strings(body, offset + 2, 3)
        self.schemas[number] = (name.decode(), encoding.decode(), definition)

    def add_channel(self, body: Bytes, offset: int) -> None:
        """Take in the channel record whose body starts at the offset; one that is fully known stays."""
        number, schema = struct.unpack_from("<HH", body, offset)
        if not self.knows(number):
            (topic, encoding), _ = read_strings(body, offset + 4, 2)
            known = self.schemas.get(schema, ("", "", b""))
            key = (self.number, number)
            self.channels[number] = Channel(key, topic.decode(), encoding.decode(), schema, *known)

    def numbers_of(self, topic: str) -> list[int]:
        """Ids of the channels of a topic."""
        return [number for number, channel in self.channels.items() if channel.topic == topic]

    def indexed_counts(self) -> Counter[int]:
        """Messages by channel id, as the blocks state them."""
        counts = Counter[int]()
        for entry in (entry for block in self.blocks for entry in block.entries):
            counts[entry.channel] += entry.messages
        return counts

    def may_hold(self, block: Block, channels: AbstractSet[int]) -> bool:
        """True if a block can have messages of the channels."""
        if not self.is_consistent or not block.entries:
            return True
        return any(entry.channel in channels for entry in block.entries)

    def note_damage(self, line: str) -> None:
        """Note a line once, however often the damage is met."""
        if line not in self.damage:
            self.damage.append(line)

    def knows(self, number: int) -> bool:
        """True if the channel and its schema are in the index."""
        channel = self.channels.get(number)
        return channel is not None and (channel.schema == 0 or channel.type_name != "")


def records_of(data: memoryview | bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode of each record, begin and end of its body. Raises struct.error for one beyond the end."""
    offset = 0
    while offset < len(data):
        opcode, length = RECORD.unpack_from(data, offset)
        begin, offset = offset + RECORD.size, offset + RECORD.size + length
        if offset > len(data):
            raise struct.error("record beyond the end")
        yield opcode, begin, offset


def read_strings(data: Bytes, offset: int, count: int) -> tuple[list[bytes], int]:
    """Strings with their lengths before them, and the byte behind the last."""
    strings = []
    for _ in range(count):
        begin = offset + 4
        offset = begin + struct.unpack_from("<I", data, offset)[0]
        if offset > min(len(data), begin + _LONGEST_STRING):
            raise struct.error("string beyond the end")
        strings.append(bytes(data[begin:offset]))
    return strings, offset


def name_of(indexes: Sequence[FileIndex]) -> str:
    """Name of a log's files in errors: all of two, of more the first and the number of the others."""
    paths = [str(index.path) for index in indexes]
    shown = f"{paths[0]} and {len(paths) - 1} more files" if len(paths) > 2 else " and ".join(paths)
    return f"{shown}, read as one log" if len(paths) > 1 else shown


def damage_of(indexes: Sequence[FileIndex]) -> str:
    """Damage of a log as the end of an error that it may explain; empty where there is none."""
    damage = [line for index in indexes for line in index.damage]
    return f"; it is damaged in {counted(len(damage), 'place')}, the first: {damage[0]}" if damage else ""
