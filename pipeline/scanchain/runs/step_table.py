"""steps.parquet: one row per scan, and the NEES of its covariances."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose, Trajectory
from scanchain.evaluation import motion_nees, pair
from scanchain.growing_array import Columns
from scanchain.runs.evidence import evidence_of
from scanchain.steps import STAGES, Steps
from scanchain.verdict import CHECKS

if TYPE_CHECKING:
    import pyarrow as pa

_PLAIN = (
    "scan_points", "dropped", "points", "inliers", "iterations", "residual_m", "fit", "cost_m2", "converged",
)  # fmt: skip


def steps_table(steps: Steps, trajectory: Trajectory, T_base_lidar: Pose | None = None) -> pa.Table:
    """A row per scan; ``trajectory`` has the final poses, ``T_base_lidar`` converts the wheel poses."""
    import pyarrow as pa

    known, covariances = steps.columns, steps.covariances()
    columns: dict[str, object] = {
        **{name: known[name] for name in ("index", "stamp_ns", "log_time_ns")},
        **pose_columns(trajectory.poses),
        **{f"odom_{name}": values for name, values in pose_columns(known["T_odom_lidar"]).items()},
        **({} if T_base_lidar is None else _wheels(known, T_base_lidar)),
        "covariance": _lists(covariances, np.isnan(covariances[:, 0, 0])),
        **{name: known[name] for name in _PLAIN},
        "match_reason": pa.array(steps.texts("match_reason"), pa.string()).dictionary_encode(),
        "degeneracy_eigenvalue": known["degeneracy_eigenvalue"],
        "observability": known["observability"],
        "degeneracy_direction": _lists(known["degeneracy_direction"]),
        **{
            f"innovation_{name.lower()}": pa.array(each, from_pandas=True)
            for name, each in steps.innovations.items()
        },
        "state": pa.array(steps.texts("state"), pa.string()).dictionary_encode(),
        "reason": pa.array(steps.texts("reason"), pa.string()).dictionary_encode(),
        "starts_segment": known["starts_segment"],
        "is_copy": known["is_copy"],
        "keyframe": known["keyframe"],
        **{f"{stage}_s": known["timing"][:, k] for k, stage in enumerate(STAGES)},
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


def _wheels(steps: Columns, T_base_lidar: Pose) -> dict[str, object]:
    """Lidar poses by the wheels, null where unknown; no columns if they are unknown throughout."""
    import pyarrow as pa

    known, wheels = steps["has_wheels"], steps["T_odom_base"] @ T_base_lidar
    if not known.any():
        return {}
    poses = pose_columns(np.where(known[:, None, None], wheels, np.eye(wheels.shape[-1])))
    return {f"wheel_{name}": pa.array(values, mask=~known) for name, values in poses.items()}


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table of a run, with checksums."""
    import pyarrow.parquet as pq

    pq.write_table(table, path, compression="zstd", write_page_checksum=True)


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
