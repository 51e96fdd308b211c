"""Verdicts on loop closures, by verification and by the back end; loops.parquet, one row a closure tried."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scanchain.data import REJECTED_WEIGHT, Closure, ClosureVerdict, GraphState, Keyframe
from scanchain.runs.step_table import pose_columns

if TYPE_CHECKING:
    import pyarrow as pa

VERIFICATION, BACK_END = "verification", "back end"  # either may reject a closure


@dataclass(frozen=True, slots=True)
class FinalClosure:
    """A closure with its final verdict, by the matcher or by the graph.

    ``weight`` and ``chi2_after`` are what the optimizer left to its edge: 0 and NaN if it never became one, 1 and
    NaN until it is optimized.
    """

    closure: Closure
    verdict: ClosureVerdict
    cause: str
    reason: str
    weight: float
    chi2_after: float

    @property
    def rejected_by(self) -> str:
        """Verification by matching, or the back end where it contradicts the graph; empty if accepted."""
        if self.verdict is ClosureVerdict.ACCEPTED:
            return ""
        return BACK_END if self.closure.verdict is ClosureVerdict.ACCEPTED else VERIFICATION


def final_verdicts(closures: Sequence[Closure], state: GraphState) -> tuple[FinalClosure, ...]:
    """Every closure with its final verdict; those the graph contradicts are rejected.

    A closure accepted since the optimization that ``state`` comes from stays accepted.
    """
    edges = _loop_edges(state)
    final = []
    for closure in closures:
        verdict, cause, reason, weight, chi2 = closure.verdict, closure.cause, closure.reason, 0.0, float("nan")
        if verdict is ClosureVerdict.ACCEPTED:
            between = edges[closure.target, closure.source]
            weight, chi2 = between.popleft() if between else (1.0, float("nan"))
            if weight < REJECTED_WEIGHT:
                verdict = ClosureVerdict.REJECTED
                cause = "contradicts the rest of the graph"
                reason = f"{cause}, χ² {chi2:.4g}"
        final.append(FinalClosure(closure, verdict, cause, reason, weight, chi2))
    return tuple(final)


def _loop_edges(state: GraphState) -> defaultdict[tuple[int, int], deque[tuple[float, float]]]:
    """Weight and χ² of the loop edges between each pair, in the order they were added."""
    edges: defaultdict[tuple[int, int], deque[tuple[float, float]]] = defaultdict(deque)
    loops = state.is_loop
    for (i, j), weight, chi2 in zip(state.edges[loops], state.weight[loops], state.edge_chi2[loops], strict=True):
        edges[int(i), int(j)].append((float(weight), float(chi2)))
    return edges


def write_closures(
    path: Path, final: Sequence[FinalClosure], keyframes: Sequence[Keyframe], dimension: int
) -> None:
    """Write the table of ``closures_table``."""
    import pyarrow.parquet as pq

    pq.write_table(closures_table(final, keyframes, dimension), path, compression="zstd")


def closures_table(final: Sequence[FinalClosure], keyframes: Sequence[Keyframe], dimension: int) -> pa.Table:
    """Every closure tried, with its final verdict and the robust weight that the optimizer left to it."""
    import pyarrow as pa

    k = 3 if dimension == 2 else 6
    closures = [item.closure for item in final]
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
        "verdict": pa.array([str(item.verdict) for item in final], pa.string()),
        "rejected_by": pa.array([item.rejected_by for item in final], pa.string()),
        "cause": pa.array([item.cause for item in final], pa.string()),
        "reason": pa.array([item.reason for item in final], pa.string()),
        "weight": pa.array([item.weight for item in final], pa.float64()),
        "chi2_before": pa.array([closure.chi2_before for closure in closures], pa.float64(), from_pandas=True),
        "chi2_after": pa.array([item.chi2_after for item in final], pa.float64(), from_pandas=True),
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
        "proposed_by": "position: close by odometry; place: by place recognition, independent of odometry",
        "rejected_by": "verification: by matching; back end: verified, but it contradicts the rest of the graph; "
        "empty where it is accepted",
        "cause": "the reason without its figures, the same for all closures of its kind",
        "chi2_before chi2_after": "of its edge, when it entered the graph and at the end; null where it never did",
        "weight": "robust weight after the last optimization, 0 for closures that never entered the graph",
    }
    return pa.table(columns).replace_schema_metadata(notes)
