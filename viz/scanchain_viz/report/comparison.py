"""report.html of a comparison, made from the files in its directory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from scanchain.comparison.processes import CLOSURES_FILE, Status
from scanchain.comparison.results import MAP_FILE, SETTINGS_FILE, TRUTH_FILE, method_folder
from scanchain.comparison.table import Table, columns_of, read_table
from scanchain.maps import read_ply
from scanchain.trajectory import read_tum
from scanchain_viz.pictures.figure import Floats
from scanchain_viz.pictures.maps import VIRIDIS, over_map, surroundings
from scanchain_viz.pictures.trajectories import DrawnTrajectory, frame, trajectories_of_comparison
from scanchain_viz.report import page, sections

_VERDICT = page.Head(
    "verdict", "", "with its error estimate; other tools are judged by wheels and constant velocity alone", True
)


def write_compare_report(directory: Path) -> None:
    """Draw and write the page."""
    table, trajectories = read_table(directory), trajectories_of_comparison(directory)
    truth_file, made = directory / TRUTH_FILE, table.provenance
    truth = read_tum(truth_file).poses[:, :3, 3] if truth_file.exists() else None
    facts = (
        ("log", table.log),
        ("topic", table.topic),
        ("scans", f"{table.scans:,} of {table.points_per_scan:,.0f} points, {table.dimension}D"),
        ("runs per method", str(table.repeats)),
        ("machine", f"{made.platform}, {made.cores} cores"),
        ("made", sections.when(made)),
    )
    warnings = [made.stopped] if made.stopped else []
    for row in table.rows:
        warnings += [f"{row.name} {row.status}: {row.reason}"] if row.status.is_failure else []
        warnings += [f"{row.name}: {row.sentence}"] if row.is_doubted else []
    how = "through every method, each in its own process"
    whole = page.Page(
        title=f"Comparison on {Path(table.log.split(', ')[0]).name}",
        subtitle=f"The same {table.scans:,} decoded scans {how}. {table.against}",
        facts=facts,
        warnings=warnings,
        notes=table.notes,
        sections=list(_sections(directory, table, trajectories, truth)),
        collapsibles=list(_collapsibles(directory, table)),
        links=[("compare.rrd", "recording for rerun"), ("table.csv", "table.csv")],
        is_sortable=True,
    )
    page.write_page(directory, whole)


def _grid(table: Table, part: str, trajectories: Sequence[DrawnTrajectory]) -> page.Grid:
    """One row per method; in the summary with its verdict, or the reason of a failure in place of its values."""
    columns, is_summary = columns_of(table.figures, part), part == "summary"
    chips = {trajectory.name: trajectory for trajectory in trajectories}
    shown, lines = [column.cells(table.figures) for column in columns], []
    for place, row in enumerate(table.rows):
        cells = [page.Cell(each[place].text, "best" if each[place].is_best else "") for each in shown]
        if is_summary:
            cells.append(page.verdict_cell(row.verdict, row.vouched))
        if row.status is not Status.OK:
            cells = [page.Cell(f"{row.status}: {row.reason}", "wide")]
        if is_summary or row.status is Status.OK:
            lines.append(page.Row(row.name, cells, chips.get(row.name)))
    heads = [page.Head("method"), *(page.Head(column.head, column.unit, column.definition) for column in columns)]
    heads += [_VERDICT] if is_summary else []
    return page.Grid(heads, lines, [f"{column.heading}: {column.definition}" for column in columns])


def _sections(
    directory: Path, table: Table, trajectories: Sequence[DrawnTrajectory], truth: Floats | None
) -> Iterator[page.Section]:
    yield page.Section("Summary", grid=_grid(table, "summary", trajectories))
    for part in ("accuracy", "time"):
        if columns_of(table.figures, part):
            yield page.Section(f"More on {part}", grid=_grid(table, part, trajectories))
    is_planar = table.dimension == 2
    if trajectories:
        # the axes frame the trajectories with maps nearly as sharp as the best; all if there are no maps
        thickness_m = {row.name: row.figures["thickness_m"] or np.inf for row in table.rows}
        limit_m = 1.25 * min(thickness_m[each.name] for each in trajectories)
        framing = [each for each in trajectories if thickness_m[each.name] <= limit_m]
        text = "All start at the same pose."
        if truth is not None:
            text = (
                "Each is aligned to the ground truth as for the ATE; one that did not finish, by its first pose."
            )
        elif len(framing) < len(trajectories):
            astray = ", ".join(each.name for each in trajectories if thickness_m[each.name] > limit_m)
            text += f" The axes frame the sharper maps; {astray} may extend beyond them."
        yield sections.trajectories_section(trajectories, framing, truth, is_planar=is_planar, text=text)
        yield from sections.error_section(trajectories, table.truth)
        yield from sections.relation_section(trajectories)
        yield from sections.time_section(trajectories)
        yield from sections.uncertainty_section(trajectories, is_planar=is_planar)
        yield from _map_section(directory, trajectories, framing, frame(framing, truth), table.dimension)
    for each in trajectories:
        closures = sections.read_closures(method_folder(directory, each.name) / CLOSURES_FILE)
        yield from sections.loop_section(each, closures, f"Loop closures of {each.name}")
    if len(table.rows) > 1:
        yield _disagreement(table)


def _map_section(
    directory: Path,
    trajectories: Sequence[DrawnTrajectory],
    framing: Sequence[DrawnTrajectory],
    box: Floats,
    dimension: int,
) -> Iterator[page.Section]:
    """Maps, all within the same corners; those of ``framing`` must be completely visible."""
    files = [(trajectory, method_folder(directory, trajectory.name) / MAP_FILE) for trajectory in trajectories]
    maps = [(trajectory, read_ply(file)) for trajectory, file in files if file.exists()]
    if not maps:
        return
    whole = {each.name for each in framing}
    corners = surroundings(box, [points for each, points in maps if each.name in whole])
    drawings = [
        page.Drawing.of(each.name, "", over_map([], points, *corners, colors=VIRIDIS), each)
        for each, points in maps
    ]
    text = "The same points of the same scans, transformed by the poses of each method."
    text += " Dark is low, bright is high." if dimension == 3 else ""
    yield page.Section("Maps", text, drawings=drawings, is_small=True)


def _disagreement(table: Table) -> page.Section:
    names = [row.name for row in table.rows]
    rows = [
        page.Row(name, [page.figure(value, 1e3, 1) for value in values])
        for name, values in zip(names, table.disagreement_m, strict=True)
    ]
    text = (
        "Median distance between the motions that two methods estimate for a scan, in millimeters. Not a measure "
        "of accuracy: two methods with the same error agree."
    )
    return page.Section("Disagreement", text, grid=page.Grid([page.Head("mm"), *map(page.Head, names)], rows))


def _collapsibles(directory: Path, table: Table) -> Iterator[page.Collapsible]:
    yield from sections.provenance_sections(table.provenance, table.baselines)
    methods = (f"{row.name}: {row.description or row.reason}" for row in table.rows)
    yield page.Collapsible("Methods", "\n".join(methods))
    definitions = dict.fromkeys(definition for row in table.rows for definition in row.definitions)
    if definitions:
        yield page.Collapsible("Definitions of the errors", "\n\n".join(definitions))
    settings = (directory / SETTINGS_FILE).read_text(encoding="utf-8")
    yield page.Collapsible("Settings, in the form of --config", settings, is_long=True)
