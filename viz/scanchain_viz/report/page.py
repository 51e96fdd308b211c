"""A self-contained report: one page, in light and dark, for screen, paper and phone, with interactive maps."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from math import isfinite
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from scanchain.data import Points
from scanchain.files import write_whole
from scanchain.verdict import Judged, Verdict
from scanchain_viz.pictures.axis import MARGIN
from scanchain_viz.pictures.figure import MIDDLE, Floats, Line, Plot
from scanchain_viz.pictures.trajectories import DrawnTrajectory

REPORT_FILE = "report.html"
_TEMPLATES = Path(__file__).parent / "templates"
SCRIPT = (_TEMPLATES / "map_viewer.js").read_text(encoding="utf-8")
_SORTING = (_TEMPLATES / "sorting.js").read_text(encoding="utf-8")
MAX_ROWS = 100  # largest number of rows of a table; the longest segments or largest clusters are kept
_MAX_LINE_POINTS = 4_000  # largest number of points of a line: 0.03 MB of a page
_HIGHEST = float(np.iinfo(np.uint16).max)  # coordinates have 16 bits


@dataclass(frozen=True, slots=True)
class Chip:
    """A name in a legend with the style of its line."""

    name: str
    color: str
    is_dashed: bool = False


Named = Chip | Line | DrawnTrajectory  # what a legend names


@dataclass(frozen=True, slots=True)
class Cell:
    """A table's cell that is more than its text.

    mark : "best", "bad" for a problem, "doubted" for what may be one, "wide" for the rest of its row; or several
    """

    text: str
    mark: str = ""


def bad_if(is_bad: bool, text: str) -> Cell:
    """A cell that is marked as a problem where it is one."""
    return Cell(text, "bad" if is_bad else "")


def figure(value: float | None, scale: float, digits: int) -> str:
    """A number in a table, scaled to its unit; – without a value."""
    return "–" if value is None or not isfinite(value) else f"{scale * value:.{digits}f}"


def date(stamp_ns: int) -> str:
    """A stamp as date and time, UTC."""
    return str(np.datetime64(stamp_ns, "ns").astype("datetime64[s]")).replace("T", " ")


def verdict_cell(verdict: str, text: str = "") -> Cell:
    """A verdict in a table, or ``text`` in its place, in the color of its severity; empty without a verdict."""
    marks: dict[str, str] = {Verdict.NOT_TRUSTWORTHY: "bad", Verdict.CHECK: "doubted"}
    return Cell(text or verdict, marks.get(verdict, ""))


@dataclass(frozen=True, slots=True)
class Row:
    """A table's row: its subject, with the style of its line in the drawings if it has one, and its cells.

    ``link`` : relative, to a page or file with details
    """

    name: str
    cells: Sequence[Cell | str]
    chip: Named | None = None
    link: str = ""


@dataclass(frozen=True, slots=True)
class Head:
    """A column's head: name, unit, definition, and whether its cells are words."""

    text: str
    unit: str = ""
    hint: str = ""
    is_text: bool = False


@dataclass(frozen=True, slots=True)
class Grid:
    """A table, and notes on how to read it, one line each."""

    heads: Sequence[Head]
    rows: Sequence[Row]
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Drawing:
    """A picture with its caption; ``svg`` comes from a ``Plot`` or is an interactive map, all else is escaped.

    ``is_wide`` : across the whole width of the page; ``is_scripted`` : drawn by ``SCRIPT``; ``is_still`` : shown
    instead of a scripted one in print and where scripts do not run
    """

    title: str
    caption: str
    svg: Markup
    chip: Named | None = None
    is_wide: bool = False
    is_scripted: bool = False
    is_still: bool = False

    @classmethod
    def of(cls, title: str, caption: str, figure: Plot, chip: Named | None = None) -> Drawing:
        """The picture of a figure."""
        return cls(title, caption, figure.svg(), chip, figure.is_wide)


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page; ``facts`` are label and value, ``is_small`` puts more drawings side by side."""

    title: str
    text: str = ""
    chips: Sequence[Named] = ()
    drawings: Sequence[Drawing] = ()
    grid: Grid | None = None
    is_small: bool = False
    facts: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True, slots=True)
class Collapsible:
    """Collapsible section of plain text; printed on paper too, unless ``is_long``."""

    title: str
    text: str
    is_long: bool = False


@dataclass(frozen=True, slots=True)
class Page:
    """A report; ``facts`` are label and value, ``warnings`` stand out, ``notes`` do not.

    ``links`` : relative address and text; ``is_sortable`` : whether a click on a column's head sorts its table
    ``judged`` : the verdict, at the top; ``refuted`` : how the ground truth contradicts it, in red
    """

    title: str
    subtitle: str
    facts: Sequence[tuple[str, str]] = ()
    warnings: Sequence[str] = ()
    notes: Sequence[str] = ()
    sections: Sequence[Section] = ()
    collapsibles: Sequence[Collapsible] = ()
    judged: Judged | None = None
    refuted: str = ""
    links: Sequence[tuple[str, str]] = ()
    is_sortable: bool = False


def write_page(folder: Path, page: Page) -> None:
    """Write report.html; all text in it is escaped, and it may load nothing and run nothing but its scripts."""
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    is_scripted = any(drawing.is_scripted for section in page.sections for drawing in section.drawings)
    scripts = [Markup(SCRIPT)] * is_scripted + [Markup(_SORTING)] * page.is_sortable
    digests = [b64encode(sha256(each.encode()).digest()).decode("ascii") for each in scripts]
    may_run = " ".join(["script-src", *(f"'sha256-{digest}'" for digest in digests)]) if digests else ""
    text = environment.get_template("report.html").render(page=page, may_run=may_run, scripts=scripts)
    write_whole(folder / REPORT_FILE, text.encode())


def interactive_map(
    points: Points, lines: Sequence[Line], low: Floats, high: Floats, *, grain_m: float, is_flat: bool
) -> Drawing:  # fmt: skip
    """The canvas in which ``SCRIPT`` draws a map (M, 3) and lines; points outside of the corners are left out.

    grain_m : distance of neighboring points of the map, the size at which they are drawn in close-ups
    """
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    shown = inside[:: max(1, -(-len(inside) // 160_000))]  # 6 bytes each, 8 as text: 1.3 MB of a page
    view = _first_view(shown, lines, low, high)
    width, height = (view[1] - view[0])[:2]
    scene = {
        "box": [low.tolist(), high.tolist()],
        "view": view.tolist(),
        "heights": view[:, 2].tolist(),
        "grain": grain_m * np.sqrt(max(len(inside), 1) / max(len(shown), 1)),
        "flat": is_flat,
        "points": _packed(shown, low, high),
        "lines": [_line(line, low, high) for line in lines if len(line.positions)],
    }
    canvas = Markup(
        '<canvas class="scene"{} tabindex="0" role="img" aria-label="Map and trajectory, to rotate and zoom" '
        'data-scene="{}"></canvas><div class="buttons"></div>'
    )
    style = Markup(' style="height: auto; aspect-ratio: {:.3f}"').format(min(width / height, 3.0))
    drag = "Drag to move" if is_flat else "Drag to rotate, Shift-drag to move"
    text = f"{drag}, click it and scroll to zoom, double-click to reset; two fingers zoom and move."
    svg = canvas.format(style if is_flat else "", json.dumps(scene, separators=(",", ":")))
    return Drawing("Interactive map", text, svg, is_wide=not is_flat, is_scripted=True)


def _first_view(points: Points, lines: Sequence[Line], low: Floats, high: Floats) -> Floats:
    """Corners (2, 3) of the initial view: all lines and most points, with a margin."""
    bulk = np.percentile(points, MIDDLE, axis=0) if len(points) else np.empty((0, 3))
    seen = np.vstack([bulk, *(line.positions for line in lines)])
    first, last = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    margin = MARGIN * (last - first)
    return np.stack([np.maximum(first - margin, low), np.minimum(last + margin, high)])


def _line(line: Line, low: Floats, high: Floats) -> dict[str, object]:
    """A line for the script: whole and downsampled, or, where it is broken, as pairs of points."""
    positions, is_known = line.positions, np.isfinite(line.positions[:, 0])
    if is_broken := not is_known.all():
        starts = np.flatnonzero(is_known[:-1] & is_known[1:])
        positions = positions[np.stack([starts, starts + 1], axis=1).ravel()]
    elif len(positions) > _MAX_LINE_POINTS:
        positions = positions[np.linspace(0, len(positions) - 1, _MAX_LINE_POINTS).astype(int)]
    return {
        "points": _packed(positions, low, high),
        "color": line.color,
        "width": 1.8 * line.width,
        "dashed": line.is_dashed,
        "pairs": is_broken,
    }


def _packed(positions: NDArray[np.floating], low: Floats, high: Floats) -> str:
    """Positions as 16-bit fractions of the box, least significant byte first, in base64."""
    size = np.maximum(high - low, 1e-9)
    fractions = np.clip(np.rint(_HIGHEST * (positions - low) / size), 0.0, _HIGHEST)
    return b64encode(fractions.astype("<u2").tobytes()).decode("ascii")
