"""A log of any format that is known as one MCAP file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import InputError
from pipeline.logs.opening import index_files
from pipeline.logs.records import FileIndex
from pipeline.logs.selection import EVERYTHING
from pipeline.logs.stream import decoded_messages
from pipeline.logs.topics import topics_of
from pipeline.logs.write import LogWriter
from pipeline.source import Source

_AHEAD = 4  # blocks


@dataclass(frozen=True, slots=True)
class Converted:
    """What came of a conversion: messages by topic, what was left out by choice, what could not be read."""

    path: Path
    messages: dict[str, int]
    notes: tuple[str, ...]
    damage: tuple[str, ...]


def convert(
    sources: Sequence[Source],
    destination: Path,
    *,
    rate_hz: float = 0.0,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Converted:
    """Write every message of the sources, one log, by log time. ROS messages stay as they are, byte by byte.

    rate_hz : as for ``index_files``. Raises InputError for what cannot be read or written.
    """
    if destination.suffix != ".mcap":
        raise InputError(f"{destination}: does not end in .mcap; name it {destination.with_suffix('.mcap')}")
    indexes = index_files(sources, rate_hz)
    is_folder = isinstance(sources[0], Path) and sources[0].is_dir()
    if len(indexes) == 1 and indexes[0].make is None and not is_folder:
        raise InputError(f"{sources[0]}: is MCAP already; scanchain run takes it as it is")
    total = sum(sum(index.counts.values()) for index in indexes)
    counts = dict.fromkeys(topics_of(indexes), 0)
    damage = [line for index in indexes for line in index.damage]
    with LogWriter(destination, force=force, profile=_profile(indexes)) as log:
        decoders = dict.fromkeys(counts, bytes)
        for message in decoded_messages(indexes, decoders, EVERYTHING, ahead=_AHEAD, damage=damage):
            assert isinstance(message.value, bytes)
            log.copy(message.channel, message.log_time_ns, message.value)
            counts[message.channel.topic] += 1
            if progress is not None:
                progress(sum(counts.values()), total)
        if not sum(counts.values()):
            raise InputError(
                f"{sources[0]}: holds no message that could be read: {'; '.join(damage) or 'it is empty'}"
            )
    notes = tuple(line for index in indexes for line in index.notes)
    return Converted(destination, counts, notes, tuple(damage))


def _profile(indexes: Sequence[FileIndex]) -> str:
    """The convention that all channels keep, empty where they differ."""
    encodings = {channel.encoding for index in indexes for channel in index.channels.values()}
    return {frozenset({"cdr"}): "ros2", frozenset({"ros1"}): "ros1"}.get(frozenset(encodings), "")
