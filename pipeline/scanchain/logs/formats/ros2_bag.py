"""ROS 2 bags in SQLite, read by rosbags; their messages stay as they are."""

from __future__ import annotations

import threading
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

from scanchain.errors import InputError, counted, one_line
from scanchain.logs.files import size_of
from scanchain.logs.formats import on_demand_index
from scanchain.logs.mcap.records import Block, Channel, Contents, FileIndex, Message
from scanchain.logs.writer import schema_text

_BLOCK_BYTES = 8_000_000  # size of a block in bytes of the file, about
_MOST_BLOCKS = 4096
_MOST_TRIES = 400  # largest number of tries to read parts of a damaged block
_LATEST_NS = (1 << 63) - 1


def claims_ros2_bag(path: Path, head: bytes) -> bool:
    """True for an SQLite file, or a folder with a bag's metadata."""
    return head.startswith(b"SQLite format 3\0") or (path / "metadata.yaml").is_file()


def index_ros2_bag(path: Path, number: int) -> FileIndex:
    """The topics of a .db3 or the folder of a ROS 2 bag. Raises InputError for what is none."""
    index, reader = on_demand_index(path, number), _open(path)
    for connection in reader.connections:
        texts = connection.topic, connection.msgtype, connection.ext.serialization_format
        if not (all(isinstance(text, str) for text in texts) and isinstance(connection.msgcount, int)):
            raise InputError(f"{path}: its metadata.yaml is damaged; ros2 bag reindex makes a new one")
    bag = _Bag(index, reader)
    index.make = bag.make
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
        """The messages of a span of time; one that cannot be read is halved until what is damaged stands alone."""
        chosen = [c for number, c in self.connections.items() if wanted is None or number in wanted]
        messages: list[Message] = []
        lost, first_ns, reason = 0, 0, ""
        last = len(self.index.blocks) - 1  # the first and the last reach as far as time, whatever the metadata
        whole = (
            0 if block.offset == 0 else block.start_ns,
            _LATEST_NS if block.offset == last else block.end_ns + 1,
        )
        spans, tries = [whole] if chosen else [], _MOST_TRIES
        with self.lock:
            while spans:
                start_ns, stop_ns = spans.pop()
                try:
                    found = list(self.reader.messages(chosen, start_ns, stop_ns))
                except Exception as error:  # whatever a damaged file makes the libraries below raise
                    middle_ns, tries = (start_ns + stop_ns) // 2, tries - 1
                    if start_ns < middle_ns and tries > 0:
                        spans += [(middle_ns, stop_ns), (start_ns, middle_ns)]
                    else:
                        first_ns, reason = first_ns or start_ns, reason or _reason(error)
                        lost += 1
                    continue
                messages += [
                    Message(self.index.channels[self.numbers[id(connection)]], time_ns, memoryview(data))
                    for connection, time_ns, data in found
                ]
        what = f"at least {counted(lost, 'message')} from {first_ns * 1e-9:.3f} s on cannot be read ({reason})"
        return Contents(messages, f"{self.index.path}: {what}" if lost else "")

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
    from rosbags import rosbag2

    try:
        reader = rosbag2.Reader(path)
        reader.open()
    except Exception as error:  # whatever a damaged file makes the libraries below raise
        raise InputError(
            f"{path}: cannot be read as a ROS bag ({_reason(error)}); "
            "ros2 bag reindex mends the folder of a ROS 2 bag"
        ) from error
    return reader


def _reason(error: Exception) -> str:
    return one_line(error) or type(error).__name__


def _channel(key: tuple[int, int], connection: Any) -> Channel:
    stated = connection.msgdef
    encoding = connection.ext.serialization_format
    language = "ros2idl" if stated.format.name == "IDL" else "ros2msg"
    definition = stated.data.encode() or schema_text(connection.msgtype)
    return Channel(key, connection.topic, encoding, key[1], connection.msgtype, language, definition)
