"""ROS 2 bags, read by rosbags; of a damaged SQLite database the readable rows are copied first."""

from __future__ import annotations

import re
import sqlite3
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zstandard

from scanchain.config import LogConfig
from scanchain.errors import InputError, counted, one_line
from scanchain.files import BLOCK_BYTES
from scanchain.logs.files import size_of
from scanchain.logs.formats import Format
from scanchain.logs.index import (
    Block,
    Channel,
    Contents,
    FileIndex,
    Message,
    most_decompressed,
    most_decompressed_file,
)
from scanchain.logs.writer import schema_text

_BLOCK_BYTES = 4_000_000  # approximate size of a block in bytes of the file
_MOST_BLOCKS = 8192  # largest number of blocks, as each one costs a query
_MOST_DECOMPRESSED = 1 << 27  # largest decompressed size of the messages of a block in bytes
_MODE = re.compile(r"^( *compression_mode:)[ \"']*(\w*).*$", re.MULTILINE)
_COUNT = re.compile(r"^  message_count: *(\d{1,15})$", re.MULTILINE)

_TABLES = (
    "SELECT name, sql FROM sqlite_master WHERE name IN ('schema', 'topics', 'message_definitions', 'messages')"
)
_CLEAN = """
CREATE TABLE IF NOT EXISTS topics(id, name, type, serialization_format);
CREATE TABLE IF NOT EXISTS messages(id, topic_id, timestamp, data);
DELETE FROM messages WHERE typeof(timestamp) != 'integer' OR typeof(data) != 'blob'
    OR topic_id NOT IN (SELECT id FROM topics);
CREATE INDEX timestamp_idx ON messages (timestamp);
"""


def index_ros2_bag(path: Path, number: int, _: LogConfig) -> FileIndex:
    """Index of a .db3 or the folder of a ROS 2 bag, in blocks of equal time. Raises InputError if not readable."""
    bag = _Bag(path)
    index, reader = FileIndex(path, number, damage=[bag.damage] if bag.damage else []), bag.reader
    for id_, each in enumerate(reader.connections, start=1):
        encoding = each.ext.serialization_format
        are_texts = all(isinstance(text, str) for text in (each.topic, each.msgtype, encoding))
        if not (are_texts and isinstance(each.msgcount, int)):
            raise InputError(f"{path}: its metadata.yaml is damaged; rewrite it with ros2 bag reindex")
        if each.msgcount:
            language = "ros2idl" if each.msgdef.format.name == "IDL" else "ros2msg"
            definition = each.msgdef.data.encode() or schema_text(each.msgtype)
            named = each.topic, encoding, id_, each.msgtype, language
            channel = Channel((number, id_), *named, definition)
            key = bag.channels.setdefault((each.topic, each.msgtype), channel).key[1]
            index.channels.setdefault(key, channel)
            index.counts[key] = index.counts.get(key, 0) + each.msgcount
    lost = reader.message_count - sum(each.msgcount for each in reader.connections)
    if lost > 0 and not bag.damage:
        index.damage.append(f"{path}: {counted(lost, 'message')} of a topic that it does not list")
    if index.channels:  # spans of equal length, each with a few megabytes on average
        size, length_ns = size_of(path), reader.end_time - bag.begin_ns
        count = min(max(size // _BLOCK_BYTES, 1), _MOST_BLOCKS, max(length_ns, 1))
        edges_ns = [bag.begin_ns + length_ns * place // count for place in range(count + 1)]
        for place, (start_ns, stop_ns) in enumerate(pairwise(edges_ns)):
            share = size // count
            index.blocks.append(Block(number, place, share, "", share, start_ns, stop_ns - 1))
        if not reader.start_time:  # messages of log time 0, which are in the first block
            index.blocks[0] = replace(index.blocks[0], start_ns=0)
    index.contents = bag.contents
    return index


def _is_bag(path: Path, head: bytes) -> bool:
    return head.startswith(b"SQLite format 3\0") or path.suffix == ".db3" or (path / "metadata.yaml").is_file()


def _parts_of(folder: Path) -> list[Path]:
    """MCAP files of a ROS 2 bag in order; its folder for another storage or if compressed; empty for no bag."""
    if not (folder / "metadata.yaml").is_file():
        return []
    from ruamel.yaml import YAML  # importing it takes 0.1 s with rosbags, not needed for other logs
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
    """A bag with its rosbags reader, used by one thread at a time.

    folder : temporary folder of a decompressed or rescued copy, if any
    begin_ns : first nonzero log time
    """

    def __init__(self, path: Path) -> None:
        self.metadata = (path / "metadata.yaml").read_text("utf-8", "replace") if path.is_dir() else ""
        mode = found[2].lower() if (found := _MODE.search(self.metadata)) else ""
        self.path, self.opened, self.is_packed, self.damage = path, path, mode == "message", ""
        self.lock, self.channels = threading.Lock(), dict[tuple[str, str], Channel]()
        if mode == "file":
            self.metadata = _MODE.sub(r"\1 ''", self.metadata).replace(".zstd", "")
            self._copy("*.zstd", _decompress)
        try:
            self._open()
        except Exception as error:  # anything that libraries raise for a damaged file
            self._rescue(one_line(error))

    def _open(self) -> None:
        from rosbags import rosbag2

        reader: Any = rosbag2.Reader(self.opened)
        reader.open()
        if self.is_packed:  # messages are decompressed below, as rosbags sets no limit
            reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
        self.begin_ns = reader.start_time or next((time_ns for _, time_ns, _ in reader.messages(start=1)), 0)
        self.reader = reader

    def _copy(self, pattern: str, copy: Callable[[Path, Path], None]) -> None:
        """Copy the files into a temporary folder. Raises InputError if that fails, as for lack of space."""
        folder = TemporaryDirectory(prefix="scanchain-", ignore_cleanup_errors=True)
        into, is_folder = Path(folder.name), self.opened.is_dir()
        try:
            (into / "metadata.yaml").write_text(self.metadata, "utf-8")
            for file in self.opened.glob(pattern) if is_folder else [self.opened]:
                copy(file, into / file.name.removesuffix(".zstd"))
        except OSError as error:
            reason = f"{self.path} cannot be copied there ({error.strerror}); set TMPDIR"
            raise InputError(f"{into}: {reason}") from error
        self.folder, self.opened = folder, into if is_folder else into / self.opened.name

    def _rescue(self, reason: str) -> None:
        """Continue with the rows that SQLite can read. Raises InputError if there are none."""
        remedy = "sqlite3 .recover may save part of a .db3, ros2 bag reindex a folder"
        self.damage = f"{self.path}: cannot be read as a ROS bag ({reason}); copy it again; {remedy}"
        counts = Counter[str]()
        try:
            self._copy("*.db3", partial(_copy_rows, counts))
            self._open()
        except InputError:
            raise
        except Exception as error:  # as above
            raise InputError(self.damage) from error
        if not counts["left"]:
            raise InputError(self.damage)
        left, stated = counts["left"], _COUNT.search(self.metadata)
        total = max(counts["stated"], int(stated[1]) if stated else 0)
        lost = f"{total - left:,} of {counted(total, 'message')}" if total else "some messages"
        self.damage = f"{self.path}: {lost} lost in damaged pages; the others are read row by row"

    def contents(self, index: FileIndex, block: Block, wanted: AbstractSet[int] | None) -> Contents:
        """Messages of a block's time span, open-ended for the first and last block: the metadata may be wrong."""
        begin_ns, end_ns = block.start_ns if block.offset else 0, block.end_ns + 1
        end_ns = (1 << 63) - 1 if block.offset == len(index.blocks) - 1 else end_ns
        chosen = {key: c for key, c in self.channels.items() if wanted is None or c.key[1] in wanted}
        found: list[tuple[Channel, int, bytes]] = []
        with self.lock:
            reader = self.reader
            connections = [each for each in reader.connections if (each.topic, each.msgtype) in chosen]
            try:
                for each, time_ns, data in reader.messages(connections, begin_ns, end_ns) if connections else ():
                    found.append((chosen[each.topic, each.msgtype], time_ns, data))
            except Exception as error:  # anything that libraries raise for a damaged file
                with suppress(InputError):
                    self._rescue(one_line(error))
        if self.reader is not reader:
            return self.contents(index, block, wanted)
        messages, left = list[Message](), _MOST_DECOMPRESSED
        for channel, time_ns, data in found:
            message, defect = _decompressed(data, left) if self.is_packed else (data, "")
            left -= len(message)
            messages.append(Message(channel, time_ns, memoryview(message), defect))
        return Contents(messages, self.damage)


def _decompressed(data: bytes, left: int) -> tuple[bytes, str]:
    """Decompressed data of an individually compressed message, and the reason for a failure, empty if none."""
    most = min(most_decompressed(len(data)), left)
    try:
        if zstandard.frame_content_size(data) > most:
            return b"", f"decompresses to more than {most:,} bytes"
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=most), ""
    except zstandard.ZstdError as error:
        return b"", f"cannot be decompressed to at most {most:,} bytes ({one_line(error)})"


def _decompress(file: Path, decompressed: Path) -> None:
    """Decompress a file up to the first damage. Raises InputError if the result is implausibly large."""
    most = most_decompressed_file(file.stat().st_size)
    with file.open("rb") as stored, decompressed.open("wb") as copy, suppress(zstandard.ZstdError):
        reader = zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True)
        while data := reader.read(BLOCK_BYTES):
            copy.write(data)
            if copy.tell() > most:
                raise InputError(f"{file}: decompresses to more than {most:,} bytes; is it a ROS 2 bag?")


def _copy_rows(counts: Counter[str], file: Path, copy: Path) -> None:
    """Copy the readable rows of a database; count the messages left and, if known, the original number."""
    uri = file.resolve().as_uri() + "?mode=ro&immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as old, closing(sqlite3.connect(copy)) as new:
        new.execute("PRAGMA synchronous = OFF")
        old.text_factory = partial(str, encoding="utf-8", errors="replace")
        with suppress(sqlite3.Error):  # raised for a destroyed header or schema
            old.execute("PRAGMA writable_schema = ON")  # lets SQLite open a truncated file
            for name, sql in old.execute(_TABLES).fetchall():
                new.execute(sql)
                ends = list[int]()
                for index in ("NOT INDEXED", "INDEXED BY timestamp_idx"):
                    with suppress(sqlite3.Error):
                        ends += [end for (end,) in old.execute(f"SELECT max(rowid) FROM {name} {index}") if end]
                counts["stated"] += max(ends, default=0) if name == "messages" else 0
                marks = ", ".join("?" for _ in old.execute(f"SELECT * FROM {name} LIMIT 0").description)
                rows = _rows(old, name, max(ends, default=file.stat().st_size // 16))  # bytes of the smallest row
                new.executemany(f"INSERT OR IGNORE INTO {name} VALUES ({marks})", rows)
        new.executescript(_CLEAN)
        ((left,),) = new.execute("SELECT count(*) FROM messages")
        counts["left"] += left
        new.commit()


def _rows(base: sqlite3.Connection, table: str, last: int) -> Iterator[list[Any]]:
    """Rows of a table up to row id ``last``; ranges in which SQLite fails are bisected."""
    ranges, failures = deque([(0, last)]), 0
    query = f"SELECT rowid, * FROM {table} NOT INDEXED WHERE rowid BETWEEN ? AND ?"
    while ranges:
        first, last = ranges.popleft()
        try:
            for number, *row in base.execute(query, (first, last)):
                first = number + 1
                yield row
        except sqlite3.Error:
            failures += 1
            if first < last and failures < 5_000:  # these take about half a second
                middle = (first + last) // 2
                ranges += (first, middle), (middle + 1, last)


FORMAT = Format(
    "ros2", "a ROS 2 .db3 or the folder of a ROS 2 bag", _is_bag, index_ros2_bag, (".db3",), "parts", _parts_of
)
