"""report.html of a comparison, made of what lies in its directory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from scanchain.comparison.figures import Column, columns_of
from scanchain.comparison.outcome import CLOSURES_FILE, Status
from scanchain.comparison.results import MAP_FILE, SETTINGS_FILE, TRUTH_FILE, method_folder
from scanchain.comparison.table import Row as TableRow
from scanchain.comparison.table import Table, read_table
from scanchain.maps import read_ply
from scanchain.trajectory import read_tum
from scanchain.viz.pictures import trajectory_figures as figures
from scanchain.viz.pictures.compared_trajectories import read_courses
from scanchain.viz.pictures.map_figures import map_picture, surroundings
from scanchain.viz.pictures.trajectory_figures import Course, Floats
from scanchain.viz.report.page import REPORT_FILE, Cell, Drawing, Fold, Grid, Head, Page, Row, Section, write_page
from scanchain.viz.report.sections import (
    chip,
    error_section,
    knowledge_section,
    loop_section,
    provenance_folds,
    relation_section,
    time_section,
    way_section,
)

_WIDEST = 10  # columns of a table beside the summary
_NEARLY = 1.25  # times the thickness of the sharpest map


def write_compare_report(directory: Path) -> None:
    """Draw and write the page."""
    table, courses = read_table(directory), read_courses(directory)
    truth_file = directory / TRUTH_FILE
    truth = read_tum(truth_file).poses[:, :3, 3] if truth_file.exists() else None
    page = Page(
        title=f"Comparison on {Path(table.log.split(', ')[0]).name}",
        subtitle=_subtitle(table),
        facts=_facts(table),
        warnings=tuple(_warnings(table)),
        notes=tuple(table.notes),
        sections=tuple(_sections(directory, table, courses, truth)),
        folds=tuple(_folds(directory, table)),
    )
    write_page(directory / REPORT_FILE, page)


def _subtitle(table: Table) -> str:
    how = "through each method, each in a process of its own"
    return f"The same {table.scans:,} decoded scans {how}. {table.against}"


def _facts(table: Table) -> tuple[tuple[str, str], ...]:
    made = table.provenance
    return (
        ("log", table.log),
        ("topic", table.topic),
        ("scans", f"{table.scans:,} of {table.points_per_scan:,.0f} points, {table.dimension}D"),
        ("runs of a method", str(table.repeats)),
        ("machine", f"{made.platform}, {made.cores} cores"),
        ("made", f"{datetime.fromisoformat(made.started):%Y-%m-%d %H:%M} UTC, in {made.duration_s:.0f} s"),
    )


def _warnings(table: Table) -> Iterator[str]:
    if table.provenance.stopped:
        yield table.provenance.stopped
    for row in table.rows:
        if row.status.is_failure:
            yield f"{row.name} {row.status}: {row.reason}"
        if row.doubt:
            yield f"{row.name} is unreliable: {row.doubt}"


def _figures(table: Table, courses: Sequence[Course]) -> Iterator[Section]:
    """The summary, and all else in one table more, or in two where that would be too wide."""
    yield Section("Summary", grid=_grid(table, table.rows, courses, columns_of(table.figures, "summary")))
    ended = [row for row in table.rows if row.status is Status.OK]
    accuracy, time = columns_of(table.figures, "accuracy"), columns_of(table.figures, "time")
    parts = {"More on accuracy": accuracy, "More on time": time}
    if len(accuracy) + len(time) <= _WIDEST:
        parts = {"More figures": [*accuracy, *time]}
    for title, columns in parts.items():
        if columns:
            yield Section(title, grid=_grid(table, ended, courses, columns))


def _grid(table: Table, rows: Sequence[TableRow], courses: Sequence[Course], columns: Sequence[Column]) -> Grid:
    """A row a method; one that failed says how in place of its figures."""
    chips = {course.name: chip(course) for course in courses}
    shown = [dict(zip((row.name for row in table.rows), c.cells(table.figures), strict=True)) for c in columns]
    lines = []
    for row in rows:
        cells = tuple(Cell(each[row.name].text, each[row.name].is_best) for each in shown)
        if row.status is not Status.OK:
            cells = (Cell(f"{row.status}: {row.reason}", is_wide=True),)
        lines.append(Row(row.name, cells, chips.get(row.name)))
    heads = (Head("method"), *(Head(column.head, column.unit, column.definition) for column in columns))
    notes = tuple(f"{column.heading}: {column.definition}" for column in columns)
    return Grid(heads, tuple(lines), notes)


def _sections(directory: Path, table: Table, courses: Sequence[Course], truth: Floats | None) -> Iterator[Section]:
    yield from _figures(table, courses)
    is_planar = table.dimension == 2
    drawn = [course for course in courses if len(course.positions)]
    if drawn:
        framing = _sharpest(table, drawn)
        text = "All start in the same place."
        if truth is not None:
            text = "Each moved onto the truth as for the ATE, one that did not come to its end by its first pose."
        if truth is None and len(framing) < len(drawn):
            whole = {course.name for course in framing}
            astray = ", ".join(course.name for course in drawn if course.name not in whole)
            text += f" The corners are those of the sharper maps; what leaves the picture is of {astray}."
        yield way_section(drawn, framing, truth, is_planar=is_planar, text=text)
        yield from error_section(drawn, table.truth)
        yield from relation_section(drawn)
        yield from time_section(drawn)
        yield from knowledge_section(drawn, is_planar=is_planar)
        yield from _map_section(directory, drawn, framing, figures.frame(framing, truth), table.dimension)
    for course in courses:
        yield from loop_section(
            course, method_folder(directory, course.name) / CLOSURES_FILE, f"Loop closures of {course.name}"
        )
    if len(table.rows) > 1:
        yield _disagreement(table)


def _sharpest(table: Table, courses: Sequence[Course]) -> list[Course]:
    """Those whose maps are nearly as sharp as the best: what pictures must show whole; all without maps."""
    thickness_m = {row.name: row.figures.thickness_m or np.inf for row in table.rows}
    limit_m = _NEARLY * min(thickness_m[course.name] for course in courses)
    return [course for course in courses if thickness_m[course.name] <= limit_m]


def _map_section(
    directory: Path,
    courses: Sequence[Course],
    framing: Sequence[Course],
    way: tuple[Floats, Floats],
    dimension: int,
) -> Iterator[Section]:
    """Maps, all within the same corners; those of ``framing`` must be seen whole."""
    files = [(course, method_folder(directory, course.name) / MAP_FILE) for course in courses]
    maps = [(course, read_ply(file)) for course, file in files if file.exists()]
    if not maps:
        return
    whole = {course.name for course in framing}
    corners = surroundings(*way, [points for course, points in maps if course.name in whole])
    drawings = tuple(
        Drawing(course.name, "", map_picture(f"map {course.name}", points, *corners), chip(course))
        for course, points in maps
    )
    text = "The same points of the same scans, put where each method has the lidar."
    text += " Dark is low, bright is high." if dimension == 3 else ""
    yield Section("Maps", text, drawings=drawings, is_small=True)


def _disagreement(table: Table) -> Section:
    names = [row.name for row in table.rows]
    rows = [
        Row(name, tuple(Cell("–" if value is None else f"{1e3 * value:.1f}") for value in values))
        for name, values in zip(names, table.disagreement_m, strict=True)
    ]
    return Section(
        "Disagreement",
        "Median distance between the motions that two methods find for a scan, in millimeters. "
        "Not ground truth: two that err alike agree.",
        grid=Grid((Head("mm"), *(Head(name) for name in names)), tuple(rows)),
    )


def _folds(directory: Path, table: Table) -> Iterator[Fold]:
    yield from provenance_folds(table.provenance, table.baselines)
    yield Fold("Methods", "\n".join(f"{row.name}: {row.description or row.reason}" for row in table.rows))
    definitions = dict.fromkeys(definition for row in table.rows for definition in row.definitions)
    if definitions:
        yield Fold("What errors are", "\n\n".join(definitions))
    yield Fold(
        "Settings, as --settings takes them", (directory / SETTINGS_FILE).read_text(encoding="utf-8"), is_long=True
    )
