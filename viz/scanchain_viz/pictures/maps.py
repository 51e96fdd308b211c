"""Maps as small pictures, with trajectories, loop closures and the sessions of a merge on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Points
from scanchain.maps import SavedMap, open_saved_map
from scanchain.runs.results import Overlay
from scanchain_viz.colors import color_of, height_shares, palette_of
from scanchain_viz.pictures.figure import INK, Floats, Line, Plot

GRAY = "#808893"  # of points of a map beneath lines
_MAX_POINTS = 120_000
_SAMPLE = 200_000  # points taken of a map's keyframes
_PIXELS_A_POINT, _WIDTHS = 2.0, (200.0, 700.0)  # of a map's picture: per root of the points; pixels
_LOWEST = 5.0  # percentile of the heights that is taken for the ground's
_SHADES, _HEIGHTS = 6, 36  # numbers of opacities and of colors of heights; a PNG has 256 colors
_VIRIDIS = (
    "440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c", "1fa088", "28ae80",
    "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725",
)  # fmt: skip
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


def map_picture(points: Points, low: Floats, high: Floats) -> Markup:
    """Points (M, 3) seen from above, within corners; the color is the height, where there is any."""
    figure = Plot.of_plan(low, high)
    draw_points(figure, points, low, high, _VIRIDIS)
    return figure.svg()


def path_over_map(
    points: Points,
    lines: Sequence[Line],
    low: Floats,
    high: Floats,
    path: Floats | None = None,
    *,
    is_wide: bool = False,
) -> Markup:
    """Lines over the map (gray), seen from above, within corners.

    path : (N, 3) its begin and end have outlines, circle and square, however short it is: it is drawn over them
    """
    figure = Plot.of_plan(low, high, is_wide=is_wide)
    draw_points(figure, points, low, high)
    if path is not None:
        figure.marks(path[:1], "o", INK, 7.0, line=1.0)
        figure.marks(path[-1:], "s", INK, 7.0, line=1.0)
    for line in lines:
        figure.line(line.positions, line.color, line.width, (3.0, 3.0) if line.is_dashed else ())
    return figure.svg()


BEFORE, AFTER = "#1aa179", "#a55bd6"  # colors of two passes
_MARGIN_M = 1.0  # around their points
_VIEW_M = {2: 12.0, 3: 30.0}  # half width of a picture of two passes
_GROUND_M = 0.5  # height above the lowest points below which points in space are ground, which hides walls


def overlay_picture(overlay: Overlay) -> Markup:
    """Points and paths of two passes over one place, seen from above; ground is left out."""
    half_m = _VIEW_M[overlay.before.shape[1]]
    before, after = _above_ground(overlay.before), _above_ground(overlay.after)
    drawn = np.concatenate([before, after])[:, :2] if len(before) + len(after) else overlay.place[None, :2]
    low = np.maximum(overlay.place[:2] - half_m, np.minimum(drawn.min(axis=0), overlay.place[:2]) - _MARGIN_M)
    high = np.minimum(overlay.place[:2] + half_m, np.maximum(drawn.max(axis=0), overlay.place[:2]) + _MARGIN_M)
    figure = Plot.of_plan(low, high)
    for points, path, color in ((before, overlay.path_before, BEFORE), (after, overlay.path_after, AFTER)):
        draw_points(figure, points, low, high, (color,))
        figure.line(path, color, 1.4)
    return figure.svg()


def _above_ground(points: Points) -> Points:
    if points.shape[1] == 2:
        return np.pad(points, ((0, 0), (0, 1)))
    return points[points[:, 2] > np.percentile(points[:, 2], _LOWEST) + _GROUND_M]


def draw_points(
    figure: Plot,
    points: Points,
    low: Floats,
    high: Floats,
    colors: Sequence[str] = (GRAY,),
) -> None:
    """Draw points (M, 3) as seen from above, within corners, in one color, or in several by height, if any."""
    shown = points[:: max(1, -(-len(points) // _MAX_POINTS))]
    inside = ((shown[:, :2] > low[:2]) & (shown[:, :2] < high[:2])).all(axis=1)
    if inside.any():
        colors = colors if len(colors) == 1 or np.ptp(shown[inside, 2]) else (GRAY,)
        pixels, palette, edge_m = _image(shown[inside], low, high, colors)
        figure.image(pixels, palette, low, low[:2] + edge_m * np.array(pixels.shape[::-1]))


def _image(
    points: Floats, low: Floats, high: Floats, colors: Sequence[str]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], float]:
    """Pixels (H, W), palette (K, 4), edge of a pixel: the color of the highest point, opacity by their number."""
    width = float(np.clip(_PIXELS_A_POINT * np.sqrt(len(points)), *_WIDTHS))
    edge_m = float(high[0] - low[0]) / width
    columns, rows = np.ceil((high[:2] - low[:2]) / edge_m).astype(int)
    column, row = ((points[:, :2] - low[:2]) / edge_m).astype(int).T
    pixel = row * columns + column
    opacity = float(np.clip(_OPAQUE / len(points), *_OPACITIES))
    counts = np.minimum(np.bincount(pixel, minlength=rows * columns), _SHADES)
    shades, highest = palette_of(colors, _HEIGHTS if len(colors) > 1 else 1), np.zeros(rows * columns, int)
    if len(shades) > 1:
        np.maximum.at(highest, pixel, np.rint((len(shades) - 1) * height_shares(points[:, 2])).astype(int))
    palette = np.repeat(shades, _SHADES + 1, axis=0)
    palette[:, 3] = np.tile(np.rint(255.0 * (1.0 - (1.0 - opacity) ** np.arange(_SHADES + 1))), len(shades))
    return (highest * (_SHADES + 1) + counts).reshape(rows, columns).astype(np.uint8), palette, edge_m


@dataclass(frozen=True, slots=True)
class DrawnMerge:
    """Sessions of a merged map, ends (E, 2, 3) of the closures between them, and the spacing of its points."""

    sessions: tuple[Line, ...]
    closures: Floats
    dimension: int
    grain_m: float

    @property
    def positions(self) -> Floats:
        """(K, 3) of all keyframes."""
        return np.concatenate([session.positions for session in self.sessions])


def read_merge(directory: Path) -> DrawnMerge:
    """The sessions of a merge's directory."""
    saved = open_saved_map(directory)
    positions = lie.lift(saved.poses)[:, :3, 3]
    sessions = tuple(
        Line(each.name, positions[saved.session == number], color_of(number))
        for number, each in enumerate(saved.sessions)
    )
    ends: NDArray[np.int64] = saved.session[saved.edges.pairs]
    between = saved.edges.pairs[ends[:, 0] != ends[:, 1]]
    return DrawnMerge(sessions, positions[between], saved.dimension, Config().maps.voxel_size_m)
