"""batch.parquet, one row a log, and summary.txt."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from scanchain.batch.task import Row, State
from scanchain.errors import counted, duration
from scanchain.files import write_whole
from scanchain.runs.metrics import Metrics
from scanchain.verdict import Verdict

TABLE_FILE, SUMMARY_FILE = "batch.parquet", "summary.txt"
_NUMBERS = (
    "scans", "dimension", "ok", "contradicted", "degenerate", "lost", "keyframes", "closures_tried",
    "closures_rejected_by_verification", "closures_verified", "closures_rejected_by_back_end", "closures_accepted",
    "degrees_of_freedom",
)  # fmt: skip
_FIGURES = ("log_span_s", "run_s", "scans_per_s", "times_real_time", "traveled_m", "chi2", "median_residual_m")
_ERRORS = ("ate_rmse_m", "ate_share_of_path", "kitti_translation_share", "kitti_rotation_rad_per_m")


def write_table(folder: Path, rows: Sequence[Row]) -> str:
    """Write table and summary, each whole or not at all; the summary's text."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema(
        [(name, pa.string()) for name in ("log", "sha256", "key", "run", "state", "reason", "verdict")]
        + [(name, pa.int64()) for name in ("warnings", "tries")]
        + [(name, pa.float64()) for name in ("duration_s", "peak_mib")]
        + [(name, pa.int64()) for name in _NUMBERS]
        + [(name, pa.float64()) for name in (*_FIGURES, *_ERRORS, "odometry_ate_rmse_m")]
    )
    notes = {
        "warnings": "warnings in the run's metrics.json: data lost, skipped or wrong",
        "run": "directory of the result, beside this file; empty where there is none",
        "duration_s, peak_mib": "of the whole process of the last try",
        "ate_*, kitti_*": "against the ground truth in the log, after optimization; null without any",
    }
    table = pa.Table.from_pylist([_cells(row) for row in rows], schema=schema.with_metadata(notes))
    data, text = io.BytesIO(), summary(rows)
    pq.write_table(table, data, compression="zstd")
    write_whole(folder / TABLE_FILE, data.getvalue())
    write_whole(folder / SUMMARY_FILE, text.encode())
    return text


def summary(rows: Sequence[Row]) -> str:
    """Totals, each log without a result and its reason, each log with stretches to check or warnings."""
    lines = [f"{name:<14} {text}" for name, text in totals(rows)]
    lines += [f"{row.state:<14} {row.log}: {row.why}" for row in rows if row.state is not State.DONE]
    lines += [
        f"{'check':<14} {row.log}: {row.metrics.verdict_reason}"
        for row in rows
        if row.metrics is not None and row.metrics.verdict is Verdict.CHECK
    ]
    for row in rows:
        if row.metrics is not None and row.warnings:
            more = f" (and {row.warnings - 1:,} more)" if row.warnings > 1 else ""
            lines.append(f"{'warned':<14} {row.log}: {row.metrics.warnings[0].replace(f'{row.log}: ', '')}{more}")
    return "\n".join(lines) + "\n"


def totals(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Totals of a batch as pairs of name and text: states of the logs, scans, speed, ATE."""
    counts = Counter(row.state for row in rows)
    ended = ", ".join(f"{counts[state]:,} {state}" for state in State if counts[state])
    results = [row.metrics for row in rows if row.metrics is not None]
    warned = sum(bool(row.warnings) for row in rows)
    warnings = [("warnings", f"in {counted(warned, 'log')}, listed in summary.txt")] if warned else []
    return [("logs", f"{len(rows):,}: {ended}"), *warnings, *(_amounts(results) if results else ())]


def _amounts(results: Sequence[Metrics]) -> Iterator[tuple[str, str]]:
    scans, contradicted, degenerate, lost = (
        sum(getattr(each, name) for each in results) for name in ("scans", "contradicted", "degenerate", "lost")
    )
    traveled_m = sum(each.traveled_m for each in results)
    path = f"{traveled_m:.1f} m" if traveled_m < 1000.0 else f"{1e-3 * traveled_m:.2f} km"
    time = duration(sum(each.log_span_s for each in results))
    speed = np.array([each.times_real_time for each in results])
    yield (
        "scans",
        f"{scans:,}, {contradicted:,} contradicted, {degenerate:,} degenerate, {lost:,} lost, "
        f"over {path} and {time}",
    )
    yield "speed", f"{np.median(speed):.1f} x real time (median), {speed.min():.1f} at the least"
    errors_m = [each.ground_truth.optimized.ate_rmse_m for each in results if each.ground_truth is not None]
    if errors_m:
        yield (
            "ATE",
            f"rmse {np.median(errors_m):.4f} m (median), {max(errors_m):.4f} m at the most, "
            f"{counted(len(errors_m), 'log')} with ground truth",
        )


def _cells(row: Row) -> dict[str, object]:
    """Cells by column, and more; what a log without result or ground truth lacks becomes null."""
    cells = msgspec.to_builtins(row)
    metrics = cells["metrics"] or {}
    truth = metrics.get("ground_truth") or {"optimized": {}, "odometry": {}}
    figures = metrics | truth["optimized"] | {"odometry_ate_rmse_m": truth["odometry"].get("ate_rmse_m")}
    return figures | cells | {"warnings": row.warnings}
