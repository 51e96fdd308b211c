"""The tables of a run's report: how far off it was, and what it took."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scanchain.runs.metrics import Accuracy, GroundTruth, Metrics
from scanchain.runs.step_table import STAGES
from scanchain.viz.report.page import Cell, Grid, Head, Row, Section
from scanchain.words import counted


def accuracy_section(truth: GroundTruth) -> Section:
    """How far off both ways were."""
    rows = tuple(
        Row(
            name, tuple(Cell(text, is_bad=bool(complaint) and k == 0) for k, text in enumerate(_figures(accuracy)))
        )
        for name, accuracy, complaint in (
            ("optimized", truth.optimized, truth.complaint),
            ("odometry", truth.odometry, ""),
        )
    )
    heads = (
        Head("way"), Head("ATE", "m", "rmse"), Head("ATE mean", "m"), Head("ATE max", "m"), Head("ATE/path", "%"),
        Head("ATE rot.", "deg", "rmse"), Head("KITTI", "%"), Head("KITTI rot.", "deg/m"),
    )  # fmt: skip
    missing = f", {truth.optimized.missing}" if truth.optimized.missing else ""
    text = (
        f"Against {truth.source}, {truth.path_length_m:.1f} m: {counted(truth.optimized.pairs, 'scan')}{missing}."
    )
    return Section("Accuracy", text, grid=Grid(heads, rows, (truth.optimized.definition,)))


def stages_section(metrics: Metrics) -> Section:
    """Time by stage."""
    heads = (Head("stage"), *(Head(stage, "ms") for stage in STAGES), Head("all but read", "ms"))
    names = (*STAGES, "all_but_read")
    rows = [
        Row(name, tuple(Cell(f"{figures_ms[stage]:.2f}") for stage in names))
        for name, figures_ms in (("median", metrics.median_ms), ("95th percentile", metrics.p95_ms))
    ]
    return Section("Time of a scan", grid=Grid(heads, tuple(rows)))


def _figures(accuracy: Accuracy) -> Iterator[str]:
    for value, scale, digits in (
        (accuracy.ate_rmse_m, 1.0, 4),
        (accuracy.ate_mean_m, 1.0, 4),
        (accuracy.ate_max_m, 1.0, 4),
        (accuracy.ate_share_of_path, 100.0, 3),
        (accuracy.ate_rotation_rmse_rad, np.degrees(1.0), 3),
        (accuracy.kitti_translation_share, 100.0, 3),
        (accuracy.kitti_rotation_rad_per_m, np.degrees(1.0), 4),
    ):
        yield "–" if value is None else f"{scale * value:.{digits}f}"
