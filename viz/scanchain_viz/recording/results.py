"""Pages and recordings of complete results: comparisons, maps, localized logs; recordings of graphs and landmarks.

Each .rrd file is written completely or not at all. Raises OSError.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from scanchain.comparison.results import MAP_FILE, SCANS_FILE, TRUTH_FILE, method_folder
from scanchain.comparison.table import read_table
from scanchain.data import ClosureVerdict, GraphState
from scanchain.graph.optimization import GraphChange
from scanchain.landmarks.study import Estimate, Study, file_stem
from scanchain.maps import read_ply
from scanchain.runs.directory import RECORDING_FILE, SUMMARY_FILE
from scanchain.sessions.change_run import COLORS
from scanchain.sessions.changes import Changes, Label
from scanchain.sessions.localize import LocalizedLog
from scanchain.trajectory import read_tum
from scanchain_viz.colors import rgb
from scanchain_viz.pictures.maps import DrawnMerge, map_points, read_merge
from scanchain_viz.pictures.trajectories import DrawnTrajectory, trajectories_of_comparison
from scanchain_viz.recording import drawing, entities
from scanchain_viz.recording.drawing import Message, Times
from scanchain_viz.recording.entities import scene, up_to_now, whole_log, with_panels
from scanchain_viz.recording.sinks import write_recording
from scanchain_viz.report import comparison, maps, problems

_PLOTS = (  # name, title, field of a trajectory, factor to the unit
    ("error", "position error [m]", "error_m", 1.0),
    ("time", "time per scan [ms]", "seconds", 1e3),
)
_FLAT_M = 1e-4  # half the height of boxes and ellipses in the plane: none, but rerun draws nothing of that size
_RADII = {  # of points of a map, in UI points: changes stand out
    Label.SAME: 0.75,
    Label.UNKNOWN: 1.0,
    Label.APPEARED: 2.0,
    Label.VANISHED: 2.0,
}
_FINAL, _SIGMA = "world/final", "plots/sigma"
_MATCHED, _UNMATCHED = "world/matches/accepted", "world/matches/rejected"


def present_comparison(directory: Path) -> None:
    """Write report.html and compare.rrd: trajectories and maps of all methods, to toggle one by one."""
    comparison.write_compare_report(directory)
    table, trajectories = read_table(directory), trajectories_of_comparison(directory)
    names = [rr.escape_entity_path_part(each.name) for each in trajectories]
    overrides: dict[Any, Any] = {f"world/{name}/trajectory": [up_to_now()] for name in names}
    overrides |= {f"world/{name}/map": [rrb.EntityBehavior(visible=False)] for name in names[1:]}
    seen = trajectories[0].positions if trajectories else None
    world = scene("trajectories and maps", table.dimension, seen, overrides)
    views = rrb.Vertical(world, rrb.Horizontal(*_plots(trajectories)), row_shares=[2, 1])
    layout = with_panels(views, scans=table.scans, has_toggles=True)
    path, name = directory / "compare.rrd", Path(table.log.split(", ")[0]).name
    write_recording(path, name, table.dimension, layout, _compared(directory, trajectories), kind="comparison")


def _compared(directory: Path, trajectories: Sequence[DrawnTrajectory]) -> Iterator[Message]:
    scans, truth_file = pq.read_table(directory / SCANS_FILE), directory / TRUTH_FILE
    _, first = np.unique(scans["index"].to_numpy(), return_index=True)  # of the method with the most scans
    stamps_ns = scans["stamp_ns"].to_numpy()[first]
    if truth_file.exists():
        path = drawing.positions(read_tum(truth_file).poses)
        yield Message(entities.GROUND_TRUTH, drawing.lines([path], entities.Color.WHITE, 0.75))
    for each in trajectories:
        yield from _of_method(each, method_folder(directory, each.name) / MAP_FILE, stamps_ns)


def _of_method(trajectory: DrawnTrajectory, map_file: Path, stamps_ns: NDArray[np.int64]) -> Iterator[Message]:
    """The trajectory in segments, the lidar on it, the map, and the plots."""
    name = rr.escape_entity_path_part(trajectory.name)
    color, positions = rgb(trajectory.color), trajectory.positions.astype(np.float32)
    times = Times(np.arange(len(positions)), stamps_ns[: len(positions)])
    segments = np.stack([np.concatenate([positions[:1], positions[:-1]]), positions], axis=1)
    places = rr.Points3D.columns(positions=positions).partition([1] * len(positions))
    yield Message(f"world/{name}/trajectory", drawing.lines(color=color, radius=1.5))
    yield Message(f"world/{name}/trajectory", rr.LineStrips3D.columns(strips=segments), times)
    yield Message(f"world/{name}/lidar", drawing.dots(color=color, radius=5.0))
    yield Message(f"world/{name}/lidar", places, times)
    if map_file.exists():
        points = drawing.at_most(read_ply(map_file), 60_000)
        red, green, blue = ((value + shade) // 2 for value, shade in zip(color, entities.Color.GRAY, strict=True))
        yield Message(f"world/{name}/map", drawing.dots(points, (red, green, blue), 0.5))
    for plot, _, field, scale in _PLOTS:
        values = scale * getattr(trajectory, field)
        if (known := np.isfinite(values)).any():
            series = rr.SeriesLines(colors=[color], names=[trajectory.name], widths=[1.0])
            yield Message(f"plots/{plot}/{name}", series)
            yield Message(f"plots/{plot}/{name}", rr.Scalars.columns(scalars=values[known]), times[known])


def _plots(trajectories: Sequence[DrawnTrajectory]) -> list[rrb.TimeSeriesView]:
    """Plots of the known values with one legend, scaled so that a single slow scan leaves the rest visible."""
    views = []
    for plot, name, field, scale in _PLOTS:
        values = np.concatenate([np.empty(0), *(scale * getattr(each, field) for each in trajectories)])
        if np.isfinite(values).any():
            highest = 1.2 * float(np.nanpercentile(values, 99.0))
            legend = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=plot == "time")
            axes = {"axis_x": whole_log(), "axis_y": rrb.ScalarAxis(range=(0.0, highest))}
            views.append(rrb.TimeSeriesView(origin=f"plots/{plot}", name=name, plot_legend=legend, **axes))
    return views


def present_merge(directory: Path) -> None:
    """Write report.html and recording.rrd: map, every session to toggle, the closures between them."""
    maps.write_merge_report(directory)
    drawn = read_merge(directory)
    layout = with_panels(scene("sessions over the map", drawn.dimension, drawn.positions), has_toggles=True)
    path, messages = directory / RECORDING_FILE, _merge(directory, drawn)
    write_recording(path, directory.name, drawn.dimension, layout, messages, kind="merge")


def _merge(directory: Path, drawn: DrawnMerge) -> Iterator[Message]:
    points = drawing.at_most(read_ply(directory / "map.ply"), 300_000)
    yield Message(entities.MAP, drawing.dots(points, entities.Color.GRAY, 0.75))
    yield Message(entities.ACCEPTED, drawing.lines(drawn.closures.astype(np.float32), entities.Color.GREEN, 0.75))
    for session in drawn.sessions:
        color, name = rgb(session.color), rr.escape_entity_path_part(session.name)
        path = session.positions.astype(np.float32)
        yield Message(f"world/sessions/{name}/trajectory", drawing.lines([path], color, 1.5))
        yield Message(f"world/sessions/{name}/keyframes", drawing.dots(path, color, 2.5))


def present_changes(directory: Path, changes: Changes) -> None:
    """Write report.html and recording.rrd next to summary.txt: points by label, boxes around clusters, arrows."""
    maps.write_changes_report(directory, changes)
    world = scene("changes", changes.dimension, drawing.in_space(changes.points))
    text = rrb.TextDocumentView(origin="summary", name="summary")
    layout = with_panels(rrb.Horizontal(world, text, column_shares=[3, 1]))
    path, messages = directory / RECORDING_FILE, _changes(changes, (directory / SUMMARY_FILE).read_text("utf-8"))
    write_recording(path, directory.name, changes.dimension, layout, messages, kind="changes")


def _changes(changes: Changes, summary: str) -> Iterator[Message]:
    yield Message("summary", rr.TextDocument(summary))
    for label, radius in _RADII.items():
        points = drawing.in_space(changes.points[changes.labels == label])
        yield Message(f"world/{label.name.lower()}", drawing.dots(points, COLORS[label], radius))
    for label in (Label.APPEARED, Label.VANISHED):
        chosen = [cluster for cluster in changes.clusters if cluster.kind == label.name.lower()]
        sizes = np.full((len(chosen), 3), _FLAT_M)
        sizes[:, : changes.dimension] = np.array([each.size_m for each in chosen]).reshape(-1, changes.dimension)
        boxes = rr.Boxes3D(
            centers=_centers(changes, [each.number for each in chosen]),
            half_sizes=0.5 * sizes,
            quaternions=_upright([each.yaw_rad for each in chosen]),
            colors=[COLORS[label]],
            labels=[str(each.number) for each in chosen],
            show_labels=False,
        )
        yield Message(f"world/clusters/{label.name.lower()}", boxes)
    moved = [each for each in changes.clusters if each.kind == "vanished" and each.counterpart]
    starts, ends = (_centers(changes, [getattr(m, key) for m in moved]) for key in ("number", "counterpart"))
    yield Message("world/clusters/moved", rr.Arrows3D(origins=starts, vectors=ends - starts))


def _centers(changes: Changes, numbers: Sequence[int]) -> drawing.Floats:
    """Centers (N, 3) of clusters by their numbers, which count from 1."""
    centers = np.array([changes.clusters[number - 1].center for number in numbers])
    return drawing.in_space(centers.reshape(-1, changes.dimension))


def _upright(angles_rad: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions x, y, z, w (N, 4) of rotations about z."""
    half, zeros = 0.5 * np.asarray(angles_rad), np.zeros(len(angles_rad))
    return np.stack([zeros, zeros, np.sin(half), np.cos(half)], axis=1)


def present_localization(directory: Path, localized: LocalizedLog) -> None:
    """Write report.html and recording.rrd: map, live pose, hypotheses while searching, state and final path."""
    maps.write_localization_report(directory, localized)
    prior, points = localized.prior, drawing.in_space(np.vstack(map_points(localized.prior)))
    side = rrb.Vertical(
        rrb.TextDocumentView(origin=entities.VERDICT, name="verdict"),
        rrb.TimeSeriesView(origin=_SIGMA, name="standard deviation of the position", axis_x=whole_log()),
        rrb.StateTimelineView(origin=entities.STATE, name="state", time_view=whole_log()),
    )
    views = rrb.Horizontal(scene("map", prior.dimension, points), side, column_shares=[5, 2])
    layout = with_panels(views, scans=len(localized.localization.states))
    names, colors = list(maps.STATE_COLORS), [rgb(color) for color in maps.STATE_COLORS.values()]
    messages = [
        Message(entities.MAP, drawing.dots(points, entities.height_colors(points), 1.0)),
        Message(entities.LIDAR, rr.TransformAxes3D(axis_length=0.5 if prior.dimension == 2 else 2.0)),
        Message(entities.SCAN, drawing.dots(color=entities.Color.YELLOW, radius=2.0)),
        Message(entities.VERDICT, rr.TextDocument(localized.metrics.judged.sentence)),
        Message(_SIGMA, rr.SeriesLines(names=["sigma [m]"], colors=[entities.Color.BLUE])),
        Message(entities.STATE, rr.StateConfiguration(values=names, labels=names, colors=colors)),
        *_localized(localized),
    ]
    path = directory / RECORDING_FILE
    write_recording(path, localized.path.name, prior.dimension, layout, messages, kind="localization")


def _localized(localized: LocalizedLog) -> Iterator[Message]:
    """States, poses as estimated at the time of each scan, keyframes localized by then, and matches."""
    found, keyframes = localized.localization, localized.localization.result.keyframes
    stamps_ns = found.trajectory.stamps_ns
    times = Times(np.arange(len(stamps_ns), dtype=np.int64), stamps_ns)
    changed = np.concatenate([[True], found.states[1:] != found.states[:-1]])
    yield Message(entities.STATE, rr.StateChange.columns(state=found.states[changed].tolist()), times[changed])
    known = np.isfinite(found.sigma_m)
    yield Message(_SIGMA, rr.Scalars.columns(scalars=found.sigma_m[known]), times[known])
    placed = np.isfinite(found.live[:, 0, 0])
    if placed.any():
        yield Message(entities.LIDAR, drawing.transforms(found.live[placed]), times[placed])
    for keyframe in keyframes[len(localized.prior.keyframes) :]:
        if placed[keyframe.scan_index]:
            points = drawing.at_most(keyframe.points, 5_000)
            yield Message(entities.SCAN, drawing.dots(points), times[np.array([keyframe.scan_index])])
    for closure in found.closures:  # hypotheses while it searches, matches then
        T_map_target = keyframes[closure.target].T_odom_lidar
        ends = drawing.positions(np.stack([T_map_target, T_map_target @ closure.match.T_target_source]))
        is_accepted = closure.verdict is ClosureVerdict.ACCEPTED
        line = drawing.lines([ends], entities.Color.GREEN if is_accepted else entities.Color.RED, 2.0)
        when = times[np.array([keyframes[closure.source].scan_index])]
        yield Message(_MATCHED if is_accepted else _UNMATCHED, line, when)
    if found.is_placed.any():
        path = drawing.positions(found.trajectory.poses[found.is_placed])
        yield Message(_FINAL, drawing.lines([path], entities.Color.CYAN, 1.0))


def record_graph(change: GraphChange, path: Path) -> None:
    """Write a pose graph, its edges colored by verdict; ``scan`` is 0 before optimization and 1 after."""
    grid = rrb.LineGrid3D(visible=False)
    layout = with_panels(rrb.Spatial3DView(origin=entities.WORLD, name="graph", line_grid=grid))
    messages = [*_graph(change.before, 0), *_graph(change.after, 1)]
    write_recording(path, change.name, change.after.poses.shape[-1] - 1, layout, messages, kind="graph")


def _graph(state: GraphState, when: int) -> Iterator[Message]:
    """Nodes, chain, loops and rejected edges at one instant."""
    times, nodes = Times.at(when, when), drawing.positions(state.poses)
    yield Message(entities.KEYFRAMES, drawing.dots(nodes, entities.Color.VIOLET, 1.5), times)
    names = (entities.ODOMETRY_EDGES, entities.ACCEPTED, entities.REJECTED)
    colors = (entities.Color.GRAY, entities.Color.GREEN, entities.Color.RED)
    for entity, edges, color in zip(names, state.drawn_edges, colors, strict=True):
        yield Message(entity, drawing.lines(nodes[edges], color, 0.75), times)


def record_landmarks(studies: Sequence[Study], path: Path) -> None:
    """Write a view of each landmark problem; ``scan`` is 0 before optimization and 1 after.

    All is in the frame of the ground truth if there is one; landmarks after optimization have 95 % ellipses.
    """
    roots = {f"{entities.WORLD}/{file_stem(study.name)}": study for study in studies}
    views = [rrb.Spatial3DView(origin=root, name=study.name) for root, study in roots.items()]
    messages = [message for root, study in roots.items() for message in _study(root, study)]
    name = ", ".join(study.name for study in studies)
    write_recording(path, name, 2, with_panels(rrb.Grid(*views)), messages, kind="landmarks")


def _study(root: str, study: Study) -> Iterator[Message]:
    """The true trajectory and landmarks, static, and the estimates at their instants."""
    known = study.true_landmarks[np.isfinite(study.true_landmarks).all(axis=1)]
    paths = [each[np.isfinite(each).all(axis=1)] for each in study.paths(study.true_poses)]
    path = drawing.lines(list(map(drawing.in_space, paths)), entities.Color.GRAY, 1.0)
    yield Message(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    yield Message(f"{root}/truth/trajectory", path)
    yield Message(f"{root}/truth/landmarks", drawing.dots(drawing.in_space(known), entities.Color.GRAY, 4.0))
    yield from _estimate(root, study, study.before, Times.at(0, 0), entities.Color.ORANGE)
    yield from _estimate(root, study, study.after, Times.at(1, 1), entities.Color.BLUE)
    axes_m, angles_rad = problems.ellipses(study)
    drawn = rr.Ellipsoids3D.from_fields(
        centers=drawing.in_space(study.after.in_truth()[1]),
        half_sizes=np.pad(axes_m, ((0, 0), (0, 1)), constant_values=_FLAT_M),
        quaternions=_upright(angles_rad),
        colors=entities.Color.BLUE,
    )
    yield Message(f"{root}/ellipses", drawn, Times.at(1, 1))


def _estimate(
    root: str, study: Study, estimate: Estimate, times: Times, color: drawing.Color
) -> Iterator[Message]:
    """Trajectories and landmarks at one instant."""
    poses, points = estimate.in_truth()
    paths = list(map(drawing.in_space, study.paths(poses)))
    yield Message(f"{root}/trajectory", drawing.lines(paths, color, 1.5), times)
    yield Message(f"{root}/landmarks", drawing.dots(drawing.in_space(points), color, 3.0), times)
