"""ROS 1 messages: little endian, nothing aligned, a sequence number before each stamp."""

from __future__ import annotations

import struct
from functools import cache

from scanchain.logs.messages.cdr import CdrReader

_ORDER = "<"


class Ros1Reader(CdrReader):
    """Reads one message from front to back, by the same verbs as for CDR."""

    __slots__ = ()

    def __init__(self, data: memoryview) -> None:
        self.data = data
        self.offset = 0
        self.order = _ORDER

    def numbers(self, code: str, count: int = 1) -> tuple[int, ...] | tuple[float, ...]:
        """``count`` numbers of one struct code."""
        layout = _layout(code, count)
        begin, self.offset = self.offset, self.offset + layout.size
        if self.offset > len(self.data):
            self._complain(self.offset)
        return layout.unpack_from(self.data, begin)

    def align(self, size: int) -> None:
        """Nothing: ROS 1 packs tightly."""

    def header(self) -> tuple[int, str]:
        """The stamp in nanoseconds and the frame of a std_msgs/Header."""
        _, seconds, nanoseconds = self.numbers("I", 3)
        return int(seconds) * 1_000_000_000 + int(nanoseconds), self.string()


@cache
def _layout(code: str, count: int) -> struct.Struct:
    return struct.Struct(f"{_ORDER}{count}{code}")
