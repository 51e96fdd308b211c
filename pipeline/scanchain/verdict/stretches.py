"""Suspicious segments of a trajectory: contradicted by a check or loop closures, or not constrained by scans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import LEAST_FIT, MOST_COPIES, Matrix
from scanchain.graph.consistency import FEWEST, carried, connected
from scanchain.verdict.checks import VELOCITY_LIMIT, WHEEL_LIMIT, Floats, Kind, Stretch, WheelCheck

_LEAST_OVERLAP = 2.0 / 3.0  # smallest accepted ``overlap``
_GAP = 3.0  # multiple of the median interval above which the motion is not predicted
_GAP_SCANS = 10  # largest number of scans without a finding within a segment
_PASSED_M = 1.0  # largest harmless extent of a segment of predicted or contradicted poses
_PASSED_BY_WHEELS_M = 4.0  # the same where the wheels agree with the trajectory
KNOWN = 0.5  # least share of scans with wheel odometry for it to count as known
_RESTING_M = 0.05  # largest distance from copies to the next scan at which the lidar was at rest
_MEDIAN_SCANS = 9  # window of the median of ``fit``; moving people contradict single scans

_LEAST_M = 0.5  # least translation error of a closure that is a contradiction
_NEAR_M = 10.0  # largest path between two closures of a group, summed over both ends
_AGREE_M, _AGREE_SHARE = 0.2, 0.02  # largest difference of two that agree: meters, and share of that path
_FINDABLE = 3000  # largest number of contradicting closures that are grouped; of more, every n-th

_FEWEST, _MOST = 3, 20  # least and largest number of closures around a segment that decide; the shortest are used
_MOST_PARTS = 8  # largest number of segments within a closure; one with more is not used
_RATIO = 1.0 / 3.0  # largest ratio of the residual with the right source to that with the wrong one
_EXPLAINED = 0.5  # least share of a disagreement left by the wrong source, or explained by a jump of the wheels
_IMPOSSIBLE_M = 1.0  # smallest change of the wheels' motion from scan to scan that is a jump


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


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence for the verdict on a trajectory, mostly (N,) arrays with a value per scan.

    seconds : log time since the first scan
    poses : (N, d+1, d+1) final
    is_lost, is_degenerate : states; False where unknown
    fit : as in ``Match``; NaN where unknown
    starts_segment : scans whose motion from the previous one is unknown
    is_copy : scans that are bit-identical to the previous one
    points : number of valid returns
    wheels, velocity, overlap : checks
    closures : those that verification accepted
    odometry : (N, d+1, d+1) before optimization; None where nothing was optimized
    error : estimated error in words, valid outside of suspicious segments; empty where unknown
    bound_m : upper bound of that error; infinite where unknown
    uncertain : the part of the log with the most uncertain positions, in words; empty for none
    open_m : position uncertainty due to range noise, two standard deviations
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
    bound_m: float = np.inf
    uncertain: str = ""
    open_m: float = 0.0

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
        """(N,) scans after a gap in time over which the motion is not predicted."""
        intervals_s = np.diff(self.seconds, prepend=self.seconds[0])
        return intervals_s > _GAP * np.median(intervals_s)

    def __len__(self) -> int:
        return len(self.seconds)


def find_stretches(evidence: Evidence) -> list[Stretch]:
    """All suspicious segments in order of time, including those where only the wheels slipped."""
    has_left = (evidence.overlap < _LEAST_OVERLAP) & ~evidence.starts_segment
    median = median_filter(np.nan_to_num(evidence.fit, nan=1.0), _MEDIAN_SCANS, mode="nearest")
    fits_badly = (evidence.is_after_gap & ~evidence.is_held_by_wheels) | (median < LEAST_FIT)
    measured = [
        *_of_states(evidence, Kind.LOST, evidence.is_lost),
        *_of_states(evidence, Kind.DEGENERATE, evidence.is_degenerate),
        *_of_states(evidence, Kind.CONTRADICTED, evidence.is_contradicted & fits_badly),
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
    """Segments of marked scans that are too long for the prediction of the motion to be harmless.

    An unmarked scan in between measures the pose again, which ends the prediction. Not so between contradicted
    scans: the map that it is matched to contains these at wrong poses.
    """
    for part in merged(is_marked):
        inner = merged(is_marked[part], 0 if kind is not Kind.CONTRADICTED else _GAP_SCANS)
        runs = [slice(part.start + run.start, part.start + run.stop) for run in inner]
        if any(_extent_m(evidence, run, kind) > _passed_m(evidence, run) for run in runs):
            counted = evidence.is_contradicted if kind is Kind.CONTRADICTED else is_marked
            yield _stretch(evidence, kind, part, counted)


def _extent_m(evidence: Evidence, part: slice, kind: Kind) -> float:
    """Largest distance from the pose before a part; after a time gap, at least the speed before times the gap."""
    positions, last = evidence.poses[:, :-1, -1], max(part.start - 1, 0)
    extent_m = float(np.linalg.norm(positions[part] - positions[last], axis=1).max())
    period_s = np.median(np.diff(evidence.seconds)) if evidence.is_after_gap[part.start] else 0.0
    if kind is Kind.DEGENERATE or not period_s > 0.0:
        return extent_m
    speed_m_s = np.linalg.norm(positions[last] - positions[last - 1]) / period_s
    return max(extent_m, float(speed_m_s * (evidence.seconds[part.start] - evidence.seconds[last])))


def _passed_m(evidence: Evidence, part: slice) -> float:
    """Largest harmless extent of a part: larger where wheel odometry is known and agrees throughout."""
    innovation = evidence.wheels.innovation[part]
    is_held = np.isfinite(innovation).mean() >= KNOWN and not (innovation > WHEEL_LIMIT).any()
    return _PASSED_BY_WHEELS_M if is_held else _PASSED_M


def _of_wheels(evidence: Evidence, measured: Sequence[Stretch]) -> Iterator[Stretch]:
    """Segments where wheels and trajectory disagree, each with the source that slipped.

    measured : segments of badly measured scans; closures that agree with them may join ambiguous places, so that
        they are no proof that the wheels slipped
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
    """Segments of copies from a stuck driver: the next scan is elsewhere, or the log begins or ends with them.

    Noise-free simulated scans at rest are identical, too, but the scan after them is at the same position.
    """
    positions = evidence.poses[:, :-1, -1]
    for part in merged(evidence.is_copy, 0):
        if part.stop - part.start <= MOST_COPIES or evidence.is_held_by_wheels[part].all():
            continue
        is_at_end = part.start == 1 or part.stop == len(evidence)
        if is_at_end or np.linalg.norm(positions[part.stop] - positions[part.stop - 1]) > _RESTING_M:
            yield _stretch(evidence, Kind.COPIES, part, evidence.is_copy)


def _of_segments(evidence: Evidence) -> Iterator[Stretch]:
    """Segments that accepted closures do not connect to the first one."""
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
    """Runs of marked scans, joined over up to ``gap`` unmarked ones."""
    places = np.flatnonzero(is_marked)
    parts = np.split(places, np.flatnonzero(np.diff(places) > gap + 1) + 1)
    return [slice(int(part[0]), int(part[-1]) + 1) for part in parts if len(part)]


def _stretch(
    evidence: Evidence, kind: Kind, part: slice, is_marked: NDArray[np.bool_], size_m: float | None = None,
    size_rad: float | None = None,
) -> Stretch:  # fmt: skip
    """A finding for a part of the scans, some of which are marked (N,)."""
    start_s, end_s = evidence.seconds[[part.start, part.stop - 1]].tolist()
    count = int(is_marked[part].sum())
    return Stretch(kind, part.start, part.stop - 1, count, start_s, end_s, size_m, size_rad)


def contradicting_groups(closures: Closures, poses: Matrix, seconds: Floats) -> list[Stretch]:
    """Segments between the ends of groups of at least three closures that agree, but contradict the final poses.

    Either the motion over the segment is wrong by about the same distance, or the two places are perceptually
    aliased.

    poses : (N, d+1, d+1) final
    seconds : (N,) of the scans
    """
    expected = lie.between(poses[closures.target], poses[closures.source])
    off = lie.between(expected, closures.T_target_source)[:, :-1, -1]
    size_m = np.linalg.norm(off, axis=1)
    chosen = np.flatnonzero(size_m > _LEAST_M)
    chosen = chosen[:: max(1, -(-len(chosen) // _FINDABLE))]
    if len(chosen) < FEWEST:
        return []
    edges, T = np.stack([closures.target, closures.source], axis=1)[chosen], closures.T_target_source[chosen]
    steps_m = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(steps_m)])[edges]

    def agree(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
        off_m = np.linalg.norm((carried(poses, edges[a], T[a], edges[b]) - T[b])[:, :-1, -1], axis=1)
        return off_m < _AGREE_M + _AGREE_SHARE * np.abs(along_m[a] - along_m[b]).sum(axis=1)

    pairs = KDTree(along_m).query_pairs(_NEAR_M, p=1, output_type="ndarray")
    groups = []
    for members in connected(np.concatenate([pairs, pairs[:, ::-1]]), len(chosen), agree):
        low, high = edges[members].min(axis=1), edges[members].max(axis=1)
        first, last = int(low.max()), int(high.min())
        if first >= last:
            first, last = int(low.min()), int(high.max())
        start_s, end_s = seconds[[first, last]].tolist()
        wrong_m = float(np.median(size_m[chosen][members]))
        groups.append(Stretch(Kind.LOOPS, first, last, len(members), start_s, end_s, wrong_m))
    return groups


def which_slipped(
    parts: Sequence[slice], odometry: Matrix, wheels: Matrix, closures: Closures
) -> list[tuple[Kind, float]]:
    """Kind of slip, of scans or wheels, and its size in m, for each part of a trajectory where the two disagree.

    A closure around a part measures the relative pose of its two scans independently. It is predicted from the
    motion of each part by scans or by wheels, in every combination, and from the motion outside of the parts by
    either, with the rotations of the scans. In a part, a source slipped if the closures are predicted well without
    it and badly with it. A jump of the wheels that no vehicle makes is slip without any closure. If neither source
    can be identified, the kind is ``Kind.WHEELS``.

    odometry, wheels : (N, d+1, d+1), of the lidar; wheels NaN where unknown
    """
    steps = np.nan_to_num(
        lie.between(wheels[:-1], wheels[1:])[:, :-1, -1] - lie.between(odometry[:-1], odometry[1:])[:, :-1, -1]
    )
    excess = np.zeros((len(odometry), odometry.shape[-1] - 1))  # position by wheels minus that by scans
    excess[1:] = np.cumsum(np.einsum("nij,nj->ni", odometry[:-1, :-1, :-1], steps), axis=0)
    ends = np.array([(max(part.start - 1, 0), part.stop - 1) for part in parts], np.int64).reshape(-1, 2)
    apart = excess[ends[:, 1]] - excess[ends[:, 0]]
    low, high = np.minimum(closures.target, closures.source), np.maximum(closures.target, closures.source)
    is_forward = (closures.target <= closures.source)[:, None, None]
    T_low_high = np.where(is_forward, closures.T_target_source, lie.inverse(closures.T_target_source))
    off = (odometry[low] @ T_low_high)[:, :-1, -1] - odometry[high][:, :-1, -1]
    found = []
    for place, (first, last) in enumerate(ends.tolist()):
        size_m = float(np.linalg.norm(apart[place]))
        changes = (np.diff(poses[first : last + 1, :-1, -1], n=2, axis=0) for poses in (wheels, odometry))
        jump_m, usual_m = (np.nan_to_num(np.linalg.norm(each, axis=1)).max(initial=0.0) for each in changes)
        if jump_m > max(_IMPOSSIBLE_M + 2.0 * usual_m, _EXPLAINED * size_m):
            found.append((Kind.WHEELS_SLIP, size_m))
            continue
        around = np.flatnonzero(closures.is_accepted & (low <= first) & (high >= last))
        around = around[np.argsort(high[around] - low[around], kind="stable")][:_MOST]
        left = []
        for closure in around.tolist():
            within = np.flatnonzero((ends[:, 0] >= low[closure]) & (ends[:, 1] <= high[closure]))
            if len(within) <= _MOST_PARTS:
                rest = excess[high[closure]] - excess[low[closure]] - apart[within].sum(axis=0)
                is_this = within == place
                left.append(
                    [_left_m(each, apart[within], is_this) for each in (off[closure], off[closure] - rest)]
                )
        found.append((_decided(np.array(left), size_m), size_m))
    return found


def _left_m(off: Floats, apart: Floats, is_this: Floats) -> tuple[float, float]:
    """Least residual of ``off`` (d,) over all combinations of parts (K, d): this part by scans, by wheels."""
    by_wheels = np.array(list(product((0.0, 1.0), repeat=len(apart))))
    left_m = np.linalg.norm(off - by_wheels @ apart, axis=1)
    has_this = by_wheels @ is_this > 0.0
    return float(left_m[~has_this].min()), float(left_m[has_this].min())


def _decided(left_m: Floats, size_m: float) -> Kind:
    """Kind of slip from residuals (C, 2, 2) of closures: rest by scans or wheels, part by scans or wheels."""
    if len(left_m) < _FEWEST:
        return Kind.WHEELS
    by_scans, by_wheels = np.median(left_m, axis=0).T
    for right, wrong, slipped in ((by_scans, by_wheels, Kind.WHEELS_SLIP), (by_wheels, by_scans, Kind.SCANS_SLIP)):
        if (right <= _RATIO * wrong).all() and (wrong >= _EXPLAINED * size_m).all():
            return slipped
    return Kind.WHEELS
