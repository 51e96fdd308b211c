"""ROS 2 messages in CDR: alignment counts from the fourth byte, byte order is in the second."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray


class MalformedMessageError(Exception):
    """A message that is not what its schema says; the text says where it ends too early."""


class CdrReader:
    """Reads one message from front to back."""

    def __init__(self, data: memoryview) -> None:
        if len(data) < 4:
            raise MalformedMessageError(f"{len(data)} bytes are too few for a CDR header")
        self.data = data
        self.offset = 4
        self.order = "<" if data[1] & 1 else ">"

    def numbers(self, code: str, count: int = 1) -> tuple[int, ...] | tuple[float, ...]:
        """``count`` numbers of one struct code."""
        size = struct.calcsize(code)
        self._align(size)
        end = self.offset + size * count
        self._need(end)
        values = struct.unpack_from(f"{self.order}{count}{code}", self.data, self.offset)
        self.offset = end
        return values

    def integer(self, code: str = "I") -> int:
        """One whole number."""
        return int(self.numbers(code)[0])

    def array(self, dtype: str) -> NDArray[np.generic]:
        """A sequence of numbers, as a view of the message."""
        count = self.integer()
        kind = np.dtype(self.order + dtype)
        if count:
            self._align(kind.itemsize)
        end = self.offset + kind.itemsize * count
        self._need(end)
        values = np.frombuffer(self.data, kind, count, self.offset)
        self.offset = end
        return values

    def octets(self) -> memoryview:
        """A string's or byte sequence's contents, a string's final zero included."""
        count = self.integer()
        end = self.offset + count
        self._need(end)
        octets = self.data[self.offset : end]
        self.offset = end
        return octets

    def string(self) -> str:
        """A string without its final zero."""
        return bytes(self.octets()).rstrip(b"\0").decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        """The stamp in nanoseconds and the frame of a std_msgs/Header."""
        seconds = self.integer("i")
        nanoseconds = self.integer("I")
        return seconds * 1_000_000_000 + nanoseconds, self.string()

    def _align(self, size: int) -> None:
        self.offset += -(self.offset - 4) % size

    def _need(self, end: int) -> None:
        if end > len(self.data):
            raise MalformedMessageError(f"{len(self.data)} bytes, but its fields reach to byte {end}")
