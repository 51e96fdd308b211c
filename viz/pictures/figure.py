"""Figures by matplotlib: an SVG inside a page that takes its colors, light or dark, or a PNG file."""

from __future__ import annotations

import io
import re
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain.whole_file import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH = 4.6  # inches
INK, LINE = "#010203", "#040506"  # stand for the page's own colors; nothing else is drawn in these
_VARIABLES = {INK: "var(--ink)", LINE: "var(--line)"}
_DPI = 140  # dots an inch of what is drawn as pixels
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.8, 0.2, 0.45, 0.12  # inches around the axes: room for numbers and labels
_LOWEST, _HIGHEST = 1.5, 5.2  # least and greatest height of a plan in inches
_SETTINGS: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.size": 8.0,
    "axes.edgecolor": LINE,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": LINE,
    "ytick.color": LINE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": LINE,
    "grid.linewidth": 0.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "lines.linewidth": 1.2,
}


def load() -> None:
    """Import matplotlib and load its fonts, as the first figure does, which takes half a second."""
    with SvgFigure("first") as figure:
        figure.svg()


class SvgFigure:
    """One figure with one pair of axes; a context, inside which ``axes`` is drawn on.

    height_inches : of the whole figure
    name : prefix of the ids of its parts on a page
    """

    def __init__(self, name: str, height_inches: float = 2.7) -> None:
        import matplotlib as mpl
        from matplotlib.figure import Figure

        self._context = mpl.rc_context(cast("Any", _SETTINGS | {"svg.hashsalt": name}))
        self._context.__enter__()
        self.figure: Figure = Figure(figsize=(_WIDTH, height_inches))
        self.axes: Axes = self.figure.add_subplot()
        self.figure.subplots_adjust(  # a layout engine would draw everything twice
            _LEFT / _WIDTH, _BOTTOM / height_inches, 1 - _RIGHT / _WIDTH, 1 - _TOP / height_inches
        )

    def __enter__(self) -> SvgFigure:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.__exit__(None, None, None)

    @classmethod
    def of_plan(
        cls, name: str, low: NDArray[np.float64], high: NDArray[np.float64], spare: float = 0.0
    ) -> SvgFigure:
        """A figure in the proportions of the box between two corners; ``spare`` inches stay free beside it."""
        inches = _WIDTH - _LEFT - _RIGHT - spare
        height = inches * (high[1] - low[1]) / (high[0] - low[0]) + _BOTTOM + _TOP
        figure = cls(name, float(np.clip(height, _LOWEST, _HIGHEST)))
        figure.axes.set_aspect("equal")
        figure.axes.set_xlim(low[0], high[0])
        figure.axes.set_ylim(low[1], high[1])
        figure.axes.set_xlabel("x [m]")
        figure.axes.set_ylabel("y [m]")
        return figure

    def svg(self) -> Markup:
        """The figure as SVG for a page; no text of a log is ever drawn."""
        buffer = io.StringIO()
        self.figure.patch.set_alpha(0.0)
        self.axes.patch.set_alpha(0.0)
        anonymous = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        self.figure.savefig(buffer, format="svg", dpi=_DPI, metadata=anonymous)
        text = buffer.getvalue()
        text = text[text.index("<svg") :]
        text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
        text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
        for color, variable in _VARIABLES.items():
            text = text.replace(color, variable)
        return Markup(text)


def write_figure(path: Path, figure: Figure, **options: Any) -> None:
    """Write it on white; ``options`` are those of savefig. Raises OSError."""
    picture = BytesIO()
    figure.savefig(picture, facecolor="white", format="png", **options)
    write_whole(path, picture.getvalue())
