"""Stretches of a trajectory that a check contradicts or that no measurement constrains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from scanchain.data import LEAST_FIT, MOST_COPIES, Matrix
from scanchain.verdict.checks import VELOCITY_LIMIT, WHEEL_LIMIT, Floats, Kind, Stretch, WheelCheck
from scanchain.verdict.closures import Closures, contradicting_groups, which_slipped

_LEAST_OVERLAP = 2.0 / 3.0  # smallest ``overlap`` that is no finding
_GAP = 3.0  # intervals of usual length from which on the motion is not predicted
_GAP_SCANS = 10  # longest gap within a stretch
_PASSED_M = 1.0  # extent of a stretch of predicted or contradicted poses up to which it is passed without harm
_PASSED_BY_WHEELS_M = 4.0  # likewise where the wheels agree with the trajectory
KNOWN = 0.5  # least share of scans that the wheels are compared at
_RESTING_M = 0.05  # distance from copies to the next scan, within which the lidar rested
_MEDIAN_SCANS = 9  # scans over which the median of ``fit`` is taken: single ones are contradicted by people


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of every scan of a trajectory, (N,) each.

    Attributes
    ----------
    seconds : since the first scan, by the log
    poses : (N, d+1, d+1) final
    is_lost, is_degenerate : states; False where unknown
    fit : as in ``Match``; NaN where unknown
    starts_segment : scans whose motion from the one before is unknown
    is_copy : scans that are the one before once more, to the last bit
    points : valid returns
    wheels, velocity, overlap : checks
    closures : those that verification accepted
    odometry : (N, d+1, d+1) before optimization; None where nothing was optimized
    error : what is known of the error of a trajectory that is right everywhere, in words; empty for nothing
    """

    seconds: Floats
    poses: Matrix
    is_lost: NDArray[np.bool_]
    is_degenerate: NDArray[np.bool_]
    fit: Floats
    starts_segment: NDArray[np.bool_]
    is_copy: NDArray[np.bool_]
    points: NDArray[np.int64]
    wheels: WheelCheck
    velocity: Floats
    overlap: Floats
    closures: Closures
    odometry: Matrix | None = None
    error: str = ""

    @property
    def is_contradicted(self) -> NDArray[np.bool_]:
        """(N,) scans whose pose is observable, but contradicted by their correspondences."""
        return (self.fit < LEAST_FIT) & ~self.is_lost & ~self.is_degenerate

    @property
    def is_held_by_wheels(self) -> NDArray[np.bool_]:
        """(N,) scans around which the wheels agree with the trajectory."""
        return self.wheels.innovation <= WHEEL_LIMIT

    @property
    def is_after_gap(self) -> NDArray[np.bool_]:
        """(N,) scans before which the log has none for so long that the motion is not predicted."""
        intervals_s = np.diff(self.seconds, prepend=self.seconds[0])
        return intervals_s > _GAP * np.median(intervals_s)

    @property
    def states(self) -> str:
        """Number of scans in each state that there is, as text; empty without matches."""
        if not np.isfinite(self.fit).any():
            return ""
        marks = {"contradicted": self.is_contradicted, "degenerate": self.is_degenerate, "lost": self.is_lost}
        counts = {name: int(is_marked.sum()) for name, is_marked in marks.items()}
        counts = {"ok": len(self) - sum(counts.values())} | counts
        return ", ".join(f"{count:,} {name}" for name, count in counts.items() if count)

    def __len__(self) -> int:
        return len(self.seconds)


def find_stretches(evidence: Evidence) -> list[Stretch]:
    """Every stretch, by time, and those where the wheels slipped, which are none of the trajectory."""
    has_left = (evidence.overlap < _LEAST_OVERLAP) & ~evidence.starts_segment
    measured = [
        *_of_states(evidence, Kind.LOST, evidence.is_lost),
        *_of_states(evidence, Kind.DEGENERATE, evidence.is_degenerate),
        *_of_states(evidence, Kind.CONTRADICTED, evidence.is_contradicted & _fits_badly(evidence)),
        *(_stretch(evidence, Kind.OVERLAP, part, has_left) for part in merged(has_left)),
        *_of_acceleration(evidence),
    ]
    found = [
        *measured,
        *_of_wheels(evidence, measured),
        *_of_copies(evidence),
        *contradicting_groups(evidence.closures, evidence.poses, evidence.seconds),
        *_of_segments(evidence),
    ]
    return sorted(found, key=lambda stretch: (stretch.first, stretch.last))


def _of_states(evidence: Evidence, kind: Kind, is_marked: NDArray[np.bool_]) -> Iterator[Stretch]:
    """Stretches that are too long to be passed by the predicted motion.

    A scan in between that is not marked measures the pose again, unless those beside it were inserted into the map
    at poses that their correspondences contradict.
    """
    for part in merged(is_marked):
        inner = merged(is_marked[part], 0 if kind is not Kind.CONTRADICTED else _GAP_SCANS)
        runs = [slice(part.start + run.start, part.start + run.stop) for run in inner]
        if any(_extent_m(evidence, run, kind) > _passed_m(evidence, run) for run in runs):
            counted = evidence.is_contradicted if kind is Kind.CONTRADICTED else is_marked
            yield _stretch(evidence, kind, part, counted)


def _extent_m(evidence: Evidence, part: slice, kind: Kind) -> float:
    """Largest distance from the pose before a part; after a gap at least what the speed before it makes of it."""
    positions, last = evidence.poses[:, :-1, -1], max(part.start - 1, 0)
    extent_m = float(np.linalg.norm(positions[part] - positions[last], axis=1).max())
    if kind is Kind.DEGENERATE or not evidence.is_after_gap[part.start]:
        return extent_m
    speed_m_s = np.linalg.norm(positions[last] - positions[last - 1]) / np.median(np.diff(evidence.seconds))
    return max(extent_m, float(speed_m_s * (evidence.seconds[part.start] - evidence.seconds[last])))


def _passed_m(evidence: Evidence, part: slice) -> float:
    """Extent up to which a part is passed without harm: more where wheels are known and none contradicts."""
    innovation = evidence.wheels.innovation[part]
    is_held = np.isfinite(innovation).mean() >= KNOWN and not (innovation > WHEEL_LIMIT).any()
    return _PASSED_BY_WHEELS_M if is_held else _PASSED_M


def _fits_badly(evidence: Evidence) -> NDArray[np.bool_]:
    """(N,) scans around which most contradict their pose, and those after a gap over which no wheels agree."""
    median = median_filter(np.nan_to_num(evidence.fit, nan=1.0), _MEDIAN_SCANS, mode="nearest")
    return (evidence.is_after_gap & ~evidence.is_held_by_wheels) | (median < LEAST_FIT)


def _of_wheels(evidence: Evidence, measured: Sequence[Stretch]) -> Iterator[Stretch]:
    """Stretches that wheels contradict, by which of the two slipped.

    measured : stretches of badly measured scans, where closures that agree with them may be of look-alikes
    """
    is_marked = evidence.wheels.innovation > WHEEL_LIMIT
    odometry, parts = evidence.poses if evidence.odometry is None else evidence.odometry, merged(is_marked)
    slipped = which_slipped(parts, odometry, evidence.wheels.poses, evidence.closures)
    for part, (kind, whole_m) in zip(parts, slipped, strict=True):
        size_m, size_rad = (
            float(np.nanmax(each[part])) for each in (evidence.wheels.apart_m, evidence.wheels.apart_rad)
        )
        if kind is Kind.WHEELS_SLIP and any(
            each.first < part.stop and part.start <= each.last for each in measured
        ):
            kind = Kind.WHEELS
        size_m = size_m if kind is Kind.WHEELS else max(size_m, whole_m)
        yield _stretch(evidence, kind, part, is_marked, size_m, size_rad)


def _of_acceleration(evidence: Evidence) -> Iterator[Stretch]:
    is_new = evidence.starts_segment
    is_marked = (evidence.velocity > VELOCITY_LIMIT) & ~is_new & ~np.concatenate([[False], is_new[:-1]])
    jumps_m = np.zeros(len(evidence))
    jumps_m[2:] = np.linalg.norm(np.diff(evidence.poses[:, :-1, -1], n=2, axis=0), axis=1)
    for part in merged(is_marked):
        size_m = float(jumps_m[part][is_marked[part]].max())
        yield _stretch(evidence, Kind.ACCELERATION, part, is_marked, size_m)


def _of_copies(evidence: Evidence) -> Iterator[Stretch]:
    """Stretches over which the driver was stuck, by what lies beside: a scan elsewhere, or none.

    Simulated scans without noise are copies at rest, and the next one is still there.
    """
    positions = evidence.poses[:, :-1, -1]
    for part in merged(evidence.is_copy, 0):
        if part.stop - part.start <= MOST_COPIES or evidence.is_held_by_wheels[part].all():
            continue
        is_at_end = part.start == 1 or part.stop == len(evidence)
        if is_at_end or np.linalg.norm(positions[part.stop] - positions[part.stop - 1]) > _RESTING_M:
            yield _stretch(evidence, Kind.COPIES, part, evidence.is_copy)


def _of_segments(evidence: Evidence) -> Iterator[Stretch]:
    """Segments that no accepted closure joins to those before."""
    segment = np.cumsum(evidence.starts_segment)
    closures = evidence.closures
    ends = np.stack([segment[closures.target], segment[closures.source]], axis=1)[closures.is_accepted]
    label = np.arange(segment[-1] + 1)
    for low, high in np.sort(ends, axis=1).tolist():
        label[label == label[high]] = label[low]
    for number in np.flatnonzero(label != label[0]).tolist():
        (part,) = merged(segment == number)
        yield _stretch(evidence, Kind.DISCONNECTED, part, segment == number)


def merged(is_marked: NDArray[np.bool_], gap: int = _GAP_SCANS) -> list[slice]:
    """Runs of marked scans, joined over gaps of a few scans."""
    places = np.flatnonzero(is_marked)
    if not len(places):
        return []
    parts = np.split(places, np.flatnonzero(np.diff(places) > gap + 1) + 1)
    return [slice(int(part[0]), int(part[-1]) + 1) for part in parts]


def _stretch(
    evidence: Evidence, kind: Kind, part: slice, is_marked: NDArray[np.bool_], size_m: float | None = None,
    size_rad: float | None = None,
) -> Stretch:  # fmt: skip
    """The stretch of a part of the scans, some of which are marked (N,)."""
    start_s, end_s = evidence.seconds[[part.start, part.stop - 1]].tolist()
    count = int(is_marked[part].sum())
    return Stretch(kind, part.start, part.stop - 1, count, start_s, end_s, size_m, size_rad)
