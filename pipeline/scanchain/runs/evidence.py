"""Evidence for the verdict, from the tables of a run or from a trajectory alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import VERIFICATION, Matrix, Proposal, State, Trajectory
from scanchain.errors import at_most
from scanchain.evaluation import ExpectedError
from scanchain.verdict import CHECKS, Closures, Evidence, smallest_jump_m

if TYPE_CHECKING:
    import pyarrow as pa


def evidence_of(
    steps: pa.Table, closures: pa.Table | None = None, expected: ExpectedError | None = None
) -> Evidence:
    """Evidence of every scan in the tables of a run."""
    dimension = 2 if steps.schema.field("covariance").type.list_size == 9 else 3
    states, sources = np.array(steps["state"].to_pylist()), [check.source for check in CHECKS if check.source]
    return Evidence(
        stamps_ns=steps["stamp_ns"].to_numpy(),
        log_times_ns=steps["log_time_ns"].to_numpy(),
        poses=poses_of(steps, "", dimension),
        is_lost=states == State.LOST,
        is_degenerate=states == State.DEGENERATE,
        fit=steps["fit"].to_numpy(),
        inlier_share=steps["inliers"].to_numpy() / np.maximum(steps["points"].to_numpy(), 1),
        starts_segment=steps["starts_segment"].to_numpy(zero_copy_only=False),
        is_copy=steps["is_copy"].to_numpy(zero_copy_only=False),
        points=steps["scan_points"].to_numpy(),
        closures=Closures.none(dimension) if closures is None else _verified(closures, dimension),
        sources={
            name: poses_of(steps, f"{name}_", dimension) for name in sources if f"{name}_x" in steps.column_names
        },
        odometry=poses_of(steps, "odom_", dimension),
        error="" if expected is None else f"ATE {expected.bounds}",
        bound_m=np.inf if expected is None else expected.high,
        uncertain="" if expected is None else expected.where,
        open_m=_open_m(steps["residual_m"].to_numpy(), steps["inliers"].to_numpy(), dimension),
    )


def evidence_of_trajectory(
    trajectory: Trajectory,
    log_times_ns: NDArray[np.int64],
    wheels: Matrix,
    points: NDArray[np.int64],
    bounds_m: Mapping[str, float] | None = None,
) -> Evidence:
    """Evidence of a trajectory without matches: wheels (N, d+1, d+1), NaN where unknown, at the same scans.

    bounds_m : upper bounds on its error, by the name of the other estimate of the same motion that they come
        from; those from other sensors are added where these are known
    """
    unknown, nowhere = np.full(len(trajectory), np.nan), np.zeros(len(trajectory), np.bool_)
    found = Evidence(
        stamps_ns=trajectory.stamps_ns,
        log_times_ns=log_times_ns,
        poses=trajectory.poses,
        is_lost=nowhere,
        is_degenerate=nowhere,
        fit=unknown,
        inlier_share=unknown,
        starts_segment=nowhere,
        is_copy=nowhere,
        points=points,
        closures=Closures.none(trajectory.dimension),
        sources={"wheel": wheels},
    )
    bounds = {check.name: check.bound_m for check in found.checked(CHECKS).checks if np.isfinite(check.bound_m)}
    bounds = {**(bounds_m or {}), **bounds}
    by = min(bounds, key=bounds.__getitem__, default="")
    if not by:
        return replace(found, error=f"no jump above {smallest_jump_m(found.seconds):.2g} m, drift unchecked")
    return replace(found, error=f"ATE below {at_most(bounds[by])} m by {by}", bound_m=bounds[by])


def _open_m(residuals_m: NDArray[np.float64], inliers: NDArray[np.int64], dimension: int) -> float:
    """Twice the median standard deviation of a position by its residuals, each along one of d directions."""
    sigmas_m = residuals_m / np.sqrt(np.maximum(inliers, 1) / dimension)
    known_m = sigmas_m[np.isfinite(sigmas_m)]
    return 2.0 * float(np.median(known_m)) if len(known_m) else 0.0


def _verified(table: pa.Table, dimension: int) -> Closures:
    """The closures that verification accepted."""
    rejected_by = np.array(table["rejected_by"].to_pylist(), np.str_)
    chosen = rejected_by != VERIFICATION
    by_position = np.array(table["proposed_by"].to_pylist(), np.str_) == Proposal.POSITION
    return Closures(
        table["target_scan"].to_numpy()[chosen],
        table["source_scan"].to_numpy()[chosen],
        poses_of(table, "", dimension)[chosen],
        rejected_by[chosen] == "",
        tried=len(np.unique(table["source_scan"].to_numpy()[by_position])),
    )


def poses_of(table: pa.Table, prefix: str = "", dimension: int = 3) -> Matrix:
    """Poses (N, d+1, d+1) from the columns whose names begin with ``prefix``, NaN where one is null."""
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = np.stack(
        [table[f"{prefix}{name}"].to_numpy(zero_copy_only=False).astype(np.float64) for name in names], axis=1
    ).reshape(-1, 7)
    known = np.isfinite(values).all(axis=1)
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[known, :3, :3] = lie.from_quaternion(values[known, 3:])
    poses[known, :3, 3] = values[known, :3]
    poses = lie.flatten(poses) if dimension == 2 else poses
    poses[~known] = np.nan
    return poses
