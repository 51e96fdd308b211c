"""report.html of a batch: a row a log, distributions of the figures, small plots of all trajectories."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from scanchain.batch.batch import totals
from scanchain.batch.task import Row, State, output_file
from scanchain.errors import counted
from scanchain.files import source_of, without_keys
from scanchain.runs.metrics import Metrics
from scanchain.trajectory import read_tum
from scanchain.verdict import MOST_CONTRADICTED
from scanchain_viz.pictures.figure import Plot
from scanchain_viz.pictures.trajectory_figures import color_of
from scanchain_viz.report import page

_MAX_TRAJECTORIES = 60
_MAX_POINTS = 1500  # largest number of points of a line
_BOX = np.array([1.0, 0.84])  # proportions of the plan of a trajectory
_BEYOND = 1.05  # of the greatest value, so that its mark is whole
_MANY_DEGENERATE, _MANY_LOST = 0.5, 0.01  # shares of the scans above which a figure is marked
_HEADS = (
    page.Head("log"),
    page.Head("verdict", "", "reliability of the trajectory; its stretches are in the run's report"),
    page.Head("scans"),
    page.Head("contr.", "", "contradicted scans: their correspondences contradict the pose"),
    page.Head("degen.", "", "degenerate scans: a direction of motion is unobservable"),
    page.Head("lost", "", "scans that could not be matched"),
    page.Head("warn.", "", "warnings of the run: data lost, skipped or wrong"),
    page.Head("path", "m", "length of the trajectory"),
    page.Head("loops", "", "loop closures accepted"),
    page.Head("ATE", "m", "rmse against the ground truth in the log, after optimization"),
    page.Head("KITTI", "%", "translational error of the KITTI metric"),
    page.Head("inliers", "%", "median over the scans"),
    page.Head("residual", "mm", "median over the scans"),
    page.Head("speed", "× real time"),
    page.Head("time", "s", "of the whole process"),
    page.Head("memory", "MiB", "peak of the process"),
)


def write_batch_report(directory: Path, rows: Sequence[Row], command: Sequence[str]) -> None:
    """Draw and write the page; runs are looked up in the directory."""
    done, names = [row for row in rows if row.metrics is not None], names_of([row.log for row in rows])
    missing = len(rows) - len(done)
    doubted = [f"{row.log} is not trustworthy: {row.why}" for row in rows if row.state is State.NOT_TRUSTWORTHY]
    whole = page.Page(
        title=f"Batch of {counted(len(rows), 'log')}",
        subtitle="Each was run in its own process.",
        facts=tuple(totals(rows)),
        warnings=(f"{missing:,} of {len(rows):,} logs have no result; see the table for the reason",)
        * bool(missing)
        + tuple(doubted),
        notes=(),
        sections=(_logs(directory, rows, names), *_spread(done), *_trajectories(directory, done, names)),
        collapsibles=(
            page.Collapsible("Command", shlex.join(without_keys(command))),
            page.Collapsible("Paths", "\n".join(map(_paths, rows))),
        ),
    )
    page.write_page(directory / page.REPORT_FILE, whole)


def names_of(logs: Sequence[str]) -> dict[str, str]:
    """Display name of each log: its file name, with as many parent folders as make it unique."""
    names = {log: source_of(log).name for log in logs}
    for depth in range(2, max((len(Path(log).parts) for log in logs), default=0) + 1):
        counts = Counter(names.values())
        names = {
            log: name if counts[name] == 1 else "/".join(Path(log).parts[-depth:]) for log, name in names.items()
        }
    return names


def _logs(directory: Path, rows: Sequence[Row], names: dict[str, str]) -> page.Section:
    legend = tuple(f"{head.text}: {head.hint}" for head in _HEADS if head.hint)
    text = "A name links to the report of its run, or to its output if there is none."
    return page.Section(
        "Logs", text, grid=page.Grid(_HEADS, tuple(_row(directory, row, names[row.log]) for row in rows), legend)
    )


def _row(directory: Path, row: Row, name: str) -> page.Row:
    """The figures of a log, or the reason for none."""
    m, link = row.metrics, _link(directory, row)
    if m is None:
        return page.Row(name, (page.Cell(f"{row.state}: {row.why}", is_wide=True),), link=link)
    truth = None if m.ground_truth is None else m.ground_truth.optimized
    is_far_off = m.ground_truth is not None and bool(m.ground_truth.complaint)
    cells = (
        page.verdict_cell(m.verdict),
        f"{m.scans:,}",
        page.Cell(f"{m.contradicted:,}", is_bad=m.contradicted > MOST_CONTRADICTED * m.scans),
        page.Cell(f"{m.degenerate:,}", is_bad=m.degenerate > _MANY_DEGENERATE * m.scans),
        page.Cell(f"{m.lost:,}", is_bad=m.lost > _MANY_LOST * m.scans),
        page.Cell(f"{row.warnings:,}", is_bad=row.warnings > 0),
        f"{m.traveled_m:,.1f}",
        f"{m.closures_accepted:,}",
        page.Cell(page.figure(None if truth is None else truth.ate_rmse_m, 1.0, 4), is_bad=is_far_off),
        page.figure(None if truth is None else truth.kitti_translation_share, 100.0, 3),
        f"{100.0 * m.median_inlier_share:.0f}",
        page.figure(m.median_residual_m, 1e3, 1),
        f"{m.times_real_time:.1f}",
        f"{row.duration_s:.1f}",
        f"{row.peak_mib:,.0f}",
    )
    return page.Row(name, cells, link=link)


def _link(directory: Path, row: Row) -> str:
    """The run's report, else what the last try printed, from this page; empty where there is neither."""
    for path in (Path(row.run) / page.REPORT_FILE if row.run else None, output_file(Path(), row.key)):
        if path is not None and (directory / path).is_file():
            return quote(path.as_posix())
    return ""


def _paths(row: Row) -> str:
    return f"{row.log}  {row.run or '–'}  sha256 {row.sha256 or '–'}"


def _spread(done: Sequence[Row]) -> Iterator[page.Section]:
    """Distributions of the figures, if there are several logs."""
    drawn = (
        ("ATE", "m", lambda row, m: None if m.ground_truth is None else m.ground_truth.optimized.ate_rmse_m),
        ("Speed", "× real time", lambda row, m: m.times_real_time),
        ("Memory", "MiB", lambda row, m: row.peak_mib),
    )
    drawings = [
        page.Drawing(title, "", _sorted_values(title, unit, values))
        for title, unit, figure in drawn
        if len(values := _values(done, figure)) > 1
    ]
    if drawings:
        yield page.Section(
            "Distributions", "Cumulative distribution over the logs.", drawings=tuple(drawings), is_small=True
        )


def _values(done: Sequence[Row], figure: Callable[[Row, Metrics], float | None]) -> list[float]:
    found = (figure(row, row.metrics) for row in done if row.metrics is not None)
    return sorted(value for value in found if value is not None)


def _sorted_values(name: str, unit: str, values: Sequence[float]) -> Markup:
    figure, ordered = Plot(), np.array(values)
    share = 100.0 * (np.arange(len(values)) + 1) / len(values)
    figure.steps(ordered, share, color_of(0))
    figure.marks(np.stack([ordered, share], axis=1), "o", color_of(0), 3.5)
    figure.x.limit(0.0, _BEYOND * max(values) or 1.0)
    figure.y.limit(0.0, 105.0)
    figure.x.label, figure.y.label, figure.has_grid = f"{name} [{unit}]", "logs below [%]", True
    return figure.svg()


def _trajectories(directory: Path, done: Sequence[Row], names: dict[str, str]) -> Iterator[page.Section]:
    """Every trajectory from above, as far as a page can hold them."""
    drawings = [
        page.Drawing(names[row.log], f"{row.run}", _trajectory(directory / row.run / "trajectory.tum"))
        for row in done[:_MAX_TRAJECTORIES]
    ]
    text = f"The first {_MAX_TRAJECTORIES} of {len(done):,}." if len(done) > _MAX_TRAJECTORIES else ""
    if drawings:
        yield page.Section(
            "Optimized trajectories, seen from above", text, drawings=tuple(drawings), is_small=True
        )


def _trajectory(trajectory: Path) -> Markup:
    positions = read_tum(trajectory).poses[:, :2, -1]
    rows = np.linspace(0, len(positions) - 1, min(len(positions), _MAX_POINTS)).astype(int)
    middle, size = 0.5 * (positions.min(axis=0) + positions.max(axis=0)), np.ptp(positions, axis=0)
    half = _BEYOND * 0.5 * (max(size / _BOX) or 1.0) * _BOX
    figure = Plot.of_plan(middle - half, middle + half)
    figure.path(positions[rows], color_of(0))
    figure.marks(positions[:1], "o", color_of(0), 5.0)
    figure.has_grid = True
    return figure.svg()
