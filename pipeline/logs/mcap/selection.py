"""The part of a log that is read, by log time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs.mcap.counting import log_times
from scanchain.logs.mcap.records import Block, FileIndex, name_of


class Span(NamedTuple):
    """Log times in nanoseconds, both ends included."""

    begin_ns: int
    end_ns: int

    @property
    def duration_s(self) -> float:
        """Seconds from one end to the other."""
        return (self.end_ns - self.begin_ns) * 1e-9

    def meets(self, block: Block) -> bool:
        """Whether the block may hold messages of the span."""
        return block.may_be_empty or (block.end_ns >= self.begin_ns and block.start_ns <= self.end_ns)

    def covers(self, block: Block) -> bool:
        """Whether all messages of the block lie in the span."""
        return self.begin_ns <= block.start_ns <= block.end_ns <= self.end_ns


EVERYTHING = Span(0, (1 << 64) - 1)


def whole_span(indexes: Sequence[FileIndex]) -> Span:
    """From the first message of all topics to the last, (0, 0) where there is none."""
    blocks = [block for index in indexes for block in index.blocks]
    blocks = [block for block in blocks if not block.may_be_empty] or blocks
    begin_ns = min((block.start_ns for block in blocks), default=0)
    return Span(begin_ns, max((block.end_ns for block in blocks), default=0))


def chosen_span(whole: Span, config: LogConfig) -> Span:
    """From ``log.start_s`` to ``log.end_s``, counted from the first message; everything where neither is set."""
    if config.start_s == 0.0 and config.end_s == float("inf"):
        return EVERYTHING
    begin_ns = whole.begin_ns + round(config.start_s * 1e9)
    end_s = min(config.end_s, whole.duration_s)
    return Span(begin_ns, whole.end_ns if end_s == whole.duration_s else whole.begin_ns + round(end_s * 1e9))


def count_messages(indexes: Sequence[FileIndex], topic: str, span: Span) -> int:
    """How many messages of a topic lie in the span."""
    count = 0
    for index in indexes:
        for number in (number for number, channel in index.channels.items() if channel.topic == topic):
            for block in filter(span.meets, index.blocks):
                if block.entries and span.covers(block):
                    count += sum(entry.messages for entry in block.entries if entry.channel == number)
                    continue
                times_ns = log_times(index, block, number)
                count += int(np.count_nonzero((times_ns >= span.begin_ns) & (times_ns <= span.end_ns)))
    return count


def count_scans(indexes: Sequence[FileIndex], topic: str, whole: Span, config: LogConfig) -> int:
    """Scans of the topic in the chosen part, thinned out. Raises InputError where there is none."""
    name, span = name_of(indexes), chosen_span(whole, config)
    total = sum(
        index.counts.get(number, 0)
        for index in indexes
        for number, channel in index.channels.items()
        if channel.topic == topic
    )
    if not total:
        raise InputError(f"{name}: topic {topic} has no messages; scanchain info lists what there is")
    chosen = total if span == EVERYTHING else count_messages(indexes, topic, span)
    if not chosen:
        raise InputError(
            f"{name}: no scan of {topic} lies {_part(config)}; the log is {whole.duration_s:.1f} s long"
        )
    return -(-chosen // config.every)


def _part(config: LogConfig) -> str:
    """The chosen part in words."""
    start, end = f"--start {config.start_s:g} s", f"--end {config.end_s:g} s"
    if config.end_s == float("inf"):
        return f"after {start}"
    return f"between {start} and {end}" if config.start_s else f"before {end}"
