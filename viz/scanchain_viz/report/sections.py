"""Sections that reports of runs and of comparisons share; those without data are left out."""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scanchain.runs.provenance import Provenance
from scanchain_viz.pictures import trajectory_figures as figures
from scanchain_viz.pictures.map_figures import loops_picture
from scanchain_viz.pictures.trajectory_figures import CLOSURES, TRUTH, DrawnTrajectory, Floats
from scanchain_viz.report.page import Cell, Chip, Collapsible, Drawing, Grid, Head, Row, Section

_TRUTH_CHIP = Chip("ground truth", TRUTH, is_dashed=True)
_WITHOUT_CAUSES = "This run is older than the column cause; reasons are in loops.parquet, a sentence a closure."


def chip(trajectory: DrawnTrajectory) -> Chip:
    """The trajectory in a legend."""
    return Chip(trajectory.name, trajectory.color, trajectory.is_dashed)


def _legend(trajectories: Sequence[DrawnTrajectory]) -> tuple[Chip, ...]:
    """Legend of several trajectories; one needs none."""
    return tuple(chip(trajectory) for trajectory in trajectories) if len(trajectories) > 1 else ()


def trajectories_section(
    trajectories: Sequence[DrawnTrajectory],
    framing: Sequence[DrawnTrajectory],
    truth: Floats | None,
    *,
    is_planar: bool,
    text: str,
) -> Section:
    """Trajectories from above, and their heights; ``framing`` are those that must fit in the axes."""
    corners = figures.frame(framing, truth)
    seen = figures.plan(trajectories, truth, *corners, is_wide=is_planar)
    drawings = [Drawing("Plan", "Seen from above.", seen, is_wide=is_planar)]
    if not is_planar:
        height = figures.height(trajectories, truth, *corners)
        drawings.append(Drawing("Height", "Over the distance traveled.", height))
    chips = _legend(trajectories) if truth is None else (*map(chip, trajectories), _TRUTH_CHIP)
    return Section("Trajectories", text, chips, tuple(drawings))


def error_section(trajectories: Sequence[DrawnTrajectory], truth_name: str) -> Iterator[Section]:
    """Position errors over distance and their distribution."""
    known = _with(trajectories, "error_m")
    if not known:
        return
    yield Section(
        "Error",
        f"Distance of each position from the true one after rigid alignment, against {truth_name}.",
        _legend(known),
        (
            Drawing(
                "Over the distance", _of_neighbors("Medians", known, "error_m"), figures.error_over_distance(known)
            ),
            Drawing(
                "Distribution",
                "Share of the scans with a smaller error.",
                figures.distribution(known, "error_m", 1.0, "position error [m]"),
            ),
        ),
    )


def relation_section(trajectories: Sequence[DrawnTrajectory]) -> Iterator[Section]:
    """Errors over manually verified relations."""
    known = _with(trajectories, "relation_error_m")
    if known:
        drawing = Drawing(
            "Distribution",
            "Share of the relations with a smaller error.",
            figures.distribution(known, "relation_error_m", 1.0, "error of a relation [m]", is_wide=True),
            is_wide=True,
        )
        text = "Distance between the motion of a relation and that of the trajectory."
        yield Section("Error over relations", text, _legend(known), (drawing,))


def time_section(trajectories: Sequence[DrawnTrajectory], stages: Grid | None = None) -> Iterator[Section]:
    """Time per scan by stage, along the log, and its distribution."""
    known = _with(trajectories, "seconds")
    if known:
        along = figures.time_per_scan(known)
        yield Section(
            "Time per scan",
            "",
            _legend(known),
            (
                Drawing("Along the log", _of_neighbors("Medians", known, "seconds"), along),
                Drawing(
                    "Distribution",
                    "Share of the scans that took less.",
                    figures.distribution(known, "seconds", 1e3, "time of a scan [ms]"),
                ),
            ),
            stages,
        )


def uncertainty_section(trajectories: Sequence[DrawnTrajectory], *, is_planar: bool) -> Iterator[Section]:
    """Consistency of the covariances with the errors, and observability."""
    reported = _with(trajectories, "observability")
    if not reported:
        return
    consistency = tuple(_consistency(trajectories, is_planar=is_planar))
    least = _of_neighbors(" Least values", reported, "observability")
    along = Drawing(
        "Observability",
        "Information along the least constrained direction over the minimum required; below 1 (dotted) a scan is "
        f"degenerate.{least}",
        figures.observability(reported, is_wide=bool(consistency)),
        is_wide=bool(consistency),
    )
    whose = f" of {reported[0].name}" if len(trajectories) > 1 else ""
    where = Drawing(
        f"Observability{whose} on the trajectory",
        "Seen from above, the least observable scans on top.",
        figures.observability_plan(reported[0]),
    )
    yield Section("Uncertainty", "", _legend(reported), (along, *consistency, where))


def _consistency(trajectories: Sequence[DrawnTrajectory], *, is_planar: bool) -> Iterator[Drawing]:
    with_covariances = _with(trajectories, "nees")
    if with_covariances:
        yield Drawing(
            "Covariance consistency",
            "Squared error of each motion over its covariance. Dotted: exact covariances; to the left of it "
            "they are too large, to the right too small.",
            figures.consistency(with_covariances, 3 if is_planar else 6),
        )


def loop_section(trajectory: DrawnTrajectory, path: Path, title: str, min_travel_m: float) -> Iterator[Section]:
    """Every loop closure tried, and the number of each verdict; ``min_travel_m`` is ``loops.min_travel_m``."""
    if not path.exists():
        return
    table = pq.ParquetFile(path).read()  # read_table imports much more
    if not table.num_rows:
        length_m = float(trajectory.distance_m[-1])
        reason = f"the trajectory did not return to a place visited more than {min_travel_m:g} m before"
        if length_m <= min_travel_m:
            reason = f"the trajectory is {length_m:.1f} m long, and a loop has more than {min_travel_m:g} m"
        yield Section(title, f"None was tried: {reason} (loops.min_travel_m).")
        return
    ends = np.stack([table["target_scan"].to_numpy(), table["source_scan"].to_numpy()], axis=1)
    rejected_by = np.array(table["rejected_by"].to_pylist())
    counts = Counter(rejected_by.tolist())
    low, high = figures.frame([trajectory], None)
    picture = loops_picture(trajectory, trajectory.positions[ends], rejected_by, low, high)
    yield Section(
        title,
        f"{len(ends):,} tried; each is a row of loops.parquet.",
        tuple(Chip(f"{name}: {counts[by]:,}", color) for by, (name, color) in CLOSURES.items()),
        (Drawing("On the trajectory", "Seen from above; circle: start.", picture, is_wide=True),),
        _verdict_grid(table),
    )


def _verdict_grid(closures: pa.Table) -> Grid:
    """Closures by verdict and cause, most frequent first; by verdict alone where a run has no causes."""
    has_causes = "cause" in closures.column_names
    causes = closures["cause"].to_pylist() if has_causes else [""] * closures.num_rows
    groups: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    for place, (by, cause) in enumerate(zip(closures["rejected_by"].to_pylist(), causes, strict=True)):
        groups[CLOSURES[by][0], cause].append(place)
    overlap, residual_m = closures["overlap"].to_numpy(), closures["residual_m"].to_numpy()
    heads = (
        Head("verdict"), Head("closures"), Head("overlap", "%", "median"), Head("residual", "mm", "median"),
        *((Head("cause", is_text=True),) if has_causes else ()),
    )  # fmt: skip
    rows = tuple(
        Row(
            verdict,
            (
                Cell(f"{len(places):,}"),
                Cell(f"{100.0 * np.median(overlap[places]):.0f}"),
                Cell(_millimeters(float(np.median(residual_m[places])))),
                *((Cell(cause, is_wide=True),) if has_causes else ()),
            ),
        )
        for (verdict, cause), places in sorted(groups.items(), key=lambda group: -len(group[1]))
    )
    return Grid(heads, rows, () if has_causes else (_WITHOUT_CAUSES,))


def _millimeters(value_m: float) -> str:
    """Millimeters as text, – without a value."""
    return f"{1e3 * value_m:.0f}" if np.isfinite(value_m) else "–"


def _of_neighbors(what: str, trajectories: Sequence[DrawnTrajectory], key: str) -> str:
    """The caption of lines whose points stand for several scans each; none where each is a scan."""
    count = max(int(np.isfinite(getattr(each, key)).sum()) for each in trajectories)
    size = figures.window(count)
    return f"{what} of {size} neighboring scans." if size > 1 else ""


def _with(trajectories: Sequence[DrawnTrajectory], key: str) -> list[DrawnTrajectory]:
    return [trajectory for trajectory in trajectories if np.isfinite(getattr(trajectory, key)).any()]


def provenance_sections(made: Provenance, others: dict[str, str]) -> Iterator[Collapsible]:
    """The command, and the versions of its packages."""
    yield Collapsible("Command", shlex.join(made.command))
    versions = {"python": made.python} | made.versions | others
    yield Collapsible(
        "Versions", "\n".join(f"{name} {number or 'not installed'}" for name, number in versions.items())
    )
    yield Collapsible(
        "Log files", "\n".join(f"{log.path}  {log.size_bytes:,} bytes  sha256 {log.sha256}" for log in made.logs)
    )
