"""Unusable scans of a log: their defects, the number allowed, and the warnings about them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from scanchain.config import LogConfig, PreprocessConfig
from scanchain.data import FEWEST_COPIED, MOST_COPIES, RawPoints, Scan
from scanchain.errors import InputError, counted, duration
from scanchain.logs.index import Decoded
from scanchain.logs.messages.lidar import Returns
from scanchain.logs.mounting import is_world
from scanchain.logs.publishers import Publisher

_MOST_REPEATED = 0.5  # share of repeated stamps above which they are a warning, not a note
_COPIES_SHARE = 0.01  # share of copies among the scans above which they are a warning, not a note
_MOST_RATE = 50.0  # ratio of two clock rates above which their units differ: by 1000, less gaps


@dataclass(slots=True)
class _Tally:
    """Messages of a publisher, those with returns, and their first and last stamp."""

    publisher: Publisher
    begin_ns: int
    end_ns: int = 0
    messages: int = 0
    with_returns: int = 0

    @property
    def is_used(self) -> bool:
        """True if its messages are used; those of a further publisher only once one had returns."""
        return self.publisher.is_used and (not self.publisher.note or self.with_returns > 0)

    @property
    def text(self) -> str:
        """Frame, stamps and share of messages with returns, as text."""
        percent = 100.0 * self.with_returns / self.messages
        clock = f"stamps {1e-9 * self.begin_ns:.1f} to {1e-9 * self.end_ns:.1f} s"
        return f"frame {self.publisher.frame or 'without a name'} ({clock}, {percent:.3g} % with returns)"


def _signed(time_s: float) -> str:
    return f"{'-' if time_s < 0.0 else '+'}{duration(abs(time_s))}"


def most_bad_scans(scans: int, config: LogConfig) -> float:
    """Largest number of scans that may be left out; unlimited at 100 %, as a damaged log may contain more."""
    share = 0.01 * config.max_bad_scans_percent
    return math.ceil(share * scans) if share < 1.0 else math.inf


def defect(message: Decoded, preprocess: PreprocessConfig | None) -> str:
    """Defect that makes a scan unusable, as text to follow its name; empty if it is usable."""
    returns = message.value
    if not isinstance(returns, Returns):
        return f"is malformed: {returns}"
    if message.log_time_ns >= 1 << 63:
        return f"has the log time {message.log_time_ns} ns, which is impossible"
    if not len(returns.points):
        return f"has no valid point ({returns.why})"
    outside = "" if preprocess is None else _none_retained(returns.points, preprocess)
    return outside and f"has {outside}"


def _none_retained(points: RawPoints, config: PreprocessConfig) -> str:
    """Reason for which preprocessing retains none of the points (N, d); empty where it retains one."""
    low_m, high_m = config.min_range_m, config.max_range_m
    if any(low_m <= math.hypot(*point) <= high_m for point in points[::64].tolist()):
        return ""
    squares = np.einsum("ij,ij->i", points, points, dtype=np.float64)
    if ((low_m * low_m <= squares) & (squares <= high_m * high_m)).any():
        return ""
    near_m, far_m = np.sqrt([squares.min(), squares.max()])
    limits = f"preprocess.min_range_m ({low_m:g}) and preprocess.max_range_m ({high_m:g})"
    seen = f"its {counted(len(points), 'point')} lie at {near_m:.3g} to {far_m:.3g} m"
    in_millimeters = low_m <= 1e-3 * near_m <= high_m < near_m
    remedy = "millimeters? convert them to meters" if in_millimeters else "widen these limits"
    return f"no point between {limits} ({seen}: {remedy})"


class ScanCounts:
    """Counts of scans left out, copied, with stamps out of order, or without wheel odometry."""

    def __init__(self, topic: str, odometry_topic: str) -> None:
        self.topic = topic
        self.odometry_topic = odometry_topic
        self.scans = self.bad = self.backwards = self.repeated = self.without_wheels = self.copies = 0
        self.farthest_back_ns = self.begin_ns = 0
        self.publishers: dict[str, _Tally] = {}
        self.jumps_s, self.first_jump = list[float](), ""
        self.first_complaint, self.first_odd, self.odd, self.unset = "", "", 0, 0
        self.steps_ns = [(0, 0)]  # steps of header stamp and log time from scan to scan, without jumps
        self._last: Scan | None = None

    def reject(self, complaint: str, expected: int, config: LogConfig) -> None:
        """Count a scan that is left out. Raises InputError if too many of the ``expected`` scans are left out."""
        self.scans += 1
        self.bad += 1
        self.first_complaint = self.first_complaint or complaint
        if self.bad > most_bad_scans(expected, config):
            raise InputError(
                f"{complaint}; with it {self.bad} of {counted(expected, 'scan')} cannot be used, more than "
                f"log.max_bad_scans_percent ({config.max_bad_scans_percent:g}) allows; raise it, or choose "
                "another --topic"
            )

    def uses(self, publisher: Publisher, returns: Returns) -> bool:
        """Count a message of a publisher; True if it is to be used."""
        tally = self.publishers.setdefault(publisher.frame, _Tally(publisher, returns.stamp_ns))
        tally.messages += 1
        tally.with_returns += len(returns.points) > 0
        tally.end_ns = returns.stamp_ns
        self.odd += bool(returns.odd)
        self.first_odd = self.first_odd or returns.odd
        return tally.is_used

    def repeats(self, points: RawPoints) -> bool:
        """True if the points of a scan are bitwise identical to those of the previous one."""
        if self._last is None or len(points) < FEWEST_COPIED:
            return False
        last = self._last.points
        # the first points decide in most scans, which saves time
        return np.array_equal(points[:64], last[:64]) and np.array_equal(points, last)

    def add(self, scan: Scan) -> None:
        """Count a scan that is used."""
        self.scans += 1
        self.without_wheels += scan.T_odom_base is None
        self.copies += scan.is_copy
        self.unset += scan.stamp_ns == 0
        if self._last is not None:
            back_ns = self._last.stamp_ns - scan.stamp_ns
            if scan.clock_jump_s:
                self.jumps_s.append(scan.clock_jump_s)
                self.first_jump = self.first_jump or self._jump(scan, self._last)
            elif back_ns > 0 and scan.stamp_ns:
                self.backwards += 1
                self.farthest_back_ns = max(self.farthest_back_ns, back_ns)
            self.repeated += back_ns == 0
            if self._last.stamp_ns and not scan.clock_jump_s:  # no step from a zero stamp, before /clock
                self.steps_ns.append((-back_ns, scan.log_time_ns - self._last.log_time_ns))
        self._last = scan
        self.begin_ns = self.begin_ns or scan.stamp_ns

    def _jump(self, scan: Scan, last: Scan) -> str:
        """Jump of the stamps at a scan: its size, where it is, and its likely cause."""
        cause = "a clock that was set, or a playback that skipped a part"
        # back near the first stamp
        if abs(scan.stamp_ns - self.begin_ns) < 0.1 * abs(last.stamp_ns - scan.stamp_ns):
            cause = "a recording played in a loop, or a simulation that restarted"
        elif scan.clock_jump_s < 0.0:
            cause = "a clock that was set back, or an older recording"
        step, logged_s = _signed(scan.clock_jump_s), 1e-9 * (scan.log_time_ns - last.log_time_ns)
        return f"scan {scan.index:,}: {step} while log times advance by {logged_s:.2g} s): {cause}"

    def _share(self, count: int) -> str:
        return f"{count} of {counted(self.scans, 'scan')} of {self.topic}"

    def losses(self) -> list[str]:
        """Warnings about scans left out or copied, and about header stamps if most repeat the previous one."""
        tallies = self.publishers.values()
        used = "".join(f"; the one used is {each.text}" for each in tallies if not each.publisher.note)
        total = counted(sum(each.messages for each in tallies), "message")
        lines = [
            f"{each.messages:,} of {total} of {self.topic} left out, from another publisher: {each.text}{used}"
            for each in tallies
            if not each.is_used
        ]
        lines += [
            f"{self.topic} is in the frame {frame}, which by its name does not move with the lidar: if a SLAM has "
            "registered the points, poses are only what it left to correct; choose the raw --topic"
            for frame in filter(is_world, self.publishers)
        ]
        if self.bad:
            were = "was" if self.bad == 1 else "were"
            lines.append(f"{self._share(self.bad)} {were} left out (the first: {self.first_complaint})")
        if self.odd:
            lines.append(f"{self._share(self.odd)} contradict themselves (the first: {self.first_odd})")
        if self.repeated > _MOST_REPEATED * self.scans:
            lines.append(
                f"{self._share(self.repeated)} have the header stamp of the previous one: times in the results do "
                "not distinguish scans; record with stamps"
            )
        if self.copies > max(MOST_COPIES, _COPIES_SHARE * self.scans):
            lines.append(
                f"{self._share(self.copies)} are bitwise copies of the previous one: while the driver is "
                "stuck, poses do not change though the lidar may move (scanchain doctor)"
            )
        return lines

    def jumps(self) -> list[str]:
        """Warnings about jumps of the header stamps, and about a rate different from that of the log times."""
        lines = []
        if self.jumps_s:
            lines.append(
                f"{counted(len(self.jumps_s), 'jump')} of the header stamps of {self.topic}, by up to "
                f"{_signed(max(self.jumps_s, key=abs))} (the first at {self.first_jump}; "
                "each begins a new segment, as the motion in between is unknown"
            )
        steps_s = 1e-9 * np.array(self.steps_ns, np.float64)
        (all_s, all_logged_s), (usual_s, usual_logged_s) = steps_s.sum(axis=0), np.median(steps_s, axis=0)
        is_apart = 0.0 < _MOST_RATE * min(all_s, all_logged_s) < max(all_s, all_logged_s)
        advance = f"{all_s:.3g} s, log times by {all_logged_s:.3g} s" if is_apart else ""
        if 0.0 < _MOST_RATE * usual_s < usual_logged_s:  # the inverse only means logging in bursts
            advance = f"{usual_s:.3g} s from scan to scan, log times by {usual_logged_s:.3g} s (medians)"
        if advance:
            lines.append(f"header stamps of {self.topic} advance by {advance}: is the unit of one of them wrong?")
        return lines

    def recovered(self, expected: int) -> str:
        """Number of scans read from a damaged log, and the expected number if that is larger, as text."""
        read = self.scans - self.bad
        scans = counted(read, "scan") if self.scans >= expected else f"{read:,} of {counted(expected, 'scan')}"
        return f"{scans} of {self.topic} {'was' if read == 1 else 'were'} recovered"

    def notes(self) -> list[str]:
        """Notes on a small number of copies, on stamps out of order and on missing wheel odometry."""
        lines = []
        if 0 < self.copies <= max(MOST_COPIES, _COPIES_SHARE * self.scans):
            lines.append(f"{self._share(self.copies)} are bitwise copies of the previous one and get its pose")
        if self.backwards:
            steps = counted(self.backwards, "step")
            most = f"by up to {1e-9 * self.farthest_back_ns:.2g} s"
            lines.append(
                f"{steps} back in the header stamps of {self.topic}, {most}; the order of the log is used"
            )
        if 0 < self.unset < self.scans - self.bad:
            lines.append(f"{self._share(self.unset)} with the header stamp 0, as of a driver that starts")
        if 0 < self.repeated <= _MOST_REPEATED * self.scans:
            lines.append(f"{self._share(self.repeated)} with the header stamp of the previous one")
        if self.odometry_topic and self.without_wheels:
            lines.append(
                f"{self._share(self.without_wheels)} without a reading of {self.odometry_topic} near the stamp; "
                "their motion is predicted from the scans"
            )
        return lines
