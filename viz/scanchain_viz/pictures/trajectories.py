"""Trajectories with values for each scan, from the tables of a run or of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from scanchain import lie
from scanchain.comparison.results import RELATIONS_FILE, SCANS_FILE
from scanchain.comparison.table import Row, read_table
from scanchain.data import Matrix, Trajectory
from scanchain.evaluation import absolute_error_of_any_path, pair, path_length
from scanchain.runs.evidence import poses_of
from scanchain.runs.step_table import nees_of_steps
from scanchain.steps import STAGES
from scanchain_viz.colors import ODOMETRY, OPTIMIZED, color_of
from scanchain_viz.pictures.figure import Floats, around


@dataclass(frozen=True, slots=True)
class DrawnTrajectory:
    """A trajectory to draw, with values for each of its N scans; unknown ones are NaN.

    name : for legends outside the drawings
    color, is_dashed : how its line is drawn
    positions : (N, 3) meters, in one frame with the other trajectories
    distance_m : (N,) traveled
    error_m : (N,) distance from the true position
    relation_error_m : (K,) error of each of K manually verified relations; empty if there are none
    seconds : (N,) processing time of each scan
    nees : (N,) squared error normalized by its covariance, 1 on average if the covariance is exact
    observability : (N,) information along the least constrained direction over the required minimum
    """

    name: str
    color: str
    is_dashed: bool
    positions: Floats
    distance_m: Floats
    error_m: Floats
    relation_error_m: Floats
    seconds: Floats
    nees: Floats
    observability: Floats


def frame(trajectories: Sequence[DrawnTrajectory], truth: Floats | None) -> Floats:
    """Corners (2, 3) of the axes: the ground truth if there is one, else the trajectories, with a margin."""
    held = np.concatenate([each.positions for each in trajectories]) if truth is None else truth
    return np.hstack([around(held[:, :2]), around(held[:, 2:], 0.1)])  # heights vary less


def trajectories_of_run(
    steps: pa.Table, truth: Trajectory | None, gap_s: float | None
) -> tuple[list[DrawnTrajectory], Floats | None]:
    """Optimized and odometry trajectories and (K, 3) true positions of the scans that have one, in the map frame.

    Errors are NaN where a scan has no true pose. Other true positions are left out: their noise would lengthen the
    path.
    """
    optimized, odometry = (
        Trajectory(steps["stamp_ns"].to_numpy(), poses_of(steps, prefix=prefix)) for prefix in ("", "odom_")
    )
    unknown, T_world_estimate, true_path = np.full(len(steps), np.nan), lie.identity(3), None
    errors_m, errors_before_m, nees = unknown.copy(), unknown.copy(), unknown
    if truth is not None:
        after, before = (pair(each, truth, gap_s=gap_s) for each in (optimized, odometry))
        ate, ate_before = absolute_error_of_any_path(after), absolute_error_of_any_path(before)
        errors_m[after.places], errors_before_m[before.places] = ate.errors_m, ate_before.errors_m
        nees = nees_of_steps(steps, odometry, truth, gap_s=gap_s)
        T_world_truth = lie.inverse(ate.T_reference_estimate)
        T_world_estimate = T_world_truth @ ate_before.T_reference_estimate
        true_path = lie.transform(T_world_truth, after.reference[:, :3, 3])
    seconds = np.sum([column_of(steps, f"{stage}_s") for stage in STAGES[1:]], axis=0)  # without reading
    observability = column_of(steps, "observability")

    def drawn(name: str, color: str, poses: Matrix, errors_m: Floats, *figures: Floats) -> DrawnTrajectory:
        length_m, none = path_length(poses), np.empty(0)
        return DrawnTrajectory(name, color, False, poses[:, :3, 3], length_m, errors_m, none, *figures)

    return [
        drawn("optimized", OPTIMIZED, optimized.poses, errors_m, seconds, nees, observability),
        drawn("odometry", ODOMETRY, T_world_estimate @ odometry.poses, errors_before_m, *[unknown] * 3),
    ], true_path


def trajectories_of_comparison(directory: Path) -> list[DrawnTrajectory]:
    """Trajectory of the longest run of each method that started, in the order of the table."""
    scans, file = pq.read_table(directory / SCANS_FILE), directory / RELATIONS_FILE
    relations = pq.read_table(file) if file.exists() else None
    rows = enumerate(read_table(directory).rows)
    trajectories = [_of_method(row, color_of(place), scans, relations) for place, row in rows]
    return [trajectory for trajectory in trajectories if len(trajectory.positions)]


def _of_method(row: Row, color: str, scans: pa.Table, relations: pa.Table | None) -> DrawnTrajectory:
    """Trajectory of the method's run with the most scans, of the first one if several have as many."""
    is_of_it = pc.field("method") == row.name
    runs = scans.filter(is_of_it)
    if len(runs):
        runs = runs.filter(pc.field("repeat") == int(np.argmax(np.bincount(runs["repeat"].to_numpy()))))
    names = ("distance_m", "error_m", "seconds", "nees", "observability")
    figures = {name: column_of(runs, name) for name in names}
    errors_m = np.empty(0) if relations is None else column_of(relations.filter(is_of_it), "error_m")
    positions = np.stack([column_of(runs, f"aligned_{axis}") for axis in "xyz"], axis=1)
    return DrawnTrajectory(row.name, color, "+loops" in row.base, positions, relation_error_m=errors_m, **figures)


def column_of(table: pa.Table, name: str) -> Floats:
    """A column as floats, NaN for null."""
    return table[name].to_numpy(zero_copy_only=False).astype(np.float64)
