"""Figures: SVG inside a page, in the page's light or dark colors, or a PNG file by matplotlib.

The SVG of a report is written without matplotlib, which takes 0.7 s of a core to load and 0.1 s per figure.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from scanchain.files import write_whole
from scanchain_viz.pictures.axis import FONT, GAP, MARGIN, Axis, width_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
Positions = NDArray[np.floating]
Pixels = NDArray[np.uint8]

INK = "var(--ink)"  # the page's own color of text
THIN = 0.8  # width of a dotted line in points
DOTS, DASHED = (1.0, 1.5), (3.0, 3.0)  # lengths of dashes and gaps, in widths of the line
MIDDLE = (0.5, 99.5)  # percentiles of values that are shown at least
_INCH = 72.0  # points, the unit of the drawing
_TICK = 3.5  # length of a tick, and its distance from the number, in points
_ABOVE, _BELOW = 0.76 * FONT, 0.24 * FONT  # height of text above and below its baseline
_FRAME = "#cccccc"  # of axes on white


@dataclass(frozen=True, slots=True)
class Line:
    """A line through positions (N, 3), broken where they are NaN, with its name in a legend."""

    name: str
    positions: Floats
    color: str
    width: float = 1.4
    is_dashed: bool = False


class Plot:
    """One figure with one pair of axes: draw in their units, then call ``svg`` or ``write_png``.

    A PNG contains only its lines, marks and images.

    logarithmic : the axes with a logarithmic scale, "x", "y" or "xy"
    height_inches : of the whole figure
    is_wide : across the whole width of the page
    """

    def __init__(
        self,
        x_label: str = "",
        y_label: str = "",
        *,
        logarithmic: str = "",
        height_inches: float = 2.7,
        is_wide: bool = False,
    ) -> None:
        self.x = Axis(x_label, is_logarithmic="x" in logarithmic)
        self.y = Axis(y_label, is_logarithmic="y" in logarithmic)
        self.has_grid = True
        self.height_inches, self.is_wide, self.proportions = height_inches, is_wide, (0.0, 0.0)  # of a plan
        self._within: list[Callable[[], str]] = []
        self.on_axes: list[Callable[[Axes], object]] = []

    @classmethod
    def of_plan(cls, low: Floats, high: Floats, *, is_wide: bool = False, has_grid: bool = False) -> Plot:
        """A figure in the proportions of the box between two corners."""
        figure = cls("x [m]", "y [m]", is_wide=is_wide)
        figure.x.limit(low[0], high[0])
        figure.y.limit(low[1], high[1])
        figure.proportions, figure.has_grid = (float(high[0] - low[0]), float(high[1] - low[1])), has_grid
        return figure

    def _lay_out(self, *, is_wide: bool) -> None:
        """Set the size of the figure, corner and extent of its axes; in a plan, their scales are equal."""
        width, highest = (9.6, 6.5) if is_wide else (4.6, 5.2)  # inches, as all here: of a figure; of a plan
        left, right, bottom, top = 0.8, 0.2, 0.45, 0.12  # around the axes, for numbers and labels
        height, shape = self.height_inches, np.array(self.proportions)
        room = width - left - right
        if shape[0]:
            height = float(np.clip(room * shape[1] / shape[0] + bottom + top, 1.5, highest))
        room = _INCH * np.array([room, height - bottom - top])
        self.size = _INCH * width, _INCH * height
        self.extent = np.min(room / shape) * shape if shape[0] else room
        self.corner = _INCH * np.array([left, top]) + 0.5 * (room - self.extent)  # on the left and above

    def line(
        self, positions: Positions, color: str, width: float = 1.2, dashes: Sequence[float] = (), *, name: str = ""
    ) -> None:
        """Draw a line through positions (N, 2) or, from above, (N, 3), broken where they are NaN.

        color : #rrggbb, or #rrggbbaa with its opacity
        dashes : lengths of dashes and gaps in line widths
        name : in the legend of a PNG; lines of the same name have one entry
        """
        x, y = self._included(positions)
        style = _stroke(color, width, dashes)
        self._within.append(lambda: f'<path d="{_path(self._at(x, y))}" style="{style}"/>')
        drawn = {"color": _on_white(color), "linewidth": width, "label": name or None}
        self.on_axes.append(lambda axes: axes.plot(x, y, linestyle=(0, (*dashes,)) if dashes else "-", **drawn))

    def marks(
        self, positions: Positions, shape: str, color: str, size: float, *, line: float = 0.0, name: str = ""
    ) -> None:
        """Draw a mark ``size`` points wide at each position (N, 2): a disk "o", a square "s" or a cross "+".

        line : width of its outline; 0 fills it instead
        name : as for ``line``
        """
        x, y = self._included(positions)
        half, style = 0.5 * size, _stroke(color, line) if line else f"stroke: none; fill: {color}"
        outline = {
            "o": f"m{-half:g} 0a{half:g} {half:g} 0 1 0 {size:g} 0a{half:g} {half:g} 0 1 0 {-size:g} 0z",
            "s": f"m{-half:g} {-half:g}h{size:g}v{size:g}h{-size:g}z",
            "+": f"m{-half:g} 0h{size:g}m{-half:g} {-half:g}v{size:g}",
        }[shape]

        def path() -> str:
            points = self._at(x, y)
            known = points[np.isfinite(points).all(axis=1)].tolist()
            return f'<path d="{"".join(f"M{x:.2f} {y:.2f}{outline}" for x, y in known)}" style="{style}"/>'

        self._within.append(path)
        drawn = {"markersize": size, "color": _on_white(color), "label": name or None}
        drawn |= {"markerfacecolor": "none", "markeredgewidth": line} if line else {}
        self.on_axes.append(lambda axes: axes.plot(x, y, linestyle="none", marker=shape, **drawn))

    def text(self, position: Floats, text: str) -> None:
        """Write text above and to the right of a position (2,)."""
        x, y = self._included(position[None])

        def drawn() -> str:
            ((left, bottom),) = self._at(x, y).tolist()
            return _text(left + _BELOW, bottom - _BELOW, text, "start")

        self._within.append(drawn)

    def image(
        self, pixels: Pixels, palette: Pixels, low: Floats, high: Floats, *, rendering: str = "pixelated"
    ) -> None:
        """Draw an image (H, W) of palette indices between two corners, its first row at ``low``.

        palette : (K, 4) red, green, blue, opacity
        rendering : "pixelated" to keep pixels apart, "auto" to blend them
        """

        def drawn() -> str:
            (left, right), (bottom, top) = self._at(np.array([low[0], high[0]]), np.array([low[1], high[1]])).T
            picture, file = Image.fromarray(pixels[::-1] if top < bottom else pixels), BytesIO()
            picture.putpalette(palette[:, :3].tobytes())
            # a higher one takes twice as long and saves a tenth
            picture.save(file, "PNG", compress_level=3, transparency=palette[:, 3].tobytes())
            data = b64encode(file.getvalue()).decode("ascii")
            return (
                f'<image x="{left:.2f}" y="{min(bottom, top):.2f}" width="{right - left:.2f}" '
                f'height="{abs(top - bottom):.2f}" preserveAspectRatio="none" '
                f'style="image-rendering: {rendering}" href="data:image/png;base64,{data}"/>'
            )

        self._within.append(drawn)
        extent = (low[0], high[0], low[1], high[1])
        self.on_axes.append(
            lambda axes: axes.imshow(palette[pixels], origin="lower", extent=extent, interpolation="antialiased")
        )

    def span(self, first: float, last: float, color: str) -> None:
        """Shade what lies between two values of x."""
        ends = np.array([first, last])
        self.x.include(ends)

        def drawn() -> str:
            left, right = self.extent[0] * self.x.fractions(ends)
            style = f"stroke: none; fill: {color}"
            return f'<rect x="{left:.2f}" width="{right - left:.2f}" height="100%" style="{style}"/>'

        self._within.append(drawn)

    def level(self, value: float) -> None:
        """Draw a dotted line at a value of y, from end to end."""
        self.y.include(np.array([value]))

        def drawn() -> str:
            (place,) = self.extent[1] * (1.0 - self.y.fractions(np.array([value])))
            return f'<path d="M0 {place:.2f}H{self.extent[0]:.2f}" style="{_stroke(INK, THIN, DOTS)}"/>'

        self._within.append(drawn)

    def svg(self) -> Markup:
        """The figure as SVG for a page, a wide one also in a narrow version; it never contains text from a log."""
        sizes = (("wide", True), ("narrow", False)) if self.is_wide else (("", False),)
        return Markup("".join(self._drawn(name, is_wide=is_wide) for name, is_wide in sizes))

    def _drawn(self, name: str, *, is_wide: bool) -> str:
        self._lay_out(is_wide=is_wide)
        (left, top), (width, height) = self.corner, self.extent
        bottom, middle = top + height, top + 0.5 * height
        across = [(left + place * width, text) for place, text in self.x.ticks(width, is_upright=False)]
        up = [(bottom - place * height, text) for place, text in self.y.ticks(height, is_upright=True)]
        rules = [f"M{left:.2f} {top:.2f}v{height:.2f}h{width:.2f}"]
        rules += [f"M{x:.2f} {bottom:.2f}v{_TICK}" for x, _ in across]
        rules += [f"M{left:.2f} {y:.2f}h{-_TICK}" for y, _ in up]
        grid = [f"M{x:.2f} {bottom:.2f}v{-height:.2f}" for x, _ in across if self.has_grid]
        grid += [f"M{left:.2f} {y:.2f}h{width:.2f}" for y, _ in up if self.has_grid]
        below = bottom + 2.0 * _TICK + _ABOVE
        aside = left - 2.0 * _TICK - max((width_of(text) for _, text in up), default=0.0) - GAP - _BELOW
        texts = [_text(x, below, text) for x, text in across]
        texts += [_text(left - 2.0 * _TICK, y + 0.5 * _ABOVE, text, "end") for y, text in up]
        texts.append(_text(left + 0.5 * width, below + FONT + GAP, self.x.label))
        texts.append(
            _text(aside, middle, self.y.label, turned=f' transform="rotate(-90 {aside:.2f} {middle:.2f})"')
        )
        box = f'x="{left:.2f}" y="{top:.2f}" width="{width:.2f}" height="{height:.2f}"'  # clips
        within, axes = "".join(drawn() for drawn in self._within), f'<path d="{"".join(rules)}"/>{"".join(texts)}'
        return (
            f'<svg class="plot {name}" viewBox="0 0 {self.size[0]:g} {self.size[1]:g}">'
            f'<path class="grid" d="{"".join(grid)}"/><svg {box}>{within}</svg>{axes}</svg>'
        )

    def _included(self, positions: Positions) -> Floats:
        """Columns x and y of positions; widens the axes to include them."""
        x, y = places = positions[:, :2].T.astype(np.float64)
        self.x.include(x)
        self.y.include(y)
        return places

    def _at(self, x: Floats, y: Floats) -> Floats:
        """Positions (N, 2) in points from the upper left corner of the axes."""
        places = np.stack([self.x.fractions(x), 1.0 - self.y.fractions(y)], axis=1) * self.extent
        return np.clip(places, -1e5, 1e5)  # points, beyond which nothing is drawn


def _stroke(color: str, width: float, dashes: Sequence[float] = ()) -> str:
    dashed = f"; stroke-dasharray: {' '.join(f'{width * each:.4g}' for each in dashes)}" if dashes else ""
    return f"stroke: {color}; stroke-width: {width:g}{dashed}"


def _text(x: float, y: float, text: str, anchor: str = "middle", turned: str = "") -> str:
    return f'<text x="{x:.2f}" y="{y:.2f}"{turned} text-anchor="{anchor}">{Markup.escape(text)}</text>'


def _path(points: Floats) -> str:
    """SVG path through points (N, 2), broken where they are NaN."""
    moves = np.ones(len(points), bool)
    moves[1:] = (np.diff(np.rint(points / 0.1), axis=0) != 0.0).any(axis=1)  # points; NaN is unequal
    known = ("" if x + y != x + y else f"L{x:.2f} {y:.2f}" for x, y in points[moves].tolist())
    return "".join("M" + "".join(run)[1:] for is_known, run in groupby(known, bool) if is_known)


def broken(segments: Positions) -> Floats:
    """Segments (E, 2, d) as one line (3 E, d) that is broken between them."""
    gaps = np.full((len(segments), 1, segments.shape[-1]), np.nan)
    return np.concatenate([segments, gaps], axis=1).reshape(-1, segments.shape[-1])


def around(points: Positions, least: float = 1.0) -> tuple[Floats, Floats]:
    """Corners (d,) around the finite points of (N, d), with a margin of at least that many meters."""
    known = points[np.isfinite(points).all(axis=1)]
    low, high = known.min(axis=0), known.max(axis=0)
    margin = max(MARGIN * float((high - low).max()), least)
    return low - margin, high + margin


def write_png(path: Path, panels: Sequence[tuple[str, Plot]], *, width_inches: float) -> None:
    """Write figures side by side, each below its title, with one legend; the tallest sets the height of all.

    width_inches : of each
    Raises OSError.
    """
    from matplotlib.figure import Figure

    shapes = [plot.proportions for _, plot in panels]
    height_inches = np.clip(width_inches * max(height / width for width, height in shapes), 2.0, 12.0)
    size = len(panels) * width_inches, float(height_inches) + 0.77  # room for title and labels
    figure, named = Figure(figsize=size, layout="constrained"), {}
    for axes, (title, plot) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for draw in plot.on_axes:
            draw(axes)
        axes.set(xlim=plot.x.ends, ylim=plot.y.ends, aspect="equal" if plot.proportions[0] else "auto")
        axes.set_title(title, loc="left")
        axes.set_xlabel(plot.x.label)
        axes.set_ylabel(plot.y.label)
        axes.tick_params(color=_FRAME)
        axes.spines[:].set_color(_FRAME)
        named |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if named:
        figure.legend([*named.values()], [*named], loc="outside lower center", ncols=5, frameon=False)
    picture = BytesIO()
    figure.savefig(picture, facecolor="white", format="png", dpi=150, bbox_inches="tight")
    write_whole(path, picture.getvalue())


def _on_white(color: str) -> str:
    """The color on white that replaces a color of the page."""
    return "#1a1a1a" if color == INK else color
