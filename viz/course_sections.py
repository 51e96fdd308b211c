"""The parts of a report that speak of courses; those of which nothing is known are left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from viz import course_figures as figures
from viz.courses import Course, Floats
from viz.map_figures import loops_picture
from viz.report import Cell, Chip, Drawing, Grid, Head, Row, Section

_DOTTED = "Dotted: the truth. "
_SHOWN_CLOSURES = 12


def chip(course: Course) -> Chip:
    """The course in a legend."""
    return Chip(course.name, course.colour, course.is_dashed)


def way_section(
    courses: Sequence[Course], framing: Sequence[Course], truth: Floats | None, *, is_planar: bool, text: str
) -> Section:
    """Where they went; ``framing`` are those that must be seen whole."""
    corners = figures.frame(framing, truth)
    dotted = _DOTTED if truth is not None else ""
    drawings = [
        Drawing("Plan", f"{dotted}Seen from above.", figures.plan("plan", courses, truth, *corners)),
    ]
    if not is_planar:
        drawings.append(
            Drawing(
                "Height",
                f"{dotted}Over the distance travelled.",
                figures.height("height", courses, truth, *corners),
            )
        )
    return Section("Trajectories", text, tuple(chip(course) for course in courses), tuple(drawings))


def error_section(courses: Sequence[Course], truth_name: str) -> Iterator[Section]:
    """How far off they were."""
    known = _with(courses, "error_m")
    if not known:
        return
    yield Section(
        "Error",
        f"Distance of each pose from the true one after rigid alignment, against {truth_name}.",
        tuple(chip(course) for course in known),
        (
            Drawing(
                "Over the distance", "Median of neighbouring scans.", figures.error_over_distance("error", known)
            ),
            Drawing(
                "Distribution",
                "Share of the scans that are off by less.",
                figures.distribution("errors", known, "error_m", 1.0, "position error [m]"),
            ),
        ),
    )


def time_section(courses: Sequence[Course]) -> Iterator[Section]:
    """How long a scan took."""
    known = _with(courses, "seconds")
    if known:
        yield Section(
            "Time per scan",
            "",
            tuple(chip(course) for course in known),
            (
                Drawing("Along the log", "Median of neighbouring scans.", figures.time_per_scan("time", known)),
                Drawing(
                    "Distribution",
                    "Share of the scans that took less.",
                    figures.distribution("times", known, "seconds", 1e3, "time of a scan [ms]"),
                ),
            ),
        )


def knowledge_section(courses: Sequence[Course], limit: float, *, is_planar: bool) -> Iterator[Section]:
    """What they knew of themselves: covariances against errors, and directions that nothing determined."""
    told = _with(courses, "eigenvalue")
    if not told:
        return
    drawings = []
    judged = _with(courses, "nees")
    if judged:
        drawings.append(
            Drawing(
                "Covariance consistency",
                "Squared error of each motion over its covariance. Dotted: exact covariances; to the left of it "
                "they are too large, to the right too small.",
                figures.consistency("nees", judged, 3 if is_planar else 6),
            )
        )
    drawings.append(
        Drawing(
            "Degeneracy along the way",
            "Smallest eigenvalue of the information per inlier, worst of neighbouring scans: 0 is blind, 1 seen "
            "by every residual. Below the dotted line a scan is called degenerate.",
            figures.degeneracy("degeneracy", told, limit),
        )
    )
    drawings.append(
        Drawing(
            f"Where {told[0].name} saw little", "The same on the way.", figures.degeneracy_plan("blind", told[0])
        )
    )
    yield Section("What ours knows of itself", "", tuple(chip(course) for course in told), tuple(drawings))


def loop_section(course: Course, path: Path) -> Iterator[Section]:
    """Every loop closure tried, with its verdict."""
    if not path.exists():
        return
    table = pq.read_table(path)
    if not table.num_rows:
        yield Section(f"Loop closures of {course.name}", "None was tried: the way never comes back to itself.")
        return
    ends = np.stack([table["target_scan"].to_numpy(), table["source_scan"].to_numpy()], axis=1)
    is_accepted = np.array([verdict == "accepted" for verdict in table["verdict"].to_pylist()])
    low, high = figures.frame([course], None)
    inches = figures.proportions(low, high)
    picture = loops_picture("loops", course, course.positions[ends], is_accepted, low, high, inches)
    yield Section(
        f"Loop closures of {course.name}",
        f"{len(ends):,} tried, {is_accepted.sum():,} accepted. Those that weigh least come first; all are in "
        "loops.parquet.",
        (),
        (Drawing("On the way", "Green: accepted. Red: rejected.", picture),),
        _closure_grid(table.sort_by("weight").slice(0, _SHOWN_CLOSURES).to_pylist()),
    )


def _closure_grid(closures: list[dict]) -> Grid:
    heads = (
        Head("scans"), Head("overlap", "%"), Head("residual", "mm"),
        Head("weight", "", "left by the robust graph"), Head("verdict"), Head("reason", is_text=True),
    )  # fmt: skip
    rows = tuple(
        Row(
            f"{closure['target_scan']} – {closure['source_scan']}",
            (
                Cell(f"{100.0 * closure['overlap']:.0f}"),
                Cell(f"{1e3 * closure['residual_m']:.0f}"),
                Cell(f"{closure['weight']:.2f}"),
                Cell(closure["verdict"]),
                Cell(closure["reason"], is_wide=True),
            ),
        )
        for closure in closures
    )
    return Grid(heads, rows)


def _with(courses: Sequence[Course], key: str) -> list[Course]:
    return [course for course in courses if np.isfinite(getattr(course, key)).any()]
