"""Messages of a log: their chosen part, their number, and all of them, decoded, in order of log time.

Chunks and files may overlap; they are decompressed and decoded ahead in threads.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from heapq import heappop, heappush
from itertools import pairwise
from math import inf
from random import Random
from typing import NamedTuple

from scanchain.config import LogConfig
from scanchain.errors import InputError, counted, duration
from scanchain.logs.index import (
    Block,
    DamagedBlockError,
    Decoded,
    FileIndex,
    Message,
    damage_of,
    name_of,
    read_block,
    release,
)
from scanchain.logs.messages.readers import is_lidar
from scanchain.logs.messages.ros import MalformedMessageError
from scanchain.threads import threads


class Span(NamedTuple):
    """Interval of log times, both ends included."""

    begin_ns: int
    end_ns: int

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return (self.end_ns - self.begin_ns) * 1e-9

    def contains(self, message: Message) -> bool:
        """True if the message was logged within the interval."""
        return self.begin_ns <= message.log_time_ns <= self.end_ns

    def overlaps(self, block: Block) -> bool:
        """True if the block may contain messages of the interval."""
        return block.may_be_empty or (block.end_ns >= self.begin_ns and block.start_ns <= self.end_ns)


_LONG_GAP_NS = 60_000_000_000  # longest time without any message that is not reported

EVERYTHING = Span(0, (1 << 64) - 1)


def whole_span(indexes: Sequence[FileIndex]) -> Span:
    """From the first to the last message of all topics; (0, 0) if there is none."""
    blocks = _timed(indexes)
    begin_ns = min((block.start_ns for block in blocks), default=0)
    return Span(begin_ns, max((block.end_ns for block in blocks), default=0))


def chosen_span(whole: Span, config: LogConfig) -> Span:
    """From ``log.start_s`` to ``log.end_s`` after the first message; everything if neither is set."""
    if config.start_s == 0.0 and config.end_s == inf:
        return EVERYTHING
    begin_ns = whole.begin_ns + round(config.start_s * 1e9)
    end_s = min(config.end_s, whole.duration_s)
    return Span(begin_ns, whole.end_ns if end_s == whole.duration_s else whole.begin_ns + round(end_s * 1e9))


def notes_on(indexes: Sequence[FileIndex], config: LogConfig) -> list[str]:
    """Warnings about the chosen part: long gaps, or an end after that of the log."""
    whole_s = whole_span(indexes).duration_s
    late_end = f"--end {config.end_s:g} s has no effect: the log ends at {whole_s:.1f} s"
    return [*([late_end] if whole_s < config.end_s < inf else []), *gap_notes(indexes, config)]


def gap_notes(indexes: Sequence[FileIndex], config: LogConfig) -> list[str]:
    """Warnings about gaps of more than a minute in the chosen part."""
    begin_ns, notes = whole_span(indexes).begin_ns, []
    for before, after in _long_gaps(indexes, config):
        files = [indexes[block.file].path.name for block in (before, after)]
        where = f" between {files[0]} and {files[1]}" if before.file != after.file else ""
        notes.append(
            f"no message for {duration(1e-9 * (after.start_ns - before.end_ns))} from "
            f"{1e-9 * (before.end_ns - begin_ns):.1f} s on{where}; read as one log: "
            "--start and --end choose a part"
        )
    return notes


def overlap_notes(indexes: Sequence[FileIndex], topic: str) -> Iterator[str]:
    """Warnings about files that contain messages of a topic at the same time, for more than a second."""
    holding = [index for index in indexes if index.numbers_of(topic)]
    for before, after in pairwise(sorted(holding, key=lambda index: whole_span([index]))):
        if whole_span([before]).end_ns > whole_span([after]).begin_ns:
            first, second = ends_of([before], topic), ends_of([after], topic)
            both_s = 1e-9 * (min(first.end_ns, second.end_ns) - second.begin_ns)
            if both_s > 1.0:
                yield (
                    f"{before.path.name} and {after.path.name} both contain {topic} for {duration(both_s)}, read "
                    "as of one lidar: if they are of two robots, or the same twice, name one of them"
                )


def check_one_log(indexes: Sequence[FileIndex], config: LogConfig) -> None:
    """Check that files with scans are close enough in time to be parts of one log. Raises InputError.

    Files without scans, such as a calibration, may be of any time.
    """
    scanned = {
        index.number
        for index in indexes
        if any(is_lidar(channel) and index.counts.get(number) for number, channel in index.channels.items())
    }
    for before, after in _long_gaps(indexes, config, scanned):
        gap_ns = after.start_ns - before.end_ns
        if before.file != after.file and gap_ns > 86_400_000_000_000:  # a day
            raise InputError(
                f"{indexes[before.file].path} ends {duration(1e-9 * gap_ns)} before {indexes[after.file].path} "
                "begins, so they are not parts of one log; run each separately, or all with scanchain batch"
            )


def are_parts(indexes: Sequence[FileIndex]) -> bool:
    """True if no two files have scans of one lidar at the same time, and no gap is longer than a minute."""
    last: dict[str, int] = {}
    for index in sorted(indexes, key=lambda index: whole_span([index])):
        span = whole_span([index])
        for topic in {channel.topic for channel in index.channels.values() if is_lidar(channel)}:
            if span.begin_ns < last.get(topic, 0):
                return False
            last[topic] = span.end_ns
    return not any(before.file != after.file for before, after in _long_gaps(indexes, LogConfig()))


def _long_gaps(
    indexes: Sequence[FileIndex], config: LogConfig, files: Collection[int] | None = None
) -> Iterator[tuple[Block, Block]]:
    """Blocks before and after gaps of more than a minute in the chosen part, of all files or of some."""
    span = chosen_span(whole_span(indexes), config)
    last: Block | None = None
    for block in sorted(filter(span.overlaps, _timed(indexes)), key=lambda block: block.start_ns):
        if files is not None and block.file not in files:
            continue
        if last is not None and block.start_ns - last.end_ns > _LONG_GAP_NS:
            yield last, block
        last = block if last is None or block.end_ns > last.end_ns else last


def _timed(indexes: Sequence[FileIndex]) -> list[Block]:
    """Blocks that contain messages; all of them if none is known to."""
    blocks = [block for index in indexes for block in index.blocks]
    return [block for block in blocks if not block.may_be_empty] or blocks


def count_messages(indexes: Sequence[FileIndex], topic: str, span: Span) -> int:
    """Number of messages of a topic in an interval."""
    count = 0
    for index in indexes:
        wanted = index.numbers_of(topic)
        for block in filter(span.overlaps, index.blocks):
            if block.counts and span.begin_ns <= block.start_ns <= block.end_ns <= span.end_ns:
                count += sum(block.counts.get(number, 0) for number in wanted)
            elif index.may_hold(block, wanted):
                count += sum(span.contains(message) for message in messages_of(index, block, wanted))
    return count


def count_scans(indexes: Sequence[FileIndex], topic: str, whole: Span, config: LogConfig) -> int:
    """Number of scans of a topic in the chosen part, every n-th. Raises InputError if there is none."""
    name, span = name_of(indexes), chosen_span(whole, config)
    total = sum(index.counts.get(number, 0) for index in indexes for number in index.numbers_of(topic))
    if not total:
        remedy = damage_of(indexes) or "; scanchain info lists the topics"
        raise InputError(f"{name}: topic {topic} has no messages{remedy}")
    chosen = total if span == EVERYTHING else count_messages(indexes, topic, span)
    if not chosen:
        raise nothing_in_part(f"{name}: no scan of {topic}", whole, config)
    return -(-chosen // config.every)


def nothing_in_part(what: str, whole: Span, config: LogConfig) -> InputError:
    """Error for a part without messages."""
    start, end = f"--start {config.start_s:g} s", f"--end {config.end_s:g} s"
    part = f"between {start} and {end}" if config.start_s else f"before {end}"
    part = f"after {start}" if config.end_s == inf else part
    return InputError(f"{what} lies {part}; the log is {whole.duration_s:.1f} s long")


def complete(index: FileIndex) -> None:
    """Add the channels and counts inside the chunks of a file without a complete summary."""
    counts = index.indexed_counts()
    unknown = {number for number in {*index.counts, *counts} if not index.knows(number)}
    for block in sorted(index.blocks, key=lambda each: unknown.isdisjoint(each.counts)):
        if unknown or not (block.counts or index.counts):
            messages = messages_of(index, block)
            counts.update(message.channel.key[1] for message in messages if not block.counts)
            unknown = {number for number in unknown if not index.knows(number)}
    index.channels |= {k: channel for k, channel in index.uncertain_channels.items() if k in unknown}
    index.counts = index.counts or dict(counts)
    _begin(index)


def _begin(index: FileIndex) -> None:
    """Replace log times of 0, as before the first /clock, by that of the first other message.

    In a log that really begins at 0 the clock neither stands still nor jumps there.
    """
    untimed = [block for block in index.blocks if block.start_ns == 0 and not block.may_be_empty]
    messages = [message for block in untimed for message in messages_of(index, block)]
    times_ns = [*(message.log_time_ns for message in messages), *(block.start_ns for block in index.blocks)]
    begin_ns = min(filter(None, times_ns), default=0)
    counts = Counter(message.channel.key[1] for message in messages if message.log_time_ns == 0)
    if counts and begin_ns and (max(counts.values()) > 1 or begin_ns > _LONG_GAP_NS):
        index.begin_ns = begin_ns
        index.blocks = [
            replace(block, start_ns=begin_ns, end_ns=max(block.end_ns, begin_ns)) if block in untimed else block
            for block in index.blocks
        ]
        index.notes.append(
            f"{index.path}: {counted(counts.total(), 'message')} of log time 0, as before the first /clock: read "
            "as of the first time that follows"
        )


def ends_of(indexes: Sequence[FileIndex], topic: str) -> Span:
    """From the first to the last message of a topic, read from the chunks they are in; (0, 0) if unknown."""
    times_ns: list[int] = []
    for index in indexes:
        for number in index.numbers_of(topic):
            holding = [block for block in index.blocks if number in block.counts]
            for block in holding[:1] + holding[1:][-1:]:
                times_ns += [message.log_time_ns for message in messages_of(index, block, {number})]
    return Span(min(times_ns, default=0), max(times_ns, default=0))


def messages_of(index: FileIndex, block: Block, wanted: AbstractSet[int] | None = None) -> list[Message]:
    """Messages of a block, of the wanted channels or of all; none, and a line of damage, if it is damaged."""
    try:
        return read_block(index, block, wanted).messages
    except DamagedBlockError as error:
        index.add_damage(f"{error}; it is skipped")
        return []


Decoders = Mapping[str, Callable[[memoryview], object]]


def decoded_messages(
    indexes: Sequence[FileIndex], decoders: Decoders, span: Span, *, damage: list[str], ahead: int = 4
) -> Iterator[Decoded]:
    """Messages of the topics that have a decoder, by log time; at equal times in the order of the files.

    ahead : largest number of decoded blocks that wait, twice as many of a remote log
    damage : extended by what is skipped
    """
    wanted = [index.numbers_of(*decoders) for index in indexes]

    def decode(block: Block) -> tuple[list[Decoded], str]:
        try:
            contents = read_block(indexes[block.file], block, wanted[block.file])
        except DamagedBlockError as error:
            return [], f"{error}; it is skipped"
        decoded = [
            Decoded(message.channel, message.log_time_ns, _decode(decoders[message.channel.topic], message))
            for message in contents.messages
            if span.contains(message)
        ]
        release(indexes[block.file], block)
        return decoded, contents.damage

    blocks = _blocks_of(indexes, wanted, span)
    waiting: list[tuple[int, int, int, int, Decoded]] = []
    is_remote = any(index.fetch is not None for index in indexes)
    ahead *= 2 if is_remote else 1  # each is a request
    results = _ahead(blocks, decode, ahead, damage, workers=max(threads(), ahead * is_remote))
    for (block, following), messages in zip(pairwise([*blocks, None]), results, strict=True):
        assert block is not None
        for place, message in enumerate(messages):
            heappush(waiting, (message.log_time_ns, block.file, block.offset, place, message))
        while waiting and (following is None or waiting[0][0] < following.start_ns):
            yield heappop(waiting)[-1]


def _blocks_of(indexes: Sequence[FileIndex], wanted: Sequence[set[int]], span: Span) -> list[Block]:
    """Blocks that may contain messages of the wanted channels of each file, by time."""
    found = [block for index in indexes for block in index.blocks if index.may_hold(block, wanted[block.file])]
    return sorted(filter(span.overlaps, found), key=lambda block: (block.start_ns, block.file, block.offset))


def _decode(decoder: Callable[[memoryview], object], message: Message) -> object:
    if message.defect:
        return MalformedMessageError(message.defect)
    try:
        return decoder(message.data)
    except MalformedMessageError as error:
        return error


def _ahead(
    blocks: Sequence[Block],
    decode: Callable[[Block], tuple[list[Decoded], str]],
    ahead: int,
    damage: list[str],
    *,
    workers: int,
) -> Iterator[list[Decoded]]:
    """Messages in the order of the blocks, decoded by threads, which end when the iterator is closed."""
    running: deque[tuple[Block, Future[tuple[list[Decoded], str]]]] = deque()
    size = 0
    pool = ThreadPoolExecutor(workers, thread_name_prefix="scanchain-read")
    try:
        for block in (*blocks, None):
            if block is not None:
                running.append((block, pool.submit(decode, block)))
                size += block.uncompressed_size
            while len(running) > (0 if block is None else ahead) or (
                size > 256_000_000 and len(running) > 1  # limits memory
            ):
                done, future = running.popleft()
                size -= done.uncompressed_size
                messages, lost = future.result()
                damage += [lost] if lost and lost not in damage else []
                yield messages
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def sampled_messages(
    indexes: Sequence[FileIndex],
    topic: str,
    decode: Callable[[memoryview], object],
    span: Span | None = None,
    *,
    blocks: int = 8,
    most: int | None = None,
) -> Iterator[Decoded]:
    """Decoded messages of a topic's first blocks, or of blocks spread over a span; without malformed ones.

    blocks : number of blocks read; most : largest number of messages of each, drawn at random, in order
    """
    chosen, at_random = EVERYTHING if span is None else span, Random(0)
    found = _blocks_of(indexes, [index.numbers_of(topic) for index in indexes], chosen)
    if span is not None and len(found) > blocks:
        found = [found[k * (len(found) - 1) // max(blocks - 1, 1)] for k in range(blocks)]
    for block in found[:blocks]:
        messages = messages_of(indexes[block.file], block)
        messages = [each for each in messages if each.channel.topic == topic and chosen.contains(each)]
        if most is not None and len(messages) > most:
            messages = [messages[k] for k in sorted(at_random.sample(range(len(messages)), most))]
        for message in messages:
            with suppress(MalformedMessageError):
                yield Decoded(message.channel, message.log_time_ns, decode(message.data))
