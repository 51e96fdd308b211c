"""ROS 2 bags, read by rosbags, and row by row where a database of SQLite is damaged; messages stay as they are."""

from __future__ import annotations

import re
import sqlite3
import threading
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zstandard

from scanchain.errors import InputError, counted, one_line
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
_COUNT = re.compile(r"^  message_count: *(\d{1,15})$", re.MULTILINE)

_ROW_BYTES = 16  # bytes of a file that a row takes at least
_MOST_FAILURES = 100_000  # ranges of rows that fail in a file, about a second
_DATA = "SELECT data FROM messages NOT INDEXED WHERE id = ?"
_ROWS = "SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED WHERE id BETWEEN ? AND ?"
_TOPICS = "SELECT id, name, type, serialization_format FROM topics"
_DEFINITIONS = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"


def index_ros2_bag(path: Path, number: int) -> FileIndex:
    """The topics of a .db3 or the folder of a ROS 2 bag; blocks are spans of time. Raises InputError for none."""
    bag = _Bag(path)
    index, reader = FileIndex(path, number, make=bag.contents), bag.reader
    if bag.damage:
        index.damage.append(bag.damage)
    for id_, each in enumerate(reader.connections, start=1):
        encoding = each.ext.serialization_format
        are_texts = all(isinstance(text, str) for text in (each.topic, each.msgtype, encoding))
        if not (are_texts and isinstance(each.msgcount, int)):
            raise InputError(f"{path}: its metadata.yaml is damaged; ros2 bag reindex makes a new one")
        if each.msgcount:
            language = "ros2idl" if each.msgdef.format.name == "IDL" else "ros2msg"
            definition = each.msgdef.data.encode() or schema_text(each.msgtype)
            named = each.topic, encoding, id_, each.msgtype, language
            channel = Channel((number, id_), *named, definition)
            channel = bag.channels.setdefault((each.topic, each.msgtype), channel)
            index.channels[channel.key[1]] = channel
            index.counts[channel.key[1]] = index.counts.get(channel.key[1], 0) + each.msgcount
    lost = reader.message_count - sum(each.msgcount for each in reader.connections)
    if lost > 0 and not bag.damage:
        index.damage.append(f"{path}: {counted(lost, 'message')} of no topic that it lists")
    if index.channels:  # spans of one length, so many that each holds a few megabytes on average
        size, length_ns = size_of(path), reader.end_time - bag.begin_ns
        count = min(max(size // _BLOCK_BYTES, 1), _MOST_BLOCKS, max(length_ns, 1))
        edges_ns = [bag.begin_ns + length_ns * place // count for place in range(count + 1)]
        for place, (start_ns, stop_ns) in enumerate(pairwise(edges_ns)):
            share = size // count
            index.blocks.append(Block(number, place, share, "", share, start_ns, stop_ns - 1))
        if not reader.start_time:  # messages of log time 0, which are in the first block
            index.blocks[0] = replace(index.blocks[0], start_ns=0)
        bag.last = len(index.blocks) - 1
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
    """A bag and its reader: of rosbags or, where that meets ``damage``, row by row; one thread at a time reads.

    begin_ns : the first log time that is not 0; ``last`` is the number of the last block
    """

    def __init__(self, path: Path) -> None:
        from rosbags import rosbag2

        text = (path / "metadata.yaml").read_text("utf-8", "replace") if path.is_dir() else ""
        mode = found[2].lower() if (found := _MODE.search(text)) else ""
        self.folder = _unpacked_folder(path, text) if mode == "file" else None  # removed with the bag
        self.path, self.opened = path, Path(self.folder.name) if self.folder else path
        self.stated = int(found[1]) if (found := _COUNT.search(text)) else 0
        self.is_packed, self.damage, self.last, self.lock = mode == "message", "", 0, threading.Lock()
        self.channels: dict[tuple[str, str], Channel] = {}
        self.reader: Any = None
        try:
            reader = rosbag2.Reader(self.opened)
            reader.open()
            self.begin_ns, self.reader = _begin_ns(reader), reader
        except Exception as error:  # whatever a damaged file makes the libraries below raise
            self._rescue(one_line(error))
            if self.reader is None:
                raise InputError(self.damage) from error
            self.begin_ns = _begin_ns(self.reader)
        if self.is_packed and not self.damage:  # messages are unpacked here, as rosbags sets no limit
            self.reader.storage.metadata = self.reader.storage.metadata._replace(compression_mode=None)

    def _rescue(self, reason: str) -> None:
        """Read row by row from here on if SQLite gives a row."""
        rows, remedy = (
            _Rows(self.opened),
            "a .db3 is saved in part by .recover of sqlite3, a folder by ros2 bag reindex",
        )
        left, total = len(rows.rows), max(rows.message_count, self.stated)
        self.damage = f"{self.path}: cannot be read as a ROS bag ({reason}); copy it again; {remedy}"
        if left:
            lost = (
                f"{total - left:,} of {counted(total, 'message')} lost"
                if total
                else f"only {left:,} messages left"
            )
            self.damage = f"{self.path}: {lost}: damaged pages ({reason}); the others were read row by row"
            self.reader = rows

    def contents(self, block: Block, wanted: AbstractSet[int] | None) -> Contents:
        """The messages of a span of time; both ends reach as far as time, whatever the metadata."""
        begin_ns, end_ns = block.start_ns if block.offset else 0, block.end_ns + 1
        end_ns = _LATEST_NS if block.offset == self.last else end_ns
        chosen = {key: c for key, c in self.channels.items() if wanted is None or c.key[1] in wanted}
        found: list[tuple[Channel, int, bytes]] = []
        with self.lock:
            reader = self.reader
            connections = [each for each in reader.connections if (each.topic, each.msgtype) in chosen]
            try:
                for each, time_ns, data in reader.messages(connections, begin_ns, end_ns) if connections else ():
                    found.append((chosen[each.topic, each.msgtype], time_ns, data))
            except Exception as error:  # whatever a damaged file makes the libraries below raise
                self._rescue(one_line(error))
        if self.reader is not reader:
            return self.contents(block, wanted)
        messages, left = list[Message](), _MOST_UNPACKED
        for channel, time_ns, data in found:
            unpacked, defect = _unpacked(data, left) if self.is_packed else (data, "")
            left -= len(unpacked)
            messages.append(Message(channel, time_ns, memoryview(unpacked), defect))
        return Contents(messages, self.damage)


def _begin_ns(reader: Any) -> int:
    return reader.start_time or next((time_ns for _, time_ns, _ in reader.messages(start=1)), 0)


class _Rows:
    """As a reader of rosbags: what SQLite still gives, row by row, of the damaged databases of a bag.

    message_count : the largest number of a row, with those that are lost, 0 where it is unknown
    """

    def __init__(self, opened: Path) -> None:
        self.by_key, self.message_count = dict[tuple[str, str], Any](), 0  # connections by topic and type
        self.rows: list[
            tuple[int, tuple[str, str], sqlite3.Connection, int]
        ] = []  # by time; the last is the number
        for path in sorted(opened.glob("*.db3"), key=natural_order) if opened.is_dir() else [opened]:
            with suppress(sqlite3.Error):  # of a header or topics that are destroyed
                self._read(path)
        self.rows.sort(key=itemgetter(0))
        counts = Counter(key for _, key, _, _ in self.rows)
        self.connections = [each._replace(msgcount=counts[key]) for key, each in self.by_key.items()]
        self.start_time, self.end_time = (self.rows[0][0], self.rows[-1][0] + 1) if self.rows else (0, 0)

    def _read(self, path: Path) -> None:
        """Add a database. Raises sqlite3.Error where its topics cannot be read."""
        from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition
        from rosbags.interfaces import MessageDefinitionFormat as Form

        base = sqlite3.connect(path.resolve().as_uri() + "?mode=ro&immutable=1", uri=True, check_same_thread=False)
        base.text_factory = partial(str, encoding="utf-8", errors="replace")
        base.execute("PRAGMA writable_schema = ON")  # by which SQLite takes a file that is cut off
        definitions, ends, keys = dict[str, tuple[str, str]](), list[int](), dict[int, tuple[str, str]]()
        rows = dict[int, tuple[int, tuple[str, str], sqlite3.Connection, int]]()
        with suppress(sqlite3.Error):
            definitions = {type_name: (form, text) for type_name, form, text in base.execute(_DEFINITIONS)}
        for number, *texts in base.execute(_TOPICS):
            topic, type_name, encoding = map(str, texts)
            form, text = definitions.get(type_name, ("", ""))
            definition = MessageDefinition(Form.IDL if form == "ros2idl" else Form.MSG, str(text))
            extra = ConnectionExtRosbag2(encoding, [])
            keys[number] = topic, type_name
            self.by_key[topic, type_name] = Connection(number, topic, type_name, definition, "", 0, extra, self)
        for sought in ("NOT INDEXED", "INDEXED BY timestamp_idx"):
            with suppress(sqlite3.Error):
                ends += [end for (end,) in base.execute(f"SELECT max(id) FROM messages {sought}") if end]
        ranges, failures = deque([(0, max(ends, default=path.stat().st_size // _ROW_BYTES))]), 0
        while ranges:
            first, last = ranges.popleft()
            try:
                for number, topic, time_ns, data in base.execute(_ROWS, (first, last)):
                    first = number + 1
                    if topic in keys and isinstance(time_ns, int) and isinstance(data, bytes):
                        rows[number] = time_ns, keys[topic], base, number
            except sqlite3.Error:
                failures += 1
                if first < last and failures < _MOST_FAILURES:
                    middle = (first + last) // 2
                    ranges += (first, middle), (middle + 1, last)
        self.rows += rows.values()
        self.message_count += max([*rows, *ends]) if ends else 0

    def messages(
        self, connections: Any = None, start: int = 0, stop: int = _LATEST_NS
    ) -> Iterator[tuple[Any, int, bytes]]:
        """The messages of a span of time."""
        wanted = {(each.topic, each.msgtype): each for each in connections or self.connections}
        first, behind = (bisect_left(self.rows, time_ns, key=itemgetter(0)) for time_ns in (start, stop))
        for time_ns, key, base, number in self.rows[first:behind]:
            if key in wanted:
                yield wanted[key], time_ns, base.execute(_DATA, (number,)).fetchone()[0]


def _unpacked(data: bytes, left: int) -> tuple[bytes, str]:
    """A message that is packed by itself, and why it does not unpack, empty where it does."""
    most = min(most_unpacked(len(data)), left)
    try:
        if zstandard.frame_content_size(data) > most:
            return b"", f"unpacks to more than {most:,} bytes"
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=most), ""
    except zstandard.ZstdError as error:
        return b"", f"does not unpack to {most:,} bytes or less ({one_line(error)})"


def _unpacked_folder(path: Path, metadata: str) -> TemporaryDirectory[str]:
    """A bag whose files are packed, unpacked up to any damage. Raises InputError for one beyond all measure."""
    folder = TemporaryDirectory(prefix="scanchain-", ignore_cleanup_errors=True)
    try:
        text = _MODE.sub(r"\1 ''", metadata).replace(".zstd", "")
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
