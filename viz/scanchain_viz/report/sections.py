"""Sections that reports of runs and of comparisons share; those without data are left out."""

from __future__ import annotations

import shlex
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.special import gammaincinv

from scanchain.runs.provenance import Provenance
from scanchain_viz.colors import CLOSURES, TRUTH
from scanchain_viz.pictures.figure import DASHED, DOTS, INK, MIDDLE, THIN, Floats, Plot
from scanchain_viz.pictures.trajectories import DrawnTrajectory, frame
from scanchain_viz.report import page
from scanchain_viz.report.page import Cell, Chip, Collapsible, Drawing, Grid, Head, Named, Row, Section

MAX_POINTS = 1500  # largest number of points of a line, and of lines of one kind, in a figure
CLIPPED = (0.01, 1000.0)  # range of observability and innovations that is drawn


def _legend(trajectories: Sequence[DrawnTrajectory]) -> Sequence[DrawnTrajectory]:
    """Legend of several trajectories; one needs none."""
    return trajectories if len(trajectories) > 1 else ()


def _known(trajectories: Sequence[DrawnTrajectory], key: str) -> list[DrawnTrajectory]:
    return [trajectory for trajectory in trajectories if np.isfinite(getattr(trajectory, key)).any()]


def _draw(figure: Plot, trajectory: DrawnTrajectory, points: Floats, width: float = 1.2) -> None:
    figure.line(points, trajectory.color, width, DASHED if trajectory.is_dashed else ())


def trajectories_section(
    trajectories: Sequence[DrawnTrajectory],
    framing: Sequence[DrawnTrajectory],
    truth: Floats | None,
    *,
    is_planar: bool,
    text: str,
) -> Section:
    """Trajectories from above, and their heights; ``framing`` are those that must fit in the axes."""
    low, high = frame(framing, truth)
    plan = Plot.of_plan(low, high, is_wide=is_planar, has_grid=True)
    height = Plot("distance traveled [m]", "z [m]")
    for each in reversed(trajectories):  # the first on top
        rows = _some(len(each.positions))
        _draw(plan, each, each.positions[rows])
        _draw(height, each, np.stack([each.distance_m[rows], each.positions[rows, 2]], axis=1))
    chips: Sequence[Named] = _legend(trajectories)
    if truth is not None:
        chips = (*trajectories, Chip("ground truth", TRUTH, is_dashed=True))
        traveled_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth, axis=0), axis=1)))
        for figure, path in ((plan, truth), (height, np.stack([traveled_m, truth[:, 2]], axis=1))):
            figure.line(path[_some(len(truth))], TRUTH, 0.9, DASHED)
    drawings = [Drawing.of("Plan", "Seen from above.", plan)]
    if not is_planar:
        height.y.limit(low[2], high[2])
        height.x.limit(0.0, 1.05 * max(float(np.median([each.distance_m[-1] for each in trajectories])), 1.0))
        drawings.append(Drawing.of("Height", "Over the distance traveled.", height))
    return Section("Trajectories", text, chips, tuple(drawings))


def error_section(trajectories: Sequence[DrawnTrajectory], truth_name: str) -> Iterator[Section]:
    """Position errors over the distance and their distribution."""
    known = _known(trajectories, "error_m")
    if not known:
        return
    figure = Plot("distance traveled [m]", "position error [m]", logarithmic="y")
    for each in reversed(known):
        finite = np.isfinite(each.error_m)
        points = windowed(each.error_m[finite], np.median, each.distance_m[finite])
        _draw(figure, each, np.maximum(points, [0.0, 1e-4]))
    drawings = (
        Drawing.of("Over the distance", _of_neighbors("Medians", known, "error_m"), figure),
        _distribution(known, "error_m", 1.0, "position error [m]", "scans with a smaller error"),
    )
    text = f"Distance of each position from the true one after rigid alignment, against {truth_name}."
    yield Section("Error", text, _legend(known), drawings)


def relation_section(trajectories: Sequence[DrawnTrajectory]) -> Iterator[Section]:
    """Errors over manually verified relations."""
    known = _known(trajectories, "relation_error_m")
    if known:
        label, those = "error of a relation [m]", "relations with a smaller error"
        drawing = _distribution(known, "relation_error_m", 1.0, label, those, is_wide=True)
        text = "Distance between the motion of a relation and that of the trajectory."
        yield Section("Error over relations", text, _legend(known), (drawing,))


def time_section(trajectories: Sequence[DrawnTrajectory], stages: Grid | None = None) -> Iterator[Section]:
    """Time per scan by stage, along the log, and its distribution."""
    known = _known(trajectories, "seconds")
    if not known:
        return
    figure = Plot("scan", "time per scan [ms]", logarithmic="y")
    for each in reversed(known):
        _draw(figure, each, windowed(1e3 * each.seconds, np.median), 0.9)
    drawings = (
        Drawing.of("Along the log", _of_neighbors("Medians", known, "seconds"), figure),
        _distribution(known, "seconds", 1e3, "time per scan [ms]", "scans that took less"),
    )
    yield Section("Time per scan", "", _legend(known), drawings, stages)


def uncertainty_section(trajectories: Sequence[DrawnTrajectory], *, is_planar: bool) -> Iterator[Section]:
    """Consistency of the covariances with the errors, and observability."""
    reported, estimated = _known(trajectories, "observability"), _known(trajectories, "nees")
    if not reported:
        return
    along = Plot("scan", "observability", logarithmic="y", is_wide=not estimated)
    for each in reversed(reported):
        _draw(along, each, windowed(np.clip(each.observability, *CLIPPED), np.min))
    along.level(1.0)
    least = _of_neighbors(" Least values", reported, "observability")
    text = (
        "Information along the least constrained direction over the minimum required; below 1 (dotted) a scan is "
        f"degenerate.{least}"
    )
    drawings = [Drawing.of("Observability", text, along)]
    if estimated:
        drawings.append(_consistency(estimated, 3 if is_planar else 6))
    yield Section("Uncertainty", "", _legend(reported), tuple(drawings))


def _distribution(
    known: Sequence[DrawnTrajectory], key: str, scale: float, label: str, those: str, *, is_wide: bool = False
) -> Drawing:
    """Cumulative distribution, shown up to the 99.5th percentile of the worst trajectory."""
    figure, ends = Plot(label, "share below [%]", logarithmic="x", is_wide=is_wide), []
    for each in reversed(known):
        ends.append(np.percentile(_cumulative(figure, each, scale * getattr(each, key), 1e-6), MIDDLE))
    figure.x.limit(0.9 * np.min(ends), 1.1 * np.max(ends))
    figure.y.limit(0.0, 100.0)
    return Drawing.of("Distribution", f"Share of the {those}.", figure)


def _consistency(estimated: Sequence[DrawnTrajectory], degrees_of_freedom: int) -> Drawing:
    """Distribution of the NEES, and the one that exact covariances would give (dotted)."""
    figure = Plot("NEES per degree of freedom (1 on average if exact)", "motions below [%]", logarithmic="x")
    for each in reversed(estimated):
        _cumulative(figure, each, each.nees, 1e-4)
    shares = np.linspace(0.001, 0.999, 200)
    ideal = 2.0 * gammaincinv(0.5 * degrees_of_freedom, shares) / degrees_of_freedom  # quantiles of χ²
    figure.line(np.stack([ideal, 100.0 * shares], axis=1), INK, THIN, DOTS)
    figure.y.limit(0.0, 100.0)
    text = (
        "Squared error of each motion normalized by its covariance. Dotted: exact covariances; to the left of "
        "it they are too large, to the right too small."
    )
    return Drawing.of("Covariance consistency", text, figure)


def _cumulative(figure: Plot, trajectory: DrawnTrajectory, values: Floats, least: float) -> Floats:
    """Draw the cumulative distribution of the finite values; returns them sorted, none below ``least``."""
    ordered = np.maximum(np.sort(values[np.isfinite(values)]), least)
    rows = np.unique(_some(len(ordered)))
    _draw(figure, trajectory, np.stack([ordered, np.linspace(0.0, 100.0, len(ordered))], axis=1)[rows])
    return ordered


def _some(count: int) -> NDArray[np.int64]:
    """Rows, out of ``count``, that a line is drawn through, including the first and the last."""
    return np.linspace(0, count - 1, min(count, MAX_POINTS)).astype(np.int64)


def window(count: int) -> int:
    """Number of neighboring values, out of ``count`` in total, that are combined to a point of a line."""
    return max(1, -(-count // 250))  # windows at most


def windowed(values: Floats, combine: Callable[..., Floats], x: Floats | None = None) -> Floats:
    """Points (K, 2) of a readable line: neighboring values combined, over the mean of x or of the scan numbers."""
    size = window(len(values))
    count = len(values) // size * size
    over = np.arange(len(values), dtype=np.float64) if x is None else x
    x, y = (each[:count].reshape(-1, size) for each in (over, values))
    return np.stack([x.mean(axis=1), combine(y, axis=1)], axis=1)


def _of_neighbors(what: str, trajectories: Sequence[DrawnTrajectory], key: str) -> str:
    """Caption of lines whose points each combine several scans; empty if each point is one scan."""
    size = window(max(int(np.isfinite(getattr(each, key)).sum()) for each in trajectories))
    return f"{what} of {size} neighboring scans." if size > 1 else ""


def read_closures(file: Path) -> pa.Table | None:
    """Table with one row per loop closure tried; None if loop closures were not searched for."""
    return pq.ParquetFile(file).read() if file.exists() else None  # read_table imports much more


def loop_section(trajectory: DrawnTrajectory, closures: pa.Table | None, title: str) -> Iterator[Section]:
    """Number of the loop closures of each verdict and cause."""
    if closures is not None and len(closures):
        text = f"{len(closures):,} tried; each is a row of loops.parquet."
        yield Section(title, text, grid=_verdict_grid(closures))
    elif closures is not None:
        path = f"the trajectory of {trajectory.distance_m[-1]:.1f} m"
        yield Section(title, f"None was tried: {path} does not revisit a place after loops.min_travel_m.")


def _verdict_grid(closures: pa.Table) -> Grid:
    """Closures by verdict and cause, most frequent first."""
    groups: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    verdicts = zip(closures["rejected_by"].to_pylist(), closures["cause"].to_pylist(), strict=True)
    for place, (by, cause) in enumerate(verdicts):
        groups[CLOSURES[by][0], cause].append(place)
    overlap, residual_m = closures["overlap"].to_numpy(), closures["residual_m"].to_numpy()
    rows = []
    for (verdict, cause), places in sorted(groups.items(), key=lambda group: -len(group[1])):
        residual = page.figure(float(np.median(residual_m[places])), 1e3, 0)
        share = f"{100.0 * np.median(overlap[places]):.0f}"
        rows.append(Row(verdict, (f"{len(places):,}", share, residual, Cell(cause, "wide"))))
    heads = (
        Head("verdict"), Head("closures"), Head("overlap", "%", "median"), Head("residual", "mm", "median"),
        Head("cause", is_text=True),
    )  # fmt: skip
    return Grid(heads, tuple(rows))


def provenance_sections(made: Provenance, others: dict[str, str]) -> Iterator[Collapsible]:
    """The command, the versions of its packages, and its log files."""
    yield Collapsible("Command", shlex.join(made.command))
    versions = {"python": made.python} | made.versions | others
    lines = (f"{name} {number or 'not installed'}" for name, number in versions.items())
    yield Collapsible("Versions", "\n".join(lines))
    logs = (f"{log.path}  {log.size_bytes:,} bytes  sha256 {log.sha256}" for log in made.logs)
    yield Collapsible("Log files", "\n".join(logs))


def when(made: Provenance) -> str:
    """When a result was made, and how long that took."""
    return f"{datetime.fromisoformat(made.started):%Y-%m-%d %H:%M} UTC, in {made.duration_s:.0f} s"


def configuration(directory: Path) -> Collapsible:
    """The whole configuration of a run or a merge."""
    return Collapsible("Configuration", (directory / "config.toml").read_text(encoding="utf-8"), is_long=True)
