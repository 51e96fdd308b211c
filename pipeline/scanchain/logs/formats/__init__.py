"""Declaration of a log format, and functions for formats whose messages are made on reading."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from scanchain.config import LogConfig
from scanchain.logs.index import Block, Channel, FileIndex
from scanchain.logs.writer import schema_text


@dataclass(frozen=True, slots=True)
class Format:
    """A log format, as its module declares it.

    name : value of ``log.format``
    description : paths of the format, for errors
    recognizes : True for a path of the format, by its first bytes (empty for a folder) or its contents
    index : index of a path of the format as the file of a log with this number
    suffixes : of its files; a folder that holds several has logs, parts of one log, or scans of one log
    parts_of : files that a folder names as the parts of a log, to be read one by one; empty if it names none
    """

    name: str
    description: str
    recognizes: Callable[[Path, bytes], bool]
    index: Callable[[Path, int, LogConfig], FileIndex]
    suffixes: tuple[str, ...] = ()
    files_are: Literal["logs", "parts", "scans"] = "logs"
    parts_of: Callable[[Path], Sequence[Path]] = lambda _: ()


def add_channel(index: FileIndex, topic: str, type_name: str) -> Channel:
    """New channel added to the index, with messages in CDR; ``type_name`` is package/msg/Type."""
    number = len(index.channels) + 1
    definition = schema_text(type_name)
    channel = Channel((index.number, number), topic, "cdr", number, type_name, "ros2msg", definition)
    index.channels[number] = channel
    return channel


def add_block(
    index: FileIndex, offset: int, size: int, times_ns: Sequence[int], counts: dict[Channel, int]
) -> None:
    """Append a block, identified by ``offset``; ``size`` is its approximate number of bytes."""
    held = {channel.key[1]: count for channel, count in counts.items() if count}
    span = min(times_ns), max(times_ns)
    index.blocks.append(Block(index.number, offset, size, "", size, *span, held))


def natural_order(path: Path) -> tuple[tuple[int, ...], str]:
    """Sort key that puts log_2 before log_10."""
    return tuple(int(digits) for digits in re.findall(r"\d+", path.stem)), path.name


def left_out(folder: Path, read: str, suffixes: Sequence[str]) -> list[str]:
    """Note on files of a folder that contain scans, too, but in another format than those read."""
    counts = Counter(file.suffix.lower() for file in folder.iterdir() if file.is_file())
    others = ", ".join(f"{counts[each]:,} {each}" for each in suffixes if counts[each] and each != read)
    if not others:
        return []
    return [f"{folder}: only its {read} files are read, not {others}; move those to another folder"]


class UnknownFormatError(Exception):
    """A file or folder that is not a log of the assumed format: arguments are its text and what it lacks."""
