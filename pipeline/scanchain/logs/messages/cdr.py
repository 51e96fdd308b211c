"""Readers of ROS messages: ROS 2's CDR and ROS 1's packed serialization, by the same methods."""

from __future__ import annotations

import struct
from functools import cache

import numpy as np
from numpy.typing import NDArray

from scanchain.words import counted

_ORDER = "<"


class MalformedMessageError(Exception):
    """A message that contradicts its schema; the text says where it ends too early."""


_FLOATS: dict[str, np.dtype[np.float32]] = {"<": np.dtype("<f4"), ">": np.dtype(">f4")}


class CdrReader:
    """Reads one message from front to back."""

    __slots__ = ("data", "offset", "order")

    def __init__(self, data: memoryview) -> None:
        if len(data) < 4:
            raise MalformedMessageError(f"{len(data)} bytes are too few for a CDR header")
        self.data = data
        self.offset = 4
        self.order = "<" if data[1] & 1 else ">"

    def numbers(self, code: str, count: int = 1) -> tuple[int, ...] | tuple[float, ...]:
        """``count`` numbers of one struct code."""
        layout, size = _layout(self.order, code, count)
        begin = self.offset + (4 - self.offset) % size
        self.offset = begin + layout.size
        if self.offset > len(self.data):
            self._complain(self.offset)
        return layout.unpack_from(self.data, begin)

    def integer(self, code: str = "I") -> int:
        """One whole number."""
        return int(self.numbers(code)[0])

    def floats(self) -> NDArray[np.float32]:
        """A sequence of float32, as a view of the message."""
        count = self.integer()
        kind = _FLOATS[self.order]
        if count:
            self.align(kind.itemsize)
        end = self.offset + kind.itemsize * count
        if end > len(self.data):
            self._complain(end)
        values = np.frombuffer(self.data, kind, count, self.offset)
        self.offset = end
        return values

    def align(self, size: int) -> None:
        """Go on to the next multiple of ``size``."""
        self.offset += (4 - self.offset) % size

    def octets(self) -> memoryview:
        """A string's or byte sequence's contents, a string's final zero included."""
        count = self.integer()
        end = self.offset + count
        if end > len(self.data):
            self._complain(end)
        octets = self.data[self.offset : end]
        self.offset = end
        return octets

    def string(self) -> str:
        """A string without its final zero."""
        return str(self.octets(), "utf-8", "replace").rstrip("\0")

    def header(self) -> tuple[int, str]:
        """The stamp in nanoseconds and the frame of a std_msgs/Header."""
        seconds = self.integer("i")
        nanoseconds = self.integer("I")
        return seconds * 1_000_000_000 + nanoseconds, self.string()

    def _complain(self, end: int) -> None:
        raise MalformedMessageError(
            f"it has {counted(len(self.data), 'byte')}, but its fields reach to byte {end}"
        )


@cache
def _layout(order: str, code: str, count: int) -> tuple[struct.Struct, int]:
    return struct.Struct(f"{order}{count}{code}"), struct.calcsize(f"={code}")


class Ros1Reader(CdrReader):
    """Reads one message from front to back, with the methods of the reader of CDR."""

    __slots__ = ()

    def __init__(self, data: memoryview) -> None:
        self.data = data
        self.offset = 0
        self.order = _ORDER

    def numbers(self, code: str, count: int = 1) -> tuple[int, ...] | tuple[float, ...]:
        """``count`` numbers of one struct code."""
        layout = _packed_layout(code, count)
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
def _packed_layout(code: str, count: int) -> struct.Struct:
    return struct.Struct(f"{_ORDER}{count}{code}")
