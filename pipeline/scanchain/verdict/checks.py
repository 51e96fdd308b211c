"""Independent checks of a trajectory: normalized innovations against wheel odometry and constant velocity.

Their findings, like those of all other evidence, are segments of consecutive scans: ``Stretch``.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from scanchain import lie
from scanchain.data import Matrix
from scanchain.registration import hand_eye
from scanchain.registration.hand_eye import HandEye
from scanchain.registration.svd_icp import DegeneratePairsError, rigid_transform

Floats = NDArray[np.float64]

WHEEL_LIMIT, VELOCITY_LIMIT = 8.0, 4.0  # largest innovations that are accepted, standard deviations
WINDOW_M = 4.0  # path over which wheels and trajectory are compared
_SHORTEST_M = 0.5  # shortest path of a window that is checked
_LARGEST_CORRECTION = 0.1  # m/m and rad/m: limit of the correction by the calibration of the wheels
_RIDGE = 1e-3  # regularization of the calibration, for directions in which the wheels never moved
_ROUNDS = 10  # iterations of the robust regression
_TURN_M_RAD = 0.5  # path length per rad of rotation
_LEAST_M, _LEAST_RAD = 0.05, 0.03  # smallest σ of the wheels over a window
_LEAST_SHARE, _MOST_SHARE = 0.02, 0.05  # m/m and rad/m: limits of the learned σ of the wheels
_TAIL, _TAIL_SIGMAS = 90.0, 1.645  # percentile of the residuals that gives σ, and its value for a standard normal

_LEAST_TURN_RAD = 1.0  # rotation of the wheels over a log below which its direction is not compared
_GRID_M, _MEDIAN = 0.1, 21  # median filter along the path: spacing and number of samples

_SPUN_M = 0.5  # largest path per scan counted from the wheels alone: a longer one is slip or a wrong reading
_WILD = 2.0  # m/m and rad/m: errors of the wheels above which a window is left out of the calibration

_ACCELERATION_M_S2, _ACCELERATION_RAD_S2 = 4.0, 12.0  # σ: a fifth to a third of what vehicles and hands reach
_MOTION_M, _MOTION_RAD = 0.05, 0.01  # σ of the motion between two scans by scan matching
_ALIKE = 1.4  # largest ratio of the usual interval to one that is used; shorter ones are due to jittering stamps

_SMALL_RAD = 0.1  # difference of headings below which the text leaves it out
_FEWEST, _BEFORE = 3, 10  # least and largest number of previous scans whose median is the usual share
_LEAST_USUAL = 1e-3  # smallest usual share of points with a correspondence


class Kind(StrEnum):
    """Kind of a finding."""

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


class Stretch(Struct, frozen=True):
    """Consecutive suspicious scans.

    first, last : scans, from 0; start_s, end_s : since the first scan of the run
    scans : number of scans among them that have this finding
    size_m, size_rad : size of the contradiction; None where not measured
    """

    kind: Kind
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
        if self.kind is Kind.ACCELERATION:
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


class WheelCheck(NamedTuple):
    """Differences of trajectory and wheel odometry around each scan, NaN where not comparable.

    innovation : (N,) standard deviations
    apart_m, apart_rad : (N,) difference of the motions over ``WINDOW_M`` after calibration
    poses : (N, d+1, d+1) of the lidar by the wheels, NaN where unknown
    turn_ratio : rotation of the trajectory over that of the wheels; NaN where the wheels turn too little
    known_share : share of the scans with a pose by the wheels, including those at rest
    mounting : correction of the assumed mounting, estimated from the motions; None unless it is clearly wrong
    """

    innovation: Floats
    apart_m: Floats
    apart_rad: Floats
    poses: Matrix
    turn_ratio: float = np.nan
    known_share: float = 0.0
    mounting: HandEye | None = None


def check_wheels(poses: Matrix, wheel_poses: Matrix) -> WheelCheck:
    """Check of the motions of a trajectory (N, d+1, d+1) against wheel odometry, NaN where unknown.

    The differences of the motions are accumulated in the frame of the lidar, which removes the effects of heading
    drift and slopes, median-filtered along the path, which removes those of late or irregular readings, and
    compared over a window around each scan. Scale errors, drift and a rotated or displaced lidar are calibrated by
    robust regression over the log; the standard deviations of the residuals are learned from the log. An assumed
    mounting that is clearly wrong is corrected first.
    """
    if (mounting := _mounting(poses, wheel_poses)) is not None:
        wheel_poses = wheel_poses @ mounting.T_base_lidar
    d, n = poses.shape[-1] - 1, len(poses)
    known = np.isfinite(wheel_poses[:, 0, 0])
    nothing = np.full(n, np.nan)
    check = WheelCheck(
        nothing, nothing.copy(), nothing.copy(), wheel_poses, known_share=float(known.mean()), mounting=mounting
    )
    ends = np.flatnonzero(known & np.concatenate([[False], known[:-1]]))
    matched, wheels = np.zeros((2, n, lie.twist_size(poses[0])))
    matched[ends] = lie.log(lie.between(poses[ends - 1], poses[ends]))
    wheels[ends] = lie.log(lie.between(wheel_poses[ends - 1], wheel_poses[ends]))
    single_m = np.maximum(_lengths(matched[:, :d]), np.minimum(_lengths(wheels[:, :d]), _SPUN_M))
    single_m += _TURN_M_RAD * np.maximum(_lengths(matched[:, d:]), _lengths(wheels[:, d:]))
    path_m = np.cumsum(single_m)
    first = np.searchsorted(path_m, path_m - 0.5 * WINDOW_M, side="left")
    last = np.searchsorted(path_m, path_m + 0.5 * WINDOW_M, side="right") - 1
    each = np.arange(n)  # the window includes the motions to and from the scan, however long
    first, last = np.maximum(np.minimum(first, each - 1), 0), np.minimum(np.maximum(last, each + 1), n - 1)
    length_m, unknown = path_m[last] - path_m[first], np.cumsum(~known)
    checked = np.flatnonzero((length_m >= _SHORTEST_M) & (unknown[last] == unknown[first]) & known)
    if not len(checked):
        return check
    first, last, length_m = first[checked], last[checked], length_m[checked]
    check = check._replace(turn_ratio=_turn_ratio(matched[:, d:], wheels[:, d:], first, last))
    inputs, outputs = np.column_stack([wheels, single_m]), matched - wheels
    innovation = np.zeros(len(checked))
    for part, apart, least in (
        (slice(0, d), check.apart_m, _LEAST_M),
        (slice(d, None), check.apart_rad, _LEAST_RAD),
    ):
        calibration = _calibration(_over(inputs, first, last), _over(outputs[:, part], first, last), length_m)
        correction = inputs @ calibration
        largest = _LARGEST_CORRECTION * single_m / np.maximum(_lengths(correction), 1e-12)
        difference = outputs[:, part] - correction * np.minimum(1.0, largest)[:, None]
        drift = _smoothed(np.cumsum(difference, axis=0), path_m)
        apart[checked] = _lengths(drift[last] - drift[first])
        share = np.percentile(apart[checked] / length_m, _TAIL) / _TAIL_SIGMAS
        sigma = np.hypot(least, np.clip(share, _LEAST_SHARE, _MOST_SHARE) * length_m)
        innovation = np.maximum(innovation, apart[checked] / sigma)
    check.innovation[checked] = innovation
    return check


def _mounting(poses: Matrix, wheel_poses: Matrix) -> HandEye | None:
    """Correction of the assumed mounting, from motions over short parts of the path; None unless clearly wrong."""
    pieces = np.floor(np.cumsum(hand_eye.path_m(lie.between(poses[:-1], poses[1:]))) / hand_eye.PAIR_M)
    nodes = np.flatnonzero(np.diff(pieces, prepend=-1.0))
    motions = np.stack([lie.between(each[nodes[:-1]], each[nodes[1:]]) for each in (wheel_poses, poses)])
    motions = motions[:, np.isfinite(motions[0, :, 0, 0])]
    has_moved = hand_eye.path_m(motions).max(axis=0, initial=0.0) > 0.5 * hand_eye.PAIR_M
    found = hand_eye.hand_eye(*motions[:, has_moved])
    return found if found is not None and found.is_apart and not found.is_mirrored else None


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
        plausible_s = np.maximum(interval_s, usual_s / _ALIKE)
        before, after = plausible_s[:-1], plausible_s[1:]
        change = motions[1:] - (after / before)[:, None] * motions[:-1]
        span_s2 = 0.5 * after * (before + after)
        sigma_m = _sigma_m(span_s2)
        sigma_rad = np.hypot(_ACCELERATION_RAD_S2 * span_s2, _MOTION_RAD)
        best = np.minimum(best, np.maximum(_lengths(change[:, :d]) / sigma_m, _lengths(change[:, d:]) / sigma_rad))
    innovation[2:] = best
    return innovation


def smallest_jump_m(seconds: Floats) -> float:
    """Smallest jump of a position that ``check_velocity`` detects at the median interval of times (N,)."""
    return VELOCITY_LIMIT * float(_sigma_m(np.median(np.diff(seconds)) ** 2)) if len(seconds) > 1 else np.inf


def _sigma_m(span_s2: Floats | float) -> Floats:
    return np.hypot(_ACCELERATION_M_S2 * span_s2, _MOTION_M)


def check_overlap(inlier_share: Floats) -> Floats:
    """(N,) inlier share of each scan relative to its median over the previous scans, NaN for the first ones.

    Consecutive scans see mostly the same surfaces. If many correspondences are lost at once, the pose in the map
    is wrong, or a close object blocks the view.
    """
    usual = np.full(len(inlier_share), np.nan)
    padded = np.append(np.full(_BEFORE, np.nan), inlier_share)  # the first scans have fewer previous ones
    usual[_FEWEST:] = np.nanmedian(sliding_window_view(padded, _BEFORE)[_FEWEST:-1], axis=1)
    return inlier_share / np.maximum(usual, _LEAST_USUAL)


def apart_m(positions: Floats, others: Floats) -> float:
    """Root mean squared distance of positions (N, d) after rigid alignment, as in the ATE."""
    weights = np.ones(len(positions))
    try:
        moved = lie.transform(rigid_transform(positions, others, weights), positions)
    except DegeneratePairsError:  # collinear positions: the rotation about their line is undetermined
        moved = positions - positions.mean(axis=0) + others.mean(axis=0)
    return float(np.sqrt(((moved - others) ** 2).sum(axis=1).mean()))


def wheel_bound_m(poses: Matrix, wheels: Matrix) -> float:
    """Upper bound of the ATE of a trajectory (N, d+1, d+1) by wheel poses, NaN where unknown, in the x-y plane.

    Two estimates with independent errors differ by more than the error of either.
    """
    known = np.flatnonzero(np.isfinite(wheels[:, 0, 0]))
    level = wheels[known[0]] @ lie.between(poses[known[0]], poses[known])  # in the frame of the wheels
    return apart_m(level[:, :2, -1], wheels[known, :2, -1])


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
    for _ in range(_ROUNDS):
        H = (A * weight[:, None]).T @ A + _RIDGE * len(A) * np.eye(A.shape[1])
        correction = np.linalg.solve(H, (A * weight[:, None]).T @ B).astype(np.float64, copy=False)
        error = _lengths(B - A @ correction)
        weight = 1.0 / (1.0 + (error / max(1.5 * float(np.median(error)), 1e-3)) ** 2) * (weight > 0.0)
    return correction


def _lengths(vectors: Matrix) -> Floats:
    return np.linalg.norm(vectors, axis=1)
