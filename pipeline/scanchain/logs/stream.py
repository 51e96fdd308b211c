"""Messages of a log: the part that is read by log time, how many they are, and all of them, decoded in order.

Chunks and files may overlap; they are unpacked and decoded ahead in threads.
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
    """Log times in nanoseconds, both ends included."""

    begin_ns: int
    end_ns: int

    @property
    def duration_s(self) -> float:
        """Seconds from one end to the other."""
        return (self.end_ns - self.begin_ns) * 1e-9

    def holds(self, message: Message) -> bool:
        """True if the message was logged within it."""
        return self.begin_ns <= message.log_time_ns <= self.end_ns

    def meets(self, block: Block) -> bool:
        """True if the block may hold messages of the span."""
        return block.may_be_empty or (block.end_ns >= self.begin_ns and block.start_ns <= self.end_ns)


_LONG_GAP_NS = 60_000_000_000  # without any message
_LONGEST_GAP_NS = 86_400_000_000_000  # without any message between two files of one log

EVERYTHING = Span(0, (1 << 64) - 1)


def whole_span(indexes: Sequence[FileIndex]) -> Span:
    """From the first message of all topics to the last, (0, 0) where there is none."""
    blocks = _timed(indexes)
    begin_ns = min((block.start_ns for block in blocks), default=0)
    return Span(begin_ns, max((block.end_ns for block in blocks), default=0))


def chosen_span(whole: Span, config: LogConfig) -> Span:
    """From ``log.start_s`` to ``log.end_s``, counted from the first message; everything where neither is set."""
    if config.start_s == 0.0 and config.end_s == inf:
        return EVERYTHING
    begin_ns = whole.begin_ns + round(config.start_s * 1e9)
    end_s = min(config.end_s, whole.duration_s)
    return Span(begin_ns, whole.end_ns if end_s == whole.duration_s else whole.begin_ns + round(end_s * 1e9))


def notes_on(indexes: Sequence[FileIndex], config: LogConfig) -> list[str]:
    """Warnings about the chosen part: an end beyond that of the log, long gaps within it."""
    whole_s = whole_span(indexes).duration_s
    is_beyond = whole_s < config.end_s < inf
    beyond = f"--end {config.end_s:g} s has no effect: the log ends at {whole_s:.1f} s"
    return [*([beyond] if is_beyond else []), *gap_notes(indexes, config)]


def gap_notes(indexes: Sequence[FileIndex], config: LogConfig) -> list[str]:
    """Warnings about gaps of more than a minute in the chosen part."""
    begin_ns, notes = whole_span(indexes).begin_ns, []
    for before, behind in _long_gaps(indexes, config):
        files = [indexes[block.file].path.name for block in (before, behind)]
        where = f" between {files[0]} and {files[1]}" if before.file != behind.file else ""
        notes.append(
            f"no message for {duration(1e-9 * (behind.start_ns - before.end_ns))} from "
            f"{1e-9 * (before.end_ns - begin_ns):.1f} s on{where}: read as one log all the same; "
            "--start and --end choose a part"
        )
    return notes


def check_one_log(indexes: Sequence[FileIndex], config: LogConfig) -> None:
    """Refuse files with scans that lie too far apart in time to be parts of one log. Raises InputError.

    Files without scans, as of a calibration, may be of any time.
    """
    scanned = {
        index.number
        for index in indexes
        if any(is_lidar(channel) and index.counts.get(number) for number, channel in index.channels.items())
    }
    for before, behind in _long_gaps(indexes, config, scanned):
        gap_ns = behind.start_ns - before.end_ns
        if before.file != behind.file and gap_ns > _LONGEST_GAP_NS:
            raise InputError(
                f"{indexes[before.file].path} ends {duration(1e-9 * gap_ns)} before {indexes[behind.file].path} "
                "begins: they are not parts of one log; run each by itself, or all of them with scanchain batch"
            )


def are_parts(indexes: Sequence[FileIndex]) -> bool:
    """True if no two files hold the same lidar's scans of one time, and none begins a minute after the others."""
    last: dict[str, int] = {}
    for index in sorted(indexes, key=lambda index: whole_span([index])):
        span = whole_span([index])
        for topic in {channel.topic for channel in index.channels.values() if is_lidar(channel)}:
            if span.begin_ns < last.get(topic, 0):
                return False
            last[topic] = span.end_ns
    return not any(before.file != behind.file for before, behind in _long_gaps(indexes, LogConfig()))


def _long_gaps(
    indexes: Sequence[FileIndex], config: LogConfig, files: Collection[int] | None = None
) -> Iterator[tuple[Block, Block]]:
    """The blocks before and behind gaps of more than a minute in the chosen part, or in that of some files."""
    span = chosen_span(whole_span(indexes), config)
    last: Block | None = None
    for block in sorted(filter(span.meets, _timed(indexes)), key=lambda block: block.start_ns):
        if files is not None and block.file not in files:
            continue
        if last is not None and block.start_ns - last.end_ns > _LONG_GAP_NS:
            yield last, block
        last = block if last is None or block.end_ns > last.end_ns else last


def _timed(indexes: Sequence[FileIndex]) -> list[Block]:
    """Blocks that hold messages; all of them if none is known to."""
    blocks = [block for index in indexes for block in index.blocks]
    return [block for block in blocks if not block.may_be_empty] or blocks


def count_messages(indexes: Sequence[FileIndex], topic: str, span: Span) -> int:
    """Number of messages of a topic in the span."""
    count = 0
    for index in indexes:
        wanted = index.numbers_of(topic)
        for block in filter(span.meets, index.blocks):
            if block.counts and span.begin_ns <= block.start_ns <= block.end_ns <= span.end_ns:
                count += sum(block.counts.get(number, 0) for number in wanted)
            elif index.may_hold(block, wanted):
                count += sum(span.holds(message) for message in messages_of(index, block, wanted))
    return count


def count_scans(indexes: Sequence[FileIndex], topic: str, whole: Span, config: LogConfig) -> int:
    """Number of scans of the topic in the chosen part, every n-th. Raises InputError where there is none."""
    name, span = name_of(indexes), chosen_span(whole, config)
    total = sum(index.counts.get(number, 0) for index in indexes for number in index.numbers_of(topic))
    if not total:
        remedy = damage_of(indexes) or "; scanchain info lists what there is"
        raise InputError(f"{name}: topic {topic} has no messages{remedy}")
    chosen = total if span == EVERYTHING else count_messages(indexes, topic, span)
    if not chosen:
        raise nothing_in_part(f"{name}: no scan of {topic}", whole, config)
    return -(-chosen // config.every)


def nothing_in_part(what: str, whole: Span, config: LogConfig) -> InputError:
    """Error of a part that holds nothing."""
    start, end = f"--start {config.start_s:g} s", f"--end {config.end_s:g} s"
    part = f"between {start} and {end}" if config.start_s else f"before {end}"
    part = f"after {start}" if config.end_s == inf else part
    return InputError(f"{what} lies {part}; the log is {whole.duration_s:.1f} s long")


def complete(index: FileIndex) -> None:
    """Add the channels and counts that a file without a full summary has inside its chunks."""
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
    """Give log times of 0, as before the first /clock, that of the first other message.

    A log may begin at 0, but then its clock does not stand still there, nor jump from there.
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
    """From the first message of a topic to the last, by the chunks they are in; (0, 0) where unknown."""
    times_ns: list[int] = []
    for index in indexes:
        for number in index.numbers_of(topic):
            holding = [block for block in index.blocks if number in block.counts]
            for block in holding[:1] + holding[1:][-1:]:
                times_ns += [message.log_time_ns for message in messages_of(index, block, {number})]
    return Span(min(times_ns, default=0), max(times_ns, default=0))


def messages_of(index: FileIndex, block: Block, wanted: AbstractSet[int] | None = None) -> list[Message]:
    """The messages of a block, of all channels or of those wanted; none where it is damaged, which is noted."""
    try:
        return read_block(index, block, wanted).messages
    except DamagedBlockError as error:
        index.note_damage(f"{error}; it was left out")
        return []


Decoders = Mapping[str, Callable[[memoryview], object]]
_BLOCKS_AHEAD = 4  # that wait decoded, at most
_REMOTE_TIMES = 2  # as many wait of a remote log, each one request
_MOST_BYTES_AHEAD = 256_000_000

_SAMPLED_BLOCKS = 8  # number of first blocks of a topic that are searched


def decoded_messages(
    indexes: Sequence[FileIndex], decoders: Decoders, span: Span, *, damage: list[str], ahead: int = _BLOCKS_AHEAD
) -> Iterator[Decoded]:
    """Every message of a topic that has a decoder, by log time; ties in the order of the files.

    At most ``ahead`` blocks wait decoded. What is damaged is left out and named in ``damage``.
    """
    wanted = [index.numbers_of(*decoders) for index in indexes]

    def decode(block: Block) -> tuple[list[Decoded], str]:
        try:
            contents = read_block(indexes[block.file], block, wanted[block.file])
        except DamagedBlockError as error:
            return [], f"{error}; it was left out"
        decoded = [
            Decoded(message.channel, message.log_time_ns, _decode(decoders[message.channel.topic], message))
            for message in contents.messages
            if span.holds(message)
        ]
        release(indexes[block.file], block)
        return decoded, contents.damage

    blocks = _blocks_of(indexes, wanted, span)
    waiting: list[tuple[int, int, int, int, Decoded]] = []
    is_remote = any(index.fetch is not None for index in indexes)
    ahead *= _REMOTE_TIMES if is_remote else 1
    results = _ahead(blocks, decode, ahead, damage, workers=max(threads(), ahead * is_remote))
    for (block, following), messages in zip(pairwise([*blocks, None]), results, strict=True):
        assert block is not None
        for place, message in enumerate(messages):
            heappush(waiting, (message.log_time_ns, block.file, block.offset, place, message))
        while waiting and (following is None or waiting[0][0] < following.start_ns):
            yield heappop(waiting)[-1]


def _blocks_of(indexes: Sequence[FileIndex], wanted: Sequence[set[int]], span: Span) -> list[Block]:
    """Those that may hold messages of the wanted channels of each file, by time."""
    found = [block for index in indexes for block in index.blocks if index.may_hold(block, wanted[block.file])]
    return sorted(filter(span.meets, found), key=lambda block: (block.start_ns, block.file, block.offset))


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
    """Contents in the order of the blocks, decoded by threads that end when the iterator is closed."""
    running: deque[tuple[Block, Future[tuple[list[Decoded], str]]]] = deque()
    size = 0
    pool = ThreadPoolExecutor(workers, thread_name_prefix="scanchain-read")
    try:
        for block in (*blocks, None):
            if block is not None:
                running.append((block, pool.submit(decode, block)))
                size += block.uncompressed_size
            while len(running) > (0 if block is None else ahead) or (
                size > _MOST_BYTES_AHEAD and len(running) > 1
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
    blocks: int = _SAMPLED_BLOCKS,
    most: int | None = None,
) -> Iterator[Decoded]:
    """Decoded messages in a topic's first blocks, or in some from all over a span; malformed ones are left out.

    blocks : number of those that are read; most : number of messages of each, at random but in order
    """
    chosen, at_random = EVERYTHING if span is None else span, Random(0)
    found = _blocks_of(indexes, [index.numbers_of(topic) for index in indexes], chosen)
    if span is not None and len(found) > blocks:
        found = [found[k * (len(found) - 1) // max(blocks - 1, 1)] for k in range(blocks)]
    for block in found[:blocks]:
        messages = messages_of(indexes[block.file], block)
        messages = [each for each in messages if each.channel.topic == topic and chosen.holds(each)]
        if most is not None and len(messages) > most:
            messages = [messages[k] for k in sorted(at_random.sample(range(len(messages)), most))]
        for message in messages:
            with suppress(MalformedMessageError):
                yield Decoded(message.channel, message.log_time_ns, decode(message.data))
