"""Messages of a log, decoded: all of them in the order of log time, or a sample before the log is read.

Chunks and files may overlap; they are unpacked and decoded ahead in threads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from heapq import heappop, heappush
from itertools import pairwise
from typing import NamedTuple, TypeVar

from scanchain.logs.mcap.records import Block, Channel, DamagedBlockError, FileIndex, Message, read_block, release
from scanchain.logs.mcap.selection import EVERYTHING, Span, messages_of
from scanchain.logs.messages.ros import MalformedMessageError
from scanchain.threads import threads

Decoders = Mapping[str, Callable[[memoryview], object]]
_BLOCKS_AHEAD = 4  # that wait decoded, at most
_REMOTE_TIMES = 2  # as many wait of a remote log, each one request
_MOST_BYTES_AHEAD = 256_000_000

T = TypeVar("T")
_SAMPLED_BLOCKS = 8  # number of first blocks of a topic that are searched


class Decoded(NamedTuple):
    """A decoded message, or the decoder's error, a MalformedMessageError."""

    channel: Channel
    log_time_ns: int
    value: object


def decoded_messages(
    indexes: Sequence[FileIndex], decoders: Decoders, span: Span, *, damage: list[str], ahead: int = _BLOCKS_AHEAD
) -> Iterator[Decoded]:
    """Every message of a topic that has a decoder, by log time; ties in the order of the files.

    At most ``ahead`` blocks wait decoded. What is damaged is left out and named in ``damage``.
    """
    wanted = [{number for topic in decoders for number in index.numbers_of(topic)} for index in indexes]

    def decode(block: Block) -> tuple[list[Decoded], str]:
        contents = read_block(indexes[block.file], block, wanted[block.file])
        decoded = [
            Decoded(message.channel, message.log_time_ns, _decode(decoders[message.channel.topic], message))
            for message in contents.messages
            if span.begin_ns <= message.log_time_ns <= span.end_ns
        ]
        release(indexes[block.file], block)
        return decoded, contents.damage

    blocks = [
        block
        for index in indexes
        for block in index.blocks
        if span.meets(block) and index.may_hold(block, wanted[block.file])
    ]
    blocks.sort(key=lambda block: (block.start_ns, block.file, block.offset))
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
        for block in blocks:
            running.append((block, pool.submit(decode, block)))
            size += block.uncompressed_size
            while len(running) > ahead or (size > _MOST_BYTES_AHEAD and len(running) > 1):
                done, future = running.popleft()
                size -= done.uncompressed_size
                yield _result(future, damage)
        while running:
            yield _result(running.popleft()[1], damage)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _result(future: Future[tuple[list[Decoded], str]], damage: list[str]) -> list[Decoded]:
    try:
        messages, incomplete = future.result()
    except DamagedBlockError as error:
        line = f"{error}; it was left out"
        damage += [] if line in damage else [line]
        return []
    if incomplete and incomplete not in damage:
        damage.append(incomplete)
    return messages


def sampled_messages(
    indexes: Sequence[FileIndex], topic: str, decode: Callable[[memoryview], T], span: Span | None = None
) -> Iterator[T]:
    """Decoded messages in a topic's first blocks, or in some from all over a span; malformed ones are left out."""
    chosen = EVERYTHING if span is None else span
    blocks = [
        block
        for index in indexes
        for block in index.blocks
        if chosen.meets(block) and index.may_hold(block, set(index.numbers_of(topic)))
    ]
    blocks.sort(key=lambda block: block.start_ns)
    if span is not None and len(blocks) > _SAMPLED_BLOCKS:
        blocks = [blocks[k * (len(blocks) - 1) // (_SAMPLED_BLOCKS - 1)] for k in range(_SAMPLED_BLOCKS)]
    for block in blocks[:_SAMPLED_BLOCKS]:
        for message in messages_of(indexes[block.file], block):
            if message.channel.topic == topic and chosen.begin_ns <= message.log_time_ns <= chosen.end_ns:
                with suppress(MalformedMessageError):
                    yield decode(message.data)
