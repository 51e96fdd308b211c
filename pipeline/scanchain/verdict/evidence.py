"""Evidence on a trajectory per scan, the findings of its checks, and the base class of a check."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import ClassVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from scanchain.data import GAP_INTERVALS, LEAST_FIT, Matrix
from scanchain.errors import FIRST

Floats = NDArray[np.float64]

KNOWN = 0.5  # least share of scans with a value of another sensor for it to count as known
_SMALL_RAD = 0.1  # difference of headings below which the text leaves it out


class Kind(StrEnum):
    """Kinds of findings that reports distinguish by color; a check may have others."""

    DEGENERATE = "degenerate"
    LOST = "lost"
    CONTRADICTED = "contradicted"
    WHEELS = "wheels disagree"
    SCANS_SLIP = "scans slip"
    WHEELS_SLIP = "wheels slip"
    ACCELERATION = "impossible acceleration"
    LOOPS = "loop closures disagree"
    DISCONNECTED = "disconnected"
    OVERLAP = "overlap lost"
    COPIES = "copies of one scan"


class Segment(Struct, frozen=True):
    """Consecutive suspicious scans.

    kind : one of ``Kind``, or of a check's own
    first, last : scans, from 0; start_s, end_s : since the first scan of the run
    scans : number of scans among them that have this finding
    size_m, size_rad : size of the contradiction; None where not measured
    """

    kind: str
    first: int
    last: int
    scans: int
    start_s: float
    end_s: float
    size_m: float | None = None
    size_rad: float | None = None

    @property
    def text(self) -> str:
        """The finding in words."""
        size, turn_rad = "" if self.size_m is None else f" by {self.size_m:,.1f} m", self.size_rad or 0.0
        if self.kind == Kind.ACCELERATION:
            size = f",{size.removeprefix(' by')} from where constant velocity leads"
        if turn_rad > np.pi:
            size += " and more than 180 deg"
        elif turn_rad > _SMALL_RAD:
            size += f" and {np.degrees(turn_rad):.0f} deg"
        place = f"scan {self.first:,}" if self.first == self.last else f"scans {self.first:,} to {self.last:,}"
        return f"{place} ({self.times}): {self.kind}{size}"

    @property
    def times(self) -> str:
        """Start and end as text, or a single time where both round to the same."""
        start, end = f"{self.start_s:.1f}", f"{self.end_s:.1f}"
        return f"{start if start == end else f'{start} to {end}'} s"

    def overlaps(self, other: Segment) -> bool:
        """True if both contain a scan."""
        return self.first <= other.last and other.first <= self.last


@dataclass(frozen=True, slots=True)
class Closures:
    """Closures that verification accepted.

    target, source : (C,) scans
    T_target_source : (C, d+1, d+1) measured
    is_accepted : (C,) True if the back end accepted it
    tried : number of scans at revisited places for which a closure was tried, accepted or not
    """

    target: NDArray[np.int64]
    source: NDArray[np.int64]
    T_target_source: Matrix
    is_accepted: NDArray[np.bool_]
    tried: int = 0

    @classmethod
    def none(cls, dimension: int) -> Closures:
        """No closures."""
        nothing = np.empty(0, np.int64)
        return cls(nothing, nothing, np.empty((0, dimension + 1, dimension + 1)), np.empty(0, np.bool_))


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence on a trajectory, mostly (N,) arrays with a value per scan.

    stamps_ns, log_times_ns : of the scans
    poses : (N, d+1, d+1) final
    is_lost, is_degenerate : states; False where unknown
    fit : as in ``Match``; NaN where unknown
    inlier_share : as in ``Match``; NaN where unknown
    starts_segment : scans whose motion from the previous one is unknown
    is_copy : scans that are bit-identical to the previous one
    points : number of valid returns
    closures : those that verification accepted
    sources : poses of the lidar (N, d+1, d+1) by other sensors, NaN where unknown; by ``Check.source``
    odometry : (N, d+1, d+1) before optimization; None where nothing was optimized
    error : estimated error in words, valid outside of suspicious segments; empty where unknown
    bound_m : upper bound of that error; infinite where unknown
    uncertain : the part of the log with the most uncertain positions, in words; empty for none
    open_m : position uncertainty due to range noise, two standard deviations
    checks : made by ``checked``
    """

    stamps_ns: NDArray[np.int64]
    log_times_ns: NDArray[np.int64]
    poses: Matrix
    is_lost: NDArray[np.bool_]
    is_degenerate: NDArray[np.bool_]
    fit: Floats
    inlier_share: Floats
    starts_segment: NDArray[np.bool_]
    is_copy: NDArray[np.bool_]
    points: NDArray[np.int64]
    closures: Closures
    sources: Mapping[str, Matrix] = field(default_factory=dict)
    odometry: Matrix | None = None
    error: str = ""
    bound_m: float = np.inf
    uncertain: str = ""
    open_m: float = 0.0
    checks: tuple[Check, ...] = ()

    def checked(self, kinds: Sequence[type[Check]]) -> Evidence:
        """The same with checks of these kinds."""
        return replace(self, checks=tuple(kind(self) for kind in kinds))

    @property
    def seconds(self) -> Floats:
        """(N,) log time since the first scan."""
        return (self.log_times_ns - self.log_times_ns[0]) * 1e-9

    @property
    def is_contradicted(self) -> NDArray[np.bool_]:
        """(N,) scans whose pose is observable, but contradicted by their correspondences."""
        return (self.fit < LEAST_FIT) & ~self.is_lost & ~self.is_degenerate

    @property
    def sensors(self) -> list[Check]:
        """The checks by other sensors."""
        return [check for check in self.checks if check.source]

    @property
    def is_confirmed(self) -> NDArray[np.bool_]:
        """(N,) scans around which another sensor agrees with the trajectory."""
        return np.any([check.values <= check.limit for check in self.sensors], axis=0)

    def is_confirmed_throughout(self, part: slice) -> bool:
        """True if another sensor is known over most of these scans and contradicts none of them."""
        parts = [(check.values[part], check.limit) for check in self.sensors]
        return any(np.isfinite(part).mean() >= KNOWN and not (part > limit).any() for part, limit in parts)

    @property
    def is_after_gap(self) -> NDArray[np.bool_]:
        """(N,) scans after a gap in time over which the motion is not predicted."""
        intervals_s = np.diff(self.seconds, prepend=0.0)
        return intervals_s > GAP_INTERVALS * np.median(intervals_s)

    def segment(
        self, kind: str, part: slice, is_marked: NDArray[np.bool_], size_m: float | None = None,
        size_rad: float | None = None,
    ) -> Segment:  # fmt: skip
        """A finding for a part of the scans, some of which are marked (N,)."""
        start_s, end_s = self.seconds[[part.start, part.stop - 1]].tolist()
        count = int(is_marked[part].sum())
        return Segment(kind, part.start, part.stop - 1, count, start_s, end_s, size_m, size_rad)

    def __len__(self) -> int:
        return len(self.poses)


class Check:
    """A check of a trajectory: its values scan by scan, the segments that they make suspicious, and reasons.

    A check is a class in a file of this package and a line of ``CHECKS``. By default, scans are suspicious where
    the values are above the limit.

    name : in the list of checks that were made; empty to leave it out
    kind : of its findings
    column : in steps.parquet; empty for none
    source : prefix of the columns of steps.parquet with the poses of the lidar by another sensor, whose agreement
        confirms poses that the scans alone do not determine; empty for none
    limit : largest value that is accepted
    harmless : kinds of its findings that are reported, but do not affect the verdict
    values : (N,) innovation in standard deviations, or what else is checked; NaN where not checked
    extent_m : largest distance from the first pose by the source; NaN where it is not known over most of the log
    bound_m : upper bound of the error of the trajectory by the source; infinite where unknown
    """

    name: ClassVar[str] = ""
    kind: ClassVar[str] = ""
    column: ClassVar[str] = ""
    source: ClassVar[str] = ""
    limit: ClassVar[float] = np.inf
    harmless: ClassVar[tuple[str, ...]] = ()
    values: Floats
    extent_m: float = np.nan
    bound_m: float = np.inf

    def __init__(self, evidence: Evidence) -> None:
        self.values = np.full(len(evidence), np.nan)

    @property
    def is_made(self) -> bool:
        """True if there was anything to check."""
        return bool(np.isfinite(self.values).any())

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Suspicious segments; ``found`` are those of the checks before this one."""
        is_marked = self.values > self.limit
        return (evidence.segment(self.kind, part, is_marked) for part in merged(is_marked))

    def failures(self, evidence: Evidence, segments: Sequence[Segment]) -> Iterator[str]:
        """Reasons why the trajectory is not trustworthy; ``segments`` are those of all checks."""
        yield from ()

    def warnings(self, evidence: Evidence) -> Iterator[str]:
        """Reasons why the trajectory as a whole is to be checked."""
        yield from ()

    def notes(self, T_base_lidar: Matrix | None) -> Iterator[str]:
        """Remarks that do not affect the verdict; ``T_base_lidar`` is the mounting that the log states, if any."""
        yield from ()


def merged(is_marked: NDArray[np.bool_], gap: int = 10) -> list[slice]:
    """Runs of marked scans, joined over up to ``gap`` unmarked ones."""
    places = np.flatnonzero(is_marked)
    parts = np.split(places, np.flatnonzero(np.diff(places) > gap + 1) + 1)
    return [slice(int(part[0]), int(part[-1]) + 1) for part in parts if len(part)]


def listed(segments: Sequence[Segment]) -> str:
    """The largest segments in words, and how many more there are."""
    largest = sorted(segments, key=lambda each: (each.size_m or 0.0, each.scans), reverse=True)[:FIRST]
    more = len(segments) - len(largest)
    return "; ".join(each.text for each in largest) + (f"; and {more:,} more" if more else "")


def extent_m(poses: Matrix) -> float:
    """Largest distance of poses (N, d+1, d+1) from the first that is known."""
    positions = poses[np.isfinite(poses[:, 0, 0]), :-1, -1]
    return float(np.linalg.norm(positions - positions[0], axis=1).max())
