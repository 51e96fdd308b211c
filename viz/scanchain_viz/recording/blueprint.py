"""Layout of a recording in the viewer: the scene, verdict, observability over time, everything else in tabs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain_viz.recording import entities
from scanchain_viz.recording.shapes import Floats

_BACKGROUND = (13, 16, 17)  # of scenes, also where the viewer is light: lines of ground truth are white
_PLAY_S = 30.0
_ORDINARY_MS = {2: 5.0, 3: 20.0}  # what a stage takes, but for the first scans, which load the kernels
_FIRST = {"log10 observability": entities.OBSERVABILITY, "residual [m]": entities.RESIDUAL}
_BEHIND = {"inliers": entities.INLIERS, "inlier share": entities.INLIER_SHARE, "iterations": entities.ITERATIONS}


def blueprint(dimension: int, box: Floats | None = None, scans: int = 0) -> rrb.Blueprint:
    """The layout of a 2D log (seen from above) or a 3D one.

    box : (2, 3) lowest and highest coordinates that the view should frame
    scans : how many there are, where that is known: they are played in half a minute, but no slower than 30 Hz
    """
    whole = whole_log()
    ordinary_ms = rrb.ScalarAxis(range=(0.0, _ORDINARY_MS[dimension]))
    tabs = rrb.Tabs(
        rrb.TextDocumentView(origin=entities.LEGEND, name="legend"),
        rrb.TextLogView(origin=entities.EVENTS, name="events"),
        *_plots(_BEHIND),
        rrb.TimeSeriesView(origin=entities.TIME, name="time", axis_x=whole, axis_y=ordinary_ms),
    )
    loops = rrb.TimeSeriesView(
        origin=entities.LOOPS,
        name="loop closures",
        axis_x=whole,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),  # there are few at first
    )
    state = rrb.StateTimelineView(origin=entities.STATE, name="state", time_view=whole)
    growing = {entities.ODOMETRY: up_to_now(), entities.TRAJECTORY: up_to_now()}
    world = scene("seen from above" if dimension == 2 else "scene", dimension, box, growing)
    verdict = rrb.TextDocumentView(origin=entities.VERDICT, name="verdict")
    side = rrb.Vertical(verdict, *_plots(_FIRST), loops, state, tabs, row_shares=[3, 3, 3, 3, 2, 5])
    return rrb.Blueprint(
        rrb.Horizontal(world, side, column_shares=[5, 3]),
        time_panel(scans),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plots(entity_by_name: dict[str, str]) -> list[rrb.TimeSeriesView]:
    """Plots of one series each, which need no legend."""
    hidden = rrb.PlotLegend(visible=False)
    return [
        rrb.TimeSeriesView(origin=entity, name=name, axis_x=whole_log(), plot_legend=hidden)
        for name, entity in entity_by_name.items()
    ]


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


def time_panel(scans: int) -> rrb.TimePanel:
    """Small, and as fast as ``blueprint`` says."""
    return rrb.TimePanel(timeline="scan", state="collapsed", fps=max(30.0, scans / _PLAY_S))


def scene(
    name: str, dimension: int, box: Floats | None, overrides: Mapping[Any, Any] | None = None
) -> rrb.Spatial3DView:
    """The world, dark whatever the viewer is; box : (2, 3) corners of what is to be seen."""
    return rrb.Spatial3DView(
        origin=entities.WORLD,
        name=name,
        overrides=overrides,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_eye(dimension, box),
    )


def _eye(dimension: int, box: Floats | None) -> rrb.EyeControls3D:
    """From above for a 2D log, obliquely for a 3D one; far enough to see the whole trajectory."""
    low, high = (np.full(3, -20.0), np.full(3, 20.0)) if box is None else box
    center = 0.5 * (low + high)
    size_m = max(float(np.linalg.norm(high - low)), 20.0 if dimension == 2 else 60.0)
    away = (0.0, 0.0, 1.3) if dimension == 2 else (-0.35, -0.7, 0.7)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=center + size_m * np.array(away),
        look_target=center,
        eye_up=(0.0, 1.0, 0.0) if dimension == 2 else (0.0, 0.0, 1.0),
    )
