"""The courses of a comparison, from its table of scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.compare.evidence import SCANS_FILE
from pipeline.compare.table import Row, read_table
from viz.courses import Course, Floats, colour_of


def read_courses(directory: Path) -> list[Course]:
    """One a method that began, in the order of the table, of its first run."""
    scans = pq.read_table(directory / SCANS_FILE)
    rows = read_table(directory).rows
    courses = [_course(scans, row, place) for place, row in enumerate(rows)]
    return [course for course in courses if len(course.positions)]


def _course(scans: pa.Table, row: Row, place: int) -> Course:
    is_first_run = scans["repeat"].to_numpy() == 0
    chosen = scans.filter(pa.array(is_first_run & (np.array(scans["method"].to_pylist()) == row.name)))
    return Course(
        name=row.name,
        colour=colour_of(place),
        is_dashed="+loops" in row.base,
        positions=np.stack([_column(chosen, f"aligned_{axis}") for axis in "xyz"], axis=1),
        distance_m=_column(chosen, "distance_m"),
        error_m=_column(chosen, "error_m"),
        seconds=_column(chosen, "seconds"),
        nees=_column(chosen, "nees"),
        eigenvalue=_column(chosen, "degeneracy_eigenvalue"),
    )


def _column(table: pa.Table, name: str) -> Floats:
    """A column as floats, NaN for null."""
    return table[name].to_numpy(zero_copy_only=False).astype(np.float64)
