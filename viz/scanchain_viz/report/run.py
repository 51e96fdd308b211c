"""report.html of a run, made of the files in its directory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scanchain import lie
from scanchain.data import Matrix, Trajectory
from scanchain.errors import counted
from scanchain.evaluation import absolute_error_of_any_path, pair
from scanchain.evaluation.absolute import path_length
from scanchain.maps import read_ply
from scanchain.runs.directory import RUN_FILE, TRUTH_FILE
from scanchain.runs.metrics import VERDICT, Accuracy, GroundTruth, Metrics
from scanchain.runs.provenance import Provenance
from scanchain.runs.results import OVERLAY_FILE, read_overlay
from scanchain.runs.step_table import STAGES, nees_of_steps
from scanchain.runs.vouching import poses_of
from scanchain.settings import read_layer
from scanchain.trajectory import read_tum
from scanchain.verdict import VELOCITY_LIMIT, WHEEL_LIMIT, Kind
from scanchain_viz.pictures.map_figures import AFTER, BEFORE, overlay_picture
from scanchain_viz.pictures.trajectory_figures import DrawnTrajectory, Floats, color_of, innovations, window
from scanchain_viz.report import page, sections
from scanchain_viz.report.trajectory_map import SCRIPT, Tables, trajectory_section

_CURVES = {
    "wheel_innovation": ("wheels", WHEEL_LIMIT),
    "velocity_innovation": ("constant velocity", VELOCITY_LIMIT),
}
_SHADE = "#d6308f"
_MAX_ROWS = 100  # largest number of stretches in the table; the longest


def write_run_report(directory: Path) -> None:
    """Draw and write the page of a run directory."""
    metrics = msgspec.json.decode((directory / "metrics.json").read_bytes(), type=Metrics)
    made = msgspec.json.decode((directory / RUN_FILE).read_bytes(), type=Provenance)
    heading, *notes = _summary_lines(directory)
    whole = page.Page(
        title=f"Run of {', '.join(Path(log.path).name for log in made.logs)}",
        subtitle=heading,
        facts=tuple(_facts(metrics, made)),
        warnings=tuple(line for line in (made.stopped, *metrics.warnings) if line),
        notes=tuple(notes),
        sections=tuple(_sections(directory, metrics)),
        collapsibles=(
            *sections.provenance_sections(made, {}),
            page.Collapsible(
                "Configuration", (directory / "config.toml").read_text(encoding="utf-8"), is_long=True
            ),
        ),
        script=SCRIPT,
        judged=metrics.judged,
    )
    page.write_page(directory / page.REPORT_FILE, whole)


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


def _sections(directory: Path, metrics: Metrics) -> Iterator[page.Section]:
    """Accuracy, trajectory and map, closures, errors, uncertainty; time last."""
    steps = pq.ParquetFile(directory / "steps.parquet").read()  # read_table imports much more
    truth_file, config = directory / TRUTH_FILE, read_layer(directory / "config.toml")
    truth = read_tum(truth_file) if truth_file.exists() and metrics.ground_truth is not None else None
    gap_s = None if metrics.ground_truth is None else metrics.ground_truth.max_gap_s
    trajectories, true_path = _trajectories(steps, truth, gap_s)
    if metrics.ground_truth is not None:
        yield accuracy_section(metrics.ground_truth)
    is_planar = metrics.dimension == 2
    loops_file, points = directory / "loops.parquet", read_ply(directory / "map.ply")
    grain_m = float(str(config["maps.voxel_size_m"]))
    tables = Tables.read(steps, loops_file, metrics.stretches)
    yield trajectory_section(trajectories[0], tables, true_path, points, grain_m)
    yield verdict_section(metrics, steps, directory / OVERLAY_FILE)
    if config["loops.enabled"]:
        yield from sections.loop_section(
            trajectories[0], loops_file, "Loop closures", float(str(config["loops.min_travel_m"]))
        )
    text = (
        "Odometry and ground truth are aligned to the optimized trajectory as for the ATE."
        if truth is not None
        else ""
    )
    yield sections.trajectories_section(trajectories, trajectories, true_path, is_planar=is_planar, text=text)
    if metrics.ground_truth is not None:
        yield from sections.error_section(trajectories, metrics.ground_truth.source)
    yield from sections.uncertainty_section(trajectories[:1], is_planar=is_planar)
    yield from sections.time_section(trajectories[:1], _stages(metrics))


def _trajectories(
    steps: pa.Table, truth: Trajectory | None, gap_s: float | None
) -> tuple[list[DrawnTrajectory], Floats | None]:
    """Both trajectories and the (K, 3) true positions at scans that have one, in the frame of the map.

    Errors are NaN where a scan has no true pose. More true positions would lengthen the path by their noise.
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
    seconds = np.sum([steps[f"{stage}_s"].to_numpy() for stage in STAGES[1:]], axis=0)  # without reading
    observability = steps["observability"].to_numpy()

    def drawn(name: str, color: str, poses: Matrix, errors_m: Floats, *figures: Floats) -> DrawnTrajectory:
        length_m, none = path_length(poses), np.empty(0)
        return DrawnTrajectory(name, color, False, poses[:, :3, 3], length_m, errors_m, none, *figures)

    return [
        drawn("optimized", color_of(0), optimized.poses, errors_m, seconds, nees, observability),
        drawn("odometry", color_of(3), T_world_estimate @ odometry.poses, errors_before_m, *[unknown] * 3),
    ], true_path


def verdict_section(metrics: Metrics, steps: pa.Table, overlay_file: Path) -> page.Section:
    """Innovations along the log, two passes over the worst place if there is one, and every suspicious stretch."""
    curves = {
        name: (steps[column].to_numpy(zero_copy_only=False).astype(np.float64) / limit, color_of(place))
        for place, (column, (name, limit)) in enumerate(_CURVES.items())
        if column in steps.column_names
    }
    shaded = [(each.first, each.last, _SHADE) for each in metrics.stretches if each.kind is not Kind.LOOPS]
    chips = (
        *(page.Chip(name, color) for name, (_, color) in curves.items()),
        *((page.Chip("stretches to check", _SHADE),) if shaded else ()),
    )
    is_alone, size = not overlay_file.exists(), window(len(steps))
    largest = f", largest of {size} neighboring scans" if size > 1 else ""
    drawing = page.Drawing(
        "Innovations",
        f"Normalized innovations over their limits{largest}; above 1 (dotted) is a finding, or wheels that slip.",
        innovations(curves, shaded, is_wide=is_alone),
        is_wide=is_alone,
    )
    drawings = [drawing]
    if not is_alone:
        overlay = read_overlay(overlay_file)
        chips += (page.Chip("scans before", BEFORE), page.Chip("scans after", AFTER))
        caption = (
            f"{overlay.text}: the scans before it and after it, or of both passes of a loop, where the trajectory "
            "places them, seen from above. Where it is right, both show the same walls."
        )
        drawings.append(page.Drawing("Worst place", caption, overlay_picture(overlay)))
    heads = (
        *map(page.Head, ("finding", "first", "last", "scans")),
        page.Head("start", "s"), page.Head("end", "s"), page.Head("size", "m"),
    )  # fmt: skip
    longest = sorted(metrics.stretches, key=lambda each: each.last - each.first, reverse=True)[:_MAX_ROWS]
    rows = tuple(
        page.Row(
            str(each.kind),
            (
                *(f"{scan:,}" for scan in (each.first, each.last, each.scans)),
                *(f"{time_s:.1f}" for time_s in (each.start_s, each.end_s)),
                page.figure(each.size_m, 1.0, 2),
            ),
        )
        for each in sorted(longest, key=lambda each: each.first)
    )
    return page.Section("Checks", "", chips, tuple(drawings), page.Grid(heads, rows) if rows else None)


def accuracy_section(truth: GroundTruth) -> page.Section:
    """Accuracy of both trajectories."""
    ate, *others = _figures(truth.optimized)
    rows = (
        page.Row("optimized", (page.Cell(ate, is_bad=bool(truth.complaint)), *others)),
        page.Row("odometry", tuple(_figures(truth.odometry))),
    )
    heads = (
        page.Head("trajectory"), page.Head("ATE", "m", "rmse"), page.Head("ATE mean", "m"),
        page.Head("ATE max", "m"), page.Head("ATE/path", "%"), page.Head("ATE rot.", "deg", "rmse"),
        page.Head("KITTI", "%"), page.Head("KITTI rot.", "deg/m"),
    )  # fmt: skip
    missing = f", {truth.optimized.missing}" if truth.optimized.missing else ""
    text = (
        f"Against {truth.source}, {truth.path_length_m:.1f} m: {counted(truth.optimized.pairs, 'scan')}{missing}."
    )
    definitions = (truth.optimized.definition, truth.optimized.kitti_definition)
    return page.Section("Accuracy", text, grid=page.Grid(heads, rows, tuple(filter(None, definitions))))


def _stages(metrics: Metrics) -> page.Grid:
    """Time of a scan by stage."""
    heads = (page.Head("stage"), *(page.Head(stage, "ms") for stage in STAGES), page.Head("all but read", "ms"))
    names = (*STAGES, "all_but_read")
    rows = [
        page.Row(name, tuple(f"{figures_ms[stage]:.2f}" for stage in names))
        for name, figures_ms in (("median", metrics.median_ms), ("95th percentile", metrics.p95_ms))
    ]
    return page.Grid(heads, tuple(rows))


def _figures(accuracy: Accuracy) -> Iterator[str]:
    yield from (
        page.figure(value, 1.0, 4) for value in (accuracy.ate_rmse_m, accuracy.ate_mean_m, accuracy.ate_max_m)
    )
    yield page.figure(accuracy.ate_share_of_path, 100.0, 3)
    yield page.figure(accuracy.ate_rotation_rmse_rad, np.degrees(1.0), 3)
    yield page.figure(accuracy.kitti_translation_share, 100.0, 3)
    yield page.figure(accuracy.kitti_rotation_rad_per_m, np.degrees(1.0), 4)
