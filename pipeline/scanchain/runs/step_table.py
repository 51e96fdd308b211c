"""steps.parquet: one row per scan, and the NEES of its covariances."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose, State, Step, Trajectory
from scanchain.evaluation import motion_nees, pair
from scanchain.graph.growing_array import Columns
from scanchain.runs.evidence import evidence_of
from scanchain.verdict import CHECKS

if TYPE_CHECKING:
    import pyarrow as pa

_SINGULAR = 1e-12  # ratio of smallest to largest eigenvalue below which an information matrix is not inverted


class StepTable:
    """Figures of all steps in columns, without points: adding a step takes microseconds and under a kilobyte."""

    def __init__(self) -> None:
        self.columns = Columns()

    def __len__(self) -> int:
        return len(self.columns)

    def append(self, step: Step) -> None:
        """Add one step."""
        scan, match = step.scan, step.match
        unknown = np.full_like(step.T_odom_lidar, np.nan)
        self.columns.append({
            "scan_points": len(scan.points),
            "match_reason": match.reason,
            "has_wheels": scan.T_odom_base is not None,
            "T_odom_base": unknown if scan.T_odom_base is None else scan.T_odom_base,
            "timing": [getattr(step.timing, f"{stage}_s") for stage in STAGES],
            "cost_m2": match.cost,
            **{name: getattr(scan, name) for name in _OF_SCAN},
            **{name: getattr(step, name) for name in _OF_STEP},
            **{name: getattr(match, name) for name in _OF_MATCH},
        })  # fmt: skip

    @property
    def last_state(self) -> State:
        """State of the last step."""
        return State(self.columns.texts[self.columns["state"][-1]])

    def trajectory(self, name: str) -> Trajectory:
        """Trajectory of the steps so far, ``T_odom_lidar`` or ``T_world_lidar``, as estimated at each step."""
        return Trajectory(self.columns["stamp_ns"].copy(), self.columns[name].copy())

    @property
    def span_s(self) -> float:
        """Log time from the first step to the last."""
        times_ns = self.columns["log_time_ns"]
        return int(times_ns[-1] - times_ns[0]) * 1e-9 if len(times_ns) else 0.0

    def covariances(self) -> Matrix:
        """(N, k, k) of the matches, of lidar-frame twists; NaN where a direction is unobservable."""
        informations = self.columns["information"]
        finite = np.atleast_1d(np.isfinite(informations).all(axis=(1, 2)))
        values, vectors = np.linalg.eigh(np.where(finite[:, None, None], informations, 0.0))
        sound = finite & (values[:, 0] > _SINGULAR * values[:, -1]) & (values[:, -1] > 0.0)
        scaled = vectors / np.sqrt(np.where(sound[:, None], values, np.nan))[:, None, :]
        return self.columns["variance_factor"][:, None, None] * (scaled @ np.swapaxes(scaled, 1, 2))

    def states(self) -> Counter[State]:
        """Number of steps in each state."""
        names = self.columns.texts
        return Counter(State(names[code]) for code in self.columns["state"].tolist())

    def table(self, trajectory: Trajectory, T_base_lidar: Pose | None = None) -> pa.Table:
        """A row per scan; ``trajectory`` has the final poses, ``T_base_lidar`` converts the wheel poses."""
        import pyarrow as pa

        steps = self.columns
        covariances = self.covariances()
        columns: dict[str, object] = {
            **{name: steps[name] for name in ("index", "stamp_ns", "log_time_ns")},
            **pose_columns(trajectory.poses),
            **{f"odom_{name}": values for name, values in pose_columns(steps["T_odom_lidar"]).items()},
            **({} if T_base_lidar is None else self._wheels(T_base_lidar)),
            "covariance": _lists(covariances, np.isnan(covariances[:, 0, 0])),
            **{name: steps[name] for name in ("scan_points", "dropped", *_OF_MATCH[:5], "cost_m2", "converged")},
            "match_reason": self._texts("match_reason"),
            "degeneracy_eigenvalue": steps["degeneracy_eigenvalue"],
            "observability": steps["observability"],
            "degeneracy_direction": _lists(steps["degeneracy_direction"]),
            "state": self._texts("state"),
            "reason": self._texts("reason"),
            "starts_segment": steps["starts_segment"],
            "is_copy": steps["is_copy"],
            "keyframe": steps["keyframe"],
            **{f"{stage}_s": steps["timing"][:, k] for k, stage in enumerate(STAGES)},
        }
        arrays = {
            name: pa.array(np.ascontiguousarray(values)) if isinstance(values, np.ndarray) else values
            for name, values in columns.items()
        }
        table = pa.table(arrays)
        evidence = evidence_of(table)
        for check in CHECKS:
            if check.column and (not check.source or check.source in evidence.sources):
                table = table.append_column(check.column, pa.array(check(evidence).values, from_pandas=True))
        return table

    def _wheels(self, T_base_lidar: Pose) -> dict[str, object]:
        """Lidar poses by the wheels, null where unknown; no columns if they are unknown throughout."""
        import pyarrow as pa

        known, wheels = self.columns["has_wheels"], self.columns["T_odom_base"] @ T_base_lidar
        if not known.any():
            return {}
        poses = pose_columns(np.where(known[:, None, None], wheels, np.eye(wheels.shape[-1])))
        return {f"wheel_{name}": pa.array(values, mask=~known) for name, values in poses.items()}

    def _texts(self, name: str) -> pa.DictionaryArray:
        import pyarrow as pa

        names = self.columns.texts
        return pa.array([names[code] for code in self.columns[name].tolist()], pa.string()).dictionary_encode()


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table of a run, with checksums."""
    import pyarrow.parquet as pq

    pq.write_table(table, path, compression="zstd", write_page_checksum=True)


def inlier_shares(steps: Columns) -> NDArray[np.float64]:
    """``Match.inlier_share`` of steps (N,) in columns."""
    return steps["inliers"] / np.maximum(steps["points"], 1)


_OF_SCAN = ("index", "stamp_ns", "log_time_ns", "dropped", "is_copy")
_OF_STEP = ("keyframe", "state", "reason", "starts_segment", "T_odom_lidar", "T_world_lidar")
_OF_MATCH = (
    "points", "inliers", "iterations", "residual_m", "fit", "converged", "degeneracy_eigenvalue", "observability",
    "degeneracy_direction", "information", "variance_factor",
)  # fmt: skip
STAGES = ("read", "preprocess", "match", "map", "loops")


def _lists(rows: Matrix, is_null: NDArray[np.bool_] | None = None) -> pa.FixedSizeListArray:
    """Rows (N, ...) as lists of fixed size, null where ``is_null`` (N,)."""
    import pyarrow as pa

    size = int(np.prod(rows.shape[1:]))
    mask = None if is_null is None else pa.array(is_null)
    return pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1)), size, mask=mask)


def pose_columns(poses: Matrix) -> dict[str, NDArray[np.float64]]:
    """Columns x, y, z, qx, qy, qz, qw of poses (N, d+1, d+1)."""
    lifted = lie.lift(poses)
    values = np.hstack([lifted[:, :3, 3], lie.to_quaternion(lifted[:, :3, :3])])
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    return {name: column.copy() for name, column in zip(names, values.T, strict=True)}


COLUMNS = ("covariance", "state")


def nees_of_steps(
    steps: pa.Table, odometry: Trajectory, truth: Trajectory, *, gap_s: float | None = None
) -> NDArray[np.float64]:
    """(N,) NEES of the motion to each scan; NaN without a true pose at both ends, or where a scan was not ok.

    steps : with ``COLUMNS``, one row per scan; odometry : T_odom_lidar of the same scans, SE(2) or lifted
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
