"""loops.parquet: one row a loop closure tried."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scanchain.data import Keyframe
from scanchain.runs.step_table import pose_columns
from scanchain.runs.verdicts import JudgedClosure


def write_closures(
    path: Path, judged: Sequence[JudgedClosure], keyframes: Sequence[Keyframe], dimension: int
) -> None:
    """Write every closure tried, with its final verdict and the robust weight that the optimizer left to it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    k = 3 if dimension == 2 else 6
    closures = [item.closure for item in judged]
    matches = [closure.match for closure in closures]
    relative = np.array([match.T_target_source for match in matches])
    columns: dict[str, object] = {
        "target": pa.array([closure.target for closure in closures], pa.int64()),
        "source": pa.array([closure.source for closure in closures], pa.int64()),
        "target_scan": pa.array([keyframes[closure.target].scan_index for closure in closures], pa.int64()),
        "source_scan": pa.array([keyframes[closure.source].scan_index for closure in closures], pa.int64()),
        "target_stamp_ns": pa.array([keyframes[closure.target].stamp_ns for closure in closures], pa.int64()),
        "source_stamp_ns": pa.array([keyframes[closure.source].stamp_ns for closure in closures], pa.int64()),
        "proposed_by": pa.array([str(closure.proposed_by) for closure in closures], pa.string()),
        "verdict": pa.array([str(item.verdict) for item in judged], pa.string()),
        "rejected_by": pa.array([item.rejected_by for item in judged], pa.string()),
        "reason": pa.array([item.reason for item in judged], pa.string()),
        "weight": pa.array([item.weight for item in judged], pa.float64()),
        "chi2_before": pa.array([closure.chi2_before for closure in closures], pa.float64(), from_pandas=True),
        "chi2_after": pa.array([item.chi2_after for item in judged], pa.float64(), from_pandas=True),
        **{
            name: pa.array(values, pa.float64())
            for name, values in pose_columns(relative.reshape(-1, dimension + 1, dimension + 1)).items()
        },
        "information": pa.array(
            [match.information.ravel().tolist() for match in matches], pa.list_(pa.float64(), k * k)
        ),
        "overlap": pa.array([closure.overlap for closure in closures], pa.float64()),
        "points": pa.array([match.points for match in matches], pa.int64()),
        "inliers": pa.array([match.inliers for match in matches], pa.int64()),
        "iterations": pa.array([match.iterations for match in matches], pa.int64()),
        "residual_m": pa.array([match.residual_m for match in matches], pa.float64()),
        "converged": pa.array([match.converged for match in matches], pa.bool_()),
        "degeneracy_eigenvalue": pa.array([match.degeneracy_eigenvalue for match in matches], pa.float64()),
    }
    notes = {
        "x y z qx qy qz qw": "pose of keyframe source in the frame of keyframe target",
        "information": "row by row, of a twist in the source's own frame, order (translation, rotation)",
        "proposed_by": "position: near by odometry; place: looked alike wherever odometry has it",
        "rejected_by": "verification: by matching; back end: verified, but it contradicts the rest of the graph; "
        "empty where it is accepted",
        "chi2_before chi2_after": "of its edge, when it entered the graph and at the end; null where it never did",
        "weight": "robust weight after the last optimization, 0 for closures that never entered the graph",
    }
    pq.write_table(pa.table(columns).replace_schema_metadata(notes), path, compression="zstd")
