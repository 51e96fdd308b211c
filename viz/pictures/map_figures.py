"""Maps as small pictures, and loop closures on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Points
from scanchain.maps import SavedMap
from scanchain.runs.overlay import Overlay
from scanchain.viz.pictures.figure import INK, SvgFigure
from scanchain.viz.pictures.trajectory_figures import CLOSURES, DrawnTrajectory, Floats, PathLine

_POINTS = "#808893"
_MAX_POINTS = 120_000
_SAMPLE = 200_000  # points taken of a map's keyframes
_PIXELS_A_POINT, _WIDTHS = 2.0, (200.0, 700.0)  # of a map's picture: per root of the points; pixels
_LOWEST = 5.0  # percentile of the heights that is taken for the ground's
_OPAQUE, _OPACITIES = 40_000, (0.4, 1.0)  # points that each are drawn so; one among many shows less
_BULK, _REACH = (0.5, 99.5), 0.5  # percentiles of a map; its sizes that a point may lie outside of these


def surroundings(low: Floats, high: Floats, clouds: Sequence[Points]) -> tuple[Floats, Floats]:
    """Corners (3,) that hold a trajectory, from ``low`` to ``high``, and the extents of its maps."""
    boxes = np.array([(low, high), *(extent(points) for points in clouds if len(points))])
    return boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)


def extent(points: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Corners (d,) of a map (M, d), but for outliers: points that lie far beyond 99 % of all, along any axis."""
    low, high = np.percentile(points, _BULK, axis=0)
    size = high - low
    size[:2] = size[:2].max()
    inside = points[((points >= low - _REACH * size) & (points <= high + _REACH * size)).all(axis=1)]
    return inside.min(axis=0).astype(np.float64), inside.max(axis=0).astype(np.float64)


def map_points(prior: SavedMap, limit: int = _SAMPLE) -> Points:
    """(N, 3) some points of all keyframes of a map, in its frame."""
    each = max(limit // max(len(prior.keyframes), 1), 1)
    clouds = [np.empty((0, 3))]
    for keyframe in prior.keyframes:
        points = keyframe.points
        some = lie.transform(keyframe.T_odom_lidar, points[:: max(1, -(-len(points) // each))])
        clouds.append(lie.lift_points(some))
    return np.vstack(clouds)


def map_picture(name: str, points: Points, low: Floats, high: Floats) -> Markup:
    """Points (M, 3) seen from above, within corners; the color is the height, where there is any."""
    with SvgFigure.of_plan(name, low, high) as figure:
        draw_points(figure, points, low, high, by_height=True)
        return figure.svg()


def path_over_map(
    name: str, points: Points, path: Floats, lines: Sequence[PathLine], low: Floats, high: Floats
) -> Markup:
    """Lines over the map (gray), seen from above, within corners; circle and square begin and end the path."""
    with SvgFigure.of_plan(name, low, high) as figure:
        draw_points(figure, points, low, high)
        for line in lines:
            style = (0, (3, 3)) if line.is_dashed else "-"
            x, y = line.positions[:, :2].T
            figure.axes.plot(x, y, color=line.color, linewidth=line.width, linestyle=style)
        for place, marker in ((0, "o"), (-1, "s")):
            figure.axes.plot(*path[place, :2], marker=marker, markersize=4, color=INK)
        return figure.svg()


def layers_picture(
    name: str,
    layers: Sequence[tuple[Points, str]],
    outlines: Sequence[tuple[Floats, str]],
    low: Floats,
    high: Floats,
) -> Markup:
    """Points (M, 3) in a color each, seen from above, the last ones on top, and closed outlines (N, 2)."""
    with SvgFigure.of_plan(name, low, high) as figure:
        for points, color in layers:
            draw_points(figure, points, low, high, color)
        for outline, color in outlines:
            figure.axes.plot(*np.vstack([outline, outline[:1]])[:, :2].T, color=color, linewidth=0.8)
        return figure.svg()


BEFORE, AFTER = "#1aa179", "#a55bd6"  # colors of two passes
_MARGIN_M = 1.0  # around their points
_VIEW_M = {2: 12.0, 3: 30.0}  # half width of a picture of two passes
_GROUND_M = 0.5  # height above the lowest points below which points in space are ground, which hides walls


def overlay_picture(name: str, overlay: Overlay) -> Markup:
    """Points and paths of two passes over one place, seen from above; ground is left out."""
    half_m = _VIEW_M[overlay.before.shape[1]]
    before, after = _above_ground(overlay.before), _above_ground(overlay.after)
    drawn = np.concatenate([before, after])[:, :2] if len(before) + len(after) else overlay.place[None, :2]
    low = np.maximum(overlay.place[:2] - half_m, np.minimum(drawn.min(axis=0), overlay.place[:2]) - _MARGIN_M)
    high = np.minimum(overlay.place[:2] + half_m, np.maximum(drawn.max(axis=0), overlay.place[:2]) + _MARGIN_M)
    with SvgFigure.of_plan(name, low, high) as figure:
        for points, path, color in ((before, overlay.path_before, BEFORE), (after, overlay.path_after, AFTER)):
            draw_points(figure, points, low, high, color)
            figure.axes.plot(path[:, 0], path[:, 1], color=color, linewidth=1.4)
        figure.axes.set_xlim(low[0], high[0])
        figure.axes.set_ylim(low[1], high[1])
        return figure.svg()


def _above_ground(points: Points) -> Points:
    if points.shape[1] == 2:
        return np.pad(points, ((0, 0), (0, 1)))
    return points[points[:, 2] > np.percentile(points[:, 2], _LOWEST) + _GROUND_M]


def draw_points(
    figure: SvgFigure, points: Points, low: Floats, high: Floats, color: str = _POINTS, *, by_height: bool = False
) -> None:
    """Draw points (M, 3) as seen from above, within corners, in one color or by their height."""
    shown = points[:: max(1, -(-len(points) // _MAX_POINTS))]
    inside = ((shown[:, :2] > low[:2]) & (shown[:, :2] < high[:2])).all(axis=1)
    if inside.any():
        image = _image(shown[inside], low, high, color, by_height=by_height)
        corners = (low[0], high[0], low[1], high[1])
        figure.axes.imshow(image, extent=corners, origin="lower", interpolation="none")


def _image(points: Floats, low: Floats, high: Floats, color: str, *, by_height: bool) -> NDArray[np.uint8]:
    """(H, W, 4), clear where nothing is, opacity by the number of points, color by the highest of them."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgba

    width = float(np.clip(_PIXELS_A_POINT * np.sqrt(len(points)), *_WIDTHS))
    edge_m = (high[0] - low[0]) / width
    columns, rows = np.ceil((high[:2] - low[:2]) / edge_m).astype(int)
    points = points[np.argsort(points[:, 2])]
    column, row = ((points[:, :2] - low[:2]) / edge_m).astype(int).T
    colors = np.array([to_rgba(color)])
    if by_height and np.ptp(points[:, 2]):
        bottom, top = np.percentile(points[:, 2], (2.0, 98.0))
        colors = colormaps["viridis"]((points[:, 2] - bottom) / max(top - bottom, 1e-9))
    image = np.zeros((rows, columns, 4))
    image[row, column] = colors
    opacity = float(np.clip(_OPAQUE / len(points), *_OPACITIES))
    counts = np.bincount(row * columns + column, minlength=rows * columns).reshape(rows, columns)
    image[:, :, 3] = 1.0 - (1.0 - opacity) ** counts
    return np.rint(255.0 * image).astype(np.uint8)


def loops_picture(
    name: str, trajectory: DrawnTrajectory, edges: Floats, rejected_by: NDArray[np.str_], low: Floats, high: Floats
) -> Markup:
    """The trajectory (gray) with its closures in the colors of ``CLOSURES``; ``edges`` (E, 2, 3)."""
    with SvgFigure.of_plan(name, low, high) as figure:
        figure.axes.plot(trajectory.positions[:, 0], trajectory.positions[:, 1], color=_POINTS, linewidth=0.7)
        for by, (_, color) in CLOSURES.items():
            chosen = edges[rejected_by == by][:, :, :2]
            gaps = np.full((len(chosen), 1, 2), np.nan)
            lines = np.concatenate([chosen, gaps], axis=1).reshape(-1, 2)
            figure.axes.plot(lines[:, 0], lines[:, 1], color=color, linewidth=0.9)
        figure.axes.plot(*trajectory.positions[0, :2], marker="o", markersize=4, color=INK)
        return figure.svg()
