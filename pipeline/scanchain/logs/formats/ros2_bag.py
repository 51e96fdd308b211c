"""ROS 2 bags, read by rosbags, and page by page where a database of SQLite is damaged; messages stay as they are.

Format of pages: https://www.sqlite.org/fileformat2.html
"""

from __future__ import annotations

import mmap
import re
import threading
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import zstandard

from scanchain.errors import InputError, counted, one_line, printable
from scanchain.logs.files import size_of
from scanchain.logs.formats import natural_order
from scanchain.logs.mcap.index import most_unpacked
from scanchain.logs.mcap.records import Block, Channel, Contents, FileIndex, Message
from scanchain.logs.writer import schema_text

_BLOCK_BYTES = 4_000_000  # size of a block in bytes of the file, about
_MOST_BLOCKS = 8192
_MOST_UNPACKED = 1 << 27  # largest number of bytes that the messages of a block unpack to
_MOST_RATIO, _LEAST_BYTES = 200, 1 << 25  # largest ratio of packing of a whole file, beyond so many bytes
_LATEST_NS = (1 << 63) - 1
_MODE = re.compile(r"^( *compression_mode:)[ \"']*(\w*).*$", re.MULTILINE)

_TABLE, _INDEX = 13, 10  # kinds of pages with the rows of a table, of an index
_SIZES = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)  # bytes of a value of the first kinds: NULL, whole numbers, a float, 0, 1
_PAGE_BYTES, _PAGE_SIZES = 4096, {1 << k for k in range(9, 16)}  # size where none is stated; those of two bytes


def index_ros2_bag(path: Path, number: int) -> FileIndex:
    """The topics of a .db3 or the folder of a ROS 2 bag; blocks are spans of time. Raises InputError for none."""
    from rosbags import rosbag2

    opened, mode = path, ""
    if path.is_dir():
        found = _MODE.search((path / "metadata.yaml").read_text("utf-8", "replace"))
        mode = found[2].lower() if found else ""
    folder = _unpacked_folder(path) if mode == "file" else None
    opened = path if folder is None else Path(folder.name)
    files = sorted(opened.glob("*.db3"), key=natural_order) if opened.is_dir() else [opened]
    bag = _Bag(path, files, is_packed=mode == "message", folder=folder)
    try:
        reader: Any = rosbag2.Reader(opened)
        bag.reader = reader
        reader.open()
        begin_ns = reader.start_time or next((time_ns for _, time_ns, _ in reader.messages(start=1)), 0)
    except Exception as error:  # whatever a damaged file makes the libraries below raise
        return _index_of_pages(bag, number, one_line(error))
    index = FileIndex(path, number)
    for id_, each in enumerate(reader.connections, start=1):
        encoding = each.ext.serialization_format
        are_texts = all(isinstance(text, str) for text in (each.topic, each.msgtype, encoding))
        if not (are_texts and isinstance(each.msgcount, int)):
            raise InputError(f"{path}: its metadata.yaml is damaged; ros2 bag reindex makes a new one")
        if each.msgcount:
            language = "ros2idl" if each.msgdef.format.name == "IDL" else "ros2msg"
            definition = each.msgdef.data.encode() or schema_text(each.msgtype)
            index.channels[id_] = Channel(
                (number, id_), each.topic, encoding, id_, each.msgtype, language, definition
            )
            index.counts[id_], bag.connections[id_] = each.msgcount, each
    if (lost := reader.message_count - sum(each.msgcount for each in reader.connections)) > 0:
        index.damage.append(f"{path}: {counted(lost, 'message')} of no topic that it lists")
    if bag.is_packed:  # messages are unpacked here, as rosbags sets no limit
        reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
    if bag.connections:
        _add_blocks(index, bag, begin_ns, reader.end_time)
        if not reader.start_time:  # messages of log time 0, which are in the first block
            index.blocks[0] = replace(index.blocks[0], start_ns=0)
    return index


def _add_blocks(index: FileIndex, bag: _Bag, begin_ns: int, end_ns: int) -> None:
    """Spans of time of one length, so many that each holds a few megabytes on average."""
    size, length_ns = size_of(bag.path), end_ns - begin_ns
    count = min(max(size // _BLOCK_BYTES, 1), _MOST_BLOCKS, max(length_ns, 1))
    edges_ns = [begin_ns + length_ns * place // count for place in range(count + 1)]
    for place, (start_ns, stop_ns) in enumerate(pairwise(edges_ns)):
        share = size // count
        index.blocks.append(Block(index.number, place, share, "", share, start_ns, stop_ns - 1))
    index.make = partial(bag.contents, index)


def _index_of_pages(bag: _Bag, number: int, reason: str) -> FileIndex:
    """Index of what the pages of a damaged bag hold. Raises InputError where they hold no message of a topic."""
    index = FileIndex(bag.path, number)
    try:
        pages = bag.pages()
    except (OSError, ValueError):
        pages = []
    counts = Counter(topic for each in pages for _, topic, _ in each.messages)
    if not counts:
        lack = " and its list of topics is destroyed" if any(each.lost for each in pages) else ""
        raise InputError(
            f"{bag.path}: cannot be read as a ROS bag ({reason}){lack}; copy it again from where it was recorded, "
            "or, if only metadata.yaml is damaged, ros2 bag reindex makes a new one"
        )
    topics = {topic: stated for each in pages for topic, stated in each.topics.items()}
    for id_, (topic, count) in enumerate(counts.items(), start=1):
        encoding, type_name, language, definition = topics[topic]
        named = topic, encoding, id_, type_name, language
        index.channels[id_] = Channel((number, id_), *named, definition or schema_text(type_name))
        index.counts[id_] = count
    bag.damage = bag.lost(reason)
    index.damage.append(bag.damage)
    times_ns = [time_ns for each in pages for time_ns, _, _ in each.messages]
    _add_blocks(index, bag, min(times_ns), max(times_ns) + 1)
    return index


def parts_of_bag(folder: Path) -> list[Path]:
    """The MCAP files of a ROS 2 bag in their order; the folder itself for another storage or a packed bag."""
    from ruamel.yaml import YAML  # a tenth of a second with rosbags, which other logs need not wait for
    from ruamel.yaml.error import YAMLError

    try:
        stated = YAML(typ="safe").load(folder / "metadata.yaml")["rosbag2_bagfile_information"]
        parts = [folder / Path(name).name for name in stated["relative_file_paths"]]
        is_packed = str(stated.get("compression_mode", "")).lower() not in ("", "none")
    except (OSError, YAMLError, KeyError, TypeError, AttributeError) as error:
        reason = one_line(error)
        raise InputError(f"{folder / 'metadata.yaml'}: is not that of a ROS 2 bag ({reason})") from error
    is_mcap = bool(parts) and all(part.suffix == ".mcap" and part.is_file() for part in parts)
    return parts if is_mcap and not is_packed else [folder]


class _Bag:
    """The messages of a bag by time, from its reader or, where that meets damage, from the pages of its files.

    damage : what is missing, empty where no damage was met
    One thread at a time may use the reader of rosbags. ``folder`` is removed with the bag.
    """

    def __init__(
        self, path: Path, files: list[Path], *, is_packed: bool, folder: TemporaryDirectory[str] | None
    ) -> None:
        self.path, self.is_packed, self.folder, self.damage = path, is_packed, folder, ""
        self.reader: Any = None
        self.connections: dict[int, Any] = {}  # by channel
        self.lock = threading.Lock()
        self.pages = cache(lambda: [_Pages(file) for file in files])

    def contents(self, index: FileIndex, block: Block, wanted: AbstractSet[int] | None) -> Contents:
        """The messages of a span of time."""
        chosen = {k: channel for k, channel in index.channels.items() if wanted is None or k in wanted}
        is_last = block.offset == len(index.blocks) - 1  # both ends reach as far as time, whatever the metadata
        begin_ns, end_ns = block.start_ns if block.offset else 0, _LATEST_NS if is_last else block.end_ns + 1
        found: list[tuple[Channel, int, bytes]] = []
        with self.lock:
            try:
                if chosen and not self.damage:
                    channels = {id(each): index.channels[k] for k, each in self.connections.items()}
                    connections = [self.connections[k] for k in chosen]
                    for connection, time_ns, data in self.reader.messages(connections, begin_ns, end_ns):
                        found.append((channels[id(connection)], time_ns, data))
            except Exception as error:  # whatever a damaged file makes the libraries below raise
                self.damage = self.lost(one_line(error))
            if self.damage and self.pages():
                by_topic = {channel.topic: channel for channel in chosen.values()}
                found = [
                    (by_topic[topic], time_ns, each.row(cell)[1][3])
                    for each in self.pages()
                    for time_ns, topic, cell in each.between(begin_ns, end_ns)
                    if topic in by_topic
                ]
        messages, left = list[Message](), _MOST_UNPACKED
        for channel, time_ns, data in found:
            unpacked, defect = _unpacked(data, left) if self.is_packed else (data, "")
            left -= len(unpacked)
            messages.append(Message(channel, time_ns, memoryview(unpacked), defect))
        return Contents(messages, self.damage)

    def lost(self, reason: str) -> str:
        """The damage, and how many messages it costs."""
        if not self.pages():  # of MCAP, packed
            return f"{self.path}: cannot be read further ({reason})"
        there, lost = (sum(each) for each in zip(*((len(p.messages), p.lost) for p in self.pages()), strict=True))
        of = counted(there + lost, "message")
        return f"{self.path}: is damaged ({reason}); {lost:,} of {of} are lost, the others were read page by page"


def _unpacked(data: bytes, left: int) -> tuple[bytes, str]:
    """A message that is packed by itself, and why it does not unpack, empty where it does."""
    most = min(most_unpacked(len(data)), left)
    try:
        if zstandard.frame_content_size(data) > most:
            return b"", f"unpacks to more than {most:,} bytes"
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=most), ""
    except zstandard.ZstdError as error:
        return b"", f"does not unpack to {most:,} bytes or less ({one_line(error)})"


def _unpacked_folder(path: Path) -> TemporaryDirectory[str]:
    """A bag whose files are packed, unpacked up to any damage. Raises InputError for one beyond all measure."""
    folder = TemporaryDirectory(prefix="scanchain-", ignore_cleanup_errors=True)
    try:
        text = (path / "metadata.yaml").read_text("utf-8", "replace")
        text = _MODE.sub(r"\1 ''", text).replace(".zstd", "")
        (Path(folder.name) / "metadata.yaml").write_text(text, "utf-8")
        for file in path.glob("*.zstd"):
            most = _LEAST_BYTES + _MOST_RATIO * file.stat().st_size
            with file.open("rb") as stored, (Path(folder.name) / file.stem).open("wb") as copy:
                unpacker = zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True)
                with suppress(zstandard.ZstdError):
                    while data := unpacker.read(1 << 20):
                        copy.write(data)
                        if copy.tell() > most:
                            raise InputError(f"{file}: unpacks to more than {most:,} bytes; is it a ROS 2 bag?")
    except OSError as error:
        raise InputError(
            f"{folder.name}: {path} cannot be unpacked there ({error.strerror}); set TMPDIR"
        ) from error
    return folder


class _Pages:
    """The messages of a damaged database of SQLite, from those of its pages that are whole.

    topics : encoding, type, and definition with its language of each, by its name
    messages : time, topic and place in the file of each, by time; ``lost`` is the number of those missing
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        is_stated = self.data[:16] == b"SQLite format 3\0"
        self.size = int.from_bytes(self.data[16:18], "big") if is_stated else _PAGE_BYTES
        self.size = self.size if self.size in _PAGE_SIZES else 1 << 16  # which is written as 1
        self.usable = self.size - (ord(self.data[20:21] or b"\0") if is_stated else 0)
        topics: dict[int, tuple[str, str, str]] = {}
        definitions: dict[str, tuple[str, bytes]] = {}
        rows: dict[int, tuple[int, int, int]] = {}
        last = 0
        for is_table, cell in self._cells():
            try:
                number, values = self.row(cell, is_table=is_table)
            except (IndexError, ValueError):
                continue
            match values:
                case [int(), int()] if not is_table:  # of the index of times, which has the number of each message
                    last = max(last, values[1])
                case [None, str(type_name), "ros2msg" | "ros2idl" as language, str(text), *_]:
                    definitions[type_name] = language, text.encode()
                case [None, str(topic), str(type_name), str(encoding), *_]:
                    topics[number] = printable(topic), encoding, type_name
                case [None, int(topic), int(time_ns), bytes()]:
                    rows[number] = time_ns, topic, cell
        named = ((time_ns, topics[topic][0], cell) for time_ns, topic, cell in rows.values() if topic in topics)
        self.messages = sorted(named)
        self.lost = max([last, *rows]) - len(self.messages)
        self.topics = {
            topic: (encoding, type_name, *definitions.get(type_name, ("ros2msg", b"")))
            for topic, encoding, type_name in topics.values()
        }

    def between(self, begin_ns: int, end_ns: int) -> list[tuple[int, str, int]]:
        """The messages of a span of time."""
        first, behind = (bisect_left(self.messages, (time_ns,)) for time_ns in (begin_ns, end_ns))
        return self.messages[first:behind]

    def _cells(self) -> Iterator[tuple[bool, int]]:
        """The rows of all pages but the first: whether each is of a table, and where it begins."""
        kinds = np.frombuffer(self.data, np.uint8)[self.size :: self.size]
        for page in (np.flatnonzero((kinds == _TABLE) | (kinds == _INDEX)) + 1).tolist():
            begin = page * self.size
            count = int.from_bytes(self.data[begin + 3 : begin + 5], "big")
            pointers = self.data[begin + 8 : min(begin + 8 + 2 * count, begin + self.size)]
            for at in range(0, len(pointers) - 1, 2):
                yield self.data[begin] == _TABLE, begin + int.from_bytes(pointers[at : at + 2], "big")

    def row(self, cell: int, *, is_table: bool = True) -> tuple[int, list[Any]]:
        """Number and values of a row, of all its pages. Raises ValueError or IndexError for a damaged one."""
        size, at = _varint(self.data, cell)
        number, at = _varint(self.data, at) if is_table else (0, at)
        usable = self.usable
        most, least = usable - 35, (usable - 12) * 32 // 255 - 23
        local = size if size <= most else least + (size - least) % (usable - 4)
        local = local if local <= most else least
        payload, at = self.data[at : at + local], at + local
        while len(payload) < size <= len(self.data):
            at = (int.from_bytes(self.data[at : at + 4], "big") - 1) * self.size
            part = self.data[at + 4 : at + min(usable, 4 + size - len(payload))] if at >= 0 else b""
            if not part:
                break
            payload += part
        if len(payload) < size or (local < size and any(self.data[at : at + 4])):  # the last names no further one
            raise ValueError("row of pages that are destroyed")
        return number, _values(payload)


def _varint(data: mmap.mmap | bytes, at: int) -> tuple[int, int]:
    """A whole number of SQLite's, and where it ends. Raises IndexError."""
    value = 0
    for place in range(at, at + 8):
        value = value << 7 | data[place] & 0x7F
        if data[place] < 0x80:
            return value, place + 1
    return value << 8 | data[at + 8], at + 9


def _values(payload: bytes) -> list[Any]:
    """The values of a row; of floats None. Raises ValueError or IndexError for one that is damaged."""
    begin, at = _varint(payload, 0)
    end, values = begin, list[Any]()
    while at < begin:
        kind, at = _varint(payload, at)
        size = _SIZES[kind] if kind < 12 else (kind - 12) // 2
        value, end = payload[end : end + size], end + size
        if kind >= 12:
            values.append(str(value, "utf-8", "replace") if kind % 2 else value)
        elif kind in (0, 7):
            values.append(None)
        else:
            values.append(kind - 8 if kind > 7 else int.from_bytes(value, "big", signed=True))
    if (at, end) != (begin, len(payload)):
        raise ValueError("row of another length than its head states")
    return values
