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
    channels = {channel.key for index in indexes for channel in index.channels.values() if channel.topic == topic}
    blocks = [
        block
        for index in indexes
        for block in index.blocks
        if not block.entries or any((block.file, entry.channel) in channels for entry in block.entries)
    ]
    for block in sorted(blocks, key=lambda block: block.start_ns)[:_BLOCKS]:
        for message in messages_of(indexes[block.file], block):
            if message.channel.topic == topic:
                try:
                    yield decode(message.data)
                except MalformedMessageError:
                    continue
