"""The check by wheel odometry: innovations, and which of wheels and scans slipped where they disagree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.errors import counted
from scanchain.registration import hand_eye
from scanchain.registration.hand_eye import HandEye
from scanchain.registration.svd_icp import DegeneratePairsError, rigid_transform
from scanchain.verdict.evidence import KNOWN, Check, Closures, Evidence, Floats, Kind, Segment, extent_m, merged
from scanchain.verdict.scans import JUMP_M

WINDOW_M = 4.0  # path over which wheels and trajectory are compared
_SHORTEST_M = 0.5  # shortest path of a window that is checked
_SPUN_M = 0.5  # largest path per scan counted from the wheels alone: a longer one is slip or a wrong reading
_GRID_M, _MEDIAN = 0.1, 21  # median filter along the path: spacing and number of samples

_LARGEST_CORRECTION = 0.1  # m/m and rad/m: limit of the correction by the calibration of the wheels
_WILD = 2.0  # m/m and rad/m: errors of the wheels above which a window is left out of the calibration
_LEAST_SIGMAS = (0.05, 0.03)  # m and rad, smallest of the wheels over a window
_SHARES = (0.02, 0.05)  # m/m and rad/m: limits of the learned σ of the wheels

_MEDIAN_LIMIT = 2.0  # largest median innovation; about 1 where calibration and σ are right
_LEAST_TURN_RAD = 1.0  # rotation of the wheels over a log below which its direction is not compared
_UNMEASURED = (Kind.DEGENERATE, Kind.LOST, Kind.CONTRADICTED, Kind.OVERLAP)

_CLOSURES = (3, 20)  # least and largest number of those around a segment that decide; the shortest are used
_MOST_PARTS = 8  # largest number of segments within a closure; one with more is not used
_RATIO = 1.0 / 3.0  # largest ratio of the residual with the right source to that with the wrong one
# least share of a disagreement that the wrong source leaves, that a jump of the wheels explains, or, of one with
# loop closures, that the wheels confirm
_EXPLAINED = 0.5


class Wheels(Check):
    """The motion over ``WINDOW_M`` around each scan, compared with that of the wheels, calibrated on the log.

    values : (N,) innovation
    apart_m, apart_rad : (N,) difference of the motions over ``WINDOW_M`` after calibration
    poses : (N, d+1, d+1) of the lidar by the wheels, NaN where unknown, with the mounting corrected
    turn_ratio : rotation of the trajectory over that of the wheels; NaN where the wheels turn too little
    mounting : correction of the assumed mounting, estimated from the motions; None unless it is clearly wrong
    """

    name, kind, column, source = "wheels", Kind.WHEELS, "wheel_disagreement", "wheel"
    limit, harmless = 8.0, (Kind.WHEELS_SLIP,)

    def __init__(self, evidence: Evidence) -> None:
        super().__init__(evidence)
        self.apart_m, self.apart_rad, self.turn_ratio, self.mounting = *np.tile(self.values, (2, 1)), np.nan, None
        self.poses = evidence.sources.get(self.source, np.full_like(evidence.poses, np.nan))
        known = np.isfinite(self.poses[:, 0, 0])
        if not known.any():
            return
        if is_known := known.mean() >= KNOWN:
            self.bound_m = wheel_bound_m(evidence.poses, self.poses)
        self.mounting = _mounting(evidence.poses, self.poses)
        if self.mounting is not None:
            self.poses = self.poses @ self.mounting.T_base_lidar
        if is_known:
            self.extent_m = extent_m(self.poses)
        self._compare(evidence.poses, known)

    def _compare(self, poses: Matrix, known: NDArray[np.bool_]) -> None:
        """Innovations of the motions of a trajectory (N, d+1, d+1), where the wheels are known (N,).

        The differences of the motions are accumulated in the frame of the lidar, which removes the effects of
        heading drift and slopes, median-filtered along the path, which removes those of late or irregular
        readings, and compared over a window around each scan. Scale errors, drift and a rotated or displaced lidar
        are calibrated by robust regression over the log, which also gives the standard deviations.
        """
        d, n = poses.shape[-1] - 1, len(poses)
        ends = np.flatnonzero(known & np.concatenate([[False], known[:-1]]))
        matched, wheels = np.zeros((2, n, lie.twist_size(poses[0])))
        matched[ends] = lie.log(lie.between(poses[ends - 1], poses[ends]))
        wheels[ends] = lie.log(lie.between(self.poses[ends - 1], self.poses[ends]))
        single_m = np.maximum(_lengths(matched[:, :d]), np.minimum(_lengths(wheels[:, :d]), _SPUN_M))
        single_m += hand_eye.TURN_M_RAD * np.maximum(_lengths(matched[:, d:]), _lengths(wheels[:, d:]))
        path_m = np.cumsum(single_m)
        first = np.searchsorted(path_m, path_m - 0.5 * WINDOW_M, side="left")
        last = np.searchsorted(path_m, path_m + 0.5 * WINDOW_M, side="right") - 1
        each = np.arange(n)  # the window includes the motions to and from the scan, however long
        first, last = np.maximum(np.minimum(first, each - 1), 0), np.minimum(np.maximum(last, each + 1), n - 1)
        length_m, unknown = path_m[last] - path_m[first], np.cumsum(~known)
        checked = np.flatnonzero((length_m >= _SHORTEST_M) & (unknown[last] == unknown[first]) & known)
        if not len(checked):
            return
        first, last, length_m = first[checked], last[checked], length_m[checked]
        self.turn_ratio = _turn_ratio(matched[:, d:], wheels[:, d:], first, last)
        inputs, outputs = np.column_stack([wheels, single_m]), matched - wheels
        innovation = np.zeros(len(checked))
        of_both = (slice(0, d), slice(d, None)), (self.apart_m, self.apart_rad), _LEAST_SIGMAS
        for part, apart, least in zip(*of_both, strict=True):
            calibration = _calibration(_over(inputs, first, last), _over(outputs[:, part], first, last), length_m)
            correction = inputs @ calibration
            largest = _LARGEST_CORRECTION * single_m / np.maximum(_lengths(correction), 1e-12)
            difference = outputs[:, part] - correction * np.minimum(1.0, largest)[:, None]
            drift = _smoothed(np.cumsum(difference, axis=0), path_m)
            apart[checked] = _lengths(drift[last] - drift[first])
            share = np.percentile(apart[checked] / length_m, 90.0) / 1.645  # as of a normal distribution
            sigma = np.hypot(least, np.clip(share, *_SHARES) * length_m)
            innovation = np.maximum(innovation, apart[checked] / sigma)
        self.values[checked] = innovation

    def segments(self, evidence: Evidence, found: Sequence[Segment]) -> Iterator[Segment]:
        """Segments where wheels and trajectory disagree, each with the source that slipped.

        At badly measured scans, closures may join ambiguous places, so that they do not prove that the wheels
        slipped.
        """
        is_marked = self.values > self.limit
        odometry, parts = evidence.poses if evidence.odometry is None else evidence.odometry, merged(is_marked)
        slipped = which_slipped(parts, odometry, self.poses, evidence.closures)
        for part, (kind, whole_m) in zip(parts, slipped, strict=True):
            size_m, size_rad = (float(np.nanmax(each[part])) for each in (self.apart_m, self.apart_rad))
            segment = evidence.segment(kind, part, is_marked, max(size_m, whole_m), size_rad)
            if kind == Kind.WHEELS or (kind == Kind.WHEELS_SLIP and any(map(segment.overlaps, found))):
                segment = evidence.segment(self.kind, part, is_marked, size_m, size_rad)
            yield segment

    def failures(self, evidence: Evidence, segments: Sequence[Segment]) -> Iterator[str]:
        """Scans that slipped by the wheels and by loop closures, or where they are badly measured."""
        for slip in (each for each in segments if each.kind == Kind.SCANS_SLIP):
            yield (
                f"{slip.kind} at {slip.times} ({slip.size_m:,.1f} m): "
                "wheels and loop closures agree with each other"
            )
        slips = [each for each in segments if each.kind == Kind.WHEELS]
        for slip in slips:
            cause = next((each for each in segments if each.kind in _UNMEASURED and each.overlaps(slip)), None)
            if cause is not None:
                yield f"{slip.text}, at scans that are not well measured: {cause.kind}"
        loops = [each for each in segments if each.kind == Kind.LOOPS]
        for loop, slip in product(loops, slips):
            is_confirmed = (slip.size_m or 0.0) > _EXPLAINED * (loop.size_m or 0.0)
            if is_confirmed and slip.overlaps(loop):
                yield (
                    f"{slip.text}, and {counted(loop.scans, 'loop closure')} between scans {loop.first:,} and "
                    f"{loop.last:,} by {loop.size_m:.1f} m"
                )
                return

    def warnings(self, evidence: Evidence) -> Iterator[str]:
        """Wheels that turn opposite, or that disagree throughout by more than the largest σ learned for them."""
        if self.turn_ratio < -hand_eye.OPPOSED:
            in_space = 'lidar_pose "x y z 1 0 0 0", or points of left-handed axes'
            flag = "upside_down true" if evidence.poses.shape[-1] == 3 else in_space
            yield (
                "the lidar turns left where the wheels turn right: the scans are mirrored (a lidar upside down "
                f"that /tf_static does not state so: --log.{flag}), or the wheels are"
            )
        known = np.isfinite(self.values)
        if not known.any() or np.median(self.values[known]) <= _MEDIAN_LIMIT:
            return
        away_m, away_rad = (np.median(each[known]) for each in (self.apart_m, self.apart_rad))
        yield (
            f"the wheels disagree with the trajectory all along, by {away_m:.1f} m and {np.degrees(away_rad):.0f} "
            f"deg over {WINDOW_M:g} m (medians): their scale is wrong, they slip, or the lidar follows what moves "
            "along"
        )

    def notes(self, T_base_lidar: Pose | None) -> Iterator[str]:
        """A mounting that the motions contradict."""
        if (mounting := self.mounting) is None:
            return
        T = mounting.T_base_lidar if T_base_lidar is None else T_base_lidar @ mounting.T_base_lidar
        where = ", seen from there" if T_base_lidar is None else ""
        said = mounting._replace(T_base_lidar=T).text
        yield f"the motions of lidar and wheels contradict the assumed mounting{where}: {said}"


def _mounting(poses: Matrix, wheel_poses: Matrix) -> HandEye | None:
    """Correction of the assumed mounting, from motions over short parts of the path; None unless clearly wrong."""
    pieces = np.floor(np.cumsum(hand_eye.path_m(lie.between(poses[:-1], poses[1:]))) / hand_eye.PAIR_M)
    nodes = np.flatnonzero(np.diff(pieces, prepend=-1.0))
    motions = np.stack([lie.between(each[nodes[:-1]], each[nodes[1:]]) for each in (wheel_poses, poses)])
    motions = motions[:, np.isfinite(motions[0, :, 0, 0])]
    has_moved = hand_eye.path_m(motions).max(axis=0, initial=0.0) > 0.5 * hand_eye.PAIR_M
    found = hand_eye.hand_eye(*motions[:, has_moved])
    return found if found is not None and found.is_apart and not found.is_mirrored else None


def wheel_bound_m(poses: Matrix, wheels: Matrix) -> float:
    """Upper bound of the ATE of a trajectory (N, d+1, d+1) by wheel poses, NaN where unknown, in the x-y plane.

    Two estimates with independent errors differ by more than the error of either.
    """
    known = np.flatnonzero(np.isfinite(wheels[:, 0, 0]))
    level = wheels[known[0]] @ lie.between(poses[known[0]], poses[known])  # in the frame of the wheels
    return apart_m(level[:, :2, -1], wheels[known, :2, -1])


def apart_m(positions: Floats, others: Floats) -> float:
    """Root mean squared distance of positions (N, d) after rigid alignment, as in the ATE."""
    weights = np.ones(len(positions))
    try:
        moved = lie.transform(rigid_transform(positions, others, weights), positions)
    except DegeneratePairsError:  # collinear positions: the rotation about their line is undetermined
        moved = positions - positions.mean(axis=0) + others.mean(axis=0)
    return float(np.sqrt(((moved - others) ** 2).sum(axis=1).mean()))


def _turn_ratio(matched: Matrix, wheels: Matrix, first: NDArray[np.intp], last: NDArray[np.intp]) -> float:
    """Rotations (N, k) of the trajectory along those of the wheels, as a ratio; NaN where these are small."""
    if _lengths(wheels).sum() < _LEAST_TURN_RAD:
        return np.nan
    matched, wheels = _over(matched, first, last), _over(wheels, first, last)
    turned_rad = np.maximum(_lengths(wheels), 1e-12)
    return float(((matched * wheels).sum(axis=1) / turned_rad).sum() / turned_rad.sum())


def _over(motions: Matrix, first: NDArray[np.intp], last: NDArray[np.intp]) -> Matrix:
    """Sums of the motions (N, k) between each first and last scan."""
    total = np.cumsum(motions, axis=0)
    return total[last] - total[first]


def _smoothed(values: Matrix, path_m: Floats) -> Matrix:
    """Values (N, d), median-filtered along the path."""
    grid_m = np.arange(0.0, path_m[-1] + _GRID_M, _GRID_M)
    sampled = [np.interp(grid_m, path_m, each) for each in values.T]
    smooth = [median_filter(each, _MEDIAN, mode="nearest") for each in sampled]
    return np.stack([np.interp(path_m, grid_m, each) for each in smooth], axis=1)


def _calibration(inputs: Matrix, outputs: Matrix, length_m: Floats) -> Matrix:
    """Linear map from inputs (M, a) to outputs (M, b), by reweighted least squares (Cauchy) per length."""
    A, B = inputs / length_m[:, None], outputs / length_m[:, None]
    weight = (_lengths(B) < _WILD).astype(np.float64)
    correction: Matrix = np.zeros((A.shape[1], B.shape[1]))
    ridge = 1e-3 * len(A) * np.eye(A.shape[1])  # for directions in which the wheels never moved
    for _ in range(10):
        H = (A * weight[:, None]).T @ A + ridge
        correction = np.linalg.solve(H, (A * weight[:, None]).T @ B).astype(np.float64, copy=False)
        error = _lengths(B - A @ correction)
        weight = 1.0 / (1.0 + (error / max(1.5 * float(np.median(error)), 1e-3)) ** 2) * (weight > 0.0)
    return correction


def _lengths(vectors: Matrix) -> Floats:
    return np.linalg.norm(vectors, axis=1)


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
        if jump_m > max(JUMP_M + 2.0 * usual_m, _EXPLAINED * size_m):
            found.append((Kind.WHEELS_SLIP, size_m))
            continue
        around = np.flatnonzero(closures.is_accepted & (low <= first) & (high >= last))
        around = around[np.argsort(high[around] - low[around], kind="stable")][: _CLOSURES[1]]
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
    if len(left_m) < _CLOSURES[0]:
        return Kind.WHEELS
    by_scans, by_wheels = np.median(left_m, axis=0).T
    for right, wrong, slipped in ((by_scans, by_wheels, Kind.WHEELS_SLIP), (by_wheels, by_scans, Kind.SCANS_SLIP)):
        if (right <= _RATIO * wrong).all() and (wrong >= _EXPLAINED * size_m).all():
            return slipped
    return Kind.WHEELS
