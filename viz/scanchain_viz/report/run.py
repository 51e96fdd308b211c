"""report.html of a run, made from the files in its directory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from scanchain.data import BACK_END, Points
from scanchain.errors import counted
from scanchain.maps import read_ply
from scanchain.runs.directory import RUN_FILE, TRUTH_FILE
from scanchain.runs.metrics import REASON, VERDICT, GroundTruth, Metrics, accuracy_lines, lines_of
from scanchain.runs.provenance import Provenance
from scanchain.settings import read_layer
from scanchain.steps import SENSORS, STAGES
from scanchain.trajectory import read_tum
from scanchain.verdict import CHECKS, Kind, Segment
from scanchain_viz.colors import CLOSURES, OPTIMIZED, SEGMENT_COLORS, TRUTH, color_of
from scanchain_viz.pictures.figure import Floats, Line, Plot, broken
from scanchain_viz.pictures.maps import over_map, surroundings
from scanchain_viz.pictures.trajectories import column_of, frame, trajectories_of_run
from scanchain_viz.report import page, sections

_CURVES = [check for check in CHECKS if check.column and np.isfinite(check.limit)]
_ACCURACY = (  # a column's head, the field of ``Accuracy``, the factor to the head's unit, digits
    (page.Head("ATE", "m", "rmse"), "ate_rmse_m", 1.0, 4),
    (page.Head("ATE mean", "m"), "ate_mean_m", 1.0, 4),
    (page.Head("ATE max", "m"), "ate_max_m", 1.0, 4),
    (page.Head("ATE/path", "%"), "ate_share_of_path", 100.0, 3),
    (page.Head("ATE rot.", "deg", "rmse"), "ate_rotation_rmse_rad", np.degrees(1.0), 3),
    (page.Head("KITTI", "%"), "kitti_translation_share", 100.0, 3),
    (page.Head("KITTI rot.", "deg/m"), "kitti_rotation_rad_per_m", np.degrees(1.0), 4),
)
_SHADE = "#8c9096"
_DISPUTED = "at closures rejected by the back end"
_STATES = (Kind.DEGENERATE, Kind.LOST, Kind.CONTRADICTED)  # kinds that are also states of scans
_OVER_STATES = (Kind.OVERLAP, Kind.WHEELS, Kind.ACCELERATION, Kind.DISCONNECTED, Kind.COPIES)


def write_run_report(directory: Path) -> None:
    """Draw and write the page of a run directory."""
    metrics = msgspec.json.decode((directory / "metrics.json").read_bytes(), type=Metrics)
    made = msgspec.json.decode((directory / RUN_FILE).read_bytes(), type=Provenance)
    lines = (directory / "summary.txt").read_text(encoding="utf-8").splitlines()
    heading, *lines = [line for line in lines if not line.startswith((VERDICT, REASON))]
    whole = page.Page(
        title=f"Run of {', '.join(Path(log.path).name for log in made.logs)}",
        subtitle=heading,
        facts=tuple(_facts(metrics, made)),
        warnings=tuple(line for line in (made.stopped, *metrics.warnings) if line),
        notes=[line.removeprefix("note").strip() for line in lines if line.startswith("note")],
        sections=tuple(_sections(directory, metrics)),
        collapsibles=(*sections.provenance_sections(made, {}), sections.configuration(directory)),
        judged=metrics.judged,
        refuted=metrics.refuted,
    )
    page.write_page(directory, whole)


def _facts(metrics: Metrics, made: Provenance) -> Iterator[tuple[str, str]]:
    """Label and text of the figures, and the origin of the run."""
    yield from lines_of(metrics)
    accuracy = dict(accuracy_lines(metrics.ground_truth))
    yield "ATE", accuracy.get("ATE", "unknown: no ground truth")
    yield "configuration", made.configuration
    yield "machine", f"{made.platform}, {made.cores} cores"
    yield "made", sections.when(made)


def _sections(directory: Path, metrics: Metrics) -> Iterator[page.Section]:
    """Accuracy, trajectory and map, closures, errors, uncertainty; time last."""
    steps = pq.ParquetFile(directory / "steps.parquet").read()  # read_table imports much more
    config, accuracy = read_layer(directory / "config.toml"), metrics.ground_truth
    truth_file, gap_s = directory / TRUTH_FILE, None if accuracy is None else accuracy.max_gap_s
    truth = read_tum(truth_file) if truth_file.exists() and accuracy is not None else None
    trajectories, true_path = trajectories_of_run(steps, truth, gap_s)
    optimized, closures = trajectories[0], sections.read_closures(directory / "loops.parquet")
    if accuracy is not None:
        yield accuracy_section(accuracy)
    lines = trajectory_lines(optimized.positions, steps, closures, metrics.segments, true_path)
    box, grain_m = frame([optimized], true_path), float(str(config["maps.voxel_size_m"]))
    yield map_section(lines, read_ply(directory / "map.ply"), box, grain_m)
    yield verdict_section(metrics, steps)
    yield from sensor_section(steps)
    if config["loops.enabled"]:
        yield from sections.loop_section(optimized, closures, "Loop closures")
    is_planar, text = metrics.dimension == 2, ""
    if truth is not None:
        text = "Odometry and ground truth are aligned to the optimized trajectory as for the ATE."
    yield sections.trajectories_section(trajectories, trajectories, true_path, is_planar=is_planar, text=text)
    if accuracy is not None:
        yield from sections.error_section(trajectories, accuracy.source)
    yield from sections.uncertainty_section([optimized], is_planar=is_planar)
    yield from sections.time_section([optimized], _stages(metrics))


def map_section(lines: Sequence[Line], points: Points, box: Floats, grain_m: float) -> page.Section:
    """The map (M, 3), its points ``grain_m`` apart, and lines within corners (2, 3), the trajectory first."""
    is_flat, path = not len(points) or not np.ptp(points[:, 2]), lines[0].positions
    corners = surroundings(box, [points])
    over = over_map(lines, points, *corners, path=path)
    still = page.Drawing.of("Trajectory over the map", "Seen from above; circle: start, square: end.", over)
    scene = page.interactive_map(points, lines, *corners, grain_m=grain_m, is_flat=is_flat)
    drawings = [replace(still, is_still=True), replace(scene, is_wide=True)]  # the scene shows it from above, too
    return page.Section("Trajectory and map", chips=lines, drawings=drawings)


def trajectory_lines(
    path: Floats, steps: pa.Table, closures: pa.Table | None, segments: Sequence[Segment], truth: Floats | None
) -> list[Line]:
    """The trajectory, closures by verdict, scans to check (one may be in several lines), and the ground truth."""
    lines = [Line("trajectory", path, OPTIMIZED, 1.2)]
    if closures is not None and len(closures):
        lines += _closure_lines(path, closures)
    states = np.array(steps["state"].to_pylist())
    marks = [(_DISPUTED, _disputed(steps, closures), Kind.LOOPS)]
    marks += [(str(kind), states == kind, kind) for kind in _STATES]
    for kind in _OVER_STATES:
        is_marked = np.zeros(len(steps), bool)
        for each in segments:
            is_marked[each.first : each.last + 1] |= each.kind == kind
        marks.append((str(kind), is_marked, kind))
    for name, is_marked, kind in marks:  # later ones are drawn on top
        if is_marked.any():
            name = f"{name}: {counted(int(is_marked.sum()), 'scan')}"
            leads_there = is_marked | np.append(is_marked[1:], False)
            part = np.where(leads_there[:, None], path, np.nan)
            lines.append(Line(name, part, SEGMENT_COLORS[kind], 2.6))
    if truth is not None:
        lines.append(Line("ground truth", truth, TRUTH, 0.9, is_dashed=True))
    return lines


def _closure_lines(path: Floats, closures: pa.Table) -> Iterator[Line]:
    """Closures by verdict with their numbers, as lines over a path (N, 3); only every n-th if there are many."""
    ends = np.stack([closures["target_scan"].to_numpy(), closures["source_scan"].to_numpy()], axis=1)
    rejected_by = np.array(closures["rejected_by"].to_pylist())
    for by, (name, color) in CLOSURES.items():
        chosen = ends[rejected_by == by]
        if len(chosen):
            drawn = chosen[:: -(-len(chosen) // sections.MAX_POINTS)]
            yield Line(f"closures {name}: {len(chosen):,}", broken(path[drawn]), color, 0.9)


def _disputed(steps: pa.Table, closures: pa.Table | None) -> NDArray[np.bool_]:
    """(N,) scans from each keyframe of a closure that the back end rejected to the next keyframe."""
    if closures is None or not len(closures):
        return np.zeros(len(steps), bool)
    keyframe = np.maximum.accumulate(np.where(steps["keyframe"].to_numpy() >= 0, np.arange(len(steps)), -1))
    is_rejected = np.array(closures["rejected_by"].to_pylist()) == BACK_END
    ends = np.stack([closures[name].to_numpy() for name in ("target_scan", "source_scan")])
    return np.isin(keyframe, ends[:, is_rejected])


def verdict_section(metrics: Metrics, steps: pa.Table) -> page.Section:
    """Innovations along the log, relative to their limits, and the segments to check."""
    figure, chips = Plot("scan", "innovation / limit", is_wide=True), []
    shaded = [each for each in metrics.segments if each.kind != Kind.LOOPS]
    for each in shaded:
        figure.span(each.first - 0.5, each.last + 0.5, f"{_SHADE}33")
    for place, check in enumerate(_CURVES):
        if check.column in steps.column_names:
            values = np.nan_to_num(column_of(steps, check.column) / check.limit)
            figure.line(sections.windowed(np.clip(values, *sections.CLIPPED), np.max), color_of(place), 0.9)
            chips.append(page.Chip(check.name, color_of(place)))
    figure.level(1.0)
    chips += [page.Chip("segments to check", _SHADE)] if shaded else []
    size = sections.window(len(steps))
    largest = f", largest of {size} neighboring scans" if size > 1 else ""
    text = f"Normalized innovations over their limits{largest}; above 1 (dotted): a finding, or wheel slip."
    grid = _segments(metrics.segments) if metrics.segments else None
    return page.Section("Checks", "", chips, [page.Drawing.of("Innovations", text, figure)], grid)


def sensor_section(steps: pa.Table) -> Iterator[page.Section]:
    """Normalized innovations of the other sensors along the log; none without any."""
    figure, chips, sizes = Plot("scan", "normalized innovation", logarithmic="y", is_wide=True), [], []
    for place, sensor in enumerate(SENSORS):
        if (name := f"innovation_{sensor.lower()}") in steps.column_names:
            values = column_of(steps, name)
            scans = np.flatnonzero(np.isfinite(values))
            sizes.append(sections.window(len(scans)))
            line = sections.windowed(values[scans], _root_mean_square, scans.astype(np.float64))
            figure.line(np.clip(line, [0.0, sections.CLIPPED[0]], None), color_of(place), 0.9)
            chips.append(page.Chip(sensor, color_of(place)))
    if chips:
        figure.level(1.0)
        size = f", root mean square of {max(sizes)} neighboring ones" if max(sizes) > 1 else ""
        text = f"Normalized innovations{size}: 1 (dotted) on average if the covariances are right."
        yield page.Section("Other sensors", "", chips, [page.Drawing.of("Against the scans", text, figure)])


def _root_mean_square(values: Floats, axis: int) -> Floats:
    return np.sqrt(np.mean(np.square(values), axis=axis))


def _segments(segments: Sequence[Segment]) -> page.Grid:
    """The longest segments, in the order of the log."""
    longest = sorted(segments, key=lambda each: each.last - each.first, reverse=True)[: page.MAX_ROWS]
    rows = []
    for each in sorted(longest, key=lambda each: each.first):
        scans = [f"{number:,}" for number in (each.first, each.last, each.scans)]
        times, size = (f"{each.start_s:.1f}", f"{each.end_s:.1f}"), page.figure(each.size_m, 1.0, 2)
        rows.append(page.Row(str(each.kind), (*scans, *times, size)))
    heads = (
        *map(page.Head, ("finding", "first", "last", "scans")),
        page.Head("start", "s"), page.Head("end", "s"), page.Head("size", "m"),
    )  # fmt: skip
    left = len(segments) - len(rows)
    return page.Grid(heads, rows, [f"and {left:,} shorter ones in metrics.json"] if left else ())


def accuracy_section(truth: GroundTruth) -> page.Section:
    """Accuracy of both trajectories."""
    rows = []
    for name, of in (("optimized", truth.optimized), ("odometry", truth.odometry)):
        ate, *others = (page.figure(getattr(of, key), scale, digits) for _, key, scale, digits in _ACCURACY)
        rows.append(page.Row(name, (page.bad_if(of is truth.optimized and bool(truth.complaint), ate), *others)))
    missing = f", {truth.optimized.missing}" if truth.optimized.missing else ""
    text = (
        f"Against {truth.source}, {truth.path_length_m:.1f} m: {counted(truth.optimized.pairs, 'scan')}{missing}."
    )
    definitions = (truth.optimized.definition, truth.optimized.kitti_definition)
    heads = (page.Head("trajectory"), *(head for head, *_ in _ACCURACY))
    return page.Section("Accuracy", text, grid=page.Grid(heads, tuple(rows), tuple(filter(None, definitions))))


def _stages(metrics: Metrics) -> page.Grid:
    """Time per scan by stage."""
    names = (*STAGES, "all_but_read")
    heads = (page.Head("stage"), *(page.Head(name.replace("_", " "), "ms") for name in names))
    rows = [
        page.Row(name, tuple(f"{figures_ms[stage]:.2f}" for stage in names))
        for name, figures_ms in (("median", metrics.median_ms), ("95th percentile", metrics.p95_ms))
    ]
    return page.Grid(heads, tuple(rows))
