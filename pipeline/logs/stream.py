"""Messages in the order of log time, over chunks and files that overlap; unpacked and decoded ahead in threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Generic, TypeVar

from pipeline.logs.blocks import DamagedBlockError, Message, read_block
from pipeline.logs.cdr import MalformedMessageError
from pipeline.logs.index import Block, Channel, FileIndex

T = TypeVar("T")

_THREADS = 2
_FOREVER = 1 << 64


@dataclass(frozen=True, slots=True)
class Decoded(Generic[T]):
    """A message as its decoder understood it, or the decoder's complaint."""

    channel: Channel
    log_time_ns: int
    value: T | MalformedMessageError


def decoded_messages(
    indexes: Sequence[FileIndex],
    blocks: Sequence[Block],
    decode: Callable[[Message], T | None],
    *,
    ahead: int,
    damage: list[str],
) -> Iterator[Decoded[T]]:
    """Every message that ``decode`` returns something for, by log time; ties in the order of the files.

    At most ``ahead`` blocks wait decoded; a damaged one is left out and named in ``damage``.
    """

    def work(block: Block) -> list[Decoded[T]]:
        return list(_decode(read_block(indexes[block.file], block), decode))

    ordered = sorted(blocks, key=lambda block: (block.start_ns, block.file, block.offset))
    waiting: list[tuple[int, int, Decoded[T]]] = []
    count = 0
    for position, messages in enumerate(_ahead(ordered, work, ahead, damage)):
        for message in messages:
            heappush(waiting, (message.log_time_ns, count, message))
            count += 1
        following = ordered[position + 1].start_ns if position + 1 < len(ordered) else _FOREVER
        while waiting and waiting[0][0] < following:
            yield heappop(waiting)[2]


def _decode(messages: list[Message], decode: Callable[[Message], T | None]) -> Iterator[Decoded[T]]:
    for message in messages:
        try:
            value = decode(message)
        except MalformedMessageError as error:
            value = error
        if value is not None:
            yield Decoded(message.channel, message.log_time_ns, value)


def _ahead(
    blocks: Sequence[Block], work: Callable[[Block], list[T]], ahead: int, damage: list[str]
) -> Iterator[list[T]]:
    """Results in the order of the blocks, computed by threads that end when the iterator is closed."""
    running: deque[Future[list[T]]] = deque()
    pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="scanchain-read")
    try:
        upcoming = iter(blocks)
        for block in upcoming:
            running.append(pool.submit(work, block))
            if len(running) > ahead:
                yield _result(running.popleft(), damage)
        while running:
            yield _result(running.popleft(), damage)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _result(future: Future[list[T]], damage: list[str]) -> list[T]:
    try:
        return future.result()
    except DamagedBlockError as error:
        damage.append(f"{error}; it was left out")
        return []
