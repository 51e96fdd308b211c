"""Seconds between successive scans whose stamps may be implausible; rejection of certainly wrong stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import TypeVar

import numpy as np

from scanchain.checks import SMALLER_UNITS
from scanchain.data import SIMILAR_INTERVALS, Scan
from scanchain.errors import InputError
from scanchain.odometry.motion_filter import MEMORY
from scanchain.trajectory import format_stamp

Result = TypeVar("Result")

_SHORTEST_S = 0.005  # below the period of any lidar: scans that follow each other faster came in a burst
_GAP = 5.0  # times the usual interval: a longer one means that scans are missing
_LONGEST = 100.0  # times the usual interval: a longer one is no plausible interval of stamps
_WRONG = 20.0  # ratio to the median of the last intervals, above which that replaces the usual interval
_RECENT = 15  # number of the last intervals that are retained
_FEWEST = 4  # least number of them to detect a gap where the usual interval is shorter than any lidar's
_LOOKED_AT = 3  # intervals that are checked: fewer may all be in a burst or a gap
_REMEMBERED = 10  # the same where they are shorter than any lidar's; also the number of intervals retained
_MOST_SWEEPS = 2.0  # largest span of a scan's point times, in intervals between scans
_SLOWEST_S = 15.0  # regular intervals above it are not in seconds but in a smaller unit
_REGULAR = 1.1  # largest ratio of a driver's intervals; above it, scans come by hand or with gaps


class Intervals:
    """The last scan, the interval before it and the usual one, in seconds; 0 while they are unknown."""

    def __init__(self) -> None:
        self.last_scan: Scan | None = None
        self.last_s = 0.0
        self.usual_s = 0.0
        self.recent_s: deque[float] = deque(maxlen=_RECENT)

    def update(self, scan: Scan, interval_s: float) -> None:
        """Add a scan and the interval since the last one.

        The usual interval is a running mean that leaves out gaps. Where it is far from the median of the last
        intervals, it came from a burst or from wrong stamps: the median replaces it.
        """
        if self.last_scan is not None:
            self.last_s = interval_s
            stamped_s, logged_s = _since(self.last_scan, scan)
            latest_s = (stamped_s if stamped_s > 0.0 else logged_s) if self.usual_s else self.last_s
            if latest_s >= _SHORTEST_S or self.usual_s < _SHORTEST_S:
                self.recent_s.append(latest_s)
            if not self.is_gap(self.last_s):
                gain = 1.0 - MEMORY if self.usual_s else 1.0
                self.usual_s += gain * (self.last_s - self.usual_s)
            median_s = sorted(self.recent_s)[len(self.recent_s) // 2] if len(self.recent_s) > 2 else self.usual_s
            if not median_s < _WRONG * self.usual_s < _WRONG**2 * median_s:
                self.usual_s = median_s
        self.last_scan = scan

    def to(self, scan: Scan) -> float:
        """Seconds since the last scan, 0 for the first.

        After a clock jump, its size, limited to that of a plausible gap. Otherwise by the stamps where these agree
        with the usual interval or with the log times, else the usual interval. Before that is known: by the
        stamps, by the log times where stamps do not increase, or the scan's duration where that is far longer.
        """
        if self.last_scan is None:
            return 0.0
        if scan.clock_jump_s:
            return float(np.clip(abs(scan.clock_jump_s), 2.0 * _GAP * self.usual_s, _LONGEST * self.usual_s))
        stamped_s, logged_s = _since(self.last_scan, scan)
        if not self.usual_s:
            interval_s = stamped_s if stamped_s > 0.0 else logged_s
            span_s = float(np.ptp(scan.times_s)) if len(scan.times_s) else 0.0
            return span_s if interval_s < 0.5 * span_s else interval_s
        if _are_similar(stamped_s, self.usual_s):
            return stamped_s
        is_plausible = _are_similar(stamped_s, logged_s) and stamped_s < _LONGEST * self.usual_s
        return stamped_s if is_plausible else self.usual_s

    def silence_s(self, scan: Scan) -> float:
        """Seconds since the last scan or of a clock jump, unlimited; 0 where stamps and log times disagree."""
        if self.last_scan is None:
            return 0.0
        if scan.clock_jump_s:
            return abs(scan.clock_jump_s)
        stamped_s, logged_s = _since(self.last_scan, scan)
        return stamped_s if _are_similar(stamped_s, logged_s) else 0.0

    def is_gap(self, interval_s: float) -> bool:
        """True of an interval in which scans are missing."""
        is_known = self.usual_s >= _SHORTEST_S or len(self.recent_s) >= _FEWEST
        return is_known and interval_s > _GAP * self.usual_s > 0.0


class LiveStamps:
    """Check of each stamp against the last ones; rejects those that are certainly wrong."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []

    def passed(self, scan: Scan, process: Callable[[Scan], Result]) -> Result:
        """The result of processing a scan, whose stamp is then recorded.

        Raises InputError, and nothing changes, where its stamp or point times contradict those before.
        """
        stamps_ns = [*self.stamps_ns, scan.stamp_ns][-_REMEMBERED - 1 :]
        self._check(scan, stamps_ns)
        result = process(scan)
        self.stamps_ns = stamps_ns
        return result

    def _check(self, scan: Scan, stamps_ns: list[int]) -> None:
        recent_s = [1e-9 * (after - before) for before, after in pairwise(stamps_ns)]
        if recent_s and recent_s[-1] <= 0.0:
            before, now = map(format_stamp, stamps_ns[-2:])
            wanted = "wanted seconds that increase from scan to scan"
            raise InputError(f"stamp_s is {now}, that of the scan before {before}; {wanted}")
        if len(recent_s) < _LOOKED_AT:
            return
        shortest_s, longest_s = min(recent_s[-_LOOKED_AT:]), max(recent_s[-_LOOKED_AT:])
        if shortest_s > _SLOWEST_S and longest_s < _REGULAR * shortest_s:
            raise InputError(
                f"stamp_s grows by {longest_s:.6g} from scan to scan, too long for a lidar if in seconds; wanted "
                f"seconds{SMALLER_UNITS}"
            )
        longest_s = max(recent_s)
        is_burst = longest_s < _SHORTEST_S and len(recent_s) < _REMEMBERED
        span_s = float(np.ptp(scan.times_s)) if len(scan.times_s) and not is_burst else 0.0
        if span_s > _MOST_SWEEPS * longest_s:
            raise InputError(
                f"times_s spans {span_s:.3g} s, but scans follow each other within {longest_s:.3g} s; wanted "
                "seconds relative to stamp_s (of times from 0 to 1 over a sweep: times its duration)"
            )


def _since(last: Scan, scan: Scan) -> tuple[float, float]:
    """Seconds between two scans by their stamps and by the log."""
    return (scan.stamp_ns - last.stamp_ns) * 1e-9, (scan.log_time_ns - last.log_time_ns) * 1e-9


def _are_similar(a: float, b: float) -> bool:
    """True if two intervals are positive and of about the same length."""
    return 0.0 < b <= SIMILAR_INTERVALS * a <= SIMILAR_INTERVALS**2 * b
