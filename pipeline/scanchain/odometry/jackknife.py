"""Errors of odometry by a delete-a-group jackknife over directions (Shao & Tu 1995, section 2.3).

Errors that scans and map share, such as miscalibrated beams or distorted scans, leave no residuals, so that no
match covariance contains them. They show when the points in each group of directions in turn are left out of
scans *and* map: odometry then differs by the influence of that group.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Influence, Matrix, Pose, Scan
from scanchain.errors import InputError
from scanchain.odometry.elevation import raised
from scanchain.odometry.odometry import Odometry
from scanchain.preprocess import Prepared, Resolution, Sweep, prepare
from scanchain.threads import threads

AZIMUTHS, ELEVATIONS = {2: 16, 3: 6}, {2: 0, 3: 4}  # groups; without a wider one, a plane may be unconstrained
LONGEST = {2: 300, 3: 60}  # scans per window; a log of at most that many is measured as a whole
_TURN_M_RAD = 1.0  # path length that counts for a turn, with which errors grow as with translation


class Window(NamedTuple):
    """Odometry of successive scans, once with all points and once without each group of directions.

    first : number of the first scan
    complete : (M, d+1, d+1) poses with all points; without : (G, M, d+1, d+1) without those of each group
    """

    first: int
    complete: Matrix
    without: Matrix


def influence(
    scans: Iterable[Scan], odometry: Matrix, keyframes: NDArray[np.int64], chosen: NDArray[np.int64],
    config: Config, T_base_lidar: Pose | None, offset_rad: float = 0.0,
) -> Influence:  # fmt: skip
    """Influence of each group of directions, for a log with known odometry.

    A short log is measured as a whole, a long one in windows evenly spread along the path; between these the
    influence per meter of path is interpolated. Raises InputError where a window has no points.
    scans : all of the log, in order; odometry : (M, d+1, d+1) their poses
    keyframes, chosen : (K,) and (N,) scan numbers: motions between keyframes, and from them to the chosen scans
    offset_rad : elevation offset of the lidar as estimated on the log
    """
    d = odometry.shape[-1] - 1
    kinds = np.repeat([0, 1], [AZIMUTHS[d], ELEVATIONS[d]])
    path_m = _path_m(odometry)
    preprocess = msgspec.structs.replace(config.preprocess, calibrate_elevation=False)
    config = msgspec.structs.replace(config, preprocess=preprocess)
    measured, scans, position = [], iter(scans), 0
    for first in first_scans(path_m, d):
        resolution, window = Resolution(preprocess, config.local_map.voxel_size_m), []
        for scan in islice(scans, first - position, min(first + LONGEST[d], len(odometry)) - position):
            window.append(prepare(scan, resolution))
            resolution = window[-1].after
        position = first + len(window)
        measured.append(_measured(first, [_raised(each, offset_rad) for each in window], config, T_base_lidar))
    of_keyframes, _ = _twists(measured, keyframes[:-1], keyframes[1:], path_m)
    before = keyframes[np.searchsorted(keyframes, chosen, side="right") - 1]
    of_scans, is_measured = _twists(measured, before, chosen, path_m)
    return Influence(of_keyframes, of_scans, is_measured, kinds)


def first_scans(path_m: NDArray[np.float64], dimension: int) -> list[int]:
    """Numbers of the first scans of the windows of a log with this path (N,).

    At least one, and at most as many as keep the matches of all groups below the number of scans of the log. Their
    middles are evenly spread along the path.
    """
    scans, length = len(path_m), LONGEST[dimension]
    count = max(scans // (length * (AZIMUTHS[dimension] + ELEVATIONS[dimension] + 1)), 1)
    middles = np.searchsorted(path_m, (np.arange(count) + 0.5) / count * path_m[-1])
    firsts = np.maximum(middles - length // 2, length * np.arange(count))  # none begins before the last one ends
    return np.maximum(np.minimum(firsts, scans - length * np.arange(count, 0, -1)), 0).tolist()


def _measured(first: int, window: Sequence[Prepared], config: Config, T_base_lidar: Pose | None) -> Window:
    """Odometry of a window, groups in parallel; a group without which odometry fails has no influence."""
    points = np.concatenate([each.sparse.points for each in window]) if window else np.empty((0, 3))
    if not len(points):
        raise InputError(f"the scans from {first} on have no points that could be left out")
    d = points.shape[1]
    limits = [
        np.quantile(angles, np.arange(1, count) / count)
        for angles, count in zip(_angles(points), (AZIMUTHS[d], ELEVATIONS[d]), strict=False)
    ]
    labels = [tuple(_groups(sweep.points, limits) for sweep in (each.sweep, each.sparse)) for each in window]

    def poses(group: int) -> Matrix:
        odometry, result = Odometry(config, T_base_lidar, dimension=d), []
        for prepared, (of_sweep, of_sparse) in zip(window, labels, strict=True):
            chosen = msgspec.structs.replace(
                prepared,
                sweep=_part(prepared.sweep, (of_sweep != group).all(axis=0)),
                sparse=_part(prepared.sparse, (of_sparse != group).all(axis=0)),
            )
            try:
                result.append(odometry.process(chosen).T_odom_lidar)
            except InputError:
                if group < 0:
                    raise
                return np.array([])
        return np.array(result)

    with ThreadPoolExecutor(threads()) as pool:
        complete, *without = pool.map(poses, range(-1, AZIMUTHS[d] + ELEVATIONS[d]))
    return Window(first, complete, np.array([each if len(each) else complete for each in without]))


def _angles(points: Matrix) -> list[NDArray[np.float64]]:
    """Azimuths (N,) of points (N, d) and, in space, elevations."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    return [azimuth] if points.shape[1] == 2 else [azimuth, np.arctan2(points[:, 2], np.hypot(*points[:, :2].T))]


def _groups(points: Matrix, limits: Sequence[NDArray[np.float64]]) -> NDArray[np.int64]:
    """Groups (1 or 2, N) of points (N, d), between limits of their azimuths and elevations."""
    found = [np.searchsorted(limit, angles) for limit, angles in zip(limits, _angles(points), strict=True)]
    return np.stack([group + place * AZIMUTHS[points.shape[1]] for place, group in enumerate(found)])


def _part(sweep: Sweep, chosen: NDArray[np.bool_]) -> Sweep:
    return Sweep(
        sweep.points[chosen], sweep.times_s[chosen] if sweep.is_distorted else sweep.times_s, sweep.middle_s
    )


def _raised(prepared: Prepared, offset_rad: float) -> Prepared:
    if not offset_rad:
        return prepared
    parts = (replace(each, points=raised(each.points, offset_rad)) for each in (prepared.sweep, prepared.sparse))
    return msgspec.structs.replace(prepared, **dict(zip(("sweep", "sparse"), parts, strict=True)))


def _path_m(poses: Matrix) -> NDArray[np.float64]:
    """Path length (N,) up to each pose, turns included."""
    twists = lie.log(lie.between(poses[:-1], poses[1:]))
    d = poses.shape[-1] - 1
    steps_m = np.hypot(np.linalg.norm(twists[:, :d], axis=1), _TURN_M_RAD * np.linalg.norm(twists[:, d:], axis=1))
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def _twists(
    measured: Sequence[Window], first: NDArray[np.int64], last: NDArray[np.int64], path_m: NDArray[np.float64]
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Twists (G, M, k) by which motions between scans differ without each group, and (M,) whether measured.

    Those not within a window are interpolated from the rates of the windows along the path.
    """
    middles_m = [path_m[each.first + len(each.complete) // 2] for each in measured]
    rates = np.array([_rates(each, path_m) for each in measured])
    at_m, length_m = 0.5 * (path_m[first] + path_m[last]), path_m[last] - path_m[first]
    twists = np.empty((rates.shape[1], len(first), rates.shape[2]))
    is_measured = np.zeros(len(first), dtype=np.bool_)
    for group, component in np.ndindex(rates.shape[1:]):
        twists[group, :, component] = length_m * np.interp(at_m, middles_m, rates[:, group, component])
    for each in measured:
        inside = (first >= each.first) & (last < each.first + len(each.complete))
        twists[:, inside] = _changes(each, first[inside] - each.first, last[inside] - each.first)
        is_measured |= inside
    return twists, is_measured


def _rates(window: Window, path_m: NDArray[np.float64]) -> Matrix:
    """Twists (G, k) per meter of path by which motions differ without each group: slopes of their running sums."""
    scans = np.arange(len(window.complete))
    sums = np.cumsum(_changes(window, scans[:-1], scans[1:]), axis=1)
    along_m = path_m[window.first + scans[1:]]
    along_m = along_m - along_m.mean()
    return along_m @ sums / max(float(along_m @ along_m), 1e-6)  # m²: at standstill


def _changes(window: Window, first: NDArray[np.int64], last: NDArray[np.int64]) -> Matrix:
    """Twists (G, M, k) by which motions between scans of a window differ without each group."""
    complete = lie.between(window.complete[first], window.complete[last])
    return lie.log(lie.inverse(complete) @ (lie.inverse(window.without[:, first]) @ window.without[:, last]))
