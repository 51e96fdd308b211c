"""report.html of a localized log: where it was found, how sure, and its path in the map."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scanchain import lie
from scanchain.errors import counted
from scanchain.sessions.localize import LocalizedLog, Part
from scanchain.sessions.localizer import MapState
from scanchain.verdict import Judged
from scanchain_viz.pictures.figure import INK, SvgFigure
from scanchain_viz.pictures.map_figures import extent, map_points, path_over_map
from scanchain_viz.pictures.trajectory_figures import PathLine
from scanchain_viz.report.page import REPORT_FILE, Cell, Chip, Drawing, Grid, Head, Page, Row, Section, write_page

COLORS = {
    MapState.SEARCHING: "#8c9096",
    MapState.LOCALIZED: "#3f9b2f",
    MapState.UNMATCHED: "#c77800",
    MapState.OUTSIDE: "#6a5acd",
    MapState.LOST: "#d6453d",
}
_PLACED_LATER = "#0f9bb5"


def write_localization_report(folder: Path, localized: LocalizedLog) -> None:
    """Write the page into a folder."""
    m = localized.metrics
    facts = (
        ("scans", f"{m.scans:,} over {m.path_m:.1f} m"),
        ("placed", f"{m.placed:,}, {100.0 * m.placed / max(m.scans, 1):.1f} %"),
        ("found", f"after {m.found_after_m:.1f} m, {m.found_after_s:.1f} s" if m.found_scan >= 0 else "not"),
        ("matches with the map", f"{m.matches:,}, {m.rejected:,} left out"),
        ("overlap", f"{m.median_overlap:.2f} (median)" if m.matches else "none"),
        ("standard deviation", f"{m.median_final_sigma_m:.3f} m (median)" if m.matches else "unknown"),
        ("log-odds of the place", f"{m.log_odds:.0f}" if np.isfinite(m.log_odds) else "none"),
        *([] if m.ground_truth is None else [("ATE", f"{m.ground_truth.optimized.ate_rmse_m:.4f} m (rmse)")]),
    )
    subtitle = f"{localized.path.name.split('.partial')[0]} in the map {localized.prior.name}"
    sections, judged = tuple(_sections(localized)), Judged(m.verdict, m.reason)
    write_page(
        folder / REPORT_FILE, Page("Localization", subtitle, facts, m.warnings, (), sections, judged=judged)
    )


def _sections(localized: LocalizedLog) -> Iterator[Section]:
    found, m = localized.localization, localized.metrics
    yield Section(
        "Path in the map",
        "As known at the time; the place of the dashed part was found afterwards, by smoothing.",
        chips=(
            *(Chip(state, color) for state, color in COLORS.items() if state in found.states),
            Chip("placed afterwards", _PLACED_LATER, is_dashed=True),
        ),
        drawings=(_path(localized),),
    )
    yield Section("State over the path", "", drawings=(_states(localized),))
    heads = (Head("kind"), Head("scans"), Head("time", "s"), Head("path", "m"))
    for title, is_doubtful in (("Stretches to check", True), ("Stretches without the map", False)):
        rows = tuple(_row(part) for part in m.parts if part.is_doubtful is is_doubtful)
        if rows:
            yield Section(title, grid=Grid(heads, rows))
    sessions = tuple(
        Row(each.name, (Cell(f"{each.keyframes:,}"), Cell(_date(each.first_stamp_ns))))
        for each in localized.prior.sessions
    )
    yield Section("The map", grid=Grid((Head("session"), Head("keyframes"), Head("begins", "UTC")), sessions))


def _row(part: Part) -> Row:
    scans, seconds = f"{part.first:,} to {part.last:,}", f"{part.start_s:.1f} to {part.end_s:.1f}"
    return Row(part.kind, (Cell(scans), Cell(seconds), Cell(f"{part.length_m:.1f}")))


def _date(stamp_ns: int) -> str:
    return str(np.datetime64(stamp_ns, "ns").astype("datetime64[s]")).replace("T", " ")


def _path(localized: LocalizedLog) -> Drawing:
    found = localized.localization
    points = map_points(localized.prior)
    low, high = extent(points)
    lines = []
    if found.is_placed.any():
        final = lie.lift_points(found.trajectory.poses[:, :-1, -1])
        later = np.where((found.is_placed & (found.states == MapState.SEARCHING))[:, None], final, np.nan)
        lines.append(PathLine(later, _PLACED_LATER, is_dashed=True, width=1.2))
        low, high = (
            np.minimum(low, final[found.is_placed].min(axis=0)),
            np.maximum(high, final[found.is_placed].max(axis=0)),
        )
    live = lie.lift_points(found.live[:, :-1, -1])
    for state, color in COLORS.items():
        lines.append(
            PathLine(np.where((found.states == state)[:, None], live, np.nan), color, is_dashed=False, width=1.4)
        )
    known = np.flatnonzero(found.is_placed)
    ends = (
        lie.lift_points(found.trajectory.poses[known][[0, -1], :-1, -1]) if len(known) else np.full((2, 3), np.nan)
    )
    margin = 0.02 * (high - low)
    svg = path_over_map(points, ends, lines, low - margin, high + margin, is_wide=True)
    return Drawing("Path over the map", "Circle: first scan placed; square: last.", svg, is_wide=True)


def _states(localized: LocalizedLog) -> Drawing:
    """Standard deviation of the position and state, over the path."""
    found = localized.localization
    figure, runs = SvgFigure(2.0, is_wide=True), np.flatnonzero(found.states[1:] != found.states[:-1]) + 1
    top = float(np.nanmax(found.sigma_m, initial=0.01)) if np.isfinite(found.sigma_m).any() else 1.0
    for run in np.split(np.arange(len(found.states)), runs):
        first_m, last_m = found.traveled_m[[run[0], min(run[-1] + 1, len(found.states) - 1)]].tolist()
        figure.span(first_m, last_m, COLORS[MapState(str(found.states[run[0]]))], 0.25)
    figure.line(found.traveled_m, found.sigma_m, INK, 0.9)
    figure.y.limit(0.0, 1.1 * top)
    figure.x.label, figure.y.label = "path [m]", "sigma [m]"
    count = counted(len(found.closures), "match with the map", "matches with the map")
    return Drawing(
        "Standard deviation of the position",
        f"Behind it the state, in the colors above; {count} tried.",
        figure.svg(),
        is_wide=True,
    )
