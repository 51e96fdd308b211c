"""The first messages of a topic, before a log is read as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from pipeline.logs.cdr import MalformedMessageError
from pipeline.logs.counting import messages_of
from pipeline.logs.records import FileIndex

T = TypeVar("T")

_BLOCKS = 8  # of a topic, from the first on, that are searched


def first_messages(indexes: Sequence[FileIndex], topic: str, decode: Callable[[memoryview], T]) -> Iterator[T]:
    """What a topic's messages in its first blocks decode to; malformed ones are passed over."""
    blocks = [
        block
        for index in indexes
        for block in index.blocks
        if index.may_hold(block, {n for n, channel in index.channels.items() if channel.topic == topic})
    ]
    for block in sorted(blocks, key=lambda block: block.start_ns)[:_BLOCKS]:
        for message in messages_of(indexes[block.file], block):
            if message.channel.topic == topic:
                try:
                    yield decode(message.data)
                except MalformedMessageError:
                    continue
