"""report.html of two maps that were compared: what changed, where, and pictures of the largest changes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from scanchain.data import Matrix
from scanchain.errors import counted
from scanchain.sessions.change_run import COLORS, METRICS_FILE, TABLE_FILE
from scanchain.sessions.changes import Changes, Cluster, Label
from scanchain_viz.pictures.figure import INK
from scanchain_viz.pictures.map_figures import extent, layers_picture
from scanchain_viz.report.page import REPORT_FILE, Cell, Chip, Drawing, Grid, Head, Page, Row, Section, write_page

_ROWS, _CLOSE_UPS = 200, 12
_AROUND_M = 3.0  # around a cluster in a close-up
_ORDER = (Label.SAME, Label.UNKNOWN, Label.VANISHED, Label.APPEARED)
_HEX = {label: "#" + bytes(COLORS[label]).hex() for label in Label}
_NAMES = {Label.SAME: "same", Label.UNKNOWN: "unknown", Label.VANISHED: "vanished", Label.APPEARED: "appeared"}
_TEXT = (
    "A change is named where the scans of the other map looked through the place. Unknown is what the other map "
    "did not see, or what is too small."
)


def write_changes_report(directory: Path, changes: Changes) -> None:
    """Write the page into a directory that holds metrics.json."""
    alignment = json.loads((directory / METRICS_FILE).read_text(encoding="utf-8"))["alignment"]
    counts = np.bincount(changes.labels, minlength=len(Label))
    facts = (
        ("alignment", str(alignment)),
        ("agreement", f"{100.0 * changes.agreement:.1f} % of what both had in sight"),
        ("resolution", f"{changes.voxel_size_m:g} m, scans up to {changes.reach_m:.0f} m"),
        *((name, f"{counts[label]:,} points") for label, name in _NAMES.items()),
    )
    title = f"{changes.names[0]} and, later, {changes.names[1]}"
    write_page(directory / REPORT_FILE, Page("Changes", title, facts, (), (), tuple(_sections(changes))))


def outline(cluster: Cluster) -> Matrix:
    """Corners (4, 2) of a cluster's box seen from above."""
    c, s = np.cos(cluster.yaw_rad), np.sin(cluster.yaw_rad)
    corners = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * cluster.size_m[:2]
    return corners @ np.array([[c, s], [-s, c]]) + cluster.center[:2]


def _sections(changes: Changes) -> Iterator[Section]:
    points = np.pad(changes.points, ((0, 0), (0, 3 - changes.dimension)))
    chips = tuple(Chip(_NAMES[label], _HEX[label]) for label in _ORDER)
    plan = _picture(points, changes, *extent(points), is_wide=True)
    drawing = Drawing("Plan", "Seen from above; boxes around clusters.", plan, is_wide=True)
    yield Section("Where", _TEXT, chips=chips, drawings=(drawing,))
    if changes.clusters:
        yield Section("What changed", grid=_grid(changes))
        largest = changes.clusters[:_CLOSE_UPS]
        yield Section("The largest changes", drawings=tuple(_close_ups(points, changes, largest)), is_small=True)


def _close_ups(points: Matrix, changes: Changes, clusters: Sequence[Cluster]) -> Iterator[Drawing]:
    for cluster in clusters:
        center = np.append(cluster.center[:2], 0.0)
        half = 0.5 * float(cluster.size_m[:2].max()) + _AROUND_M
        title = f"{cluster.number}: {cluster.kind}"
        picture = _picture(points, changes, center - half, center + half)
        yield Drawing(title, counted(cluster.points, "point"), picture)


def _picture(points: Matrix, changes: Changes, low: Matrix, high: Matrix, *, is_wide: bool = False) -> Markup:
    layers = [(points[changes.labels == label], _HEX[label]) for label in _ORDER]
    outlines = [(outline(each), INK) for each in changes.clusters]
    return layers_picture(layers, outlines, low, high, is_wide=is_wide)


def _grid(changes: Changes) -> Grid:
    axes = ("x", "y", "z")[: changes.dimension]
    sizes = ("length", "width", "height")[: changes.dimension]
    last = Head("volume", "m³") if changes.dimension == 3 else Head("area", "m²")
    heads = (
        Head("number"),
        Head("kind", is_text=True),
        *(Head(name, "m") for name in (*axes, *sizes)),
        last,
        Head("points"),
        Head("counterpart", hint="what it became or was when it moved"),
    )
    rows = tuple(Row(str(each.number), tuple(map(Cell, _cells(each)))) for each in changes.clusters[:_ROWS])
    left = len(changes.clusters) - _ROWS
    return Grid(heads, rows, (f"and {left:,} smaller ones: {TABLE_FILE}",) if left > 0 else ())


def _cells(cluster: Cluster) -> list[str]:
    numbers = [*cluster.center.tolist(), *cluster.size_m.tolist(), cluster.volume]
    counterpart = str(cluster.counterpart) if cluster.counterpart else ""
    return [cluster.kind, *(f"{number:.2f}" for number in numbers), f"{cluster.points:,}", counterpart]
