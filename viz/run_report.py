"""report.html of a run, made of what lies in its directory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline import lie
from pipeline.data import Pose, Trajectory
from pipeline.errors import InputError
from pipeline.evaluate import Pairs, align, pair
from pipeline.evaluate.absolute import path_length
from pipeline.evaluate.alignment import Alignment
from pipeline.maps import read_ply
from pipeline.runs.consistency import nees_of_steps
from pipeline.runs.directory import RUN_FILE
from pipeline.runs.metrics import Metrics
from pipeline.runs.provenance import Provenance
from pipeline.runs.run import TRUTH_FILE
from pipeline.runs.step_table import STAGES
from pipeline.settings import read_layer
from pipeline.trajectory import read_tum
from viz import course_figures as figures
from viz.course_sections import error_section, knowledge_section, loop_section, time_section, way_section
from viz.courses import Course, Floats, colour_of
from viz.map_figures import AROUND_M, map_picture
from viz.provenance_folds import provenance_folds
from viz.report import REPORT_FILE, Cell, Drawing, Fold, Grid, Head, Page, Row, Section, write_page


def write_run_report(directory: Path) -> None:
    """Draw and write the page of a run directory."""
    metrics = msgspec.json.decode((directory / "metrics.json").read_bytes(), type=Metrics)
    made = msgspec.json.decode((directory / RUN_FILE).read_bytes(), type=Provenance)
    heading, *notes = _summary_lines(directory)
    page = Page(
        title=f"Run of {', '.join(Path(log.path).name for log in made.logs)}",
        subtitle=heading,
        facts=tuple(_facts(metrics, made)),
        warnings=(made.stopped,) if made.stopped else (),
        grid_title="Time of a scan",
        grid=_stages(metrics),
        legend=tuple(notes),
        sections=tuple(_sections(directory, metrics)),
        folds=(
            *provenance_folds(made, {}),
            Fold("Configuration", (directory / "config.toml").read_text(encoding="utf-8")),
        ),
    )
    write_page(directory / REPORT_FILE, page)


def _summary_lines(directory: Path) -> list[str]:
    """The summary's heading, then its notes."""
    heading, *lines = (directory / "summary.txt").read_text(encoding="utf-8").splitlines()
    return [heading, *(line.removeprefix("note").strip() for line in lines if line.startswith("note"))]


def _facts(m: Metrics, made: Provenance) -> Iterator[tuple[str, str]]:
    yield "scans", f"{m.scans:,} over {m.log_span_s:.1f} s, {m.dimension}D"
    yield "state", f"{m.ok:,} ok, {m.degenerate:,} degenerate, {m.lost:,} lost"
    yield "way", f"{m.travelled_m:.1f} m, {m.keyframes:,} keyframes"
    yield "loop closures", f"{m.closures_tried:,} tried, {m.closures_accepted:,} accepted"
    yield "speed", f"{m.scans_per_s:.0f} scans/s, {m.times_real_time:.1f} × real time"
    residual = "" if m.median_residual_m is None else f", {1e3 * m.median_residual_m:.1f} mm"
    yield "matching", f"{100.0 * m.median_inlier_share:.0f} % inliers{residual} (medians)"
    if m.ground_truth is not None:
        truth = m.ground_truth
        yield "ATE", f"{truth.optimised.ate_rmse_m:.4f} m over {truth.path_length_m:.1f} m, against {truth.source}"
        if truth.optimised.kitti_translation_share is not None:
            yield "KITTI", f"{100.0 * truth.optimised.kitti_translation_share:.3f} %"
    yield "configuration", made.configuration
    yield "machine", f"{made.platform}, {made.cores} cores"


def _stages(metrics: Metrics) -> Grid:
    """Time by stage."""
    heads = (Head("stage"), *(Head(stage, "ms") for stage in STAGES), Head("all but read", "ms"))
    names = (*STAGES, "all_but_read")
    rows = [
        Row(name, tuple(Cell(f"{figures_ms[stage]:.2f}") for stage in names))
        for name, figures_ms in (("median", metrics.median_ms), ("95th percentile", metrics.p95_ms))
    ]
    return Grid(heads, tuple(rows))


def _sections(directory: Path, metrics: Metrics) -> Iterator[Section]:
    steps = pq.read_table(directory / "steps.parquet")
    trajectory, odometry = _trajectory(steps, ""), _trajectory(steps, "odom_")
    truth_file = directory / TRUTH_FILE
    truth = read_tum(truth_file) if truth_file.exists() and metrics.ground_truth is not None else None
    T = np.eye(4) if truth is None else _alignment(pair(trajectory, truth))
    courses = [
        _course("optimised", 0, trajectory, truth, T, steps),
        _course("odometry", 3, odometry, truth, T if truth is None else _alignment(pair(odometry, truth)), None),
    ]
    is_planar = metrics.dimension == 2
    way = None if truth is None else truth.poses[:, :3, 3]
    text = "Each moved onto the truth as for the ATE." if truth is not None else ""
    section = way_section(courses, courses, way, is_planar=is_planar, text=text)
    drawings = (*section.drawings, _map(directory, courses[0], T, metrics.dimension))
    yield replace(section, title="Trajectory and map", drawings=drawings)
    if metrics.ground_truth is not None:
        yield from error_section(courses, metrics.ground_truth.source)
    yield from time_section(courses[:1])
    limit = float(read_layer(directory / "config.toml")["matching.min_information"])
    yield from knowledge_section(courses[:1], limit, is_planar=is_planar)
    yield from loop_section(courses[0], directory / "loops.parquet", "Loop closures")


def _course(
    name: str, place: int, trajectory: Trajectory, truth: Trajectory | None, T: Pose, steps: pa.Table | None
) -> Course:
    """One of the two ways; what is known of the scans belongs to the first."""
    unknown = np.full(len(trajectory), np.nan)
    poses = T @ trajectory.poses
    errors_m = unknown.copy()
    if truth is not None:
        pairs = pair(trajectory, truth)
        aligned = (T @ pairs.estimate)[:, :3, 3]
        errors_m[pairs.indices[:, 0]] = np.linalg.norm(aligned - pairs.reference[:, :3, 3], axis=1)
    return Course(
        name=name,
        colour=colour_of(place),
        is_dashed=False,
        positions=poses[:, :3, 3],
        distance_m=path_length(poses),
        error_m=errors_m,
        seconds=unknown if steps is None else _seconds(steps),
        nees=unknown if steps is None or truth is None else _nees(steps, truth),
        eigenvalue=unknown if steps is None else steps["degeneracy_eigenvalue"].to_numpy(),
    )


def _trajectory(steps: pa.Table, prefix: str) -> Trajectory:
    """The poses of columns whose names begin so."""
    columns = [steps[f"{prefix}{name}"].to_numpy() for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    poses = np.tile(np.eye(4), (len(steps), 1, 1))
    poses[:, :3, :3] = lie.from_quaternion(np.stack(columns[3:], axis=1))
    poses[:, :3, 3] = np.stack(columns[:3], axis=1)
    return Trajectory(steps["stamp_ns"].to_numpy(), poses)


def _alignment(pairs: Pairs) -> Pose:
    """As for the ATE: rigid, or by the first pose where a straight way leaves that open."""
    try:
        return align(pairs.estimate, pairs.reference, Alignment.RIGID)
    except InputError:
        return align(pairs.estimate, pairs.reference, Alignment.FIRST)


def _seconds(steps: pa.Table) -> Floats:
    """All stages but reading."""
    return np.sum([steps[f"{stage}_s"].to_numpy() for stage in STAGES[1:]], axis=0)


def _nees(steps: pa.Table, truth: Trajectory) -> Floats:
    return nees_of_steps(steps, _trajectory(steps, "odom_"), truth)


def _map(directory: Path, course: Course, T: Pose, dimension: int) -> Drawing:
    """The points of the map around the way."""
    low, high = figures.frame([course], None)
    low, high = low - AROUND_M[dimension], high + AROUND_M[dimension]
    points = lie.transform(T, read_ply(directory / "map.ply"))
    picture = map_picture("map", points, low, high, figures.proportions(low, high))
    return Drawing("Map", "map.ply, seen from above.", picture)
