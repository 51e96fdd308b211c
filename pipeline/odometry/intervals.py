"""Seconds between successive scans, by stamps that need not be plausible."""

from __future__ import annotations

from scanchain.data import Scan

_GAP = 5.0  # times the usual interval: a longer one means that scans are missing
_ALIKE = 1.4  # largest ratio of two intervals that agree
_LONGEST = 100.0  # times the usual interval: a longer one is no plausible interval of stamps
_MEMORY = 0.9  # weight of the usual interval so far against the next one


class Intervals:
    """The last scan, the interval before it and the usual one, in seconds; 0 while they are unknown."""

    def __init__(self) -> None:
        self.last_scan: Scan | None = None
        self.last_s = 0.0
        self.usual_s = 0.0

    def take(self, scan: Scan) -> None:
        """Remember a scan."""
        if self.last_scan is not None:
            self.last_s = self.to(scan)
            if not self.is_gap(self.last_s):
                gain = 1.0 - _MEMORY if self.usual_s else 1.0
                self.usual_s += gain * (self.last_s - self.usual_s)
        self.last_scan = scan

    def to(self, scan: Scan) -> float:
        """Seconds since the last scan, 0 for the first.

        By the stamps where these agree with the usual interval or with the times of the log, else as usual; by the
        log where stamps do not go on before an interval is usual.
        """
        if self.last_scan is None:
            return 0.0
        stamped_s, logged_s = _since(self.last_scan, scan)
        if not self.usual_s:
            return stamped_s if stamped_s > 0.0 else logged_s
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

    def has_gap_before(self, scan: Scan) -> bool:
        """True if scans are missing before this one."""
        return self.is_gap(self.to(scan))

    def is_gap(self, interval_s: float) -> bool:
        """True of an interval in which scans are missing."""
        return interval_s > _GAP * self.usual_s > 0.0


def _since(last: Scan, scan: Scan) -> tuple[float, float]:
    """Seconds between two scans by their stamps and by the log."""
    return (scan.stamp_ns - last.stamp_ns) * 1e-9, (scan.log_time_ns - last.log_time_ns) * 1e-9


def _are_alike(a: float, b: float) -> bool:
    """True if two intervals are positive and of about the same length."""
    return 0.0 < b <= _ALIKE * a <= _ALIKE**2 * b
