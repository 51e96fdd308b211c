"""Verdict on a run, from its tables, and on the trajectory of another tool, from the log it was computed from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Matrix, Scan, Trajectory
from scanchain.errors import InputError, one_line
from scanchain.evaluation import ExpectedError, pair
from scanchain.evaluation.consistency import velocities
from scanchain.files import Source
from scanchain.logs import Log, open_log
from scanchain.odometry.distortion import choose_point_times
from scanchain.preprocess import Resolution, ScanMotion
from scanchain.registration import MapKeeper, create_matcher
from scanchain.runs.directory import METRICS_FILE
from scanchain.runs.evidence import evidence_of, evidence_of_trajectory
from scanchain.settings import Override, load_settings
from scanchain.trajectory import read_tum
from scanchain.verdict import Judged, apart_m, judge

if TYPE_CHECKING:
    import pyarrow as pa


class Known(msgspec.Struct):
    """Figures of a run's metrics that a verdict needs."""

    expected_ate_m: ExpectedError | None = None
    distortion: str = ""


def judge_run(folder: Path) -> Judged:
    """The verdict on the tables of a run directory. Raises InputError where it has none that can be read."""
    import pyarrow.parquet as pq

    if not folder.is_dir():
        raise InputError(f"{folder}: is not a run directory; to check a log, name a --trajectory FILE.tum")
    tables = list["pa.Table"]()
    for path in (folder / "steps.parquet", folder / "loops.parquet"):
        if tables and not path.exists():
            continue
        try:
            tables.append(pq.ParquetFile(path, page_checksum_verification=True).read())
        except Exception as error:  # any that Arrow raises on a damaged or foreign file
            remedy = "name a directory of scanchain run (--resume ends an unfinished one)"
            why = "" if isinstance(error, FileNotFoundError) else f" ({one_line(error)})"
            raise InputError(f"{folder}: has no {path.name} that can be read{why}; {remedy}") from error
    known = known_of_run(folder)
    try:
        evidence = evidence_of(tables[0], *tables[1:], expected=known.expected_ate_m)
        return judge(evidence, distortion=known.distortion)
    except Exception as error:  # any that Arrow or NumPy raises on damaged figures
        raise InputError(f"{folder}: its tables are damaged ({one_line(error)}); run the log again") from error


def known_of_run(folder: Path) -> Known:
    """Expected ATE and distortion in the metrics of a run directory. Raises InputError where it has none."""
    try:
        return msgspec.json.decode((folder / METRICS_FILE).read_bytes(), type=Known)
    except (OSError, msgspec.DecodeError) as error:
        raise InputError(f"{folder / METRICS_FILE}: cannot be read, but a verdict needs it: copy it") from error


def judge_trajectory(file: Path, logs: Sequence[Source], overrides: Sequence[Override]) -> tuple[Judged, int]:
    """The verdict on the poses at the scans of a log, and the number of scans without a pose.

    Checks: wheel odometry, constant velocity, and alignment of each scan to a map of the scans before it at the
    given poses.
    file : TUM, poses of the lidar. Raises InputError where it has poses for fewer than three scans.
    """
    poses = read_tum(file)
    log = open_log(logs, load_settings(overrides=overrides).config.log)
    choose_point_times(log)
    config = load_settings(log.dimension, overrides=overrides).config
    stamps_ns, log_times_ns, points, wheels = _table(log, config)
    placeholders = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    pairs = pair(Trajectory(stamps_ns, placeholders), poses)
    if len(pairs) < 3:
        raise InputError(f"{file}: has poses at {len(pairs)} of {len(stamps_ns)} scans; it must be of this log")
    found = pairs.places
    T_world_lidar = lie.flatten(pairs.reference) if log.dimension == 2 else pairs.reference
    trajectory = Trajectory(stamps_ns[found], T_world_lidar)
    is_chosen = np.zeros(len(stamps_ns), np.bool_)
    is_chosen[found] = True
    scans = (scan for scan in log.scans(config.preprocess) if is_chosen[scan.index])
    corrections, (inlier_shares, observability, fit) = _matched(scans, trajectory, config)
    bounds_m = {"scan matching": _matched_bound_m(trajectory.poses, corrections)}
    evidence = replace(
        evidence_of_trajectory(trajectory, log_times_ns[found], wheels[found], points[found], bounds_m),
        is_lost=inlier_shares < config.matching.min_inlier_share,
        is_degenerate=observability < 1.0,
        inlier_share=inlier_shares,
        fit=fit,
    )
    return judge(evidence, distortion=log.distortion), len(stamps_ns) - len(pairs)


def _table(log: Log, config: Config) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Matrix]:
    """Stamps, log times, numbers of points, and lidar poses by the wheels, NaN where unknown, of all scans."""
    rows, wheels = [], []
    unknown = np.full(log.T_base_lidar.shape, np.nan)
    for scan in log.scans(config.preprocess):
        rows.append((scan.stamp_ns, scan.log_time_ns, len(scan.points)))
        wheels.append(unknown if scan.T_odom_base is None else scan.T_odom_base @ log.T_base_lidar)
    stamps_ns, log_times_ns, points = np.array(rows, np.int64).T.copy()
    return stamps_ns, log_times_ns, points, np.array(wheels)


def _matched_bound_m(poses: Matrix, corrections: Matrix) -> float:
    """RMS distance of a trajectory from the one chained from its motions as corrected by scan matching.

    Each scan is matched to a map at the given poses. An error that grows along the path shows in every correction,
    so that the sum of the corrections is larger than the error.
    """
    motions = lie.between(poses[:-1], poses[1:]) @ corrections[1:]
    chained = [poses[0]]
    for motion in motions:
        chained.append(chained[-1] @ motion)
    return apart_m(poses[:, :-1, -1], np.array(chained)[:, :-1, -1])


def _matched(scans: Iterable[Scan], trajectory: Trajectory, config: Config) -> tuple[Matrix, Matrix]:
    """Corrections (N, d+1, d+1) of given poses by aligning each scan to a map of the scans before it.

    Also (3, N): inlier share, observability and fit, which is 0 where a match is too far from the given pose.
    """
    resolution = Resolution(config.preprocess, config.local_map.voxel_size_m)
    keeper, matcher = MapKeeper(trajectory.dimension, config.local_map), create_matcher(config.matching)
    corrections, figures = [], []
    for scan, T_world_lidar, twist in zip(scans, trajectory.poses, velocities(trajectory), strict=True):
        sweep, sparse = resolution.downsampled(scan)
        keeper.resize(resolution.scale)
        motion = ScanMotion(twist)
        points = sparse.from_middle(motion)
        T_world_middle = T_world_lidar @ motion.over(sweep.middle_s)
        correction, figure = lie.identity(trajectory.dimension), (1.0, np.inf, np.nan)
        if len(keeper.surfaces) and len(points):
            match = matcher.align(points, keeper.surfaces, T_world_middle)
            correction = lie.between(T_world_middle, match.T_target_source)
            is_near = np.linalg.norm(correction[:-1, -1]) < config.matching.max_distance_m
            figure = (match.inlier_share, match.observability, match.fit * is_near)
        corrections.append(correction)
        figures.append(figure)
        keeper.extend(sweep.from_middle(motion), T_world_middle)
    return np.array(corrections), np.array(figures).T
