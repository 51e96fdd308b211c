"""A localized log as a recording: map, live pose, hypotheses while searching, state over time, final path."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain.data import ClosureVerdict
from scanchain.sessions.localize import LocalizedLog
from scanchain.sessions.localizer import MapState
from scanchain_viz.pictures.map_figures import map_points
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.blueprint import scene, time_panel, whole_log
from scanchain_viz.recording.messages import Message, Times
from scanchain_viz.recording.sinks import write_recording

_LIVE, _FINAL, _SCAN = "world/lidar", "world/final", "world/lidar/scan"
_ACCEPTED, _REJECTED, _SIGMA = "world/matches/accepted", "world/matches/rejected", "plots/sigma"
_COLORS = {
    MapState.SEARCHING: entities.GRAY,
    MapState.LOCALIZED: entities.GREEN,
    MapState.UNMATCHED: entities.ORANGE,
    MapState.OUTSIDE: entities.VIOLET,
    MapState.LOST: entities.RED,
}
_MAX_SCAN_POINTS = 5_000


def record_localization(path: Path, localized: LocalizedLog) -> None:
    """Write a .rrd file. Raises OSError."""
    found, prior = localized.localization, localized.prior
    points = shapes.in_space(map_points(prior))
    messages = [
        entities.UP,
        Message(
            entities.MAP, rr.Points3D(points, colors=entities.height_colors(points), radii=entities.pixels(1.0))
        ),
        Message(_LIVE, rr.TransformAxes3D(axis_length=0.5 if prior.dimension == 2 else 2.0)),
        Message(_SCAN, entities.dots(entities.YELLOW, 2.0)),
        Message(entities.VERDICT, rr.TextDocument(localized.metrics.sentence)),
        Message(_SIGMA, rr.SeriesLines(names=["sigma [m]"], colors=[entities.BLUE])),
        Message(
            entities.STATE,
            rr.StateConfiguration(values=list(MapState), labels=list(MapState), colors=list(_COLORS.values())),
        ),
        *_states(localized),
        *_live(localized),
        *_scans(localized),
        *_matches(localized),
    ]
    if found.is_placed.any():
        placed = shapes.positions(found.trajectory.poses[found.is_placed])
        messages.append(Message(_FINAL, entities.lines(entities.CYAN, 1.0, [placed])))
    box = np.array([points.min(axis=0), points.max(axis=0)]) if len(points) else None
    side = rrb.Vertical(
        rrb.TextDocumentView(origin=entities.VERDICT, name="verdict"),
        rrb.TimeSeriesView(origin=_SIGMA, name="standard deviation of the position", axis_x=whole_log()),
        rrb.StateTimelineView(origin=entities.STATE, name="state", time_view=whole_log()),
    )
    world = scene("map", prior.dimension, box)
    layout = rrb.Blueprint(
        rrb.Horizontal(world, side, column_shares=[5, 2]), time_panel(len(found.states)), collapse_panels=True
    )
    write_recording(path, localized.path.name.split(".partial")[0], prior.dimension, layout, messages)


def _times(localized: LocalizedLog) -> Times:
    stamps_ns = localized.localization.trajectory.stamps_ns
    return Times(np.arange(len(stamps_ns), dtype=np.int64), stamps_ns)


def _states(localized: LocalizedLog) -> list[Message]:
    found, times = localized.localization, _times(localized)
    changed = np.concatenate([[True], found.states[1:] != found.states[:-1]])
    known = np.isfinite(found.sigma_m)
    return [
        Message(entities.STATE, rr.StateChange.columns(state=found.states[changed].tolist()), times[changed]),
        Message(_SIGMA, rr.Scalars.columns(scalars=found.sigma_m[known]), times[known]),
    ]


def _live(localized: LocalizedLog) -> list[Message]:
    """The pose known at the time of each scan."""
    found, times = localized.localization, _times(localized)
    known = np.isfinite(found.live[:, 0, 0])
    if not known.any():
        return []
    return [Message(_LIVE, shapes.transforms(found.live[known]), times[known])]


def _scans(localized: LocalizedLog) -> list[Message]:
    """Points of the keyframes of the log, from when its place is known."""
    found, times = localized.localization, _times(localized)
    first = len(localized.prior.keyframes)
    messages = []
    for keyframe in found.result.keyframes[first:]:
        if np.isfinite(found.live[keyframe.scan_index, 0, 0]):
            points = shapes.in_space(shapes.at_most(keyframe.points, _MAX_SCAN_POINTS))
            content = rr.Points3D.columns(positions=points).partition([len(points)])
            messages.append(Message(_SCAN, content, times[np.array([keyframe.scan_index])]))
    return messages


def _matches(localized: LocalizedLog) -> list[Message]:
    """Places in the map that keyframes were matched at: hypotheses while it searches, matches then."""
    found, times, keyframes = localized.localization, _times(localized), localized.localization.result.keyframes
    messages = []
    for closure in found.closures:
        T_map_target = keyframes[closure.target].T_odom_lidar
        ends = np.stack([T_map_target, T_map_target @ closure.match.T_target_source])
        is_accepted = closure.verdict is ClosureVerdict.ACCEPTED
        color = entities.GREEN if is_accepted else entities.RED
        strips = rr.LineStrips3D.columns(
            strips=[shapes.positions(ends)], colors=[color], radii=[entities.pixels(2.0)]
        ).partition([1])
        when = times[np.array([keyframes[closure.source].scan_index])]
        messages.append(Message(_ACCEPTED if is_accepted else _REJECTED, strips, when))
    return messages
