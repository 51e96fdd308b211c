"""Conversion of a log of any supported format to one MCAP file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

from scanchain.config import LogConfig
from scanchain.errors import InputError, grouped
from scanchain.files import Source
from scanchain.logs import stream
from scanchain.logs.index import Decoded, FileIndex, name_of
from scanchain.logs.log import Log
from scanchain.logs.messages.readers import is_lidar
from scanchain.logs.opening import AUTO, DEFAULTS, index_files
from scanchain.logs.topics import find_lidars, topics_of
from scanchain.logs.writer import LogWriter

_FIXED = "tf_static"  # end of the name of a topic of fixed transforms
_WHOLE = (DEFAULTS.topic, DEFAULTS.start_s, DEFAULTS.end_s, DEFAULTS.every)


@dataclass(frozen=True, slots=True)
class Converted:
    """Result of a conversion: message counts by topic, notes on what was left out by choice, and damage."""

    path: Path
    messages: dict[str, int]
    notes: tuple[str, ...]
    damage: tuple[str, ...]


def convert(
    sources: Sequence[Source],
    destination: Path,
    *,
    config: LogConfig = DEFAULTS,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Converted:
    """Write the sources, as one log, to an MCAP file in order of log time; ROS messages are copied unchanged.

    config : what is left out: messages before ``start_s`` and after ``end_s``, lidars other than ``topic``, all
        but every ``every``-th scan; static transforms of the whole log are kept
    Raises InputError if the sources cannot be read or the file cannot be written.
    """
    if destination.suffix != ".mcap":
        raise InputError(f"{destination}: does not end in .mcap; name it {destination.with_suffix('.mcap')}")
    indexes = index_files(sources, config)
    is_folder = isinstance(sources[0], Path) and sources[0].is_dir()
    is_part = (config.topic, config.start_s, config.end_s, config.every) != _WHOLE
    is_mcap = indexes[0].path.name.endswith(".mcap") and config.format == AUTO
    if len(indexes) == 1 and is_mcap and not is_folder and not is_part:
        raise InputError(f"{sources[0]}: is MCAP already; --start, --end, --every or --topic cut it")
    total = sum(sum(index.counts.values()) for index in indexes)
    lidars, channels = find_lidars(indexes, config.topic) if config.topic else [], topics_of(indexes)
    others = [name for name in channels if lidars and is_lidar(channels[name]) and channels[name] not in lidars]
    counts = {name: 0 for name in channels if name not in others}
    for topic in counts:
        if config.every > 1 and is_lidar(channels[topic]) and Log(indexes, replace(config, topic=topic)).sectors:
            parts = f"the messages of {topic} are sectors of revolutions, in which --every would cause dropouts"
            raise InputError(f"{name_of(indexes)}: {parts}; run counts sweeps instead")
    span = stream.chosen_span(stream.whole_span(indexes), config)
    moving = [topic for topic in counts if not topic.endswith(_FIXED)]
    if span != stream.EVERYTHING and not any(stream.count_messages(indexes, topic, span) for topic in moving):
        raise stream.nothing_in_part(f"{name_of(indexes)}: no message", stream.whole_span(indexes), config)
    damage = [line for index in indexes for line in index.damage]
    encodings = {channel.encoding for index in indexes for channel in index.channels.values()}
    profile = "ros2" if encodings == {"cdr"} else "ros1" if encodings == {"ros1"} else ""
    with LogWriter(destination, force=force, profile=profile) as log:
        for message in _messages(indexes, counts, config, damage):
            log.copy(message.channel, message.log_time_ns, message.value)
            counts[message.channel.topic] += 1
            if progress is not None:
                progress(sum(counts.values()), total)
        if not sum(counts.values()):
            raise InputError(
                f"{name_of(indexes)}: contains no readable message: {'; '.join(grouped(damage)) or 'it is empty'}"
            )
    notes = (*(line for index in indexes for line in index.notes), *stream.notes_on(indexes, config))
    return Converted(destination, counts, notes, tuple(grouped(damage)))


def _messages(
    indexes: Sequence[FileIndex], topics: Iterable[str], config: LogConfig, damage: list[str]
) -> Iterator[Decoded]:
    """Messages to write. For a part of a log, static transforms come first, at log times within the part."""
    span = stream.chosen_span(stream.whole_span(indexes), config)
    fixed = set() if span == stream.EVERYTHING else {topic for topic in topics if topic.endswith(_FIXED)}
    for message in stream.decoded_messages(indexes, dict.fromkeys(fixed, bytes), stream.EVERYTHING, damage=[]):
        yield message._replace(log_time_ns=min(max(message.log_time_ns, span.begin_ns), span.end_ns))
    others = dict.fromkeys((topic for topic in topics if topic not in fixed), bytes)
    scans = Counter[str]()
    for message in stream.decoded_messages(indexes, others, span, damage=damage):
        scans[message.channel.topic] += is_lidar(message.channel)
        if not isinstance(message.value, bytes):  # an error: it could not be read
            continue
        if (scans[message.channel.topic] - 1) % config.every == 0 or not is_lidar(message.channel):
            yield message
