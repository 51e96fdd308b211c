"""The entities of a recording, their paths, colors and static messages, and their layout in the viewer.

Frames are entities: points under ``world/lidar`` move with the scan's pose, points under ``world/odom`` with the
correction that loop closures make. A 2D log is drawn in the plane z = 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from scanchain.data import State
from scanchain.steps import STAGES
from scanchain.verdict import Kind
from scanchain_viz.colors import SEGMENT_COLORS, between, height_shares, rgb
from scanchain_viz.recording.drawing import Floats, Message, dots, lines, pixels

WORLD = "world"
ODOM = "world/odom"
LOCAL_MAP = "world/odom/local_map"
LIDAR = "world/lidar"
SCAN = "world/lidar/scan"
COVARIANCE = "world/lidar/covariance"
ODOMETRY = "world/odometry"
TRAJECTORY = "world/trajectory"
OPTIMIZED = "world/optimized"
GROUND_TRUTH = "world/ground_truth"
OPTIMIZED_LIDAR = "world/optimized/lidar"
KEYFRAMES = "world/graph/keyframes"
ODOMETRY_EDGES = "world/graph/odometry"
ACCEPTED = "world/graph/loops/accepted"
REJECTED = "world/graph/loops/rejected"
SEGMENTS = "world/segments"
MAP = "world/map"
GRID = "world/grid"
TIME = "plots/time"
INLIERS = "plots/inliers"
INLIER_SHARE = "plots/inlier_share"
RESIDUAL = "plots/residual"
OBSERVABILITY = "plots/observability"
ITERATIONS = "plots/iterations"
LOOPS = "plots/loops"
INNOVATIONS = "plots/innovations"
STATE = "state"
EVENTS = "events"
LEGEND = "legend"
VERDICT = "verdict"

SERIES = {  # plots of one series each, and their names
    OBSERVABILITY: "log10 observability",
    RESIDUAL: "residual [m]",
    INLIERS: "inliers",
    INLIER_SHARE: "inlier share",
    ITERATIONS: "iterations",
}
COVARIANCE_SCALE = 100.0  # a standard deviation of 1 mm is drawn 10 cm long
_HEIGHT_COLORS = ((50, 60, 150), (40, 140, 170), (60, 190, 120), (220, 210, 80), (240, 240, 230))


# a list, since the viewer wraps its lines but cuts off those of a table
_LEGEND = f"""
- **yellow points**: the scan, deskewed and downsampled, as it was matched
- **gray points**: the local map it was matched against
- **orange line**: trajectory by odometry alone; smooth, drifts
- **blue line**: trajectory as estimated at the time of each scan, with the closures known then
- **cyan line**: trajectory after the last optimization, over all scans
- **white line**: ground truth, aligned to the optimized trajectory as for the ATE
- **violet dots, gray edges**: keyframes and the odometry between them
- **green edges**: accepted loop closures; pale where the back end lowered their weight below ½
- **red edges**: loop closures that the matcher or, later, the back end rejected
- **thick lines**: segments to check, listed in the verdict and in the events
- **violet ellipsoid**: the matcher's standard deviation of the position, enlarged {COVARIANCE_SCALE:.0f} times

**Observability** is the information along the least constrained direction over the minimum required: below 1
(log10 below 0) a scan is degenerate.

**Other sensors**: normalized innovations of their measurements against the scans, 1 on average if the covariances
are right; known at the end of the run.

**Timelines**: `scan` counts the scans in the order of the log, `sensor_time` is the header stamp, which may step
back.
"""


UP = Message(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)


class Color:
    """Colors of the scenes, RGB."""

    YELLOW, GRAY, WHITE = (255, 205, 60), (110, 120, 135), (235, 235, 235)
    BLUE = (70, 150, 255)
    GREEN = (60, 200, 90)
    RED = (235, 70, 60)
    ORANGE = (255, 140, 40)
    VIOLET = (190, 120, 255)
    CYAN, PALE_GREEN = (70, 210, 210), (190, 240, 160)


def height_colors(points: Floats) -> NDArray[np.uint8]:
    """Colors (N, 3) of points (N, 3) by height, from the 2nd to the 98th percentile."""
    return between(_HEIGHT_COLORS, height_shares(points[:, 2]))


def constants(dimension: int) -> list[Message]:
    """Static messages: axes, colors, line widths, names of the series."""
    size_m = 0.5 if dimension == 2 else 2.0
    stages = rr.SeriesLines(
        names=[f"{stage} [ms]" for stage in STAGES],
        colors=[Color.CYAN, Color.GREEN, Color.BLUE, Color.YELLOW, Color.RED],
    )
    marked = [rgb(SEGMENT_COLORS[kind]) for kind in (Kind.CONTRADICTED, Kind.DEGENERATE, Kind.LOST)]
    states = rr.StateConfiguration(values=list(State), labels=list(State), colors=[Color.GREEN, *marked])
    return [
        UP,
        Message(LIDAR, rr.TransformAxes3D(axis_length=size_m)),
        Message(SCAN, dots(color=Color.YELLOW, radius=2.0)),
        Message(LOCAL_MAP, dots(color=Color.GRAY, radius=1.2)),
        Message(COVARIANCE, rr.Ellipsoids3D.from_fields(colors=[Color.VIOLET], line_radii=pixels(1.0))),
        Message(ODOMETRY, lines(color=Color.ORANGE, radius=1.0)),
        Message(TRAJECTORY, lines(color=Color.BLUE, radius=1.5)),
        Message(KEYFRAMES, dots(color=Color.VIOLET, radius=2.0)),
        Message(ODOMETRY_EDGES, lines(color=Color.GRAY, radius=0.75)),
        Message(ACCEPTED, lines(radius=1.5)),
        Message(REJECTED, lines(color=Color.RED, radius=0.75)),
        Message(LEGEND, rr.TextDocument(_LEGEND, media_type=rr.MediaType.MARKDOWN)),
        Message(VERDICT, rr.TextDocument("The verdict is available at the end of the run.")),
        Message(TIME, stages),
        *(Message(entity, rr.SeriesLines(names=[name], colors=[Color.BLUE])) for entity, name in SERIES.items()),
        Message(LOOPS, rr.SeriesLines(names=["accepted", "rejected"], colors=[Color.GREEN, Color.RED])),
        Message(STATE, states),
    ]


def blueprint(
    dimension: int, box: Floats | None = None, scans: int = 0, *, has_sensors: bool = False
) -> rrb.Blueprint:
    """The layout of a 2D log (seen from above) or a 3D one.

    box : (2, 3) lowest and highest coordinates that the view should frame
    scans : their number, 0 if unknown; they are played in half a minute, but no slower than 30 Hz
    has_sensors : whether there are innovations of other sensors
    """
    hidden, whole = rrb.PlotLegend(visible=False), whole_log()
    observability, residual, *others = (
        rrb.TimeSeriesView(origin=entity, name=name, axis_x=whole, plot_legend=hidden)
        for entity, name in SERIES.items()
    )
    ordinary_ms = rrb.ScalarAxis(range=(0.0, 5.0 if dimension == 2 else 20.0))  # the first scans load kernels
    tabs = rrb.Tabs(
        rrb.TextDocumentView(origin=LEGEND, name="legend"),
        rrb.TextLogView(origin=EVENTS, name="events"),
        *others,
        *([rrb.TimeSeriesView(origin=INNOVATIONS, name="other sensors", axis_x=whole)] if has_sensors else ()),
        rrb.TimeSeriesView(origin=TIME, name="time", axis_x=whole, axis_y=ordinary_ms),
    )
    left = rrb.PlotLegend(rrb.Corner2D.LeftTop)  # there are few closures at first
    loops = rrb.TimeSeriesView(origin=LOOPS, name="loop closures", axis_x=whole, plot_legend=left)
    state = rrb.StateTimelineView(origin=STATE, name="state", time_view=whole)
    growing = {ODOMETRY: up_to_now(), TRAJECTORY: up_to_now()}
    world = scene("seen from above" if dimension == 2 else "scene", dimension, box, growing)
    verdict = rrb.TextDocumentView(origin=VERDICT, name="verdict")
    shares = [3, 3, 3, 3, 2, 5]
    side = rrb.Vertical(verdict, observability, residual, loops, state, tabs, row_shares=shares)
    return with_panels(rrb.Horizontal(world, side, column_shares=[5, 3]), scans=scans)


def with_panels(root: rrb.Container | rrb.View, *, scans: int = 0, has_toggles: bool = False) -> rrb.Blueprint:
    """Views with collapsed panels around them; with ``has_toggles`` the list of entities is expanded."""
    return rrb.Blueprint(
        root,
        rrb.TimePanel(timeline="scan", state="collapsed", fps=max(30.0, scans / 30.0)),  # in 30 s
        rrb.BlueprintPanel(state="expanded" if has_toggles else "collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def whole_log() -> rrb.TimeAxis:
    """Time axis from the first scan to the last."""
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
    """View of the world on a dark background: from above for a 2D log, obliquely for a 3D one.

    seen : (N, 3) points, or corners, that the view should contain
    """
    known = np.array([[-20.0] * 3, [20.0] * 3]) if seen is None or not len(seen) else seen
    low, high = known.min(axis=0), known.max(axis=0)
    center, is_flat = 0.5 * (low + high), dimension == 2
    size_m = max(float(np.linalg.norm(high - low)), 20.0 if is_flat else 60.0)
    away = (0.0, 0.0, 1.3) if is_flat else (-0.35, -0.7, 0.7)
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=center + size_m * np.array(away),
        look_target=center,
        eye_up=(0.0, 1.0, 0.0) if is_flat else (0.0, 0.0, 1.0),
    )
    return rrb.Spatial3DView(
        origin=WORLD,
        name=name,
        overrides=overrides,
        background=(13, 16, 17),  # also in a light viewer: lines of ground truth are white
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )
