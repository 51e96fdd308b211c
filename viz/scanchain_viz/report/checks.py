"""Section of a report with the independent checks of a run, and the stretches that they found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from scanchain.runs.metrics import Metrics
from scanchain.runs.overlay import read_overlay
from scanchain.verdict import VELOCITY_LIMIT, WHEEL_LIMIT, Kind, Stretch, Verdict
from scanchain_viz.pictures.map_figures import AFTER, BEFORE, overlay_picture
from scanchain_viz.pictures.trajectory_figures import color_of, innovations, window
from scanchain_viz.report.page import Cell, Chip, Drawing, Grid, Head, Row, Section

_CURVES = {
    "wheel_innovation": ("wheels", WHEEL_LIMIT),
    "velocity_innovation": ("constant velocity", VELOCITY_LIMIT),
}
_SHADE = "#d6308f"
_MAX_ROWS = 100  # largest number of stretches in the table; the longest


def verdict_section(metrics: Metrics, steps: pa.Table, overlay_file: Path) -> Section:
    """Innovations along the log, two passes over the worst place if there is one, and every suspicious stretch."""
    curves = {
        name: (steps[column].to_numpy(zero_copy_only=False).astype(np.float64) / limit, color_of(place))
        for place, (column, (name, limit)) in enumerate(_CURVES.items())
        if column in steps.column_names
    }
    shaded = [(each.first, each.last, _SHADE) for each in metrics.stretches if each.kind is not Kind.LOOPS]
    chips = (
        *(Chip(name, color) for name, (_, color) in curves.items()),
        *((Chip("stretches to check", _SHADE),) if shaded else ()),
    )
    is_alone, size = not overlay_file.exists(), window(len(steps))
    largest = f", largest of {size} neighboring scans" if size > 1 else ""
    drawing = Drawing(
        "Innovations",
        f"Normalized innovations over their limits{largest}; above 1 (dotted) is a finding, or wheels that slip.",
        innovations(curves, shaded, is_wide=is_alone),
        is_wide=is_alone,
    )
    drawings = [drawing]
    if not is_alone:
        overlay = read_overlay(overlay_file)
        chips += (Chip("scans before", BEFORE), Chip("scans after", AFTER))
        caption = (
            f"{overlay.text}: the scans before it and after it, or of both passes of a loop, where the trajectory "
            "places them, seen from above. Where it is right, both show the same walls."
        )
        drawings.append(Drawing("Worst place", caption, overlay_picture(overlay)))
    heads = (
        Head("finding"), Head("first"), Head("last"), Head("scans"), Head("start", "s"), Head("end", "s"),
        Head("size", "m"),
    )  # fmt: skip
    longest = sorted(metrics.stretches, key=lambda each: each.last - each.first, reverse=True)[:_MAX_ROWS]
    rows = tuple(_row(each) for each in sorted(longest, key=lambda each: each.first))
    return Section("Checks", "", chips, tuple(drawings), Grid(heads, rows) if rows else None)


def verdict_cell(verdict: str, text: str = "") -> Cell:
    """A verdict in a table, in other words if there are any, in the color of its severity; empty for none."""
    return Cell(text or verdict, is_bad=verdict == Verdict.NOT_TRUSTWORTHY, is_doubted=verdict == Verdict.CHECK)


def _row(stretch: Stretch) -> Row:
    size = "–" if stretch.size_m is None else f"{stretch.size_m:.2f}"
    scans = (f"{value:,}" for value in (stretch.first, stretch.last, stretch.scans))
    cells = (*scans, f"{stretch.start_s:.1f}", f"{stretch.end_s:.1f}")
    return Row(str(stretch.kind), (*map(Cell, cells), Cell(size)))
