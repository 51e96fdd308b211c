"""The table of a comparison: as JSON, CSV, Markdown, and as a person reads it in a terminal."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from pipeline.compare.figures import COLUMNS, Column, Figures, columns_of
from pipeline.compare.outcome import Status
from pipeline.runs.provenance import Provenance

TABLE_FILE = "table.json"


class Row(Struct, frozen=True):
    """A method: how its runs ended, what it did with which settings, and its figures.

    Attributes
    ----------
    status, reason : of the first run that did not end well, else ok
    settings : whole, as a TOML file for --settings would hold them
    definitions : what its errors are, in words
    """

    name: str
    base: str
    status: Status
    reason: str
    description: str
    settings: dict[str, Any]
    figures: Figures
    definitions: list[str]


class Table(Struct, frozen=True):
    """A comparison.

    Attributes
    ----------
    log, topic : what was read, for headings
    truth : what errors are against; empty where there is no ground truth
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
    rows: list[Row]
    disagreement_m: list[list[float | None]]
    notes: list[str]
    provenance: Provenance
    baselines: dict[str, str]

    @property
    def columns(self) -> list[Column]:
        """The columns that any method has a figure for."""
        return columns_of(self.figures)

    @property
    def figures(self) -> list[Figures]:
        """Those of all rows."""
        return [row.figures for row in self.rows]


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
    """The main columns for a README, the best of each in bold, and below it what they say."""
    columns = columns_of(table.figures, main=True)
    head = ["method", *(_head(column) for column in columns)]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    best = [column.best(table.figures) for column in columns]
    for place, row in enumerate(table.rows):
        if row.status is not Status.OK:
            ending = f"{row.status}: {row.reason}".replace("|", "\\|")
            lines.append(f"| {row.name} | {' | '.join([ending, *[''] * (len(columns) - 1)])} |")
            continue
        cells = [
            f"**{column.show(row.figures)}**" if best[index][place] else column.show(row.figures)
            for index, column in enumerate(columns)
        ]
        lines.append(f"| {row.name} | {' | '.join(cells)} |")
    notes = [f"*{_head(column)}*: {column.definition}." for column in columns]
    return "\n".join([*lines, "", *notes]) + "\n"


def text(table: Table) -> str:
    """The main columns, well set; the best of each starred; then who failed and why."""
    columns = columns_of(table.figures, main=True)
    best = [column.best(table.figures) for column in columns]
    grid = [["method", *(column.head for column in columns)], ["", *(column.unit for column in columns)]]
    for place, row in enumerate(table.rows):
        marks = ["*" if best[index][place] else " " for index in range(len(columns))]
        cells = [column.show(row.figures) + mark for column, mark in zip(columns, marks, strict=True)]
        grid.append([row.name, *(cells if row.status is Status.OK else [f" {row.status} "])])
    names = max(len(line[0]) for line in grid)
    widths = [max(len(line[i]) for line in grid if len(line) > 2) for i in range(1, len(columns) + 1)]
    lines = [
        f"{line[0]:<{names}}  "
        + "  ".join(f"{cell:>{width}}" for cell, width in zip(line[1:], widths, strict=False))
        for line in grid
    ]
    endings = [f"{row.name}: {row.status}: {row.reason}" for row in table.rows if row.status is not Status.OK]
    against = (
        f"errors against {table.truth}" if table.truth else "no ground truth: surfaces and to others are none"
    )
    return "\n".join([*(line.rstrip() for line in lines), f"* best of its column; {against}", *endings]) + "\n"


def _csv(table: Table) -> str:
    """Every figure in its own unit, plus name and status."""
    keys = [column.key for column in COLUMNS]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["method", "status", *keys])
    for row in table.rows:
        writer.writerow([row.name, row.status, *(getattr(row.figures, key) for key in keys)])
    return buffer.getvalue()


def _head(column: Column) -> str:
    return f"{column.head} {column.unit}".strip()
