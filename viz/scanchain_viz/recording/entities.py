"""The entities of a recording: their paths, colors, and static messages.

Frames are entities: points under ``world/lidar`` move with the scan's pose, points under ``world/odom`` with the
correction that loop closures make. A 2D log is drawn in the plane z = 0.
"""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from scanchain.data import State
from scanchain_viz.colors import between, height_shares
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
STRETCHES = "world/stretches"
MAP = "world/map"
GRID = "world/grid"
TIME = "plots/time"
INLIERS = "plots/inliers"
INLIER_SHARE = "plots/inlier_share"
RESIDUAL = "plots/residual"
OBSERVABILITY = "plots/observability"
ITERATIONS = "plots/iterations"
LOOPS = "plots/loops"
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
STAGES = ("read", "preprocess", "match", "map", "loops")
COVARIANCE_SCALE = 100.0  # a standard deviation of 1 mm is drawn 10 cm long

YELLOW, GRAY, WHITE = (255, 205, 60), (110, 120, 135), (235, 235, 235)
BLUE, GREEN, RED, ORANGE, VIOLET = (70, 150, 255), (60, 200, 90), (235, 70, 60), (255, 140, 40), (190, 120, 255)
CYAN = (70, 210, 210)

_HEIGHT_COLORS = ((50, 60, 150), (40, 140, 170), (60, 190, 120), (220, 210, 80), (240, 240, 230))

# a list, since the viewer wraps its lines; those of a table it cuts off
_LEGEND = f"""
- **yellow points**: the scan, deskewed and downsampled, as it was matched
- **gray points**: the local map it was matched against
- **orange line**: trajectory by odometry alone; smooth, drifts
- **blue line**: trajectory as known at the time, every scan placed by the closures known then
- **cyan line**: trajectory after the last optimization, over all scans
- **white line**: ground truth, aligned to the optimized trajectory as for the ATE
- **violet dots, gray edges**: keyframes and the odometry between them
- **green edges**: accepted loop closures; amber where the back end lowered their weight below ½
- **red edges**: loop closures that the matcher or, later, the back end rejected
- **thick lines**: stretches to check, listed in the verdict and in the events
- **violet ellipsoid**: standard deviation of the position by the matcher, {COVARIANCE_SCALE:.0f} times as large

**Observability** is the information along the least constrained direction over the least that is required: below 1
(log10 below 0) a scan is degenerate.

**Timelines**: `scan` counts the scans in the order of the log, `sensor_time` is the header stamp, which may step
back.
"""


UP = Message(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)


def height_colors(points: Floats) -> NDArray[np.uint8]:
    """Colors (N, 3) of points (N, 3) by height, from the 2nd to the 98th percentile."""
    return between(_HEIGHT_COLORS, height_shares(points[:, 2]))


def constants(dimension: int) -> list[Message]:
    """Static messages: axes, colors, line widths, names of the series."""
    size_m = 0.5 if dimension == 2 else 2.0
    return [
        UP,
        Message(LIDAR, rr.TransformAxes3D(axis_length=size_m)),
        Message(SCAN, dots(color=YELLOW, radius=2.0)),
        Message(LOCAL_MAP, dots(color=GRAY, radius=1.2)),
        Message(COVARIANCE, rr.Ellipsoids3D.from_fields(colors=[VIOLET], line_radii=pixels(1.0))),
        Message(ODOMETRY, lines(color=ORANGE, radius=1.0)),
        Message(TRAJECTORY, lines(color=BLUE, radius=1.5)),
        Message(KEYFRAMES, dots(color=VIOLET, radius=2.0)),
        Message(ODOMETRY_EDGES, lines(color=GRAY, radius=0.75)),
        Message(ACCEPTED, lines(radius=1.5)),
        Message(REJECTED, lines(color=RED, radius=0.75)),
        Message(LEGEND, rr.TextDocument(_LEGEND, media_type=rr.MediaType.MARKDOWN)),
        Message(VERDICT, rr.TextDocument("The verdict comes with the end of the run.")),
        *_series(),
    ]


def _series() -> list[Message]:
    stages = rr.SeriesLines(names=[f"{stage} [ms]" for stage in STAGES], colors=[CYAN, GREEN, BLUE, YELLOW, RED])
    states = rr.StateConfiguration(values=list(State), labels=list(State), colors=[GREEN, VIOLET, ORANGE, RED])
    loops = rr.SeriesLines(
        names=["accepted", "rejected"],
        colors=[GREEN, RED],
        interpolation_mode=rr.components.InterpolationMode.StepAfter,  # each holds until the next
    )
    return [
        Message(TIME, stages),
        *(Message(entity, rr.SeriesLines(names=[name], colors=[BLUE])) for entity, name in SERIES.items()),
        Message(LOOPS, loops),
        Message(STATE, states),
    ]
