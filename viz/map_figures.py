"""Maps as small pictures, and loop closures on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.data import Points
from viz.courses import Course, Floats
from viz.sheet import INK, Sheet

_ACCEPTED, _REJECTED = "#1aa179", "#d6453d"
_POINTS = "#808893"
_MAX_POINTS = 120_000
_PIXELS_A_POINT, _WIDTHS = 2.0, (200.0, 700.0)  # of a map's picture: per root of the points; pixels
_OPAQUE, _OPACITIES = 40_000, (0.4, 1.0)  # points that each are drawn so; one among many shows less
AROUND_M = {2: 5.0, 3: 20.0}  # of map that is shown around a way, at most
_SHOWN_SHARES, _MARGIN_M = (0.2, 99.8), 1.0  # per cent of the points


def surroundings(low: Floats, high: Floats, clouds: Sequence[Points], dimension: int) -> tuple[Floats, Floats]:
    """Corners of a map: those of a way and some of what is around it, as far as there are points."""
    ends = np.array([np.percentile(points, _SHOWN_SHARES, axis=0) for points in clouds if len(points)])
    if not len(ends):
        return low, high
    around_m = AROUND_M[dimension]
    lowest, highest = ends[:, 0].min(axis=0) - _MARGIN_M, ends[:, 1].max(axis=0) + _MARGIN_M
    return (
        np.minimum(low, np.maximum(low - around_m, lowest)),
        np.maximum(high, np.minimum(high + around_m, highest)),
    )


def map_picture(name: str, points: Points, low: Floats, high: Floats) -> Markup:
    """Points (M, 3) seen from above, within corners; the colour is the height, where there is any."""
    shown = points[:: max(1, -(-len(points) // _MAX_POINTS))]
    inside = ((shown[:, :2] > low[:2]) & (shown[:, :2] < high[:2])).all(axis=1)
    shown = shown[inside]
    with Sheet.of_plan(name, low, high) as sheet:
        if len(shown):
            corners = (low[0], high[0], low[1], high[1])
            sheet.axes.imshow(_image(shown, low, high), extent=corners, origin="lower", interpolation="none")
        return sheet.svg()


def _image(points: Floats, low: Floats, high: Floats) -> NDArray[np.uint8]:
    """(H, W, 4), clear where nothing is, the fuller the more points there are, coloured as the highest of them."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgba

    width = float(np.clip(_PIXELS_A_POINT * np.sqrt(len(points)), *_WIDTHS))
    edge_m = (high[0] - low[0]) / width
    columns, rows = np.ceil((high[:2] - low[:2]) / edge_m).astype(int)
    points = points[np.argsort(points[:, 2])]
    column, row = ((points[:, :2] - low[:2]) / edge_m).astype(int).T
    colours = np.array([to_rgba(_POINTS)])
    if np.ptp(points[:, 2]):
        bottom, top = np.percentile(points[:, 2], (2.0, 98.0))
        colours = colormaps["viridis"]((points[:, 2] - bottom) / max(top - bottom, 1e-9))
    image = np.zeros((rows, columns, 4))
    image[row, column] = colours
    opacity = float(np.clip(_OPAQUE / len(points), *_OPACITIES))
    counts = np.bincount(row * columns + column, minlength=rows * columns).reshape(rows, columns)
    image[:, :, 3] = 1.0 - (1.0 - opacity) ** counts
    return np.rint(255.0 * image).astype(np.uint8)


def loops_picture(
    name: str, course: Course, edges: Floats, is_accepted: np.ndarray, low: Floats, high: Floats
) -> Markup:
    """The way (grey) with its closures, accepted and rejected; ``edges`` (E, 2, 3) from place to place."""
    with Sheet.of_plan(name, low, high) as sheet:
        sheet.axes.plot(course.positions[:, 0], course.positions[:, 1], color=_POINTS, linewidth=0.7)
        for chosen, colour in ((~is_accepted, _REJECTED), (is_accepted, _ACCEPTED)):
            gaps = np.full((int(chosen.sum()), 1, 2), np.nan)
            lines = np.concatenate([edges[chosen][:, :, :2], gaps], axis=1).reshape(-1, 2)
            sheet.axes.plot(lines[:, 0], lines[:, 1], color=colour, linewidth=0.9)
        sheet.axes.plot(*course.positions[0, :2], marker="o", markersize=4, color=INK)
        return sheet.svg()
