"""A self-contained report: one page, in light and dark, on paper and on a phone."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from math import isfinite
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from scanchain.files import write_whole
from scanchain.verdict import Judged, Verdict

REPORT_FILE = "report.html"
_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True, slots=True)
class Chip:
    """A name in a legend with the line that it is drawn with."""

    name: str
    color: str
    is_dashed: bool = False


@dataclass(frozen=True, slots=True)
class Cell:
    """A table's cell that is more than its text.

    mark : "best", "bad" for a problem, "doubted" for what may be one, "wide" up to the end of its row; or several
    """

    text: str
    mark: str = ""


def bad_if(is_bad: bool, text: str) -> Cell:
    """A cell that is marked as a problem where it is one."""
    return Cell(text, "bad" if is_bad else "")


def figure(value: float | None, scale: float, digits: int) -> str:
    """A figure in a table in its unit, – without a value."""
    return "–" if value is None or not isfinite(value) else f"{scale * value:.{digits}f}"


def date(stamp_ns: int) -> str:
    """A stamp as date and time, UTC."""
    return str(np.datetime64(stamp_ns, "ns").astype("datetime64[s]")).replace("T", " ")


def verdict_cell(verdict: str, text: str = "") -> Cell:
    """A verdict in a table, in other words if there are any, in the color of its severity; empty for none."""
    marks: dict[str, str] = {Verdict.NOT_TRUSTWORTHY: "bad", Verdict.CHECK: "doubted"}
    return Cell(text or verdict, marks.get(verdict, ""))


@dataclass(frozen=True, slots=True)
class Row:
    """A table's row: its subject, with its line in the drawings if it has one, and its cells.

    ``link`` : a page or file beside this one with details
    """

    name: str
    cells: Sequence[Cell | str]
    chip: Chip | None = None
    link: str = ""


@dataclass(frozen=True, slots=True)
class Head:
    """A column's head: name, unit, definition, and whether words stand below it."""

    text: str
    unit: str = ""
    hint: str = ""
    is_text: bool = False


@dataclass(frozen=True, slots=True)
class Grid:
    """A table, and notes on its reading, a line each."""

    heads: Sequence[Head]
    rows: Sequence[Row]
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Drawing:
    """A picture with its caption; ``svg`` comes from an ``Plot`` or is a scene, all else is escaped.

    ``is_wide`` : over the whole width of the page
    """

    title: str
    caption: str
    svg: Markup
    chip: Chip | None = None
    is_wide: bool = False


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page; ``facts`` are label and value, ``is_small`` puts more drawings side by side."""

    title: str
    text: str = ""
    chips: Sequence[Chip] = ()
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

    ``script`` : the only one that the page may run; ``judged`` : the verdict, which stands at its head
    """

    title: str
    subtitle: str
    facts: Sequence[tuple[str, str]] = ()
    warnings: Sequence[str] = ()
    notes: Sequence[str] = ()
    sections: Sequence[Section] = ()
    collapsibles: Sequence[Collapsible] = ()
    script: str = ""
    judged: Judged | None = None


def write_page(folder: Path, page: Page) -> None:
    """Write report.html; all text in it is escaped, and it may load nothing and run nothing but its script."""
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    digest = b64encode(sha256(page.script.encode()).digest()).decode("ascii")
    may_run = f"script-src 'sha256-{digest}'" if page.script else ""
    script = Markup(page.script)
    text = environment.get_template("report.html").render(page=page, may_run=may_run, script=script)
    write_whole(folder / REPORT_FILE, text.encode())
