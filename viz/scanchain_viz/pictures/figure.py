"""Figures: SVG inside a page, in the page's light or dark colors, or a PNG file by matplotlib.

The SVG of a report is written without matplotlib, which takes half a second to load and as long again for a dozen
figures.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from scanchain.files import write_whole
from scanchain_viz.pictures.axis import FONT, Axis, width_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

INK, LINE = "var(--ink)", "var(--line)"  # the page's own colors
THIN, DOTS = 0.8, (1.0, 1.5)  # width and dashes, in widths, of a dotted line
DASHED = (3.0, 3.0)
_INCH = 72.0  # points, the unit of the drawing
_WIDTH, _WHOLE = 4.6, 9.6  # inches: of a figure next to another, of one across the page; same text size
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.8, 0.2, 0.45, 0.12  # inches around the axes: room for numbers and labels
_LOWEST, _HIGHEST, _HIGHEST_WHOLE = 1.5, 5.2, 6.5  # least and greatest heights of a plan in inches
_TICK = 3.5  # length of a tick, and its distance from the number
_ABOVE, _BELOW = 0.76 * FONT, 0.24 * FONT  # height of text above and below its baseline
_LABEL = 4.0  # distance of a label from the numbers
_SAME = 0.1  # points; successive positions of a line that are closer are merged
_FAR = 1e5  # points beyond which nothing is drawn
_LEVEL = 3  # PNG compression: a higher level takes twice as long and saves a tenth
_FRAME = "#cccccc"  # of axes on white
_PANEL_INCHES = (2.0, 12.0)  # least and greatest height of a figure in a PNG
_TITLE_INCHES, _TITLE_FONT = 0.77, 11.0  # room for its title and labels, and the height of their text in points
_STYLE = (
    f"font: {FONT:g}px 'DejaVu Sans', Verdana, Arial, sans-serif; fill: none; stroke-linejoin: round; "
    "stroke-linecap: butt"
)


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

    logarithmic : the axis with a logarithmic scale, "x" or "y"
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
        self.x, self.y = (Axis(is_logarithmic=name == logarithmic) for name in "xy")
        self.x.label, self.y.label = x_label, y_label
        self.has_grid = True
        self.height_inches, self.is_wide, self.proportions = height_inches, is_wide, (0.0, 0.0)  # of a plan
        self._within: list[Callable[[], str]] = []
        self._on_axes: list[Callable[[Axes], object]] = []

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
        size, (width, height) = np.array([_WHOLE if is_wide else _WIDTH, self.height_inches]), self.proportions
        if width:
            needed = (size[0] - _LEFT - _RIGHT) * height / width + _BOTTOM + _TOP
            size[1] = np.clip(needed, _LOWEST, _HIGHEST_WHOLE if is_wide else _HIGHEST)
        first, last = np.array([[_LEFT, _TOP], [_RIGHT, _BOTTOM]])
        room = extent = size - first - last
        if width:
            extent = np.min(room / self.proportions) * np.array(self.proportions)
        self.size, self.extent = _INCH * size, _INCH * extent
        self.corner = _INCH * (first + 0.5 * (room - extent))  # of the axes, on the left and above

    def line(
        self,
        positions: NDArray[np.floating],
        color: str,
        width: float = 1.2,
        dashes: Sequence[float] = (),
        *,
        name: str = "",
    ) -> None:
        """Draw a line through positions (N, 2) or, from above, (N, 3), broken where they are NaN.

        color : #rrggbb, or #rrggbbaa with its opacity
        dashes : lengths of dashes and gaps in line widths
        name : in the legend of a PNG; lines of the same name have one entry
        """
        x, y = self._included(positions)
        dashed = f"; stroke-dasharray: {' '.join(f'{width * each:.4g}' for each in dashes)}" if dashes else ""
        style = f"stroke: {color}; stroke-width: {width:g}{dashed}"
        self._within.append(lambda: f'<path d="{_path(self._at(x, y))}" style="{style}"/>')
        drawn = {"color": _on_white(color), "linewidth": width, "label": name or None}
        self._on_axes.append(lambda axes: axes.plot(x, y, linestyle=(0, (*dashes,)) if dashes else "-", **drawn))

    def marks(
        self,
        positions: NDArray[np.floating],
        shape: str,
        color: str,
        size: float,
        *,
        line: float = 0.0,
        name: str = "",
    ) -> None:
        """Draw a mark ``size`` points wide at each position (N, 2): a disk "o", a square "s" or a cross "+".

        line : width of its outline; 0 fills it instead
        name : as for ``line``
        """
        x, y = self._included(positions)
        half, style = 0.5 * size, f"stroke: {color}; stroke-width: {line:g}" if line else f"fill: {color}"
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
        self._on_axes.append(lambda axes: axes.plot(x, y, linestyle="none", marker=shape, **drawn))

    def text(self, position: Floats, text: str) -> None:
        """Write text above and to the right of a position (2,)."""
        x, y = self._included(position[None])

        def drawn() -> str:
            ((left, bottom),) = self._at(x, y).tolist()
            return _text(left + _BELOW, bottom - _BELOW, text, "start")

        self._within.append(drawn)

    def image(
        self,
        pixels: NDArray[np.uint8],
        palette: NDArray[np.uint8],
        low: Floats,
        high: Floats,
        *,
        rendering: str = "pixelated",
    ) -> None:
        """Draw an image (H, W) of palette indices between two corners, its first row at ``low``.

        palette : (K, 4) red, green, blue, opacity
        rendering : "pixelated" to keep pixels apart, "auto" to blend them
        """

        def drawn() -> str:
            (left, right), (bottom, top) = self._at(np.array([low[0], high[0]]), np.array([low[1], high[1]])).T
            picture, file = Image.fromarray(pixels[::-1] if top < bottom else pixels), BytesIO()
            picture.putpalette(palette[:, :3].tobytes())
            picture.save(file, "PNG", compress_level=_LEVEL, transparency=palette[:, 3].tobytes())
            data = b64encode(file.getvalue()).decode("ascii")
            return (
                f'<image x="{left:.2f}" y="{min(bottom, top):.2f}" width="{right - left:.2f}" '
                f'height="{abs(top - bottom):.2f}" preserveAspectRatio="none" '
                f'style="image-rendering: {rendering}" href="data:image/png;base64,{data}"/>'
            )

        self._within.append(drawn)
        extent = (low[0], high[0], low[1], high[1])
        self._on_axes.append(
            lambda axes: axes.imshow(palette[pixels], origin="lower", extent=extent, interpolation="antialiased")
        )

    def span(self, first: float, last: float, color: str) -> None:
        """Shade what lies between two values of x."""
        self.x.include(np.array([first, last]))

        def drawn() -> str:
            left, right = self.extent[0] * self.x.fractions(np.array([first, last]))
            box = f'x="{left:.2f}" width="{right - left:.2f}" height="{self.extent[1]:.2f}"'
            return f'<rect {box} style="fill: {color}"/>'

        self._within.append(drawn)

    def level(self, value: float) -> None:
        """Draw a dotted line at a value of y, from end to end."""
        self.y.include(np.array([value]))
        style = f"stroke: {INK}; stroke-width: {THIN:g}; stroke-dasharray: {' '.join(map(str, DOTS))}"

        def drawn() -> str:
            (place,) = self.extent[1] * (1.0 - self.y.fractions(np.array([value])))
            return f'<path d="M0 {place:.2f}H{self.extent[0]:.2f}" style="{style}"/>'

        self._within.append(drawn)

    def svg(self) -> Markup:
        """The figure as SVG for a page, a wide one also in a narrow version; it never contains text from a log."""
        sizes = (("wide", True), ("narrow", False)) if self.is_wide else (("", False),)
        return Markup("".join(self._drawn(name, is_wide=is_wide) for name, is_wide in sizes))

    def draw_on(self, axes: Axes, title: str) -> None:
        """Draw on axes of matplotlib, with a white background."""
        for draw in self._on_axes:
            draw(axes)
        axes.set(xlim=self.x.ends, ylim=self.y.ends, aspect="equal" if self.proportions[0] else "auto")
        axes.set_xlabel(self.x.label, fontsize=_TITLE_FONT - 2.0)
        axes.set_ylabel(self.y.label, fontsize=_TITLE_FONT - 2.0)
        axes.set_title(title, loc="left", fontsize=_TITLE_FONT)
        axes.tick_params(labelsize=_TITLE_FONT - 2.0, color=_FRAME)
        for spine in axes.spines.values():
            spine.set_color(_FRAME)

    def _drawn(self, name: str, *, is_wide: bool) -> str:
        self._lay_out(is_wide=is_wide)
        (left, top), (width, height) = self.corner, self.extent
        across = [(left + place * width, text) for place, text in self.x.ticks(width, is_upright=False)]
        up = [(top + (1.0 - place) * height, text) for place, text in self.y.ticks(height, is_upright=True)]
        bottom = top + height
        parts = [f'<svg class="{name}" viewBox="0 0 {self.size[0]:g} {self.size[1]:g}" style="{_STYLE}">']
        if self.has_grid:
            parts += [_rule(x, bottom, f"v{-height:.2f}", 0.5) for x, _ in across]
            parts += [_rule(left, y, f"h{width:.2f}", 0.5) for y, _ in up]
        parts.append(f'<svg x="{left:.2f}" y="{top:.2f}" width="{width:.2f}" height="{height:.2f}">')  # clips
        parts += [drawn() for drawn in self._within]
        parts.append(f"</svg>{_rule(left, top, f'v{height:.2f}h{width:.2f}', 0.8)}")
        for x, text in across:
            parts += [_rule(x, bottom, f"v{_TICK}", 0.8), _text(x, bottom + 2.0 * _TICK + _ABOVE, text)]
        for y, text in up:
            parts.append(_rule(left, y, f"h{-_TICK}", 0.8))
            parts.append(_text(left - 2.0 * _TICK, y + 0.5 * _ABOVE, text, "end"))
        below = bottom + 2.0 * _TICK + FONT + _LABEL + _ABOVE
        aside = left - 2.0 * _TICK - max((width_of(text) for _, text in up), default=0.0) - _LABEL - _BELOW
        if self.x.label:
            parts.append(_text(left + 0.5 * width, below, self.x.label))
        if self.y.label:
            parts.append(_text(aside, top + 0.5 * height, self.y.label, is_upright=True))
        return "".join([*parts, "</svg>"])

    def _included(self, positions: NDArray[np.floating]) -> Floats:
        """Columns x and y of positions; widens the axes to include them."""
        x, y = places = positions[:, :2].T.astype(np.float64)
        self.x.include(x)
        self.y.include(y)
        return places

    def _at(self, x: Floats, y: Floats) -> Floats:
        """Positions (N, 2) in points from the upper left corner of the axes."""
        places = np.stack([self.x.fractions(x), 1.0 - self.y.fractions(y)], axis=1) * self.extent
        return np.clip(places, -_FAR, _FAR)


def _rule(x: float, y: float, steps: str, width: float) -> str:
    return f'<path d="M{x:.2f} {y:.2f}{steps}" style="stroke: {LINE}; stroke-width: {width:g}"/>'


def _text(x: float, y: float, text: str, anchor: str = "middle", *, is_upright: bool = False) -> str:
    turned = f' transform="rotate(-90 {x:.2f} {y:.2f})"' if is_upright else ""
    style = f"fill: {INK}; text-anchor: {anchor}"
    return f'<text x="{x:.2f}" y="{y:.2f}"{turned} style="{style}">{Markup.escape(text)}</text>'


def _path(points: Floats) -> str:
    """SVG path through points (N, 2), broken where they are NaN."""
    known, cells = np.isfinite(points[:, 0] + points[:, 1]), np.rint(points / _SAME)
    begins, moves = known.copy(), np.ones(len(points), bool)
    begins[1:] &= ~known[:-1]
    moves[1:] = (cells[1:] != cells[:-1]).any(axis=1)
    kept = known & (begins | moves)
    return "".join(
        f"{'M' if is_first else 'L'}{x:.2f} {y:.2f}"
        for is_first, (x, y) in zip(begins[kept].tolist(), points[kept].tolist(), strict=True)
    )


def broken(segments: NDArray[np.floating]) -> Floats:
    """Segments (E, 2, d) as one line (3 E, d) that is broken between them."""
    gaps = np.full((len(segments), 1, segments.shape[-1]), np.nan)
    return np.concatenate([segments, gaps], axis=1).reshape(-1, segments.shape[-1])


def around(points: NDArray[np.floating], share: float, least: float) -> tuple[Floats, Floats]:
    """Corners (d,) around the finite points of (N, d), with a margin: ``share`` of their extent or ``least``."""
    known = points[np.isfinite(points).all(axis=1)]
    low, high = known.min(axis=0), known.max(axis=0)
    margin = max(share * float((high - low).max()), least)
    return low - margin, high + margin


def write_png(path: Path, panels: Sequence[tuple[str, Plot]], *, width_inches: float) -> None:
    """Write figures side by side, each below its title, with one legend; the tallest sets the height of all.

    width_inches : of each
    Raises OSError.
    """
    from matplotlib.figure import Figure

    shapes = [plot.proportions for _, plot in panels]
    height_inches = np.clip(width_inches * max(height / width for width, height in shapes), *_PANEL_INCHES)
    size = len(panels) * width_inches, float(height_inches) + _TITLE_INCHES
    figure, named = Figure(figsize=size, layout="constrained"), {}
    for axes, (title, plot) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        plot.draw_on(axes, title)
        named |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if named:
        figure.legend([*named.values()], [*named], loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    picture = BytesIO()
    figure.savefig(picture, facecolor="white", format="png", dpi=150, bbox_inches="tight")
    write_whole(path, picture.getvalue())


def _on_white(color: str) -> str:
    """The color on white that replaces a color of the page."""
    return "#1a1a1a" if color == INK else color
