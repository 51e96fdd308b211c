"""The doctor's checks of the scans: damage, returns, ranges, surfaces, rings, copies, rest, mounting."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain.config import PreprocessConfig
from scanchain.data import MOST_COPIES, Points, RawPoints
from scanchain.logs.bad_scans import are_millimeters, most_bad_scans
from scanchain.logs.doctor.finding import Finding, Severity
from scanchain.logs.doctor.statistics import LEAST_S, Rest, Survey
from scanchain.logs.mounting import TILTED_RAD, tilt_rad
from scanchain.words import counted

_MANY_LOST = 0.5
_MANY_UNUSED = 0.3  # share of unused returns, from which on a wider range is recommended
_SOME_BELOW = 0.05  # share of beams below range_min that is reported
_STUCK_SHARE = 0.01  # share of beams at one farthest range that is reported
_LONG_REST_S = 5.0
_WHEELS_MOVE = 0.02  # least motion by the wheels that ends a rest: meters, or the sine of a turn
_FEW_POINTS = 50
_OPEN = 0.003  # information about the weakest motion, below which matches are usually degenerate

_VOXEL_M = 0.5  # at most one point in each, in 3D: else the ground near the lidar outweighs all else
_POINTS = 1500  # largest number of points whose normals are estimated
_NEIGHBORS = {2: 7, 3: 10}  # number of neighbors from which a point's normal is estimated
_FLAT = 0.02  # largest ratio of the two least eigenvalues of the covariance of neighbors on a surface
_LINE = 0.03  # least ratio of the two largest ones: neighbors on one ring make no surface
_FEW_SURFACES = 20
_MOTIONS = {
    2: ("motion along x", "motion along y", "rotation"),
    3: (
        "motion along x",
        "motion along y",
        "motion along z",
        "rotation about x",
        "rotation about y",
        "rotation about z",
    ),
}


def check_scans(seen: Survey, preprocess: PreprocessConfig) -> Iterator[Finding]:
    """Every finding about the scans. ``preprocess`` is what a run of this log would use."""
    yield _damage(seen, preprocess)
    yield _returns(seen)
    yield _no_return(seen)
    yield _ranges(seen, preprocess)
    if seen.log.dimension == 3:
        yield _rings(seen)
    yield _surfaces(seen, preprocess)
    yield _duplicates(seen)
    yield _rest(seen)
    yield _mounting(seen)


def _damage(seen: Survey, preprocess: PreprocessConfig) -> Finding:
    empty = sum(scan.kept == 0 for scan in seen.scans)
    low_m, high_m = preprocess.min_range_m, preprocess.max_range_m
    outside = sum(bool(scan.ranges_m[0] > high_m or scan.ranges_m[-1] < low_m) for scan in seen.scans)
    bad = len(seen.malformed) + empty + outside
    lines = list(seen.damage)
    if seen.malformed:
        lines.append(f"{counted(len(seen.malformed), 'malformed scan')} (the first: {seen.malformed[0]})")
    if empty:
        lines.append(f"{counted(empty, 'scan')} without a valid point")
    if outside:
        limits = f"preprocess.min_range_m ({low_m:g}) and preprocess.max_range_m ({high_m:g})"
        lines.append(f"{counted(outside, 'scan')} without a point between {limits}")
    if not lines:
        return Finding("damage", Severity.OK, "every scan is readable and has points")
    messages = len(seen.scans) + len(seen.malformed)
    if bad > most_bad_scans(messages, seen.log.config):
        effect = "a run stops: these are more bad scans than log.max_bad_scans_percent allows"
        remedy = f"--log.max_bad_scans_percent {math.ceil(100 * bad / messages)}" if bad < messages else ""
        return Finding("damage", Severity.PROBLEM, "; ".join(lines), effect, remedy)
    effect = "what was damaged is left out, the rest is used"
    return Finding("damage", Severity.WARNING, "; ".join(lines), effect)


def _returns(seen: Survey) -> Finding:
    undefined, zero = seen.share(lambda scan: scan.undefined), seen.share(lambda scan: scan.zero)
    below = seen.share(lambda scan: scan.below)
    kept = np.array([scan.kept for scan in seen.scans])
    found = f"{100 * undefined:.2g} % NaN or infinite, {100 * zero:.2g} % zero, "
    if below:
        found += (
            f"{100 * below:.2g} % below range_min ({np.median([scan.limits_m[0] for scan in seen.scans]):.3g} m), "
        )
    found += f"{int(np.median(kept)):,} valid a scan (median)"
    poor = kept < _FEW_POINTS
    few = int(np.count_nonzero(poor))
    if few:
        effect = f"{counted(few, 'scan')} with fewer than {_FEW_POINTS} returns: matches are weak there, or lost"
        return Finding("returns", Severity.WARNING, found, effect, _without_ends(seen, poor))
    if undefined + zero + below > _MANY_LOST:
        return Finding("returns", Severity.NOTE, found, "they are left out; what is left may determine too little")
    if below > _SOME_BELOW:
        return Finding(
            "returns", Severity.NOTE, found, "what lies below range_min is not used: the sensor's own limit"
        )
    return Finding("returns", Severity.OK, found)


def _without_ends(seen: Survey, poor: NDArray[np.bool_]) -> str:
    """The flags that leave out scans at the start and at the end, where these are the poor ones and no others."""
    good = np.flatnonzero(~poor)
    if not len(good) or poor[good[0] : good[-1] + 1].any():
        return ""
    start_s, end_s = (seen.into_log_s(int(seen.log_ns[place])) for place in (good[0], good[-1]))
    flags = [f"--start {math.floor(1e3 * start_s) / 1e3:g}"] if poor[0] else []
    return " ".join([*flags, *([f"--end {math.ceil(1e3 * end_s) / 1e3:g}"] if poor[-1] else [])])


def _no_return(seen: Survey) -> Finding:
    """Finding on beams that all have one farthest range, as of scanners that write a number for no return."""
    values = Counter(scan.farthest_m for scan in seen.scans if np.isfinite(scan.farthest_m))
    farthest_m = max(values, default=0.0)
    below_m = np.floor(1e3 * farthest_m) / 1e3  # the flag must lie below the stated range, to the last bit
    stuck = sum(scan.at_farthest for scan in seen.scans if scan.farthest_m == farthest_m)
    share = stuck / max(sum(scan.beams for scan in seen.scans), 1)
    stated_m = min((scan.limits_m[1] for scan in seen.scans), default=float("inf"))
    limit_m = min(stated_m, seen.log.config.max_range_m)
    if share < _STUCK_SHARE:
        return Finding("no return", Severity.OK, "no range is so frequent that it must mean no return")
    found = f"{100 * share:.2g} % of the beams have exactly {farthest_m:.6g} m, the farthest there is"
    if farthest_m >= limit_m:
        return Finding("no return", Severity.OK, f"{found}; range limits take it out")
    effect = "if it stands for no return, it is taken for a wall that moves along"
    return Finding("no return", Severity.WARNING, found, effect, f"--log.max_range_m {below_m:g}")


def _ranges(seen: Survey, preprocess: PreprocessConfig) -> Finding:
    ranges_m = np.array([scan.ranges_m for scan in seen.scans if scan.kept], np.float64)
    near_m, far_m = np.median(ranges_m[:, [1, 99]], axis=0).tolist() if len(ranges_m) else (np.nan, np.nan)
    found = f"98 % of the returns lie between {near_m:.3g} and {far_m:.4g} m (medians)"
    low_m, high_m = preprocess.min_range_m, preprocess.max_range_m
    if far_m > high_m:
        unused = float(np.mean(ranges_m > high_m))
        effect = f"{100 * unused:.3g} % lie beyond {high_m:g} m and are not used"
        if are_millimeters(float(np.median(ranges_m)), preprocess):
            return Finding("ranges", Severity.PROBLEM, found, f"{effect}: millimeters? convert them to meters")
        remedy = f"--preprocess.max_range_m {np.ceil(far_m):g}" if unused > _MANY_UNUSED else ""
        return Finding("ranges", Severity.NOTE, found, effect, remedy)
    if near_m < low_m:
        unused = float(np.mean(ranges_m < low_m))
        effect = f"{100 * unused:.3g} % lie nearer than {low_m:g} m and are not used (right for the robot itself)"
        remedy = f"--preprocess.min_range_m {0.9 * near_m:.2g}" if unused > _MANY_UNUSED else ""
        return Finding("ranges", Severity.NOTE, found, effect, remedy)
    return Finding("ranges", Severity.OK, found)


def _surfaces(seen: Survey, preprocess: PreprocessConfig) -> Finding:
    """Finding on surfaces that leave a motion unobservable; a run tests this by matching, scan by scan."""
    found = [weakest_motion(sample, preprocess) for sample in seen.samples]
    open_motions = Counter(each.direction for each in found if each.information < _OPEN)
    bad = open_motions.total()
    if not bad:
        return Finding(
            "surfaces", Severity.OK, f"they determine every motion in {counted(len(found), 'scan')} looked at"
        )
    motions = " and ".join(motion for motion, _ in open_motions.most_common(2))
    extent = f"in {bad} of {counted(len(found), 'scan')} looked at they hardly determine {motions} (lidar frame)"
    effect = (
        "scans are degenerate there, that motion is predicted; a run most of whose scans are so is not trustworthy"
    )
    if not seen.wheels:
        effect += "; wheel odometry, or a lidar with a wider view or a longer range, helps"
    return Finding("surfaces", Severity.WARNING if 2 * bad >= len(found) else Severity.NOTE, extent, effect)


def _rings(seen: Survey) -> Finding:
    rings = [scan.rings for scan in seen.scans]
    if not any(rings):
        return Finding("rings", Severity.OK, "points have no field of their ring; a run does not need it")
    most, least = max(rings), min(rings)
    found = counted(most, "ring") if most == least else f"{least} to {most} rings"
    if least < most:
        return Finding("rings", Severity.NOTE, found, "scans without some of their rings are sparser, no more")
    return Finding("rings", Severity.OK, found)


def _duplicates(seen: Survey) -> Finding:
    digests = [scan.digest for scan in seen.scans]
    runs = [len(list(copies)) for _, copies in groupby(digests)]
    same = len(digests) - len(runs)
    if not same:
        return Finding("duplicates", Severity.OK, "no scan is the one before once more")
    found = f"{same} of {len(digests):,} scans are the one before once more, to the last bit"
    if max(runs) > MOST_COPIES:
        found += f", {max(runs):,} of them in a row"
        effect = "the driver was stuck, or a simulation without noise at rest: the trajectory stands still there"
        return Finding("duplicates", Severity.WARNING, found, effect)
    effect = "a copy looks like a stop: the prediction at constant velocity stands still, then has to catch up"
    every = round(len(digests) / (len(digests) - same))
    remedy = f"--every {every}" if every > 1 else ""
    return Finding("duplicates", Severity.WARNING, found, effect, remedy)


def _rest(seen: Survey) -> Finding:
    """Finding on the time during which neither the surroundings change nor the wheels, if any, move."""
    rests = [_until_wheels_move(seen, rest) for rest in seen.rests]
    rests = [rest for rest in rests if rest.duration_s >= LEAST_S]
    still_s = sum(rest.duration_s for rest in rests)
    first_s = rests[0].duration_s if rests and rests[0].first == 0 else 0.0
    total_s = float(seen.log_ns[-1] - seen.log_ns[0]) * 1e-9
    found = (
        f"{still_s:.1f} of {total_s:.1f} s nothing changes from scan to scan, {first_s:.1f} s of it at the start"
    )
    if rests and rests[0].last - rests[0].first == len(seen.scans) - 1:
        effect = "nothing moves, or all scans are the same as in a bare corridor: the trajectory is one point"
        return Finding("rest", Severity.WARNING, found, effect)
    if first_s > _LONG_REST_S:
        effect = "the trajectory drifts by millimeters meanwhile, and it takes time"
        return Finding(
            "rest", Severity.NOTE, found, effect, f"--start {np.floor(seen.into_log_s(rests[0].end_ns)):g}"
        )
    return Finding("rest", Severity.OK, found)


def _until_wheels_move(seen: Survey, rest: Rest) -> Rest:
    """The rest up to the first motion by the wheels."""
    begin_ns, end_ns = seen.stamps_ns[rest.first], seen.stamps_ns[rest.last]
    poses = [pose for pose in seen.wheels if begin_ns <= pose.stamp_ns <= end_ns]
    for pose in poses:
        if np.abs(pose.T_parent_child - poses[0].T_parent_child).max() > _WHEELS_MOVE:
            stamps_ns = seen.stamps_ns[rest.first : rest.last + 1]
            last = rest.first + max(int(np.count_nonzero(stamps_ns <= pose.stamp_ns)) - 1, 0)
            return rest._replace(last=last, end_ns=int(seen.log_ns[last]))
    return rest


def _mounting(seen: Survey) -> Finding:
    frame = seen.scans[0].frame or "without a name"
    frames = {scan.frame for scan in seen.scans}
    if len(frames) > 1:
        effect = "only the first frame's mounting is used; scans of the others are taken to sit there, too"
        return Finding(
            "mounting", Severity.PROBLEM, f"scans in several frames: {', '.join(sorted(frames))}", effect
        )
    note = next((line for line in seen.log.notes if line.startswith("no static transform")), "")
    if note:
        effect = "trajectories are the lidar's; record /tf_static"
        if not seen.wheels:
            return Finding("mounting", Severity.WARNING, note, effect)
        effect += ", as the wheels' turns are taken about the lidar instead of the robot"
        return Finding("mounting", Severity.WARNING, note, effect, "--odometry.prior constant-velocity")
    place = ", ".join(f"{value:.3f}" for value in seen.log.T_base_lidar[:-1, -1])
    mounting = seen.log.mounting
    if mounting.motion is not None:
        effect = "trajectories are the lidar's, its motion on the robot included"
        effect += "; wheels are carried over to it by /tf" if seen.log.has_odometry else ""
        return Finding("mounting", Severity.NOTE, f"the lidar moves: {mounting.motion}", effect)
    if seen.log.dimension == 2 and tilt_rad(mounting.T_base_lidar) > TILTED_RAD:
        effect = "distances along the tilt are too short or too long, and walls are not where they seem to be"
        return Finding("mounting", Severity.WARNING, mounting.out_of_plane[0], effect)
    if np.array_equal(seen.log.T_base_lidar, np.eye(seen.log.dimension + 1)):
        return Finding("mounting", Severity.OK, f"lidar frame {frame}: at the robot's origin, or not stated")
    return Finding(
        "mounting", Severity.OK, f"lidar frame {frame}: at {place} m of {mounting.base_name}, {mounting.source}"
    )


class Weakest(NamedTuple):
    """The least observable motion of a scan: its relative information, 0 to 1, and its name."""

    information: float
    direction: str


def weakest_motion(points: RawPoints, config: PreprocessConfig) -> Weakest:
    """The least eigenvalue of the information Σ JᵀJ / n of point-to-plane residuals, J = [nᵀ, (p × n)ᵀ / range].

    points : (N, d) meters, lidar frame
    """
    from scipy.spatial import KDTree

    d = points.shape[1]
    ranges_m = np.linalg.norm(points, axis=1)
    near: Points = points[(ranges_m >= config.min_range_m) & (ranges_m <= config.max_range_m)].astype(np.float64)
    if d == 3:
        _, first = np.unique(np.floor(near / _VOXEL_M).astype(np.int64), axis=0, return_index=True)
        near = near[np.sort(first)]
    if len(near) <= _NEIGHBORS[d]:
        return Weakest(0.0, _MOTIONS[d][0])
    some = near[:: max(1, len(near) // _POINTS)]
    neighbors = near[KDTree(near).query(some, _NEIGHBORS[d])[1]]
    off_m = neighbors - neighbors.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off_m, off_m))
    on_surface = values[:, 0] < _FLAT * values[:, 1]
    if d == 3:
        on_surface &= values[:, 1] > _LINE * values[:, 2]
    if np.count_nonzero(on_surface) < _FEW_SURFACES:
        return Weakest(0.0, _MOTIONS[d][0])
    p, n = some[on_surface], vectors[on_surface, :, 0]
    turning = np.cross(p, n) if d == 3 else (p[:, :1] * n[:, 1:] - p[:, 1:] * n[:, :1])
    J = np.hstack([n, turning / np.sqrt(np.mean(np.sum(np.square(p), axis=1)))])
    information, directions = np.linalg.eigh(J.T @ J / len(J))
    return Weakest(float(information[0]), _MOTIONS[d][int(np.argmax(np.abs(directions[:, 0])))])
