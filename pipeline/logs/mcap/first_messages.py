"""Some messages of a topic, the first or some from all over the log, before it is read as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from scanchain.logs.mcap.counting import messages_of
from scanchain.logs.mcap.records import Block, FileIndex
from scanchain.logs.mcap.selection import EVERYTHING, Span
from scanchain.logs.messages.cdr import MalformedMessageError

T = TypeVar("T")

_BLOCKS = 8  # of a topic, from the first on, that are searched


def first_messages(indexes: Sequence[FileIndex], topic: str, decode: Callable[[memoryview], T]) -> Iterator[T]:
    """What a topic's messages in its first blocks decode to; malformed ones are passed over."""
    yield from _decoded(indexes, _blocks(indexes, topic)[:_BLOCKS], topic, decode, EVERYTHING)


def spread_messages(
    indexes: Sequence[FileIndex], topic: str, decode: Callable[[memoryview], T], span: Span
) -> Iterator[T]:
    """What a topic's messages in blocks from all over a span decode to; malformed ones are passed over."""
    blocks = [block for block in _blocks(indexes, topic) if span.meets(block)]
    chosen = (
        blocks
        if len(blocks) <= _BLOCKS
        else [blocks[k * (len(blocks) - 1) // (_BLOCKS - 1)] for k in range(_BLOCKS)]
    )
    yield from _decoded(indexes, chosen, topic, decode, span)


def _blocks(indexes: Sequence[FileIndex], topic: str) -> list[Block]:
    """Those that may hold messages of the topic, by time."""
    blocks = [
        block
        for index in indexes
        for block in index.blocks
        if index.may_hold(block, {n for n, channel in index.channels.items() if channel.topic == topic})
    ]
    return sorted(blocks, key=lambda block: block.start_ns)


def _decoded(
    indexes: Sequence[FileIndex],
    blocks: Sequence[Block],
    topic: str,
    decode: Callable[[memoryview], T],
    span: Span,
) -> Iterator[T]:
    for block in blocks:
        for message in messages_of(indexes[block.file], block):
            if message.channel.topic == topic and span.begin_ns <= message.log_time_ns <= span.end_ns:
                try:
                    yield decode(message.data)
                except MalformedMessageError:
                    continue
