"""Recordings of maps: a merge with its sessions, a log that was localized, and what changed between two."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain.data import ClosureVerdict
from scanchain.maps import read_ply
from scanchain.runs.directory import RECORDING_FILE
from scanchain.sessions.change_run import COLORS, SUMMARY_FILE
from scanchain.sessions.changes import Changes, Label
from scanchain.sessions.localize import LocalizedLog
from scanchain.sessions.localizer import MapState
from scanchain_viz.colors import rgb
from scanchain_viz.pictures.maps import DrawnMerge, map_points, read_merge
from scanchain_viz.recording import drawing, entities
from scanchain_viz.recording.blueprint import scene, whole_log, with_panels
from scanchain_viz.recording.drawing import Message, Times
from scanchain_viz.recording.sinks import write_recording

_MAP_POINTS = 300_000
_FLAT_M = 0.02  # height of a box in the plane
_RADII = {Label.SAME: 0.75, Label.UNKNOWN: 1.0, Label.APPEARED: 2.0, Label.VANISHED: 2.0}
_LIVE, _FINAL, _SCAN = "world/lidar", "world/final", "world/lidar/scan"
_ACCEPTED, _REJECTED, _SIGMA = "world/matches/accepted", "world/matches/rejected", "plots/sigma"
_STATE_COLORS = {
    MapState.SEARCHING: entities.GRAY,
    MapState.LOCALIZED: entities.GREEN,
    MapState.UNMATCHED: entities.ORANGE,
    MapState.OUTSIDE: entities.VIOLET,
    MapState.LOST: entities.RED,
}
_MAX_SCAN_POINTS = 5_000


def record_merge(directory: Path) -> None:
    """Write recording.rrd into a merge's directory: the map, every session to toggle, the closures between them.

    Raises OSError.
    """
    drawn = read_merge(directory)
    world = scene("sessions over the map", drawn.dimension, drawn.positions)
    layout, messages = with_panels(world, has_toggles=True), _merge(directory, drawn)
    write_recording(directory / RECORDING_FILE, directory.name, drawn.dimension, layout, messages, kind="merge")


def _merge(directory: Path, drawn: DrawnMerge) -> Iterator[Message]:
    points = drawing.at_most(read_ply(directory / "map.ply"), _MAP_POINTS)
    yield Message(entities.MAP, drawing.dots(points, entities.GRAY, 0.75))
    yield Message(entities.ACCEPTED, drawing.lines(drawn.closures.astype(np.float32), entities.GREEN, 0.75))
    for session in drawn.sessions:
        color, name = rgb(session.color), rr.escape_entity_path_part(session.name)
        path = session.positions.astype(np.float32)
        yield Message(f"world/sessions/{name}/trajectory", drawing.lines([path], color, 1.5))
        yield Message(f"world/sessions/{name}/keyframes", drawing.dots(path, color, 2.5))


def record_changes(directory: Path, changes: Changes) -> None:
    """Write recording.rrd into a directory that holds summary.txt: points by label, boxes around clusters, arrows.

    Raises OSError.
    """
    points = drawing.in_space(changes.points)
    text = rrb.TextDocumentView(origin="summary", name="summary")
    world = scene("changes", changes.dimension, points)
    layout = with_panels(rrb.Horizontal(world, text, column_shares=[3, 1]))
    summary = rr.TextDocument((directory / SUMMARY_FILE).read_text(encoding="utf-8"))
    messages = [
        Message("summary", summary),
        *(
            Message(
                f"world/{label.name.lower()}",
                drawing.dots(points[changes.labels == label], COLORS[label], radius),
            )
            for label, radius in _RADII.items()
        ),
        *(_boxes(changes, label) for label in (Label.APPEARED, Label.VANISHED)),
        _arrows(changes),
    ]
    path = directory / RECORDING_FILE
    write_recording(path, directory.name, changes.dimension, layout, messages, kind="changes")


def _boxes(changes: Changes, label: Label) -> Message:
    kind = label.name.lower()
    chosen = [cluster for cluster in changes.clusters if cluster.kind == kind]
    sizes = np.full((len(chosen), 3), _FLAT_M)
    upright = np.zeros((len(chosen), 4))
    for row, cluster in enumerate(chosen):
        sizes[row, : changes.dimension] = cluster.size_m
        upright[row, 2:] = np.sin(0.5 * cluster.yaw_rad), np.cos(0.5 * cluster.yaw_rad)
    centers = drawing.in_space(np.array([cluster.center for cluster in chosen]).reshape(-1, changes.dimension))
    drawn = rr.Boxes3D(
        centers=centers,
        half_sizes=0.5 * sizes,
        quaternions=upright,
        colors=[COLORS[label]],
        labels=[str(cluster.number) for cluster in chosen],
        show_labels=False,
    )
    return Message(f"world/clusters/{kind}", drawn)


def _arrows(changes: Changes) -> Message:
    """From where something vanished to where it appeared."""
    moved = [each for each in changes.clusters if each.kind == "vanished" and each.counterpart]
    starts = np.array([each.center for each in moved]).reshape(-1, changes.dimension)
    ends = np.array([changes.clusters[each.counterpart - 1].center for each in moved]).reshape(starts.shape)
    arrows = rr.Arrows3D(origins=drawing.in_space(starts), vectors=drawing.in_space(ends - starts))
    return Message("world/clusters/moved", arrows)


def record_localization(path: Path, localized: LocalizedLog) -> None:
    """Write a .rrd file: map, live pose, hypotheses while searching, state, final path. Raises OSError."""
    prior = localized.prior
    points = drawing.in_space(map_points(prior))
    side = rrb.Vertical(
        rrb.TextDocumentView(origin=entities.VERDICT, name="verdict"),
        rrb.TimeSeriesView(origin=_SIGMA, name="standard deviation of the position", axis_x=whole_log()),
        rrb.StateTimelineView(origin=entities.STATE, name="state", time_view=whole_log()),
    )
    views = rrb.Horizontal(scene("map", prior.dimension, points), side, column_shares=[5, 2])
    layout = with_panels(views, scans=len(localized.localization.states))
    states = rr.StateConfiguration(
        values=list(MapState), labels=list(MapState), colors=list(_STATE_COLORS.values())
    )
    messages = [
        Message(entities.MAP, drawing.dots(points, entities.height_colors(points), 1.0)),
        Message(_LIVE, rr.TransformAxes3D(axis_length=0.5 if prior.dimension == 2 else 2.0)),
        Message(_SCAN, drawing.dots(color=entities.YELLOW, radius=2.0)),
        Message(entities.VERDICT, rr.TextDocument(localized.metrics.sentence)),
        Message(_SIGMA, rr.SeriesLines(names=["sigma [m]"], colors=[entities.BLUE])),
        Message(entities.STATE, states),
        *_localized(localized),
    ]
    write_recording(path, localized.path.name, prior.dimension, layout, messages, kind="localization")


def _localized(localized: LocalizedLog) -> Iterator[Message]:
    """States, poses as known at the time of each scan, keyframes from when their place is known, and matches."""
    found, keyframes = localized.localization, localized.localization.result.keyframes
    stamps_ns = found.trajectory.stamps_ns
    times = Times(np.arange(len(stamps_ns), dtype=np.int64), stamps_ns)
    changed = np.concatenate([[True], found.states[1:] != found.states[:-1]])
    yield Message(entities.STATE, rr.StateChange.columns(state=found.states[changed].tolist()), times[changed])
    known = np.isfinite(found.sigma_m)
    yield Message(_SIGMA, rr.Scalars.columns(scalars=found.sigma_m[known]), times[known])
    placed = np.isfinite(found.live[:, 0, 0])
    if placed.any():
        yield Message(_LIVE, drawing.transforms(found.live[placed]), times[placed])
    for keyframe in keyframes[len(localized.prior.keyframes) :]:
        if placed[keyframe.scan_index]:
            points = drawing.at_most(keyframe.points, _MAX_SCAN_POINTS)
            yield Message(_SCAN, drawing.dots(points), times[np.array([keyframe.scan_index])])
    for closure in found.closures:  # hypotheses while it searches, matches then
        T_map_target = keyframes[closure.target].T_odom_lidar
        ends = drawing.positions(np.stack([T_map_target, T_map_target @ closure.match.T_target_source]))
        is_accepted = closure.verdict is ClosureVerdict.ACCEPTED
        line = drawing.lines([ends], entities.GREEN if is_accepted else entities.RED, 2.0)
        when = times[np.array([keyframes[closure.source].scan_index])]
        yield Message(_ACCEPTED if is_accepted else _REJECTED, line, when)
    if found.is_placed.any():
        path = drawing.positions(found.trajectory.poses[found.is_placed])
        yield Message(_FINAL, drawing.lines([path], entities.CYAN, 1.0))
