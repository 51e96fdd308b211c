"""Writes a study: tables as text, JSON and CSV."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from scanchain.data import Matrix
from scanchain.errors import counted
from scanchain.landmarks.study import Estimate, Study
from scanchain.trajectory import write_tum

_HEADINGS = (
    "method", "build ms", "factor ms", "solve ms", "total ms", "again ms", "solves", "nnz factor", "differs by",
)  # fmt: skip


def file_stem(name: str) -> str:
    """A name as a valid stem of a file name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "problem"


def table_of(study: Study) -> list[tuple[str, ...]]:
    """Headings, then one row per method; without the column of differences for a single method."""
    rows: list[tuple[str, ...]] = [_HEADINGS]
    for each in study.methods:
        times_s = (each.build_s, each.factor_s, each.solve_s, each.total_s, each.again_s)
        counts = str(each.iterations), f"{each.factor.nnz:,}"
        rows.append(
            (each.method, *(f"{1e3 * time_s:.2f}" for time_s in times_s), *counts, f"{each.difference:.1e}")
        )
    return rows if len(study.methods) > 1 else [row[:-1] for row in rows]


def text_of(study: Study) -> str:
    """The whole study for a terminal."""
    lines = [study.name, *(f"  {label:<16}{value}" for label, value in study.facts.items())]
    lines += [f"  {label:<16}{value}" for label, value in accuracy_lines(study)]
    lines.append(f"  {'A':<16}{size_of(study)}")
    rows = table_of(study)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for method, *figures in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(figures, widths[1:], strict=True)]
        lines.append("  ".join(["", f"{method:<{widths[0]}}", *cells]))
    return "\n".join(lines)


def size_of(study: Study) -> str:
    """Size of A as text."""
    rows, columns = study.system.pattern.shape
    entries = counted(len(study.system.values), "entry", "entries")
    build = f"assembled in {1e3 * study.build_s:.1f} ms"
    return f"{counted(rows, 'row')}, {counted(columns, 'column')}, {entries}, {build}"


def accuracy_lines(study: Study) -> list[tuple[str, str]]:
    """Label and value of the accuracy before and after, and how it is defined."""
    return [
        ("before", _accuracy(study.before)),
        ("after", _accuracy(study.after)),
        ("accuracy", study.after.definition),
    ]


def tree_of(study: Study) -> dict[str, object]:
    """The figures for JSON."""
    rows, columns = study.system.pattern.shape
    names = ("method", "build_s", "factor_s", "solve_s", "again_s", "iterations")
    return {
        "name": study.name,
        "facts": study.facts,
        "converged": study.converged,
        "before": _figures(study.before),
        "after": _figures(study.after),
        "A": {"rows": rows, "columns": columns, "entries": len(study.system.values), "build_s": study.build_s},
        "methods": [
            {
                **{name: getattr(method, name) for name in names},
                "factor": method.factor.name,
                "factor_entries": method.factor.nnz,
                "difference": method.difference,
            }
            for method in study.methods
        ],
    }


def write_estimate(directory: Path, study: Study) -> None:
    """Poses and landmarks with their covariances as CSV, and the poses as TUM where they have stamps."""
    stem, state, covariance = directory / file_stem(study.name), study.after.state, study.covariance
    _write_csv(f"{stem}_poses.csv", "pose", np.arange(len(state.poses)), state.poses, covariance.poses)
    names = study.system.pattern.layout.landmarks
    _write_csv(f"{stem}_landmarks.csv", "landmark", names, state.landmarks, covariance.landmarks)
    if study.trajectory is not None:
        write_tum(Path(f"{stem}.tum"), study.trajectory, force=True)


def _write_csv(path: str, kind: str, numbers: np.ndarray, values: Matrix, covariance: Matrix) -> None:
    """One line each: number, values, upper triangle of the covariance."""
    names = ["x_m", "y_m", "heading_rad"][: values.shape[1]]
    rows, columns = np.triu_indices(len(names))
    header = [kind, *names, *(f"cov_{names[i]}_{names[j]}" for i, j in zip(rows, columns, strict=True))]
    table = np.column_stack([numbers, values, covariance[:, rows, columns]])
    np.savetxt(path, table, ["%d"] + (table.shape[1] - 1) * ["%.9g"], ",", header=",".join(header), comments="")


def _accuracy(estimate: Estimate) -> str:
    poses, landmarks = (
        "unknown" if math.isnan(error_m) else f"{error_m:.4f} m off"
        for error_m in (estimate.poses_m, estimate.landmarks_m)
    )
    return "unknown" if poses == landmarks == "unknown" else f"poses {poses}, landmarks {landmarks}"


def _figures(estimate: Estimate) -> dict[str, float | str | None]:
    return {
        "poses_m": None if math.isnan(estimate.poses_m) else estimate.poses_m,
        "landmarks_m": None if math.isnan(estimate.landmarks_m) else estimate.landmarks_m,
        "definition": estimate.definition,
    }
