"""Which channels a file has and how many messages of each, opening only the chunks that must be opened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanchain.logs.mcap.blocks import DamagedBlockError, read_block
from scanchain.logs.mcap.records import Block, FileIndex, Message


def complete(index: FileIndex) -> None:
    """Learn the channels and counts that a file without a full summary keeps inside its chunks."""
    needed = set(index.counts) | {entry.channel for block in index.blocks for entry in block.entries}
    unknown = {number for number in needed if not index.knows(number)}
    counts: Counter[int] = Counter()
    for block in index.blocks:
        for entry in block.entries:
            counts[entry.channel] += entry.messages
        if block.entries and not unknown & {entry.channel for entry in block.entries}:
            continue
        if not block.entries and index.is_counted and not unknown:
            continue
        messages = messages_of(index, block)
        if not block.entries:
            counts.update(message.channel.key[1] for message in messages)
        unknown = {number for number in unknown if not index.knows(number)}
    index.believe(unknown)
    if not index.is_counted:
        index.counts = dict(counts)
        index.is_counted = True


def times_of(indexes: Sequence[FileIndex], topic: str) -> tuple[int, int, int]:
    """How many messages a topic has, and the log times of the first and the last of them; 0, 0 where unknown.

    Exact where a file has a message index, else as exactly as its chunks say.
    """
    messages, ends_ns = 0, []
    for index in indexes:
        for number in (number for number, channel in index.channels.items() if channel.topic == topic):
            messages += index.counts.get(number, 0)
            holding = [block for block in index.blocks if any(entry.channel == number for entry in block.entries)]
            for block in {id(block): block for block in holding[:1] + holding[-1:]}.values():
                ends_ns += _ends(index, block, number)
    return messages, min(ends_ns, default=0), max(ends_ns, default=0)


def _ends(index: FileIndex, block: Block, channel: int) -> list[int]:
    """Log times of the first and last message of a channel in a block that holds some."""
    if not any(e.channel == channel and e.offset >= 0 for e in block.entries):
        return [block.start_ns, block.end_ns]
    times_ns = log_times(index, block, channel)
    return [int(times_ns.min()), int(times_ns.max())] if len(times_ns) else [block.start_ns, block.end_ns]


def messages_of(index: FileIndex, block: Block) -> list[Message]:
    """The messages of a block, none where it is damaged, which is noted in the index."""
    try:
        return read_block(index, block).messages
    except DamagedBlockError as error:
        index.note_damage(f"{error}; it was left out")
        return []


def log_times(index: FileIndex, block: Block, channel: int) -> NDArray[np.uint64]:
    """Log times of a channel's messages in a block, from the message index where there is one."""
    for entry in block.entries:
        if entry.channel == channel and entry.offset >= 0:
            return np.frombuffer(index.bytes_at(entry.offset, 16 * entry.messages), "<u8")[::2]
        if entry.channel == channel and index.make is not None and block.start_ns == block.end_ns:
            return np.full(entry.messages, block.start_ns, np.uint64)
    if block.entries and all(entry.channel != channel for entry in block.entries):
        return np.empty(0, np.uint64)
    messages = messages_of(index, block)
    times = [message.log_time_ns for message in messages if message.channel.key[1] == channel]
    return np.array(times, np.uint64)
