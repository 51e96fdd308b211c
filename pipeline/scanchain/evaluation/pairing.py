"""Pairs of estimated and true poses at the same stamps, interpolated in between; ground truth from files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Trajectory, brief
from scanchain.errors import InputError, counted
from scanchain.trajectory import read_kitti, read_tum, text_lines

# least and most of the default widest gap: at 1 m/s² a straight line is up to 1.3 mm and up to 5 cm off within it
_GAPS_S = (0.1, 0.6)
_INTERVALS = 5.0  # median intervals of the reference that the default widest gap has at least
ERRORS_S = (1e-6, 5e-4)  # largest of a stamp that was a floating-point number of seconds, or in milliseconds
_FEW = 10  # number of poses below which their error has little meaning
_FEWEST_AFTER_START = 4  # pairs with the first pose, of which three remain: as many as a rigid alignment takes
_ROUNDING_SHARE = 0.1  # share of the reference's median interval that either error is at most
_SLACK_NS = 1_000_000_000  # largest error of the expected stamps of a log's scans


@dataclass(frozen=True, slots=True)
class Pairs:
    """Estimate and reference, pose by pose, in the order and at the stamps of the estimate.

    estimate, reference : (N, 4, 4) poses; SE(2) lifted into the plane z = 0
    places : (N,) int64, indices of the poses in the estimate
    estimate_count, reference_count : numbers of poses before pairing
    interpolated : how many of the N reference poses lie between two of the reference's own
    early, late, in_gap : estimated poses without a reference pose: before its start, after its end, in gaps of it
    gap_s : widest gap of the reference to interpolate over; widest_s : widest interpolated over
    """

    __repr__ = brief
    stamps_ns: NDArray[np.int64]
    estimate: Matrix
    reference: Matrix
    places: NDArray[np.int64]
    estimate_count: int
    reference_count: int
    interpolated: int
    early: int
    late: int
    in_gap: int
    gap_s: float
    widest_s: float

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def share(self) -> float:
        """Share of the estimated poses that have a reference pose."""
        return len(self) / self.estimate_count

    @property
    def starts(self) -> bool:
        """True if the first two poses of the estimate, and another, have a reference pose."""
        return len(self) >= _FEWEST_AFTER_START and self.places[:2].tolist() == [0, 1]

    @property
    def after_start(self) -> Pairs:
        """The pairs from the second pose of the estimate on: nothing predicts the motion up to it."""
        if not self.starts:
            return self
        parts = {name: getattr(self, name)[1:] for name in ("stamps_ns", "estimate", "reference", "places")}
        return replace(self, **parts)

    @property
    def start_error_m(self) -> float | None:
        """Error of the motion from the first pose to the second; None where that is unknown."""
        if not self.starts:
            return None
        motion, true_motion = (lie.between(poses[0], poses[1]) for poses in (self.estimate, self.reference))
        return float(np.linalg.norm(lie.between(true_motion, motion)[:3, 3]))

    @property
    def missing(self) -> str:
        """Number of estimated poses without a reference pose, with the reason; empty where all have one."""
        counts = {
            "before the truth begins": self.early,
            "after it ends": self.late,
            f"in gaps of it wider than {self.gap_s:.3g} s": self.in_gap,
        }
        reasons = ", ".join(f"{count:,} {where}" for where, count in counts.items() if count)
        return f"{self.estimate_count - len(self):,} without a true pose: {reasons}" if reasons else ""

    @property
    def description(self) -> str:
        """Description of the pairs and of the interpolation."""
        text = (
            f"{len(self):,} of {self.estimate_count:,} estimated poses ({100.0 * self.share:.1f} %), each with "
            f"the reference (of {counted(self.reference_count, 'pose')}) at its stamp"
        )
        if self.interpolated:
            text += (
                f": {len(self) - self.interpolated:,} as they are, {self.interpolated:,} interpolated (position "
                f"linear, rotation by SLERP, gaps up to {self.gap_s:.3g} s), none extrapolated"
            )
        return f"{text}; {self.missing}" if self.missing else text

    @property
    def warnings(self) -> list[str]:
        """Reasons for which figures over these pairs may mislead, one per line."""
        lines = []
        if 2 * len(self) < self.estimate_count:
            lines.append(
                f"accuracy is that of {len(self):,} of {self.estimate_count:,} scans alone: {self.missing}"
            )
        elif len(self) < _FEW:
            lines.append(f"accuracy is that of {counted(len(self), 'pose')} alone")
        if self.widest_s > _GAPS_S[1]:
            lines.append(
                f"true poses are up to {self.widest_s:.3g} s apart, and the path between them is taken as straight"
            )
        return lines


def pair(estimate: Trajectory, reference: Trajectory, *, gap_s: float | None = None) -> Pairs:
    """The reference at the stamps of the estimate: positions linear, rotations by SLERP between its neighbors.

    A reference pose of the same stamp, to a microsecond, is taken as it is. Nothing is extrapolated: outside the
    reference, and where its neighbors are more than ``gap_s`` apart, an estimated pose has none, except one within
    the rounding of a stamp written in milliseconds. Neither trajectory's stamps need increase.

    gap_s : None for five typical intervals of the reference (half of its time lies in longer ones), 0.1 to 0.6 s
    """
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        if not len(trajectory):
            raise InputError(f"the {name} has no pose; nothing to compare")
    order = np.argsort(reference.stamps_ns, kind="stable")
    stamps_ns, wanted_ns = reference.stamps_ns[order], estimate.stamps_ns
    interval_ns = _usual_interval_ns(stamps_ns)
    default_s = min(max(_INTERVALS * 1e-9 * interval_ns, _GAPS_S[0]), _GAPS_S[1])
    gap_ns = 1e9 * (default_s if gap_s is None else gap_s)
    index, difference_ns = nearest(wanted_ns, reference.stamps_ns)
    after = np.searchsorted(stamps_ns, wanted_ns, side="right")
    early, late = after == 0, after == len(stamps_ns)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(stamps_ns) - 1)
    interval = stamps_ns[after] - stamps_ns[before]
    same_ns, rounded_ns = (min(each * 1e9, _ROUNDING_SHARE * (interval_ns or np.inf)) for each in ERRORS_S)
    between = ~early & ~late & (difference_ns > same_ns) & (interval <= gap_ns)
    known = between | (difference_ns <= rounded_ns)
    poses = reference.poses[index]
    share = (wanted_ns - stamps_ns[before])[between] / interval[between]
    poses[between] = _interpolated(
        reference.poses[order[before[between]]], reference.poses[order[after[between]]], share
    )
    if not known.any():
        raise InputError(_no_pairs(estimate, reference, gap_ns * 1e-9))
    if known.sum() > 1 and not np.ptp(wanted_ns[known]):
        same = f"all have the stamp {1e-9 * wanted_ns[known][0]:.3f} s"
        raise InputError(
            f"the {known.sum():,} poses that can be paired {same}: no true pose is known to be theirs"
        )
    return Pairs(
        stamps_ns=wanted_ns[known],
        estimate=lie.lift(estimate.poses[known]),
        reference=lie.lift(poses[known]),
        places=np.flatnonzero(known),
        estimate_count=len(estimate),
        reference_count=len(reference),
        interpolated=int(between.sum()),
        early=int((early & ~known).sum()),
        late=int((late & ~known).sum()),
        in_gap=int((~early & ~late & ~known).sum()),
        gap_s=gap_ns * 1e-9,
        widest_s=float(interval[between].max(initial=0)) * 1e-9,
    )


def during(reference: Trajectory, stamps_ns: NDArray[np.int64]) -> Trajectory:
    """The reference from its last pose not after the first of these stamps to its first not before the last."""
    there, first_ns, last_ns = reference.stamps_ns, stamps_ns.min(), stamps_ns.max()
    begin_ns = np.max(there, where=there <= first_ns, initial=there.min())
    end_ns = np.min(there, where=there >= last_ns, initial=there.max())
    chosen = (there >= begin_ns) & (there <= end_ns)
    return Trajectory(there[chosen], reference.poses[chosen])


def nearest(
    wanted_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of the stamp nearest each wanted one, and the distance in ns.

    Of equal stamps the first in the given order is taken, of two equally far ones the earlier.
    """
    order = np.argsort(stamps_ns, kind="stable")
    ordered = stamps_ns[order]
    after = np.searchsorted(ordered, wanted_ns, side="left")
    upper = np.minimum(after, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    lower = np.searchsorted(ordered, ordered[before], side="left")
    to_upper, to_lower = np.abs(ordered[upper] - wanted_ns), np.abs(ordered[lower] - wanted_ns)
    chosen = np.where(to_lower <= to_upper, lower, upper)
    return order[chosen], np.minimum(to_lower, to_upper)


def span(stamps_ns: NDArray[np.int64]) -> str:
    """From the earliest stamp to the latest, as text."""
    return f"{stamps_ns.min() / 1e9:.3f} to {stamps_ns.max() / 1e9:.3f} s"


def _usual_interval_ns(ordered_ns: NDArray[np.int64]) -> float:
    """Time-weighted median of the intervals between stamps; 0 where all are equal.

    If stamps come in bursts, most intervals are close to zero, and so is their plain median.
    """
    intervals = np.sort(np.diff(ordered_ns))
    if not intervals.any():
        return 0.0
    elapsed = np.cumsum(intervals)
    return float(intervals[np.searchsorted(elapsed, 0.5 * elapsed[-1])])


def _interpolated(T_a: Matrix, T_b: Matrix, share: NDArray[np.float64]) -> Matrix:
    """Poses (K, d+1, d+1) at a share of the motion from a to b: position linear, rotation by SLERP."""
    d = T_a.shape[-1] - 1
    R_a, R_b = T_a.copy(), T_b.copy()
    R_a[:, :d, d] = R_b[:, :d, d] = 0.0
    result = lie.exp(share[:, None] * lie.log(R_b @ lie.inverse(R_a))) @ R_a
    result[:, :d, d] = T_a[:, :d, d] + share[:, None] * (T_b[:, :d, d] - T_a[:, :d, d])
    return result


def _no_pairs(estimate: Trajectory, reference: Trajectory, gap_s: float) -> str:
    here, there = estimate.stamps_ns, reference.stamps_ns
    spans = f"the estimate ({span(here)}) has no pose that can be paired with the reference ({span(there)})"
    if len(np.unique(there)) == 1:
        return f"{spans}, which has poses at one instant alone; give true poses all along the trajectory"
    if here.max() < there.min() or there.max() < here.min():
        return f"{spans}; check that both use the same clock"
    return f"{spans}, whose neighbors are more than {gap_s:.3g} s apart there; --max-gap allows more"


@dataclass(frozen=True, slots=True)
class TruthFile:
    """Poses of the lidar from a TUM file, or from a KITTI file, without stamps, one row per scan."""

    path: Path
    poses: Trajectory
    has_stamps: bool

    def check(self, scans_ns: NDArray[np.int64], scans: int) -> None:
        """Refuse a file that cannot belong to this number of scans between these stamps. Raises InputError."""
        if self.has_stamps:
            check_overlap(str(self.path), self.poses.stamps_ns, scans_ns)
        else:
            self._check_rows(scans)

    def at(self, stamps_ns: NDArray[np.int64]) -> Trajectory:
        """The poses with their stamps; those of a KITTI file, of which there must be N, with those of N scans."""
        if self.has_stamps:
            return self.poses
        self._check_rows(len(stamps_ns))
        return Trajectory(stamps_ns, self.poses.poses)

    def first(self, scans: int) -> TruthFile:
        """The poses of the first scans only, of a KITTI file; a TUM file as it is."""
        if self.has_stamps:
            return self
        poses = Trajectory(self.poses.stamps_ns[:scans], self.poses.poses[:scans])
        return TruthFile(self.path, poses, has_stamps=False)

    def _check_rows(self, scans: int) -> None:
        if len(self.poses) != scans:
            raise InputError(
                f"{self.path}: has {counted(len(self.poses), 'line')} for {counted(scans, 'scan')}; "
                "a KITTI file has one line per scan that is read, or give a TUM file, which has stamps"
            )


def check_overlap(source: str, truth_ns: NDArray[np.int64], scans_ns: NDArray[np.int64]) -> None:
    """Refuse a truth whose stamps, given whole or by both ends, lie all before or all after those of the scans."""
    if truth_ns.min() > scans_ns.max() + _SLACK_NS or truth_ns.max() < scans_ns.min() - _SLACK_NS:
        raise InputError(
            f"{source}: its poses ({span(truth_ns)}) and the scans ({span(scans_ns)}) have no time in common; "
            "check that both use the same clock and that it belongs to this log"
        )


def read_truth(path: Path) -> TruthFile:
    """Ground truth of a TUM or a KITTI file, by the number of words in its first line."""
    first = next(iter(text_lines(path)), None)
    is_kitti = first is not None and len(first[1]) == 12  # the upper three rows of a pose
    return TruthFile(path, read_kitti(path) if is_kitti else read_tum(path), not is_kitti)
