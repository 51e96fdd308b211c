"""The trajectories of a comparison, from its table of scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from scanchain.comparison.results import RELATIONS_FILE, SCANS_FILE
from scanchain.comparison.table import Row, read_table
from scanchain_viz.pictures.trajectory_figures import DrawnTrajectory, Floats, color_of


def read_trajectories(directory: Path) -> list[DrawnTrajectory]:
    """Trajectory of each method that began, in the order of the table, of its longest run."""
    scans, file = pq.read_table(directory / SCANS_FILE), directory / RELATIONS_FILE
    relations = pq.read_table(file) if file.exists() else None
    rows = read_table(directory).rows
    trajectories = [_drawn(scans, relations, row, place) for place, row in enumerate(rows)]
    return [trajectory for trajectory in trajectories if len(trajectory.positions)]


def _drawn(scans: pa.Table, relations: pa.Table | None, row: Row, place: int) -> DrawnTrajectory:
    runs = _of(scans, row.name)
    chosen = runs.filter(pa.array(runs["repeat"].to_numpy() == _furthest(runs["repeat"].to_numpy())))
    errors_m = np.empty(0) if relations is None else _column(_of(relations, row.name), "error_m")
    return DrawnTrajectory(
        name=row.name,
        color=color_of(place),
        is_dashed="+loops" in row.base,
        positions=np.stack([_column(chosen, f"aligned_{axis}") for axis in "xyz"], axis=1),
        distance_m=_column(chosen, "distance_m"),
        error_m=_column(chosen, "error_m"),
        relation_error_m=errors_m,
        seconds=_column(chosen, "seconds"),
        nees=_column(chosen, "nees"),
        observability=_column(chosen, "observability"),
    )


def _of(table: pa.Table, method: str) -> pa.Table:
    """Rows of a method."""
    return table.filter(pa.array(np.array(table["method"].to_pylist(), object) == method))


def _furthest(repeats: NDArray[np.int64]) -> int:
    """Index of the run with most scans, the first of several."""
    return int(np.argmax(np.bincount(repeats))) if len(repeats) else 0


def _column(table: pa.Table, name: str) -> Floats:
    """A column as floats, NaN for null."""
    return table[name].to_numpy(zero_copy_only=False).astype(np.float64)
