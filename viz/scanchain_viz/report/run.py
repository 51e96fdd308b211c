"""report.html of a run, made of the files in its directory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scanchain import lie
from scanchain.data import Pose, Trajectory
from scanchain.errors import counted
from scanchain.evaluation import absolute_error_of_any_path, pair
from scanchain.evaluation.absolute import path_length
from scanchain.maps import read_ply
from scanchain.runs.directory import RUN_FILE, TRUTH_FILE
from scanchain.runs.metrics import VERDICT, Accuracy, GroundTruth, Metrics
from scanchain.runs.overlay import OVERLAY_FILE
from scanchain.runs.provenance import Provenance
from scanchain.runs.step_table import STAGES, nees_of_steps
from scanchain.runs.vouching import poses_of
from scanchain.settings import read_layer
from scanchain.trajectory import read_tum
from scanchain_viz.pictures.trajectory_figures import DrawnTrajectory, Floats, color_of
from scanchain_viz.report.checks import verdict_section
from scanchain_viz.report.page import REPORT_FILE, Cell, Collapsible, Grid, Head, Page, Row, Section, write_page
from scanchain_viz.report.sections import (
    error_section,
    loop_section,
    provenance_sections,
    time_section,
    trajectories_section,
    uncertainty_section,
)
from scanchain_viz.report.trajectory_map import SCRIPT, Tables, trajectory_section


def write_run_report(directory: Path) -> None:
    """Draw and write the page of a run directory."""
    metrics = msgspec.json.decode((directory / "metrics.json").read_bytes(), type=Metrics)
    made = msgspec.json.decode((directory / RUN_FILE).read_bytes(), type=Provenance)
    heading, *notes = _summary_lines(directory)
    page = Page(
        title=f"Run of {', '.join(Path(log.path).name for log in made.logs)}",
        subtitle=heading,
        facts=tuple(_facts(metrics, made)),
        warnings=tuple(line for line in (made.stopped, *metrics.warnings) if line),
        notes=tuple(notes),
        sections=tuple(_sections(directory, metrics)),
        collapsibles=(
            *provenance_sections(made, {}),
            Collapsible("Configuration", (directory / "config.toml").read_text(encoding="utf-8"), is_long=True),
        ),
        script=SCRIPT,
        judged=metrics.judged,
    )
    write_page(directory / REPORT_FILE, page)


def _summary_lines(directory: Path) -> list[str]:
    """The summary's heading, then its notes."""
    lines = (directory / "summary.txt").read_text(encoding="utf-8").splitlines()
    heading, *lines = [line for line in lines if not line.startswith(VERDICT)]
    return [heading, *(line.removeprefix("note").strip() for line in lines if line.startswith("note"))]


def _facts(m: Metrics, made: Provenance) -> Iterator[tuple[str, str]]:
    """Facts of a run: the result first, its cost last."""
    yield "trajectory", f"{m.traveled_m:.1f} m, {counted(m.keyframes, 'keyframe')}"
    yield "accuracy", _accuracy(m)
    yield "expected ATE", m.expected_ate
    yield "scans", f"{m.scans:,} over {m.log_span_s:.1f} s, {m.dimension}D"
    yield "state", f"{m.ok:,} ok, {m.contradicted:,} contradicted, {m.degenerate:,} degenerate, {m.lost:,} lost"
    yield "pose graph", m.fit
    yield "loop closures", m.closures
    yield (
        "matching",
        f"{100.0 * m.median_inlier_share:.0f} % inliers, residual {m.residual} (medians)",
    )
    yield "map", counted(m.map_points, "point")
    yield "configuration", made.configuration
    yield "speed", f"{counted(round(m.scans_per_s), 'scan')}/s, {m.times_real_time:.1f} × real time{m.compiling}"
    yield "machine", f"{made.platform}, {made.cores} cores"


def _accuracy(m: Metrics) -> str:
    if m.ground_truth is None:
        return "unknown: no ground truth"
    error = m.ground_truth.optimized
    share = "" if error.ate_share_of_path is None else f", {100.0 * error.ate_share_of_path:.3f} % of the path"
    return f"ATE {error.ate_rmse_m:.4f} m{share}"


def _sections(directory: Path, metrics: Metrics) -> Iterator[Section]:
    """Accuracy, trajectory and map, closures, errors, uncertainty; time last."""
    steps = pq.ParquetFile(directory / "steps.parquet").read()  # read_table imports much more
    stamps_ns = steps["stamp_ns"].to_numpy()
    trajectory, odometry = (Trajectory(stamps_ns, poses_of(steps, prefix)) for prefix in ("", "odom_"))
    truth_file, config = directory / TRUTH_FILE, read_layer(directory / "config.toml")
    truth = read_tum(truth_file) if truth_file.exists() and metrics.ground_truth is not None else None
    gap_s = None if metrics.ground_truth is None else metrics.ground_truth.max_gap_s
    optimized, before = (_against(each, truth, gap_s) for each in (trajectory, odometry))
    nees = None if truth is None else nees_of_steps(steps, odometry, truth, gap_s=gap_s)
    T_world_truth = lie.inverse(optimized.T_truth_estimate)
    trajectories = [
        _drawn("optimized", 0, trajectory, lie.identity(3), optimized, steps, nees),
        _drawn("odometry", 3, odometry, T_world_truth @ before.T_truth_estimate, before, None, None),
    ]
    if metrics.ground_truth is not None:
        yield accuracy_section(metrics.ground_truth)
    is_planar = metrics.dimension == 2
    true_path = None if truth is None else lie.transform(T_world_truth, optimized.truth)
    loops_file, points = directory / "loops.parquet", read_ply(directory / "map.ply")
    grain_m = float(str(config["maps.voxel_size_m"]))
    tables = Tables.read(steps, loops_file, metrics.stretches)
    yield trajectory_section(trajectories[0], tables, true_path, points, grain_m)
    yield verdict_section(metrics, steps, directory / OVERLAY_FILE)
    if config["loops.enabled"]:
        yield from loop_section(
            trajectories[0], loops_file, "Loop closures", float(str(config["loops.min_travel_m"]))
        )
    text = (
        "Odometry and ground truth are aligned to the optimized trajectory as for the ATE."
        if truth is not None
        else ""
    )
    yield trajectories_section(trajectories, trajectories, true_path, is_planar=is_planar, text=text)
    if metrics.ground_truth is not None:
        yield from error_section(trajectories, metrics.ground_truth.source)
    yield from uncertainty_section(trajectories[:1], is_planar=is_planar)
    yield from time_section(trajectories[:1], _stages(metrics))


@dataclass(frozen=True, slots=True)
class _Off:
    """A trajectory against the ground truth: its alignment, and errors (N,) in meters, NaN without a true pose.

    ``truth`` : (K, 3) true positions at the scans that have one; more would lengthen the path by their noise
    """

    T_truth_estimate: Pose
    errors_m: Floats
    truth: Floats


def _against(trajectory: Trajectory, truth: Trajectory | None, gap_s: float | None) -> _Off:
    errors_m = np.full(len(trajectory), np.nan)
    if truth is None:
        return _Off(np.eye(4), errors_m, np.empty((0, 3)))
    pairs = pair(trajectory, truth, gap_s=gap_s)
    ate = absolute_error_of_any_path(pairs)
    errors_m[pairs.places] = ate.errors_m
    return _Off(ate.T_reference_estimate, errors_m, pairs.reference[:, :3, 3])


def _drawn(
    name: str, place: int, trajectory: Trajectory, T_world_estimate: Pose, off: _Off, steps: pa.Table | None,
    nees: Floats | None,
) -> DrawnTrajectory:  # fmt: skip
    """One of the two trajectories in the frame of the map; figures of the scans belong to the first."""
    unknown = np.full(len(trajectory), np.nan)
    poses = T_world_estimate @ trajectory.poses
    return DrawnTrajectory(
        name=name,
        color=color_of(place),
        is_dashed=False,
        positions=poses[:, :3, 3],
        distance_m=path_length(poses),
        error_m=off.errors_m,
        relation_error_m=np.empty(0),
        seconds=unknown if steps is None else _seconds(steps),
        nees=unknown if nees is None else nees,
        observability=unknown if steps is None else steps["observability"].to_numpy(),
    )


def _seconds(steps: pa.Table) -> Floats:
    """All stages but reading."""
    return np.sum([steps[f"{stage}_s"].to_numpy() for stage in STAGES[1:]], axis=0)


def accuracy_section(truth: GroundTruth) -> Section:
    """Accuracy of both trajectories."""
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
        Head("trajectory"), Head("ATE", "m", "rmse"), Head("ATE mean", "m"), Head("ATE max", "m"),
        Head("ATE/path", "%"), Head("ATE rot.", "deg", "rmse"), Head("KITTI", "%"), Head("KITTI rot.", "deg/m"),
    )  # fmt: skip
    missing = f", {truth.optimized.missing}" if truth.optimized.missing else ""
    text = (
        f"Against {truth.source}, {truth.path_length_m:.1f} m: {counted(truth.optimized.pairs, 'scan')}{missing}."
    )
    definitions = (truth.optimized.definition, truth.optimized.kitti_definition)
    return Section("Accuracy", text, grid=Grid(heads, rows, tuple(filter(None, definitions))))


def _stages(metrics: Metrics) -> Grid:
    """Time of a scan by stage."""
    heads = (Head("stage"), *(Head(stage, "ms") for stage in STAGES), Head("all but read", "ms"))
    names = (*STAGES, "all_but_read")
    rows = [
        Row(name, tuple(Cell(f"{figures_ms[stage]:.2f}") for stage in names))
        for name, figures_ms in (("median", metrics.median_ms), ("95th percentile", metrics.p95_ms))
    ]
    return Grid(heads, tuple(rows))


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
