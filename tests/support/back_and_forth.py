"""A log played forward and backward in turn: a drive as long as one likes, without a jump anywhere."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle, islice

import numpy as np

from scanchain.data import Pose, Scan
from scanchain.logs import Log
from scanchain.point_store import PointStore

_PAUSE_NS = 50_000_000  # between two passes, in which nothing moves


class BackAndForth:
    """Scans of a log, kept in files; time runs backward on every other pass, also within a sweep."""

    def __init__(self, log: Log, count: int | None = None) -> None:
        """Count : of the scans of a pass, from the first on."""
        self._points, self._times = PointStore(log.dimension), PointStore(1)
        self._kept: list[tuple[int, int, int, int, Pose | None]] = []
        for scan in islice(log.scans(), count):
            points = self._points.add(scan.points)
            times = self._times.add(scan.times_s[:, None])
            self._kept.append((scan.stamp_ns, points.first, points.count, times.count, scan.T_odom_base))
        self._stamps_ns = np.array([each[0] for each in self._kept])

    def scans(self, count: int) -> Iterator[Scan]:
        """So many scans; every pass ends where the next begins."""
        first_ns, last_ns, offset_ns = int(self._stamps_ns.min()), int(self._stamps_ns.max()), 0
        index = 0
        for sign in cycle((1, -1)):
            for stamp_ns, row, points, times, T_odom_base in self._kept[::sign]:
                since_ns = stamp_ns - first_ns if sign > 0 else last_ns - stamp_ns
                times_s = sign * self._times.read(row if times else 0, times)[:, 0]
                yield Scan(
                    index,
                    offset_ns + since_ns,
                    index,
                    self._points.read(row, points),
                    times_s,
                    0,
                    T_odom_base,
                )
                index += 1
                if index == count:
                    return
            offset_ns += last_ns - first_ns + _PAUSE_NS
