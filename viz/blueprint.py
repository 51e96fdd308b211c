"""How the viewer lays a recording out: the scene, the plots in tabs, the state over time."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from viz import entities
from viz.shapes import Floats

_PLOTS = {
    "time by stage": entities.TIME,
    "inliers": entities.INLIERS,
    "inlier share": entities.INLIER_SHARE,
    "residual": entities.RESIDUAL,
    "degeneracy": entities.DEGENERACY,
    "iterations": entities.ITERATIONS,
}


def blueprint(dimension: int, path: Floats | None = None) -> rrb.Blueprint:
    """The layout of a 2D log (seen from above) or a 3D one; ``path`` (N, 3) is what the view should frame."""
    plots = rrb.Tabs(*(rrb.TimeSeriesView(origin=entity, name=name) for name, entity in _PLOTS.items()))
    texts = rrb.Tabs(
        rrb.TextDocumentView(origin=entities.LEGEND, name="legend"),
        rrb.TextLogView(origin=entities.EVENTS, name="events"),
    )
    state = rrb.StateTimelineView(origin=entities.STATE, name="state")
    side = rrb.Vertical(plots, state, texts, row_shares=[4, 1, 3])
    return rrb.Blueprint(
        rrb.Horizontal(_scene(dimension, path), side, column_shares=[5, 3]),
        rrb.TimePanel(timeline="scan", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scene(dimension: int, path: Floats | None) -> rrb.Spatial3DView:
    """The world; the two ways grow with the time cursor instead of showing their last piece only."""
    so_far = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                timeline,
                start=rrb.TimeRangeBoundary.infinite(),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
            for timeline in ("scan", "sensor_time")
        ]
    )
    return rrb.Spatial3DView(
        origin=entities.WORLD,
        name="seen from above" if dimension == 2 else "scene",
        overrides={entities.ODOMETRY: so_far, entities.TRAJECTORY: so_far},
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_eye(dimension, path),
    )


def _eye(dimension: int, path: Floats | None) -> rrb.EyeControls3D | None:
    """From above for a 2D log, obliquely for a 3D one; far enough to see the whole way."""
    if path is None or not len(path):
        path = np.array([[-20.0, -20.0, 0.0], [20.0, 20.0, 0.0]], np.float32)
    low, high = path.min(axis=0), path.max(axis=0)
    centre = 0.5 * (low + high)
    size_m = max(float(np.linalg.norm(high - low)), 20.0)
    away = (0.0, 0.0, 1.3) if dimension == 2 else (-0.35, -0.7, 0.7)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre + size_m * np.array(away),
        look_target=centre,
        eye_up=(0.0, 1.0, 0.0) if dimension == 2 else (0.0, 0.0, 1.0),
    )
