"""Index of a log file of any format: its channels, blocks of messages, damage; and the messages of a block."""

from __future__ import annotations

import bz2
import mmap
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple

import lz4.frame
import zstandard

from scanchain.errors import counted, one_line, printable
from scanchain.files import Source


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of messages; its texts are made printable.

    key : number of the file and id of the channel in it, unique over all files of a log
    schema : id of the schema, 0 if there is none; ``definition`` is its text in the language ``schema_encoding``
    """

    key: tuple[int, int]
    topic: str
    encoding: str
    schema: int
    type_name: str
    schema_encoding: str
    definition: bytes = b""

    def __post_init__(self) -> None:
        for name in ("topic", "encoding", "type_name"):
            object.__setattr__(self, name, printable(getattr(self, name)))


class Message(NamedTuple):
    """A serialized message; ``defect`` is the reason if it cannot be read."""

    channel: Channel
    log_time_ns: int
    data: memoryview
    defect: str = ""


class Decoded(NamedTuple):
    """A decoded message; ``value`` is a MalformedMessageError if it could not be decoded."""

    channel: Channel
    log_time_ns: int
    value: Any


class Contents(NamedTuple):
    """Messages of a block in the order of the file, and the damage after which others are missing, as text."""

    messages: list[Message]
    damage: str


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive records of a file: a chunk, or messages outside of chunks.

    file, offset, size : number of the file, and range of bytes in it; ``is_cut`` if the file ends within the range
    compression, uncompressed_size : as stated by the chunk
    start_ns, end_ns : log times of the first and last message
    counts : number of messages by channel id; empty if the file does not state them
    head : number of bytes of the chunk's record before the range; 0 for messages outside of chunks
    """

    file: int
    offset: int
    size: int
    compression: str
    uncompressed_size: int
    start_ns: int
    end_ns: int
    counts: dict[int, int] = field(default_factory=dict)
    head: int = 0
    is_cut: bool = False

    @property
    def may_be_empty(self) -> bool:
        """True if its times are those that writers state for a chunk without messages."""
        return (self.start_ns == self.end_ns == 0 and not self.counts) or self.start_ns > self.end_ns


@dataclass(slots=True)
class FileIndex:
    """Index of one file.

    number : its index among the files of the log
    data : its bytes, if blocks are ranges of them; ``fetch`` reads those of a remote file, by offset and size
    contents : contents of a block of the index, at least for the channels wanted, None for all; set by its format
        without a reference to the index, which would keep the file open
    schemas : name, language and definition by schema id, in MCAP
    channels, counts : channels, and number of messages, by channel id; counts are empty until they are known
    is_consistent : whether the channels stated by blocks were checked
    begin_ns : log time assigned to messages logged at 0 before the first /clock; 0 if there are none
    uncertain_channels : channels of a rejected summary, for those defined nowhere else
    """

    path: Source
    number: int
    data: mmap.mmap | bytes = b""
    fetch: Callable[[int, int], bytes] | None = None
    contents: Callable[[FileIndex, Block, AbstractSet[int] | None], Contents] = field(init=False)
    blocks: list[Block] = field(default_factory=list)
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    is_consistent: bool = True
    begin_ns: int = 0
    uncertain_channels: dict[int, Channel] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def bytes_at(self, offset: int, size: int) -> memoryview:
        """A range of the bytes of a local or remote file."""
        if self.fetch is not None:
            return memoryview(self.fetch(offset, size))
        return memoryview(self.data)[offset : offset + size]

    def numbers_of(self, *topics: str) -> set[int]:
        """Ids of the channels of the topics."""
        return {number for number, channel in self.channels.items() if channel.topic in topics}

    def indexed_counts(self) -> Counter[int]:
        """Number of messages by channel id, as stated by the blocks."""
        counts = Counter[int]()
        for block in self.blocks:
            counts.update(block.counts)
        return counts

    def may_hold(self, block: Block, channels: AbstractSet[int]) -> bool:
        """True if a block may contain messages of the channels."""
        return not self.is_consistent or not block.counts or not channels.isdisjoint(block.counts)

    def add_damage(self, line: str) -> None:
        """Add a line on damage unless it is there already."""
        if line not in self.damage:
            self.damage.append(line)

    def knows(self, number: int) -> bool:
        """True if the channel and its schema are in the index."""
        channel = self.channels.get(number)
        return channel is not None and (channel.schema == 0 or channel.type_name != "")


def most_decompressed(size: int) -> int:
    """Largest accepted decompressed size of a chunk or message of ``size`` bytes; more indicates damage."""
    return min(max(1 << 25, 20 * size), 1 << 30)


def most_decompressed_file(size: int) -> int:
    """Largest accepted decompressed size of a file of ``size`` bytes; more indicates another kind of file."""
    return (1 << 25) + 200 * size


class DamagedBlockError(Exception):
    """A block that cannot be read reliably; the text names it and the reason."""


def read_block(index: FileIndex, block: Block, wanted: AbstractSet[int] | None = None) -> Contents:
    """Contents of a block, of the wanted channels or of all; channels defined in it are added to the index.

    Raises DamagedBlockError if a complete block does not decompress to what its header states.
    """
    messages, damage = index.contents(index, block, wanted)
    messages = [each for each in messages if wanted is None or each.channel.key[1] in wanted]
    if index.begin_ns:
        messages = [each._replace(log_time_ns=each.log_time_ns or index.begin_ns) for each in messages]
    return Contents(messages, damage)


def unpack(index: FileIndex, block: Block, stated_crc: Callable[[memoryview], int] = lambda _: 0) -> memoryview:
    """Decompressed bytes of a block; of a truncated one those that remain, unchecked.

    stated_crc : CRC-32 stated by the head of a chunk's record, 0 if there is none
    Raises DamagedBlockError.
    """
    record = index.bytes_at(block.offset - block.head, block.head + block.size)
    size, crc = block.uncompressed_size, stated_crc(record) if block.head else 0
    try:
        payload = _decompressed(record[block.head :], block.compression, size, is_cut=block.is_cut)
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError, OSError, ValueError) as error:
        if block.is_cut:
            return memoryview(b"")
        raise DamagedBlockError(
            f"{name_of_block(index, block)}: cannot be decompressed ({one_line(error)})"
        ) from error
    if not block.is_cut and len(payload) != size:
        raise DamagedBlockError(
            f"{name_of_block(index, block)}: decompresses to {len(payload)} bytes instead of {size}"
        )
    if not block.is_cut and crc and zlib.crc32(payload) != crc:
        raise DamagedBlockError(f"{name_of_block(index, block)}: its CRC is wrong")
    return memoryview(payload)


def release(index: FileIndex, block: Block) -> None:
    """Release the memory that maps a block, so that memory does not grow with the part that has been read."""
    if isinstance(index.data, mmap.mmap) and hasattr(index.data, "madvise"):
        begin = block.offset - block.offset % mmap.PAGESIZE
        index.data.madvise(mmap.MADV_DONTNEED, begin, block.offset + block.size - begin)


def _decompressed(stored: memoryview, compression: str, size: int, *, is_cut: bool) -> bytes | memoryview:
    """At most ``size`` decompressed bytes; of a truncated block those that remain."""
    if not size or compression == "":
        return stored if size else b""
    if compression == "zstd" and is_cut:
        with zstandard.ZstdDecompressor().stream_reader(BytesIO(stored)) as reader:
            return reader.read(size)
    if compression == "zstd":
        if zstandard.frame_content_size(stored) not in (-1, size):
            raise ValueError("it states another decompressed size")
        return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size)
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(stored, max_length=size)
    raise ValueError(f"compression {compression!r} is not supported; none, lz4 and zstd are")


def name_of_block(index: FileIndex, block: Block) -> str:
    """Name of a block in messages about damage."""
    return f"{index.path}: the {'chunk' if block.head else 'sequence of messages'} at byte {block.offset}"


def name_of(indexes: Sequence[FileIndex]) -> str:
    """Names of a log's files for errors; of more than two the first and the number of the others."""
    paths = [str(index.path) for index in indexes]
    shown = f"{paths[0]} and {len(paths) - 1} more files" if len(paths) > 2 else " and ".join(paths)
    return f"{shown}, read as one log" if len(paths) > 1 else shown


def damage_of(indexes: Sequence[FileIndex]) -> str:
    """Damage of a log, to be appended to an error that it may explain; empty if there is none."""
    damage = [line for index in indexes for line in index.damage]
    return f"; it is damaged in {counted(len(damage), 'place')} (the first: {damage[0]})" if damage else ""
