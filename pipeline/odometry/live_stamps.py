"""Stamps and point times of scans that a driver gives one by one, and which of them are certainly wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from scanchain.checks import SMALLER_UNITS
from scanchain.data import Scan
from scanchain.errors import InputError
from scanchain.odometry.intervals import SHORTEST_S
from scanchain.trajectory import format_stamp

Result = TypeVar("Result")

_LOOKED_AT = 3  # intervals: of fewer, a burst or a gap may be the rule
_REMEMBERED = 10  # the same where they are shorter than any lidar's, and number of the last ones that are kept
_MOST_SWEEPS = 2.0  # intervals between scans that the times of a scan's points may span
_SLOWEST_S = 15.0  # between scans, above which regular intervals are not of seconds but of a smaller unit
_REGULAR = 1.1  # ratio of the intervals of a driver, above which people or gaps set them


class LiveStamps:
    """Remembers the last stamps, and refuses those that are certainly wrong."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self.intervals_s: list[float] = []

    def passed(self, scan: Scan, process: Callable[[Scan], Result]) -> Result:
        """The result of a scan, which is checked before and remembered after it. Raises InputError."""
        self.check(scan)
        result = process(scan)
        self.take(scan)
        return result

    def check(self, scan: Scan) -> None:
        """Refuse a scan whose stamp or point times contradict those before. Raises InputError; nothing changes."""
        if self.last_ns is None:
            return
        if scan.stamp_ns <= self.last_ns:
            raise InputError(
                f"stamp_s is {format_stamp(scan.stamp_ns)}, that of the scan before {format_stamp(self.last_ns)}; "
                "wanted seconds that increase from scan to scan"
            )
        recent_s = self._with(scan)
        if len(recent_s) < _LOOKED_AT:
            return
        shortest_s, longest_s = min(recent_s[-_LOOKED_AT:]), max(recent_s[-_LOOKED_AT:])
        if shortest_s > _SLOWEST_S and longest_s < _REGULAR * shortest_s:
            raise InputError(
                f"stamp_s grows by {longest_s:.6g} from scan to scan, which no lidar takes in seconds; wanted "
                f"seconds{SMALLER_UNITS}"
            )
        longest_s = max(recent_s)
        is_burst = longest_s < SHORTEST_S and len(recent_s) < _REMEMBERED
        span_s = float(np.ptp(scan.times_s)) if len(scan.times_s) and not is_burst else 0.0
        if span_s > _MOST_SWEEPS * longest_s:
            raise InputError(
                f"times_s spans {span_s:.3g} s, but scans follow each other within {longest_s:.3g} s; wanted "
                "seconds relative to stamp_s (of times from 0 to 1 over a sweep: times its duration)"
            )

    def take(self, scan: Scan) -> None:
        """Remember a scan."""
        if self.last_ns is not None:
            self.intervals_s = self._with(scan)
        self.last_ns = scan.stamp_ns

    def _with(self, scan: Scan) -> list[float]:
        """The last intervals, this scan's included."""
        assert self.last_ns is not None
        return [*self.intervals_s, 1e-9 * (scan.stamp_ns - self.last_ns)][-_REMEMBERED:]
