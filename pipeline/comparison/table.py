"""The table of a comparison: as JSON, CSV, Markdown, and as a person reads it in a terminal."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from scanchain.comparison.columns import COLUMNS, columns_of
from scanchain.comparison.figures import Figures
from scanchain.comparison.outcome import Status
from scanchain.runs.provenance import Provenance

TABLE_FILE = "table.json"


class Row(Struct, frozen=True):
    """A method: how its runs ended, what it did with which settings, and its figures.

    Attributes
    ----------
    status, reason : of the first run that did not end well, else ok
    settings : whole, as a TOML file for --settings would hold them
    definitions : what its errors are, in words
    doubt : why it is not reliable by its own account, as most of its scans are degenerate; empty else
    """

    name: str
    base: str
    status: Status
    reason: str
    description: str
    settings: dict[str, Any]
    figures: Figures
    definitions: list[str]
    doubt: str = ""


class Table(Struct, frozen=True):
    """A comparison.

    Attributes
    ----------
    log, topic : what was read, for headings
    truth : what errors are against; empty where there is no ground truth
    truth_note : how many scans have no true pose, or why a truth could not be used; else empty
    disagreement_m : row by row the median distance between two methods' motions; None where one has failed
    notes : what was chosen or assumed, a line each
    baselines : versions of the packages that were compared
    """

    log: str
    topic: str
    dimension: int
    scans: int
    points_per_scan: float
    repeats: int
    truth: str
    truth_note: str
    rows: list[Row]
    disagreement_m: list[list[float | None]]
    notes: list[str]
    provenance: Provenance
    baselines: dict[str, str]

    @property
    def against(self) -> str:
        """What errors are against, in a sentence."""
        note = f" {self.truth_note}." if self.truth_note else ""
        if self.truth:
            return f"Errors are against {self.truth}.{note}"
        return (
            f"There is no ground truth: surfaces and to others tell who is sharp or alone, not who is right.{note}"
        )

    @property
    def figures(self) -> list[Figures]:
        """What the rows are compared by; nothing of one that did not end well."""
        return [row.figures if row.status is Status.OK else Figures() for row in self.rows]


def write_table(folder: Path, table: Table) -> None:
    """table.json, table.csv and table.md."""
    tree = msgspec.to_builtins(table) | {"columns": msgspec.to_builtins(COLUMNS)}
    (folder / TABLE_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(tree), indent=2) + b"\n")
    (folder / "table.csv").write_text(_csv(table), encoding="utf-8")
    (folder / "table.md").write_text(markdown(table), encoding="utf-8")


def read_table(folder: Path) -> Table:
    """The table of a comparison's directory."""
    return msgspec.json.decode((folder / TABLE_FILE).read_bytes(), type=Table)


def markdown(table: Table) -> str:
    """The summary for a README, the best of each column in bold, and below it what the columns say."""
    columns = columns_of(table.figures, "summary")
    head = ["method", *(column.heading for column in columns)]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    shown, bar = [column.cells(table.figures) for column in columns], "\\|"
    for place, row in enumerate(table.rows):
        cells = [f"**{cells[place].text}**" if cells[place].is_best else cells[place].text for cells in shown]
        if row.status is not Status.OK:
            cells = [f"{row.status}: {row.reason}".replace("|", bar), *[""] * (len(columns) - 1)]
        lines.append(f"| {row.name.replace('|', bar)} | {' | '.join(cells)} |")
    notes = [f"- *{column.heading}*: {column.definition}" for column in columns]
    return "\n".join([*lines, "", table.against, "", *notes]) + "\n"


def text(table: Table) -> str:
    """The summary, well set; the best of each column starred; then who failed and why."""
    columns = columns_of(table.figures, "summary")
    shown = [column.cells(table.figures) for column in columns]
    names = [row.name if row.status is Status.OK else f"{row.name}: {row.status}" for row in table.rows]
    names = ["method", "", *names]
    lines = [f"{name:<{max(map(len, names))}}" for name in names]
    for column, cells in zip(columns, shown, strict=True):
        texts = [column.head, column.unit, *(cell.text + (" ", "*")[cell.is_best] for cell in cells)]
        lines = [f"{line}  {text:>{max(map(len, texts))}}" for line, text in zip(lines, texts, strict=True)]
    endings = [f"{row.name}: {row.status}: {row.reason}" for row in table.rows if row.status is not Status.OK]
    endings += [f"{row.name}: UNRELIABLE: {row.doubt}" for row in table.rows if row.doubt]
    endings += [table.provenance.stopped] if table.provenance.stopped else []
    known = [line.rstrip() for line in lines]
    return "\n".join([*known, f"* best of its column. {table.against}", *endings]) + "\n"


def _csv(table: Table) -> str:
    """Every figure in its own unit, plus name and status."""
    keys = [column.key for column in COLUMNS]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["method", "status", *keys])
    for row in table.rows:
        writer.writerow([row.name, row.status, *(getattr(row.figures, key) for key in keys)])
    return buffer.getvalue()
