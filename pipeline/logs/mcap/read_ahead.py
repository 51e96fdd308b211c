"""Read-ahead of a remote file: byte ranges that will be read, downloaded in large parts."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

_PART_BYTES = 4_000_000  # largest size of ranges that are downloaded together
_GAP_BYTES = 65_536  # largest gap between two ranges that is downloaded along, as another request takes longer
_AHEAD = 3  # number of parts requested ahead
_RETAINED = 2  # number of parts retained behind, as threads that read them overtake each other
_REPEATED = 4  # number of unannounced ranges retained: the first blocks are read more than once


class Part(NamedTuple):
    """A byte range that is downloaded at once."""

    begin: int
    end: int


class ReadAhead:
    """Reads ranges with ``fetch(offset, size)``, the expected ones ahead and in their order."""

    def __init__(self, fetch: Callable[[int, int], bytes]) -> None:
        self.fetch = fetch
        self.fetch_alone = lru_cache(_REPEATED)(fetch)
        self.parts: list[Part] = []
        self.by_begin: list[tuple[int, int]] = []  # byte at which a part begins, its place in the order of reading
        self.coming: dict[int, Future[bytes]] = {}
        self.lock = threading.Lock()
        self.pool = ThreadPoolExecutor(_AHEAD, thread_name_prefix="scanchain-fetch")

    def expect(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Announce the ranges that will be read next, in order: first byte and the one behind the last."""
        with self.lock:
            self.parts = merged(ranges)
            self.by_begin = sorted((part.begin, place) for place, part in enumerate(self.parts))
            self.coming = {}

    def read(self, offset: int, size: int) -> memoryview:
        """So many bytes from the offset on; a range that was not announced is downloaded by itself."""
        with self.lock:
            place = self._index_of(offset, size)
            if place is None:
                begin, coming = offset, None
            else:
                begin, coming = self.parts[place].begin, self._request(place)
        data = self.fetch_alone(offset, size) if coming is None else coming.result()
        return memoryview(data)[offset - begin : offset - begin + size]

    def _index_of(self, offset: int, size: int) -> int | None:
        """Index of the part in which the bytes lie."""
        found = bisect_right(self.by_begin, (offset, len(self.parts))) - 1
        if found < 0:
            return None
        place = self.by_begin[found][1]
        return place if offset + size <= self.parts[place].end else None

    def _request(self, place: int) -> Future[bytes]:
        """The part of an index; the next ones are requested, those passed are dropped."""
        for number in range(place, min(place + 1 + _AHEAD, len(self.parts))):
            if number not in self.coming:
                part = self.parts[number]
                self.coming[number] = self.pool.submit(self.fetch, part.begin, part.end - part.begin)
        for number in [number for number in self.coming if number < place - _RETAINED]:
            del self.coming[number]
        return self.coming[place]


def merged(ranges: Iterable[tuple[int, int]]) -> list[Part]:
    """Ranges joined with those that follow close behind, up to the size of a part."""
    parts: list[Part] = []
    for begin, end in ranges:
        last = parts[-1] if parts else Part(0, -_GAP_BYTES - 1)
        is_close = last.end <= begin <= last.end + _GAP_BYTES and end - last.begin <= _PART_BYTES
        if is_close:
            parts[-1] = Part(last.begin, end)
        else:
            parts.append(Part(begin, end))
    return parts
