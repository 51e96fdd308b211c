"""Layout of a recording in the viewer: the scene, verdict, observability over time, everything else in tabs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from scanchain_viz.recording import entities
from scanchain_viz.recording.drawing import Floats

_BACKGROUND = (13, 16, 17)  # of scenes, also where the viewer is light: lines of ground truth are white
_PLAY_S = 30.0
_ORDINARY_MS = {2: 5.0, 3: 20.0}  # what a stage takes, but for the first scans, which load the kernels


def blueprint(dimension: int, box: Floats | None = None, scans: int = 0) -> rrb.Blueprint:
    """The layout of a 2D log (seen from above) or a 3D one.

    box : (2, 3) lowest and highest coordinates that the view should frame
    scans : how many there are, where that is known: they are played in half a minute, but no slower than 30 Hz
    """
    hidden, whole = rrb.PlotLegend(visible=False), whole_log()
    observability, residual, *others = (
        rrb.TimeSeriesView(origin=entity, name=name, axis_x=whole, plot_legend=hidden)
        for entity, name in entities.SERIES.items()
    )
    ordinary_ms = rrb.ScalarAxis(range=(0.0, _ORDINARY_MS[dimension]))
    tabs = rrb.Tabs(
        rrb.TextDocumentView(origin=entities.LEGEND, name="legend"),
        rrb.TextLogView(origin=entities.EVENTS, name="events"),
        *others,
        rrb.TimeSeriesView(origin=entities.TIME, name="time", axis_x=whole, axis_y=ordinary_ms),
    )
    left = rrb.PlotLegend(rrb.Corner2D.LeftTop)  # there are few closures at first
    loops = rrb.TimeSeriesView(origin=entities.LOOPS, name="loop closures", axis_x=whole, plot_legend=left)
    state = rrb.StateTimelineView(origin=entities.STATE, name="state", time_view=whole)
    growing = {entities.ODOMETRY: up_to_now(), entities.TRAJECTORY: up_to_now()}
    world = scene("seen from above" if dimension == 2 else "scene", dimension, box, growing)
    verdict = rrb.TextDocumentView(origin=entities.VERDICT, name="verdict")
    shares = [3, 3, 3, 3, 2, 5]
    side = rrb.Vertical(verdict, observability, residual, loops, state, tabs, row_shares=shares)
    return with_panels(rrb.Horizontal(world, side, column_shares=[5, 3]), scans=scans)


def with_panels(root: rrb.Container | rrb.View, *, scans: int = 0, has_toggles: bool = False) -> rrb.Blueprint:
    """Views with collapsed panels around them, but for the list of entities where they are there to toggle."""
    return rrb.Blueprint(
        root,
        rrb.TimePanel(timeline="scan", state="collapsed", fps=max(30.0, scans / _PLAY_S)),
        rrb.BlueprintPanel(state="expanded" if has_toggles else "collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def whole_log() -> rrb.TimeAxis:
    """From the first scan to the last."""
    return rrb.TimeAxis(
        view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
    )


def up_to_now() -> rrb.VisibleTimeRanges:
    """Time range of a trajectory that grows with the time cursor, instead of showing its last segment only."""
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    return rrb.VisibleTimeRanges(
        [rrb.VisibleTimeRange(timeline, start=start, end=end) for timeline in ("scan", "sensor_time")]
    )


def scene(
    name: str, dimension: int, seen: NDArray[np.floating] | None, overrides: Mapping[Any, Any] | None = None
) -> rrb.Spatial3DView:
    """The world, dark whatever the viewer is; seen : (N, 3) points, or corners, that the view should hold."""
    return rrb.Spatial3DView(
        origin=entities.WORLD,
        name=name,
        overrides=overrides,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_eye(dimension, seen),
    )


def _eye(dimension: int, seen: NDArray[np.floating] | None) -> rrb.EyeControls3D:
    """From above for a 2D log, obliquely for a 3D one; far enough to see the whole trajectory."""
    known = np.array([[-20.0] * 3, [20.0] * 3]) if seen is None or not len(seen) else seen
    low, high = known.min(axis=0), known.max(axis=0)
    center = 0.5 * (low + high)
    size_m = max(float(np.linalg.norm(high - low)), 20.0 if dimension == 2 else 60.0)
    away = (0.0, 0.0, 1.3) if dimension == 2 else (-0.35, -0.7, 0.7)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=center + size_m * np.array(away),
        look_target=center,
        eye_up=(0.0, 1.0, 0.0) if dimension == 2 else (0.0, 0.0, 1.0),
    )
