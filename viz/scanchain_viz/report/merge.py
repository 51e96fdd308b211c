"""report.html of a merge, made of the files in its directory."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from scanchain.errors import counted
from scanchain.maps import read_ply
from scanchain.runs.directory import RUN_FILE
from scanchain.runs.provenance import Provenance
from scanchain.sessions.merging import MergeMetrics
from scanchain_viz.pictures.map_figures import surroundings
from scanchain_viz.pictures.merge import DrawnMerge, picture, read_merge
from scanchain_viz.pictures.trajectory_figures import PathLine
from scanchain_viz.recording.shapes import in_space
from scanchain_viz.report import page
from scanchain_viz.report.sections import provenance_sections
from scanchain_viz.report.trajectory_map import SCRIPT, interactive_map

_HEADS = (
    page.Head("session"),
    page.Head("from", "UTC", is_text=True),
    page.Head("keyframes"),
    page.Head("closures", "", "closures in force between this session and those of other maps"),
)
_GONE = page.Head("gone", "points", "points of its keyframes that newer sessions saw through, removed")


def write_merge_report(directory: Path) -> None:
    """Draw and write the page of a merge."""
    metrics = msgspec.json.decode((directory / "metrics.json").read_bytes(), type=MergeMetrics)
    made = msgspec.json.decode((directory / RUN_FILE).read_bytes(), type=Provenance)
    summary = (directory / "summary.txt").read_text(encoding="utf-8")
    drawn = read_merge(directory)
    whole = page.Page(
        title="Merged map",
        subtitle=summary.partition("\n")[0].removeprefix("merged").strip(),
        facts=tuple(_facts(metrics)),
        warnings=metrics.warnings,
        notes=(),
        sections=(_map_section(directory, drawn, metrics), _sessions(drawn, metrics)),
        collapsibles=(
            *provenance_sections(made, {}),
            page.Collapsible(
                "Configuration", (directory / "config.toml").read_text(encoding="utf-8"), is_long=True
            ),
        ),
        script=SCRIPT,
    )
    page.write_page(directory / page.REPORT_FILE, whole)


def _facts(m: MergeMetrics) -> Iterator[tuple[str, str]]:
    yield "sessions", f"{len(m.sessions)} of {len(m.sessions) + sum(map(len, m.apart))}"
    yield "keyframes", f"{m.keyframes:,}"
    yield "closures", f"{m.closures_tried:,} tried between maps, {m.closures_in_force:,} in force"
    yield "pose graph", m.fit
    yield "certificate", m.certificate
    yield "map", counted(m.map_points, "point")
    yield "time", f"{m.run_s:.1f} s"


def _map_section(directory: Path, drawn: DrawnMerge, metrics: MergeMetrics) -> page.Section:
    points = in_space(read_ply(directory / "map.ply")).astype(float)
    low, high = surroundings(drawn.positions.min(axis=0), drawn.positions.max(axis=0), [points])
    lines = [PathLine(each.positions, each.color, 1.4) for each in drawn.sessions]
    is_flat = metrics.dimension == 2
    drawings = (
        page.Drawing(
            "Sessions over the map",
            "Seen from above; thin lines: closures in force between sessions.",
            picture(drawn, points, low, high),
        ),
        interactive_map(points, lines, low, high, grain_m=drawn.grain_m, is_flat=is_flat),
    )
    chips = tuple(page.Chip(each.name, each.color) for each in drawn.sessions)
    return page.Section("Map", chips=chips, drawings=drawings)


def _sessions(drawn: DrawnMerge, metrics: MergeMetrics) -> page.Section:
    rows = tuple(
        page.Row(
            each.name,
            (
                page.Cell(_date(each.first_stamp_ns)),
                page.Cell(f"{each.keyframes:,}"),
                page.Cell(f"{each.closures:,}"),
                *([page.Cell(f"{each.removed_points:,}")] if metrics.updated else []),
            ),
            chip=page.Chip(each.name, line.color),
        )
        for each, line in zip(metrics.sessions, drawn.sessions, strict=True)
    )
    apart = tuple(
        page.Row(name, (page.Cell(warning.partition(": ")[2], is_wide=True, is_bad=True),))
        for group, warning in zip(metrics.apart, metrics.warnings, strict=False)  # of the map come last
        for name in group
    )
    return page.Section("Sessions", grid=page.Grid((*_HEADS, _GONE) if metrics.updated else _HEADS, rows + apart))


def _date(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(sep=" ", timespec="seconds")[:19]
