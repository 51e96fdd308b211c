"""The verdict on a run, from steps.parquet and loops.parquet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import VERIFICATION, Matrix, Proposal, State, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import ExpectedError
from scanchain.runs.metrics import METRICS_FILE
from scanchain.verdict import (
    KNOWN,
    Closures,
    Evidence,
    Judged,
    check_overlap,
    check_velocity,
    check_wheels,
    judge,
    smallest_jump_m,
    wheel_bound_m,
)

if TYPE_CHECKING:
    import pyarrow as pa


class _Known(msgspec.Struct):
    """Figures of a run's metrics that a verdict needs."""

    expected_ate_m: ExpectedError | None = None


def judge_run(folder: Path) -> Judged:
    """The verdict on the tables of a run directory. Raises InputError where it has none."""
    return judge(evidence_of_run(folder, expected_of_run(folder)))


def expected_of_run(folder: Path) -> ExpectedError | None:
    """The expected ATE in the metrics of a run directory; None where these know none."""
    try:
        known = msgspec.json.decode((folder / METRICS_FILE).read_bytes(), type=_Known)
    except (OSError, msgspec.DecodeError):
        return None
    return known.expected_ate_m


def evidence_of_run(folder: Path, expected: ExpectedError | None) -> Evidence:
    """Evidence of every scan in a run directory. Raises InputError where it has no tables."""
    import pyarrow.parquet as pq

    if not folder.is_dir():
        raise InputError(f"{folder}: is not a run directory; to check a log, name a --trajectory FILE.tum")
    try:
        steps = pq.ParquetFile(folder / "steps.parquet").read()
    except FileNotFoundError:
        told = "no run directory, or that of an unfinished run (--resume goes on)"
        if (folder / "summary.txt").exists():  # of another command
            told = "only scanchain run writes it; see summary.txt"
        raise InputError(f"{folder}: has no steps.parquet: {told}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: no steps.parquet that can be read ({error}); name a run directory") from None
    loops_file = folder / "loops.parquet"
    return evidence_of(steps, pq.ParquetFile(loops_file).read() if loops_file.exists() else None, expected)


def evidence_of(steps: pa.Table, closures: pa.Table | None, expected: ExpectedError | None = None) -> Evidence:
    """Evidence of every scan in the tables of a run."""
    dimension = 2 if steps.schema.field("covariance").type.list_size == 9 else 3
    poses = poses_of(steps, "", dimension)
    states = np.array(steps["state"].to_pylist())
    stamps_ns, log_times_ns = steps["stamp_ns"].to_numpy(), steps["log_time_ns"].to_numpy()
    wheels = (
        poses_of(steps, "wheel_", dimension) if "wheel_x" in steps.column_names else np.full_like(poses, np.nan)
    )
    is_copy = np.zeros(len(poses), np.bool_)
    if "is_copy" in steps.column_names:  # older runs have none
        is_copy = steps["is_copy"].to_numpy(zero_copy_only=False)
    return Evidence(
        seconds=(log_times_ns - log_times_ns[0]) * 1e-9,
        poses=poses,
        is_lost=states == State.LOST,
        is_degenerate=states == State.DEGENERATE,
        fit=steps["fit"].to_numpy(),
        starts_segment=steps["starts_segment"].to_numpy(zero_copy_only=False),
        is_copy=is_copy,
        points=steps["scan_points"].to_numpy(),
        wheels=check_wheels(poses, wheels),
        velocity=check_velocity(stamps_ns, log_times_ns, poses),
        overlap=check_overlap(steps["inliers"].to_numpy() / np.maximum(steps["points"].to_numpy(), 1)),
        closures=_no_closures(poses) if closures is None else _verified(closures, dimension),
        odometry=poses_of(steps, "odom_", dimension),
        error="" if expected is None else f"ATE {expected.low:.3f} to {expected.high:.3f} m with 95 %",
    )


def evidence_of_trajectory(
    trajectory: Trajectory,
    log_times_ns: NDArray[np.int64],
    wheels: Matrix,
    points: NDArray[np.int64],
    bounds_m: Mapping[str, float] | None = None,
) -> Evidence:
    """Evidence of a trajectory without matches: wheels (N, d+1, d+1), NaN where unknown, at the same scans.

    bounds_m : on its error, by the name of another estimate of the same motion; the wheels are one as well
    """
    n, unknown = len(trajectory), np.zeros(len(trajectory), np.bool_)
    found = Evidence(
        seconds=(log_times_ns - log_times_ns[0]) * 1e-9,
        poses=trajectory.poses,
        is_lost=unknown,
        is_degenerate=unknown,
        fit=np.full(n, np.nan),
        starts_segment=unknown,
        is_copy=unknown,
        points=points,
        wheels=check_wheels(trajectory.poses, wheels),
        velocity=check_velocity(trajectory.stamps_ns, log_times_ns, trajectory.poses),
        overlap=np.full(n, np.nan),
        closures=_no_closures(trajectory.poses),
    )
    bounds = dict(bounds_m or {})
    if found.wheels.known_share >= KNOWN:
        bounds["wheels"] = wheel_bound_m(trajectory.poses, wheels)
    by = min(bounds, key=bounds.__getitem__, default="")
    error = f"no jump above {smallest_jump_m(found.seconds):.2g} m, drift unchecked"
    return replace(found, error=f"ATE below {bounds[by]:.2g} m by {by}" if by else error)


def _verified(table: pa.Table, dimension: int) -> Closures:
    """The closures that verification accepted."""
    rejected_by = np.array(table["rejected_by"].to_pylist(), np.str_)
    chosen = rejected_by != VERIFICATION
    return Closures(
        table["target_scan"].to_numpy()[chosen],
        table["source_scan"].to_numpy()[chosen],
        poses_of(table, "", dimension)[chosen],
        rejected_by[chosen] == "",
        tried=table["proposed_by"].to_pylist().count(Proposal.POSITION),
    )


def _no_closures(poses: Matrix) -> Closures:
    nothing = np.empty(0, np.int64)
    return Closures(nothing, nothing, poses[:0], np.empty(0, np.bool_))


def poses_of(table: pa.Table, prefix: str = "", dimension: int = 3) -> Matrix:
    """(N, d+1, d+1) of the columns whose names begin so, NaN where one is null."""
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
