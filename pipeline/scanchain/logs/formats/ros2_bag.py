"""ROS 2 bags in SQLite, read by rosbags; their messages stay as they are."""

from __future__ import annotations

import threading
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from scanchain.errors import InputError, one_line
from scanchain.logs.files import size_of
from scanchain.logs.mcap.records import Block, Channel, Contents, FileIndex, Message
from scanchain.logs.writer import schema_text

_BLOCK_BYTES = 4_000_000  # size of a block in bytes of the file, about; damage loses the rest of one
_MOST_BLOCKS = 8192
_LATEST_NS = (1 << 63) - 1


def index_ros2_bag(path: Path, number: int) -> FileIndex:
    """The topics of a .db3 or the folder of a ROS 2 bag; blocks are spans of time. Raises InputError for none."""
    from rosbags import rosbag2

    try:
        reader: Any = rosbag2.Reader(path)
        reader.open()
        begin_ns = reader.start_time or next((time_ns for _, time_ns, _ in reader.messages(start=1)), 0)
    except Exception as error:  # whatever a damaged file makes the libraries below raise
        raise InputError(
            f"{path}: cannot be read as a ROS bag ({one_line(error)}); "
            "ros2 bag reindex mends the folder of a ROS 2 bag"
        ) from error
    index = FileIndex(path, number)
    connections: dict[int, Any] = {}
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
            index.counts[id_], connections[id_] = each.msgcount, each
    if connections:  # spans of time of one length, so many that each holds a few megabytes on average
        length_ns, size = reader.end_time - begin_ns, size_of(path)
        count = min(max(size // _BLOCK_BYTES, 1), _MOST_BLOCKS, max(length_ns, 1))
        edges_ns = [begin_ns + length_ns * place // count for place in range(count + 1)]
        for place, (start_ns, stop_ns) in enumerate(pairwise(edges_ns)):
            share = size // count
            index.blocks.append(Block(number, place, share, "", share, start_ns, stop_ns - 1))
        if not reader.start_time:  # messages of log time 0, which are in the first block
            index.blocks[0] = replace(index.blocks[0], start_ns=0)
    index.make = partial(_contents, index, reader, connections, threading.Lock())
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


def _contents(
    index: FileIndex,
    reader: Any,
    connections: dict[int, Any],
    lock: threading.Lock,
    block: Block,
    wanted: AbstractSet[int] | None,
) -> Contents:
    """The messages of a span of time, up to the first that cannot be read.

    One thread at a time may use the reader of rosbags.
    """
    chosen = [each for number, each in connections.items() if wanted is None or number in wanted]
    if not chosen:
        return Contents([], "")
    channels = {id(each): index.channels[number] for number, each in connections.items()}
    is_last = block.offset == len(index.blocks) - 1  # both ends reach as far as time, whatever the metadata
    begin_ns, end_ns = block.start_ns if block.offset else 0, _LATEST_NS if is_last else block.end_ns + 1
    messages: list[Message] = []
    with lock:
        try:
            for connection, time_ns, data in reader.messages(chosen, begin_ns, end_ns):
                messages.append(Message(channels[id(connection)], time_ns, memoryview(data)))
        except Exception as error:  # whatever a damaged file makes the libraries below raise
            begin_ns = messages[-1].log_time_ns if messages else block.start_ns
            lost = (
                f"{begin_ns * 1e-9:.3f} to {block.end_ns * 1e-9:.3f} s cannot be read further ({one_line(error)})"
            )
            return Contents(messages, f"{index.path}: what was recorded from {lost}")
    return Contents(messages, "")
