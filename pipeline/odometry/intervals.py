"""Seconds between successive scans, by stamps that need not be plausible."""

from __future__ import annotations

from collections import deque

import numpy as np

from scanchain.data import Scan

SHORTEST_S = 0.005  # below the period of any lidar: scans that follow each other faster came in a burst
_GAP = 5.0  # times the usual interval: a longer one means that scans are missing
_ALIKE = 1.4  # largest ratio of two intervals that agree
_LONGEST = 100.0  # times the usual interval: a longer one is no plausible interval of stamps
_WRONG = 20.0  # ratio to the median of the last ones, from which on the usual interval never was usual
_MEMORY = 0.9  # weight of the usual interval so far against the next one
_RECENT = 15  # number of the last intervals that are remembered
_FEWEST = 4  # of them, before a gap follows from intervals that are shorter than any lidar's
_PART = 0.5  # of the time over which its points were measured, which the first interval is not shorter than


class Intervals:
    """The last scan, the interval before it and the usual one, in seconds; 0 while they are unknown."""

    def __init__(self) -> None:
        self.last_scan: Scan | None = None
        self.last_s = 0.0
        self.usual_s = 0.0
        self.recent_s: deque[float] = deque(maxlen=_RECENT)

    def take(self, scan: Scan) -> None:
        """Remember a scan.

        The usual interval is a running mean that leaves out gaps. Where it disagrees with the median of the last
        ones, it came from a burst or from stamps that were wrong: the median takes its place.
        """
        if self.last_scan is not None:
            self.last_s = self.to(scan)
            stamped_s, logged_s = _since(self.last_scan, scan)
            latest_s = (stamped_s if stamped_s > 0.0 else logged_s) if self.usual_s else self.last_s
            if latest_s >= SHORTEST_S or self.usual_s < SHORTEST_S:
                self.recent_s.append(latest_s)
            if not self.is_gap(self.last_s):
                gain = 1.0 - _MEMORY if self.usual_s else 1.0
                self.usual_s += gain * (self.last_s - self.usual_s)
            median_s = sorted(self.recent_s)[len(self.recent_s) // 2] if len(self.recent_s) > 2 else self.usual_s
            if not median_s < _WRONG * self.usual_s < _WRONG**2 * median_s:
                self.usual_s = median_s
        self.last_scan = scan

    def to(self, scan: Scan) -> float:
        """Seconds since the last scan, 0 for the first.

        By the stamps where these agree with the usual interval or with the times of the log, else as usual. Before
        an interval is usual, by the log where stamps do not go on, and by the points where they took longer.
        """
        if self.last_scan is None:
            return 0.0
        stamped_s, logged_s = _since(self.last_scan, scan)
        if not self.usual_s:
            interval_s = stamped_s if stamped_s > 0.0 else logged_s
            span_s = float(np.ptp(scan.times_s)) if len(scan.times_s) else 0.0
            return span_s if interval_s < _PART * span_s else interval_s
        if _are_alike(stamped_s, self.usual_s):
            return stamped_s
        is_plausible = _are_alike(stamped_s, logged_s) and stamped_s < _LONGEST * self.usual_s
        return stamped_s if is_plausible else self.usual_s

    def silence_s(self, scan: Scan) -> float:
        """Seconds since the last scan, however many; 0 where the stamps and the log disagree."""
        if self.last_scan is None:
            return 0.0
        stamped_s, logged_s = _since(self.last_scan, scan)
        return stamped_s if _are_alike(stamped_s, logged_s) else 0.0

    def is_gap(self, interval_s: float) -> bool:
        """True of an interval in which scans are missing."""
        is_known = self.usual_s >= SHORTEST_S or len(self.recent_s) >= _FEWEST
        return is_known and interval_s > _GAP * self.usual_s > 0.0


def _since(last: Scan, scan: Scan) -> tuple[float, float]:
    """Seconds between two scans by their stamps and by the log."""
    return (scan.stamp_ns - last.stamp_ns) * 1e-9, (scan.log_time_ns - last.log_time_ns) * 1e-9


def _are_alike(a: float, b: float) -> bool:
    """True if two intervals are positive and of about the same length."""
    return 0.0 < b <= _ALIKE * a <= _ALIKE**2 * b
