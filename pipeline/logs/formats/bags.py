"""ROS 1 bags, and ROS 2 bags kept in SQLite, read by rosbags; their messages stay as they are."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import ConnectionExtRosbag1
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from pipeline.errors import InputError
from pipeline.logs.formats.made import made_index
from pipeline.logs.records import Block, Channel, Contents, FileIndex, Message
from pipeline.logs.ros2_definitions import schema_text
from pipeline.logs.sizes import size_of

_BLOCK_BYTES = 8_000_000  # about, of the file
_MOST_BLOCKS = 4096


def index_bag(path: Path, number: int) -> FileIndex:
    """The topics of a bag: a .bag, a .db3, or the folder of a ROS 2 bag. Raises InputError where it is damaged."""
    index = made_index(path, number)
    bag = _Bag(index, _open(path))
    index.make = bag.make
    return index


def parts_of_bag(folder: Path) -> list[Path]:
    """The MCAP files of a ROS 2 bag in their order; the folder itself where it is kept otherwise or is packed."""
    try:
        told = YAML(typ="safe").load(folder / "metadata.yaml")["rosbag2_bagfile_information"]
        parts = [folder / Path(name).name for name in told["relative_file_paths"]]
        is_packed = str(told.get("compression_mode", "")).lower() not in ("", "none")
    except (OSError, YAMLError, KeyError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{folder / 'metadata.yaml'}: is not that of a ROS 2 bag ({reason})") from error
    is_mcap = bool(parts) and all(part.suffix == ".mcap" and part.is_file() for part in parts)
    return parts if is_mcap and not is_packed else [folder]


class _Bag:
    """A reader of rosbags, which one thread at a time may use; blocks are spans of time."""

    def __init__(self, index: FileIndex, reader: Any) -> None:
        self.index = index
        self.reader = reader
        self.lock = threading.Lock()
        self.connections = {number: c for number, c in enumerate(reader.connections, start=1) if c.msgcount}
        for number, connection in self.connections.items():
            index.channels[number] = _channel((index.number, number), connection)
            index.counts[number] = connection.msgcount
        self.numbers = {id(connection): number for number, connection in self.connections.items()}
        if self.connections:
            self._cut()

    def make(self, block: Block, wanted: AbstractSet[int] | None) -> Contents:
        """The messages of a span of time."""
        chosen = [c for number, c in self.connections.items() if wanted is None or number in wanted]
        messages: list[Message] = []
        damage = ""
        try:
            with self.lock:
                found = self._between(chosen, block.start_ns, block.end_ns + 1) if chosen else ()
                for connection, time_ns, data in found:
                    channel = self.index.channels[self.numbers[id(connection)]]
                    messages.append(Message(channel, time_ns, memoryview(data)))
        except Exception as error:  # whatever a damaged file makes the libraries below raise
            reason = " ".join(str(error).split()) or type(error).__name__
            damage = f"{self.index.path}: from {block.start_ns * 1e-9:.1f} s on it cannot be read ({reason})"
        return Contents(messages, damage)

    def _between(self, chosen: Sequence[Any], start_ns: int, stop_ns: int) -> Iterator[tuple[Any, int, bytes]]:
        """Messages from start up to stop; the reader of ROS 1 bags would walk all that come before."""
        if not isinstance(self.reader, rosbag1.Reader):
            yield from self.reader.messages(chosen, start_ns, stop_ns)
            return
        whole = self.reader.indexes
        try:
            self.reader.indexes = {c.id: _slice(whole[c.id], start_ns, stop_ns) for c in chosen}
            yield from self.reader.messages(chosen)
        finally:
            self.reader.indexes = whole

    def _cut(self) -> None:
        """Spans of time of one length, so many that each holds a few megabytes on average."""
        begin_ns, end_ns = self.reader.start_time, self.reader.end_time  # the end is not in it
        size = size_of(self.index.path)
        count = min(max(size // _BLOCK_BYTES, 1), _MOST_BLOCKS, max(end_ns - begin_ns, 1))
        edges_ns = [begin_ns + (end_ns - begin_ns) * place // count for place in range(count + 1)]
        for place in range(count):
            start_ns, last_ns = edges_ns[place], edges_ns[place + 1] - 1
            share = size // count
            block = Block(self.index.number, place, share, "", share, 0, start_ns, last_ns, is_chunk=False)
            self.index.blocks.append(block)


def _open(path: Path) -> Any:
    try:
        reader = rosbag1.Reader(path) if _is_ros1(path) else rosbag2.Reader(path)
        reader.open()
    except Exception as error:  # whatever a damaged file makes the libraries below raise
        reason = " ".join(str(error).split()) or type(error).__name__
        remedy = "rosbag reindex mends a .bag, ros2 bag reindex the folder of a ROS 2 bag"
        raise InputError(f"{path}: cannot be read as a ROS bag ({reason}); {remedy}") from error
    return reader


def _slice(entries: list[rosbag1.reader.IndexData], start_ns: int, stop_ns: int) -> list[rosbag1.reader.IndexData]:
    first, last = (bisect_left(entries, time_ns, key=lambda entry: entry.time) for time_ns in (start_ns, stop_ns))
    return entries[first:last]


def _channel(key: tuple[int, int], connection: Any) -> Channel:
    told = connection.msgdef
    if isinstance(connection.ext, ConnectionExtRosbag1):
        type_name = connection.msgtype.replace("/msg/", "/")
        return Channel(key, connection.topic, "ros1", key[1], type_name, "ros1msg", told.data.encode())
    encoding = connection.ext.serialization_format
    language = "ros2idl" if told.format.name == "IDL" else "ros2msg"
    definition = told.data.encode() or _definition(connection.msgtype)
    return Channel(key, connection.topic, encoding, key[1], connection.msgtype, language, definition)


def _definition(type_name: str) -> bytes:
    """What a type looks like that an old bag does not define, empty where nobody here knows."""
    try:
        return schema_text(type_name)
    except KeyError:
        return b""


def _is_ros1(path: Path) -> bool:
    if path.is_dir():
        return False
    with path.open("rb") as file:
        return file.read(7) == b"#ROSBAG"
