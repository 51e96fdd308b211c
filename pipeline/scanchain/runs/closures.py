"""Verdicts on loop closures, by verification and by the back end; loops.parquet, one row per closure tried."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from scanchain.data import REJECTED_WEIGHT, Closure, ClosureVerdict, GraphState, Keyframe, Problem
from scanchain.runs.step_table import pose_columns

if TYPE_CHECKING:
    import pyarrow as pa


def final_verdicts(closures: Sequence[Closure], state: GraphState) -> tuple[Closure, ...]:
    """Every closure with its final verdict, weight and χ²; those the graph contradicts are rejected.

    A closure accepted after the optimization that gave ``state`` stays accepted.
    """
    edges, final = _loop_edges(state), []
    for closure in closures:
        if closure.verdict is ClosureVerdict.ACCEPTED:
            between = edges[closure.target, closure.source]
            weight, chi2 = between.popleft() if between else (1.0, float("nan"))
            closure = replace(closure, weight=weight, chi2_after=chi2)
            if weight < REJECTED_WEIGHT:
                cause = "contradicts the rest of the graph"
                closure = closure.rejected(Problem(cause, f"{cause}, χ² {chi2:.4g}"))
        final.append(closure)
    return tuple(final)


def _loop_edges(state: GraphState) -> defaultdict[tuple[int, int], deque[tuple[float, float]]]:
    """Weight and χ² of the loop edges between each pair, in the order they were added."""
    edges: defaultdict[tuple[int, int], deque[tuple[float, float]]] = defaultdict(deque)
    loops = state.is_loop
    for (i, j), weight, chi2 in zip(state.edges[loops], state.weight[loops], state.edge_chi2[loops], strict=True):
        edges[int(i), int(j)].append((float(weight), float(chi2)))
    return edges


def closures_table(closures: Sequence[Closure], keyframes: Sequence[Keyframe], dimension: int) -> pa.Table:
    """Every closure tried, with its final verdict and its robust weight after optimization."""
    import pyarrow as pa

    def of(items: Sequence[object], kind: pa.DataType, *names: str, null_nan: bool = False) -> dict[str, pa.Array]:
        return {
            name: pa.array([getattr(each, name) for each in items], kind, from_pandas=null_nan) for name in names
        }

    k = 3 if dimension == 2 else 6
    whole, number, text = pa.int64(), pa.float64(), pa.string()
    matches = [closure.match for closure in closures]
    ends = {name: [keyframes[getattr(closure, name)] for closure in closures] for name in ("target", "source")}
    poses = np.array([match.T_target_source for match in matches]).reshape(-1, dimension + 1, dimension + 1)
    columns = {
        **of(closures, whole, "target", "source"),
        **{f"{end}_scan": pa.array([each.scan_index for each in ends[end]], whole) for end in ends},
        **{f"{end}_stamp_ns": pa.array([each.stamp_ns for each in ends[end]], whole) for end in ends},
        **of(closures, text, "proposed_by", "verdict", "rejected_by", "cause", "reason"),
        **of(closures, number, "weight"),
        **of(closures, number, "chi2_before", "chi2_after", null_nan=True),
        **{name: pa.array(values, number) for name, values in pose_columns(poses).items()},
        "information": pa.array(
            [match.information.ravel().tolist() for match in matches], pa.list_(number, k * k)
        ),
        **of(closures, number, "overlap"),
        **of(matches, whole, "points", "inliers", "iterations"),
        **of(matches, number, "residual_m"),
        **of(matches, pa.bool_(), "converged"),
        **of(matches, number, "degeneracy_eigenvalue"),
    }
    return pa.table(columns)
