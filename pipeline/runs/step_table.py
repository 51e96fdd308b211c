"""steps.parquet: one row a scan, and the NEES of its covariances."""

from __future__ import annotations

import math
from collections import Counter
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Match, Matrix, Pose, State, Step, Timing, Trajectory
from scanchain.evaluation import motion_nees, pair
from scanchain.verdict import check_overlap, check_velocity, check_wheels

if TYPE_CHECKING:
    import pyarrow as pa

_SINGULAR = 1e-12  # smallest over largest eigenvalue of an information matrix below which it is not inverted


class StepRow(msgspec.Struct, frozen=True):
    """A step without its points."""

    index: int
    stamp_ns: int
    log_time_ns: int
    points: int
    dropped: int
    T_odom_lidar: Pose
    T_world_lidar: Pose
    match: Match
    state: State
    reason: str
    keyframe: int
    timing: Timing
    T_odom_base: Pose | None = None
    starts_segment: bool = False


class StepTable:
    """Rows of all steps; an append takes microseconds, columns are made when the table is written."""

    def __init__(self) -> None:
        self.rows: list[StepRow] = []

    def __len__(self) -> int:
        return len(self.rows)

    def append(self, step: Step) -> StepRow:
        """Keep one step; what is kept of it."""
        scan = step.scan
        self.rows.append(
            StepRow(
                scan.index,
                scan.stamp_ns,
                scan.log_time_ns,
                len(scan.points),
                scan.dropped,
                step.T_odom_lidar,
                step.T_world_lidar,
                step.match,
                step.state,
                step.reason,
                step.keyframe,
                step.timing,
                scan.T_odom_base,
                step.starts_segment,
            )
        )
        return self.rows[-1]

    @property
    def odometry(self) -> Trajectory:
        """T_odom_lidar of the steps so far."""
        return self._trajectory([row.T_odom_lidar for row in self.rows])

    @property
    def best_known(self) -> Trajectory:
        """T_world_lidar of the steps so far, each as it was known at its time."""
        return self._trajectory([row.T_world_lidar for row in self.rows])

    @property
    def span_s(self) -> float:
        """Log time from the first step to the last."""
        return (self.rows[-1].log_time_ns - self.rows[0].log_time_ns) * 1e-9 if self.rows else 0.0

    def covariances(self) -> list[Matrix | None]:
        """Covariance (k, k) of each match, of a lidar-frame twist; None where a direction is unobservable."""
        k = len(self.rows[0].match.information) if self.rows else 0
        flat = _covariances(np.array([row.match.information for row in self.rows]))
        return [None if each is None else np.array(each).reshape(k, k) for each in flat]

    def seconds_by_stage(self) -> Matrix:
        """(N, 5) of every step, in the order of ``STAGES``."""
        of_stages = attrgetter(*(f"{stage}_s" for stage in STAGES))
        return np.array([of_stages(row.timing) for row in self.rows], np.float64).reshape(-1, len(STAGES))

    def states(self) -> Counter[State]:
        """Number of steps in each state."""
        return Counter(row.state for row in self.rows)

    def wheel_poses(self, T_base_lidar: Pose) -> Matrix:
        """(N, d+1, d+1) poses of the lidar by the wheels, NaN where the log has none."""
        unknown = np.full(T_base_lidar.shape, np.nan)
        known = (row.T_odom_base for row in self.rows)
        return np.array([unknown if pose is None else pose @ T_base_lidar for pose in known])

    def write(self, path: Path, trajectory: Trajectory, T_base_lidar: Pose | None = None) -> None:
        """Write the table; ``trajectory`` has the final pose of each step, ``T_base_lidar`` is for the wheels."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        rows, matches = self.rows, [row.match for row in self.rows]
        k = len(matches[0].information) if matches else 0
        columns: dict[str, object] = {
            "index": [row.index for row in rows],
            "stamp_ns": [row.stamp_ns for row in rows],
            "log_time_ns": [row.log_time_ns for row in rows],
            **pose_columns(trajectory.poses),
            **{f"odom_{name}": values for name, values in pose_columns(self.odometry.poses).items()},
            **self._checks(trajectory, T_base_lidar),
            "covariance": pa.array(
                _covariances(np.array([match.information for match in matches])), pa.list_(pa.float64(), k * k)
            ),
            "scan_points": [row.points for row in rows],
            "dropped": [row.dropped for row in rows],
            "points": [match.points for match in matches],
            "inliers": [match.inliers for match in matches],
            "iterations": [match.iterations for match in matches],
            "residual_m": [match.residual_m for match in matches],
            "fit": [match.fit for match in matches],
            "cost_m2": [match.cost for match in matches],
            "converged": [match.converged for match in matches],
            "match_reason": pa.array([match.reason for match in matches]).dictionary_encode(),
            "degeneracy_eigenvalue": [match.degeneracy_eigenvalue for match in matches],
            "observability": [match.observability for match in matches],
            "degeneracy_direction": pa.array(
                [match.degeneracy_direction.tolist() for match in matches], pa.list_(pa.float64(), k)
            ),
            "state": pa.array([str(row.state) for row in rows]).dictionary_encode(),
            "reason": pa.array([row.reason for row in rows]).dictionary_encode(),
            "starts_segment": [row.starts_segment for row in rows],
            "keyframe": [row.keyframe for row in rows],
            **{f"{stage}_s": column for stage, column in zip(STAGES, self.seconds_by_stage().T, strict=True)},
        }
        table = pa.table(columns).replace_schema_metadata(_NOTES)
        pq.write_table(table, path, compression="zstd")

    def _checks(self, trajectory: Trajectory, T_base_lidar: Pose | None) -> dict[str, object]:
        """Poses by the wheels, and normalized innovations of the independent checks, null where there are none."""
        import pyarrow as pa

        log_times_ns = np.array([row.log_time_ns for row in self.rows], np.int64)
        velocity = check_velocity(trajectory.stamps_ns, log_times_ns, trajectory.poses)
        overlap = check_overlap(np.array([row.match.inlier_share for row in self.rows], np.float64))
        columns: dict[str, object] = {
            "velocity_innovation": pa.array(velocity, from_pandas=True),
            "overlap_ratio": pa.array(overlap, from_pandas=True),
        }
        if T_base_lidar is None or not any(row.T_odom_base is not None for row in self.rows):
            return columns
        wheels = self.wheel_poses(T_base_lidar)
        innovation = check_wheels(trajectory.poses, wheels).innovation
        return columns | {"wheel_innovation": pa.array(innovation, from_pandas=True)} | _wheel_columns(wheels)

    def _trajectory(self, poses: list[Pose]) -> Trajectory:
        stamps_ns = np.array([row.stamp_ns for row in self.rows], np.int64)
        return Trajectory(stamps_ns, np.array(poses))


STAGES = ("read", "preprocess", "match", "map", "loops")
_NOTES = {
    "x y z qx qy qz qw": "T_world_lidar after optimization, meters; odom_*: T_odom_lidar before it; "
    "wheel_*: of the lidar by wheel odometry, null where there is no reading near the stamp",
    "covariance": "row by row, of a twist xi in the lidar's own frame, T exp(xi), order (translation, rotation), "
    "SE(2) 3x3, SE(3) 6x6; null where a direction of the match is unobservable",
    "points, inliers": "of the downsampled scan; scan_points: valid returns, dropped: invalid ones",
    "wheel_innovation": "difference of the motion around the scan from that by the wheels, standard deviations; "
    "null where there is nothing to compare",
    "velocity_innovation": "change of the motion to the scan, standard deviations of what an acceleration can be",
    "starts_segment": "true if the motion from the scan before is unknown: a new map begins there",
    "overlap_ratio": "share of the points with a correspondence over its median in the scans before",
    "keyframe": "number in the graph, -1 if none was made",
}


def pose_columns(poses: Matrix) -> dict[str, NDArray[np.float64]]:
    """Columns x, y, z, qx, qy, qz, qw of poses (N, d+1, d+1)."""
    lifted = lie.lift(poses)
    values = np.hstack([lifted[:, :3, 3], lie.to_quaternion(lifted[:, :3, :3])])
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    return {name: np.ascontiguousarray(column) for name, column in zip(names, values.T, strict=True)}


def _wheel_columns(poses: Matrix) -> dict[str, object]:
    """Pose columns of poses (N, d+1, d+1), null where one is NaN."""
    import pyarrow as pa

    known = np.isfinite(poses[:, 0, 0])
    columns = pose_columns(np.where(known[:, None, None], poses, np.eye(poses.shape[-1])))
    return {f"wheel_{name}": pa.array(values, mask=~known) for name, values in columns.items()}


def _covariances(informations: Matrix) -> list[list[float] | None]:
    """Inverses (k · k) of (N, k, k), None where there is none."""
    finite = np.atleast_1d(np.isfinite(informations).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], informations, 0.0))
    sound = finite & (values[:, 0] > _SINGULAR * values[:, -1]) & (values[:, -1] > 0.0)
    scaled = vectors / np.sqrt(np.where(sound[:, None], values, 1.0))[:, None, :]
    flat = (scaled @ np.swapaxes(scaled, 1, 2)).reshape(len(values), -1).tolist()
    return [row if good else None for row, good in zip(flat, sound.tolist(), strict=True)]


COLUMNS = ("covariance", "state")


def nees_of_steps(
    steps: pa.Table, odometry: Trajectory, truth: Trajectory, *, gap_s: float | None = None
) -> NDArray[np.float64]:
    """(N,) NEES of the motion up to each scan; NaN without a true pose at both ends, or where a scan was not ok.

    steps : with ``COLUMNS``, a row a scan; odometry : T_odom_lidar of the same scans, SE(2) or lifted
    """
    size = steps.schema.field("covariance").type.list_size
    unknown, k = [np.nan] * size, math.isqrt(size)
    covariances = np.array([row or unknown for row in steps["covariance"].to_pylist()]).reshape(-1, k, k)
    covariances[[state != "ok" for state in steps["state"].to_pylist()]] = np.nan
    pairs = pair(odometry, truth, gap_s=gap_s)
    place = pairs.places
    estimate, reference = pairs.estimate, pairs.reference
    if k == 3:
        estimate, reference = lie.flatten(estimate), lie.flatten(reference)
    nees = motion_nees(estimate, covariances[place], reference)
    nees[np.diff(place) != 1] = np.nan
    result = np.full(len(odometry), np.nan)
    result[place[1:]] = nees
    return result
