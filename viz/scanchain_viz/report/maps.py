"""report.html of maps: a merge, a log that was localized in one, and what changed between two."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Matrix
from scanchain.errors import counted
from scanchain.maps import read_ply
from scanchain.runs.directory import METRICS_FILE, RUN_FILE
from scanchain.runs.provenance import Provenance
from scanchain.sessions.change_run import COLORS, TABLE_FILE
from scanchain.sessions.changes import Changes, Label
from scanchain.sessions.localize import LocalizedLog, lines_of
from scanchain.sessions.localizer import MapState
from scanchain.sessions.merging import MergeMetrics
from scanchain_viz.colors import CLOSURES
from scanchain_viz.pictures import maps
from scanchain_viz.pictures.figure import INK, Line, Plot, broken
from scanchain_viz.report import page
from scanchain_viz.report.sections import configuration, provenance_sections, when

_HEADS = (
    page.Head("session"),
    page.Head("from", "UTC", is_text=True),
    page.Head("keyframes"),
    page.Head("closures", "", "closures accepted between this session and those of other maps"),
)
_GONE = page.Head("removed", "points", "points of its keyframes that newer sessions saw through")
STATE_COLORS = {
    MapState.SEARCHING: "#8c9096",
    MapState.LOCALIZED: "#3f9b2f",
    MapState.UNMATCHED: "#c77800",
    MapState.OUTSIDE: "#6a5acd",
    MapState.LOST: "#d6453d",
}
_AFTERWARDS = "#0f9bb5"
_ORDER = (Label.SAME, Label.UNKNOWN, Label.VANISHED, Label.APPEARED)
_HEX = {label: f"#{bytes(COLORS[label]).hex()}" for label in Label}
_HOW_LABELED = (
    "A point has changed if the scans of the other map saw through its position. It is unknown if the other map "
    "did not see its position, or if its cluster is too small."
)


def write_merge_report(directory: Path) -> None:
    """Draw and write the page of a merge."""
    metrics = msgspec.json.decode((directory / "metrics.json").read_bytes(), type=MergeMetrics)
    made = msgspec.json.decode((directory / RUN_FILE).read_bytes(), type=Provenance)
    summary, drawn = (directory / "summary.txt").read_text(encoding="utf-8"), maps.read_merge(directory)
    whole = page.Page(
        title="Merged map",
        subtitle=summary.partition("\n")[0].removeprefix("merged").strip(),
        facts=[*_merge_facts(metrics), ("made", when(made))],
        warnings=metrics.warnings,
        sections=(_merged_map(directory, drawn), _sessions(drawn, metrics)),
        collapsibles=(*provenance_sections(made, {}), configuration(directory)),
    )
    page.write_page(directory, whole)


def _merge_facts(m: MergeMetrics) -> Iterator[tuple[str, str]]:
    yield "sessions", f"{len(m.sessions)} of {len(m.sessions) + sum(map(len, m.apart))}"
    yield "keyframes", f"{m.keyframes:,}"
    yield "closures", f"{m.closures_tried:,} tried between maps, {m.closures_in_force:,} accepted"
    yield "pose graph", m.fit
    yield "certificate", m.certificate
    yield "map", counted(m.map_points, "point")
    yield "time", f"{m.run_s:.1f} s"


def _merged_map(directory: Path, drawn: maps.DrawnMerge) -> page.Section:
    points = read_ply(directory / "map.ply").astype(float)
    low, high = maps.surroundings(drawn.positions, [points])
    closures = Line("", broken(drawn.closures), CLOSURES[""][1], 0.5)
    grain_m, is_flat = Config().maps.voxel_size_m, drawn.dimension == 2
    drawings = (
        page.Drawing.of(
            "Sessions over the map",
            "Seen from above; thin green lines: accepted closures between sessions.",
            maps.over_map([closures, *drawn.sessions], points, low, high),
        ),
        page.interactive_map(points, drawn.sessions, low, high, grain_m=grain_m, is_flat=is_flat),
    )
    return page.Section("Map", chips=drawn.sessions, drawings=drawings)


def _sessions(drawn: maps.DrawnMerge, metrics: MergeMetrics) -> page.Section:
    rows = []
    for each, line in zip(metrics.sessions, drawn.sessions, strict=True):
        cells = [page.date(each.first_stamp_ns), f"{each.keyframes:,}", f"{each.closures:,}"]
        cells += [f"{each.removed_points:,}"] if metrics.updated else []
        rows.append(page.Row(each.name, cells, line))
    for group, warning in zip(metrics.apart, metrics.warnings, strict=False):  # those of the map come last
        why = page.Cell(warning.partition(": ")[2], "wide bad")
        rows += [page.Row(name, [why]) for name in group]
    return page.Section("Sessions", grid=page.Grid((*_HEADS, _GONE) if metrics.updated else _HEADS, rows))


def write_localization_report(folder: Path, localized: LocalizedLog) -> None:
    """Write the page into a folder."""
    m = localized.metrics
    facts = [("scans", f"{m.scans:,} over {m.path_m:.1f} m"), *lines_of(m)]
    subtitle = f"{localized.path.name} in the map {localized.prior.name}"
    sections = list(_localized(localized))
    page.write_page(folder, page.Page("Localization", subtitle, facts, m.warnings, (), sections, judged=m.judged))


def _localized(localized: LocalizedLog) -> Iterator[page.Section]:
    yield _path_section(localized)
    yield page.Section("State over the path", drawings=[_states_picture(localized)])
    heads = (page.Head("kind"), page.Head("scans"), page.Head("time", "s"), page.Head("path", "m"))
    for title, is_doubtful in (("Segments to check", True), ("Segments without the map", False)):
        rows = []
        for part in localized.metrics.parts:
            if part.is_doubtful is is_doubtful:
                scans, times = f"{part.first:,} to {part.last:,}", f"{part.start_s:.1f} to {part.end_s:.1f}"
                rows.append(page.Row(part.kind, (scans, times, f"{part.length_m:.1f}")))
        if rows:
            yield page.Section(title, grid=page.Grid(heads, rows))
    sessions = [
        page.Row(each.name, (f"{each.keyframes:,}", page.date(each.first_stamp_ns)))
        for each in localized.prior.sessions
    ]
    heads = (page.Head("session"), page.Head("keyframes"), page.Head("begins", "UTC", is_text=True))
    yield page.Section("The map", grid=page.Grid(heads, sessions))


def _path_section(localized: LocalizedLog) -> page.Section:
    found, points = localized.localization, np.vstack(maps.map_points(localized.prior))
    final, live = (lie.lift_points(poses[:, :-1, -1]) for poses in (found.trajectory.poses, found.live))
    ends = final[found.is_placed]
    low, high = maps.surroundings(ends, [points])
    later = found.is_placed & (found.states == MapState.SEARCHING)
    path = np.where(later[:, None], final, np.nan)
    lines = [Line("localized afterwards", path, _AFTERWARDS, 1.2, is_dashed=True)] if later.any() else []
    for state, color in STATE_COLORS.items():
        if (is_in := found.states == state).any():
            lines.append(Line(state, np.where(is_in[:, None], live, np.nan), color))
    figure = maps.over_map(lines, points, low, high, path=ends, is_wide=True)
    drawing = page.Drawing.of("Path over the map", "Circle: first scan localized; square: last.", figure)
    text = "As estimated at the time of each scan; dashed parts were localized afterwards, by smoothing."
    return page.Section("Path in the map", text, lines, [drawing])


def _states_picture(localized: LocalizedLog) -> page.Drawing:
    """Standard deviation of the position and state, over the path."""
    found = localized.localization
    figure = Plot("distance traveled [m]", "standard deviation [m]", height_inches=2.0, is_wide=True)
    runs = np.flatnonzero(found.states[1:] != found.states[:-1]) + 1
    top = float(np.nanmax(found.sigma_m, initial=0.01)) if np.isfinite(found.sigma_m).any() else 1.0
    for run in np.split(np.arange(len(found.states)), runs):
        first_m, last_m = found.traveled_m[[run[0], min(run[-1] + 1, len(found.states) - 1)]].tolist()
        figure.span(first_m, last_m, f"{STATE_COLORS[MapState(str(found.states[run[0]]))]}40")
    figure.line(np.stack([found.traveled_m, found.sigma_m], axis=1), INK, 0.9)
    figure.y.limit(0.0, 1.1 * top)
    text = "Background: the state, in the colors above."
    return page.Drawing.of("Standard deviation of the position", text, figure)


def write_changes_report(directory: Path, changes: Changes) -> None:
    """Write the page into a directory that holds metrics.json."""
    alignment = json.loads((directory / METRICS_FILE).read_text(encoding="utf-8"))["alignment"]
    counts = np.bincount(changes.labels, minlength=len(Label))
    facts = (
        ("alignment", str(alignment)),
        ("agreement", f"{100.0 * changes.agreement:.1f} % of what both observed"),
        ("resolution", f"{changes.voxel_size_m:g} m, scans up to {changes.reach_m:.0f} m"),
        *((label.name.lower(), f"{counts[label]:,} points") for label in _ORDER),
    )
    subtitle = f"from {changes.names[0]} to {changes.names[1]}"
    page.write_page(directory, page.Page("Changes", subtitle, facts, sections=list(_changed(changes))))


def _changed(changes: Changes) -> Iterator[page.Section]:
    points = lie.lift_points(changes.points)
    chips = [page.Chip(label.name.lower(), _HEX[label]) for label in _ORDER]
    plan = _changes_picture(points, changes, *maps.surroundings(points[:0], [points]), is_wide=True)
    drawing = page.Drawing.of(
        "Plan", "Seen from above; boxes around clusters, with their numbers in the table.", plan
    )
    yield page.Section("Where", _HOW_LABELED, chips, [drawing])
    if changes.clusters:
        yield page.Section("What changed", grid=_cluster_grid(changes))
        drawings = []
        for each in changes.clusters[:12]:  # the largest
            center = np.append(each.center[:2], 0.0)
            half_m = 1.5 * float(each.size_m[:2].max()) + 1.0
            figure = _changes_picture(points, changes, center - half_m, center + half_m)
            drawings.append(page.Drawing.of(f"{each.number}: {each.kind}", counted(each.points, "point"), figure))
        yield page.Section("The largest changes", drawings=drawings, is_small=True)


def _changes_picture(
    points: Matrix, changes: Changes, low: Matrix, high: Matrix, *, is_wide: bool = False
) -> Plot:
    """Points (M, 3) in the colors of their labels, seen from above, and boxes of clusters."""
    figure = Plot.of_plan(low, high, is_wide=is_wide)
    for label in _ORDER:
        maps.draw_points(figure, points[changes.labels == label], low, high, (_HEX[label],), changes.voxel_size_m)
    for cluster in changes.clusters:
        c, s = np.cos(cluster.yaw_rad), np.sin(cluster.yaw_rad)
        corners = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * cluster.size_m[:2]
        corners = corners @ np.array([[c, s], [-s, c]]) + cluster.center[:2]
        figure.line(corners, INK, 0.8)
        figure.text(corners.max(axis=0), str(cluster.number))
    return figure


def _cluster_grid(changes: Changes) -> page.Grid:
    is_flat, has_moved = changes.dimension == 2, any(each.counterpart for each in changes.clusters)
    meters = ("x", "y", "length", "width") if is_flat else ("x", "y", "z", "length", "width", "height")
    heads = (
        page.Head("number"),
        page.Head("kind", is_text=True),
        *(page.Head(name, "m") for name in meters),
        page.Head("area", "m²") if is_flat else page.Head("volume", "m³"),
        page.Head("points"),
        *([page.Head("counterpart", hint="number of the cluster that it moved to or from")] if has_moved else ()),
    )
    rows = []
    for each in changes.clusters[: page.MAX_ROWS]:
        numbers = [*each.center.tolist(), *each.size_m.tolist(), each.volume]
        cells = (each.kind, *(f"{number:.2f}" for number in numbers), f"{each.points:,}")
        cells += (str(each.counterpart or ""),) if has_moved else ()
        rows.append(page.Row(str(each.number), cells))
    left = len(changes.clusters) - page.MAX_ROWS
    return page.Grid(heads, rows, [f"and {left:,} smaller ones in {TABLE_FILE}"] if left > 0 else ())
