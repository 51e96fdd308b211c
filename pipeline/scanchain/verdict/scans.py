"""The checks of the scans themselves: their matches, overlap and accelerations, and copies of one scan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from scanchain import lie
from scanchain.data import LEAST_FIT, MOST_COPIES, SIMILAR_INTERVALS, Matrix
from scanchain.verdict.evidence import Check, Evidence, Floats, Kind, Segment, listed, merged

MOST_CONTRADICTED = 0.1  # largest share of contradicted scans; good real runs have up to 0.025
_MOST_PREDICTED = 0.5  # largest share of scans with a predicted pose that nothing confirms
MOST_OPEN = 0.2  # largest share of degenerate scans of a trajectory that is trustworthy
_FEW_POINTS = 100  # number of points below which a scan is sparse; scans of planar lidars have more
# largest harmless extent of a segment of predicted or contradicted poses; of one that another sensor confirms
_PASSED_M = (1.0, 4.0)
_MEDIAN_SCANS = 9  # window of the median of ``fit``; moving people contradict single scans

_LEAST_OVERLAP = 2.0 / 3.0  # smallest accepted ratio of the inlier share to the usual one
_PREVIOUS = (3, 10)  # least and largest number of previous scans whose median is the usual share

_ACCELERATION = (4.0, 12.0)  # m/s² and rad/s², σ: a fifth to a third of what vehicles and hands reach
JUMP_M = 1.0  # change of the motion from scan to scan that no vehicle makes
_MOTION = (0.05, 0.01)  # m and rad, σ of the motion between two scans by scan matching

_RESTING_M = 0.05  # largest distance from copies to the next scan at which the lidar was at rest


class States(Check):
    """The fit of each scan to the map, and whether its points determine its pose."""

    name = "fit"

    def __init__(self, evidence: Evidence) -> None:
        self.values = evidence.fit

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Segments of lost, degenerate and contradicted scans."""
        median = median_filter(np.nan_to_num(evidence.fit, nan=1.0), _MEDIAN_SCANS, mode="nearest")
        fits_badly = (evidence.is_after_gap & ~evidence.is_confirmed) | (median < LEAST_FIT)
        yield from _of_state(evidence, Kind.LOST, evidence.is_lost)
        yield from _of_state(evidence, Kind.DEGENERATE, evidence.is_degenerate)
        yield from _of_state(evidence, Kind.CONTRADICTED, evidence.is_contradicted & fits_badly)

    def failures(self, evidence: Evidence, segments: Sequence[Segment]) -> Iterator[str]:
        """Many contradicted scans, or mostly predicted poses."""
        yield from _many_contradicted(evidence)
        yield from _mostly_predicted(evidence)

    def warnings(self, evidence: Evidence) -> Iterator[str]:
        """Many degenerate scans."""
        count = int(evidence.is_degenerate.sum())
        if count > MOST_OPEN * len(evidence):
            yield (
                f"{count:,} of {len(evidence):,} scans are degenerate: in at least one direction poses are those "
                "of the prediction, by wheels where these are used"
            )


def _many_contradicted(evidence: Evidence) -> Iterator[str]:
    total = int(evidence.is_contradicted.sum())
    count = int((evidence.is_contradicted & ~evidence.is_confirmed).sum())
    if count > MOST_CONTRADICTED * len(evidence):
        held = f", {total - count:,} of them where the wheels agree" if count < total else ""
        yield (
            f"{total:,} of {len(evidence):,} scans are contradicted by the map where they were placed (fit below "
            f"{LEAST_FIT:g}{held}): the motion between scans may be larger than the search, or the log is "
            "at fault (scanchain doctor)"
        )


def _mostly_predicted(evidence: Evidence) -> Iterator[str]:
    is_open = evidence.is_degenerate & ~evidence.is_confirmed
    if (is_open | evidence.is_lost).sum() <= _MOST_PREDICTED * len(evidence):
        return
    line = (
        f"{int(evidence.is_degenerate.sum()):,} of {len(evidence):,} scans are degenerate and "
        f"{int(evidence.is_lost.sum()):,} lost: most poses are predicted, not measured, in at least one direction"
    )
    points = float(np.median(evidence.points))
    if points < _FEW_POINTS:
        few = f"scans have {points:.0f} valid points (median)"
        yield f"{line}; {few}, as a radar's have: choose a lidar with --topic"
    else:
        yield f"{line}: the surroundings do not constrain it there, or the log is faulty (scanchain doctor)"


def _of_state(evidence: Evidence, kind: Kind, is_marked: NDArray[np.bool_]) -> Iterator[Segment]:
    """Segments of marked scans that are too long for the prediction of the motion to be harmless.

    An unmarked scan in between measures the pose again, which ends the prediction. Not so between contradicted
    scans: the map that it is matched to contains these at wrong poses.
    """
    for part in merged(is_marked):
        inner = merged(is_marked[part]) if kind is Kind.CONTRADICTED else merged(is_marked[part], 0)
        runs = [slice(part.start + run.start, part.start + run.stop) for run in inner]
        limits_m = [_PASSED_M[evidence.is_confirmed_throughout(run)] for run in runs]
        if any(_extent_m(evidence, run, kind) > limit_m for run, limit_m in zip(runs, limits_m, strict=True)):
            counted = evidence.is_contradicted if kind is Kind.CONTRADICTED else is_marked
            yield evidence.segment(kind, part, counted)


def _extent_m(evidence: Evidence, part: slice, kind: Kind) -> float:
    """Largest distance from the pose before a part; after a time gap, at least the speed before times the gap."""
    positions, last = evidence.poses[:, :-1, -1], max(part.start - 1, 0)
    extent_m = float(np.linalg.norm(positions[part] - positions[last], axis=1).max())
    period_s = np.median(np.diff(evidence.seconds)) if evidence.is_after_gap[part.start] else 0.0
    if kind is Kind.DEGENERATE or not period_s > 0.0:
        return extent_m
    speed_m_s = np.linalg.norm(positions[last] - positions[last - 1]) / period_s
    return max(extent_m, float(speed_m_s * (evidence.seconds[part.start] - evidence.seconds[last])))


class Overlap(Check):
    """The inlier share of each scan relative to its median over the previous scans."""

    name, kind, column = "overlap", Kind.OVERLAP, "overlap_ratio"

    def __init__(self, evidence: Evidence) -> None:
        self.values = check_overlap(evidence.inlier_share)

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Segments where many correspondences are lost at once, except where a segment begins."""
        has_left = (self.values < _LEAST_OVERLAP) & ~evidence.starts_segment
        return (evidence.segment(self.kind, part, has_left) for part in merged(has_left))


def check_overlap(inlier_share: Floats) -> Floats:
    """(N,) inlier share of each scan relative to its median over the previous scans, NaN for the first ones.

    Consecutive scans see mostly the same surfaces. If many correspondences are lost at once, the pose in the map
    is wrong, or a close object blocks the view.
    """
    usual = np.full(len(inlier_share), np.nan)
    if not np.isfinite(inlier_share).any():
        return usual
    fewest, most = _PREVIOUS
    padded = np.append(np.full(most, np.nan), inlier_share)  # the first scans have fewer previous ones
    usual[fewest:] = np.nanmedian(sliding_window_view(padded, most)[fewest:-1], axis=1)
    return inlier_share / np.maximum(usual, 1e-3)


class Velocity(Check):
    """The change of the motion from scan to scan over the standard deviation of plausible accelerations."""

    name, kind, column, limit = "constant velocity", Kind.ACCELERATION, "velocity_innovation", 4.0

    def __init__(self, evidence: Evidence) -> None:
        self.values = check_velocity(evidence.stamps_ns, evidence.log_times_ns, evidence.poses)

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Segments of impossible accelerations, except where a segment begins."""
        is_new = evidence.starts_segment
        is_marked = (self.values > self.limit) & ~is_new & ~np.concatenate([[False], is_new[:-1]])
        jumps_m = np.zeros(len(evidence))
        jumps_m[2:] = np.linalg.norm(np.diff(evidence.poses[:, :-1, -1], n=2, axis=0), axis=1)
        for part in merged(is_marked):
            size_m = float(jumps_m[part][is_marked[part]].max())
            yield evidence.segment(self.kind, part, is_marked, size_m)

    def failures(self, evidence: Evidence, segments: Sequence[Segment]) -> Iterator[str]:
        """The large jumps."""
        jumps = [each for each in segments if each.kind == self.kind and (each.size_m or 0.0) > JUMP_M]
        if jumps:
            yield listed(jumps)


def check_velocity(stamps_ns: NDArray[np.int64], log_times_ns: NDArray[np.int64], poses: Matrix) -> Floats:
    """(N,) innovation of each motion against constant velocity, in standard deviations of plausible accelerations.

    The previous motion is scaled by the ratio of the time intervals, by the stamps, by the log times or constant,
    whichever agrees best, so that jittering stamps cause no innovation. NaN for the first two scans,
    and for all where neither clock advances.
    """
    n, d = len(poses), poses.shape[-1] - 1
    innovation = np.full(n, np.nan)
    if n < 3:
        return innovation
    motions = lie.log(lie.between(poses[:-1], poses[1:]))
    clocks = [np.diff(clock) * 1e-9 for clock in (stamps_ns, log_times_ns)]
    usual_s = next((usual_s for clock in clocks if (usual_s := float(np.median(clock))) > 0.0), 0.0)
    if not usual_s:
        return innovation
    clocks.append(np.full(n - 1, usual_s))
    best = np.full(n - 2, np.inf)
    for interval_s in clocks:
        plausible_s = np.maximum(interval_s, usual_s / SIMILAR_INTERVALS)
        before, after = plausible_s[:-1], plausible_s[1:]
        change = motions[1:] - (after / before)[:, None] * motions[:-1]
        span_s2 = 0.5 * after * (before + after)
        parts = (change[:, :d], change[:, d:])
        apart = [np.linalg.norm(part, axis=1) / _sigma(span_s2, k) for k, part in enumerate(parts)]
        best = np.minimum(best, np.maximum(*apart))
    innovation[2:] = best
    return innovation


def smallest_jump_m(seconds: Floats) -> float:
    """Smallest jump of a position that ``check_velocity`` detects at the median interval of times (N,)."""
    return Velocity.limit * float(_sigma(np.median(np.diff(seconds)) ** 2)) if len(seconds) > 1 else np.inf


def _sigma(span_s2: Floats | float, part: int = 0) -> Floats:
    """Standard deviation of a change of motion: of its translation (0) or its rotation (1)."""
    return np.hypot(_ACCELERATION[part] * span_s2, _MOTION[part])


class Copies(Check):
    """Copies after which the next scan is elsewhere, or with which the log begins or ends.

    Noise-free simulated scans at rest are identical, too, but the scan after them is at the same position.
    """

    kind = Kind.COPIES

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Segments of more than a few copies that no other sensor confirms."""
        positions = evidence.poses[:, :-1, -1]
        for part in merged(evidence.is_copy, 0):
            if part.stop - part.start <= MOST_COPIES or evidence.is_confirmed[part].all():
                continue
            is_at_end = part.start == 1 or part.stop == len(evidence)
            if is_at_end or np.linalg.norm(positions[part.stop] - positions[part.stop - 1]) > _RESTING_M:
                yield evidence.segment(self.kind, part, evidence.is_copy)
