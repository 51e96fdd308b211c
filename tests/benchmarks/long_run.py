"""Time and memory of SLAM along a long log.

The log is played forward and backward in turn. Every tenth of the way: the mean CPU time of ``Slam.process`` a
scan, loops and optimizations included, of this thread and of all, the memory of this process and its peak, and
what it keeps in a file instead. With ``--live``, so many scans more come in real time, forty a second: the longest
that ``Slam.track`` took of one, by the clock. With ``--finish`` the last optimization follows, of everything.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path
from time import perf_counter, process_time, sleep, thread_time

import numpy as np

from scanchain import Slam
from scanchain.data import Pose, Scan
from scanchain.logs import Log, open_log
from scanchain.point_store import PointStore
from scanchain.processes import peak_mib, resident_mib
from scanchain.settings import load_settings
from tests.benchmarks.harness import options_of

_LIVE_S = 0.025  # period of a fast laser scanner
_PAUSE_NS = 50_000_000  # between two passes, in which nothing moves


class BackAndForth:
    """Scans of a log, kept in files; time runs backward on every other pass, also within a sweep."""

    def __init__(self, log: Log) -> None:
        self._points, self._times = PointStore(log.dimension), PointStore(1)
        self._kept: list[tuple[int, int, int, int, Pose | None]] = []
        for scan in log.scans():
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
                xyz = self._points.read(row, points)
                yield Scan(index, offset_ns + since_ns, index, xyz, times_s, 0, T_odom_base)
                index += 1
                if index == count:
                    return
            offset_ns += last_ns - first_ns + _PAUSE_NS


def main() -> None:
    arguments = options_of(__doc__, cache=False, log=Path, scans=20_000, live=0, finish=False)
    log = open_log(arguments.log)
    scans = BackAndForth(log).scans(arguments.scans + arguments.live)
    slam = Slam(load_settings(log.dimension).config, log.T_base_lidar)
    _follow(slam, islice(scans, arguments.scans), arguments.scans)
    _follow_live(slam, scans)
    if arguments.finish:
        started = process_time()
        slam.finish()
        print(f"last optimization: {process_time() - started:.1f} s, peak {peak_mib():.1f} MiB")


def _follow(slam: Slam, scans: Iterator[Scan], count: int) -> None:
    tenth, spent_s, held_mib, taken_s, all_s = max(count // 10, 1), [], [], 0.0, 0.0
    for number, scan in enumerate(scans, 1):
        started, all_started = thread_time(), process_time()
        slam.process(scan)
        taken_s, all_s = taken_s + thread_time() - started, all_s + process_time() - all_started
        if number % tenth == 0:
            spent_s.append(taken_s)
            held_mib.append(resident_mib(os.getpid()))
            stored_mib = 4 * slam.dimension * slam.points.rows / 2**20
            print(
                f"{number:6} scans {1e3 * taken_s / tenth:6.2f} ms a scan "
                f"({1e3 * all_s / tenth:.2f} with threads), {held_mib[-1]:6.1f} MiB (peak {peak_mib():.1f}), "
                f"{stored_mib:5.1f} in a file; {len(slam.keyframes)} keyframes, "
                f"{len(slam.closures)} closures tried",
                flush=True,
            )
            taken_s, all_s = 0.0, 0.0
    if len(spent_s) >= 10:
        varies = 100.0 * np.ptp(held_mib) / held_mib[0]
        print(f"last tenth / second tenth: {spent_s[9] / spent_s[1]:.2f}; memory varies by {varies:.1f} %")


def _follow_live(slam: Slam, scans: Iterator[Scan]) -> None:
    longest_s, optimizations, before = 0.0, 0, len(slam.keyframes)
    slam.back_end.is_live = True
    for scan in scans:
        started = perf_counter()
        step = slam.process(scan)
        taken_s = perf_counter() - started
        longest_s, optimizations = max(longest_s, taken_s), optimizations + (step.graph is not None)
        sleep(max(_LIVE_S - taken_s, 0.0))
    if longest_s:
        print(
            f"live: {longest_s:.3f} s at most a scan, {len(slam.keyframes) - before} keyframes, "
            f"{optimizations} optimizations taken over"
        )


if __name__ == "__main__":
    main()
