"""report.html of a batch: one row per log, small plots of the trajectories."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np

from scanchain.batch.batch import totals
from scanchain.batch.task import Row, State, output_file
from scanchain.errors import counted
from scanchain.files import source_of, without_keys
from scanchain.trajectory import read_tum
from scanchain.verdict import MOST_CONTRADICTED, MOST_OPEN
from scanchain_viz.colors import color_of
from scanchain_viz.pictures.axis import MARGIN
from scanchain_viz.pictures.figure import Plot
from scanchain_viz.report import page

_MAX_TRAJECTORIES = 60  # largest number of runs whose trajectories are drawn
_BOX = np.array([1.0, 0.84])  # proportions of the plan of a trajectory
_HEADS = (
    page.Head("log"),
    page.Head("verdict", "", "reliability of the trajectory; segments to check are in the run's report"),
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
    page.Head("speed", "×", "times real time"),
    page.Head("time", "s", "of the whole process"),
    page.Head("memory", "MiB", "peak of the process"),
)


def write_batch_report(directory: Path, rows: Sequence[Row], command: Sequence[str]) -> None:
    """Draw and write the page; runs are looked up in the directory."""
    done, names = [row for row in rows if row.metrics is not None], names_of([row.log for row in rows])
    missing = len(rows) - len(done)
    warnings = (
        [f"{missing:,} of {len(rows):,} logs have no result; see the table for the reason"] if missing else []
    )
    warnings += [f"{row.log} is not trustworthy: {row.why}" for row in rows if row.state is State.NOT_TRUSTWORTHY]
    paths = (f"{row.log}  {row.run or '–'}  sha256 {row.sha256 or '–'}" for row in rows)
    collapsibles = (
        page.Collapsible("Command", shlex.join(without_keys(command))),
        page.Collapsible("Paths", "\n".join(paths)),
    )
    text = "A name links to the report of its run, or to its output if there is none."
    lines = [page.Row(names[row.log], _cells(row), link=_link(directory, row)) for row in rows]
    legend = [f"{head.text}: {head.hint}" for head in _HEADS if head.hint]
    logs = page.Section("Logs", text, grid=page.Grid(_HEADS, lines, legend))
    sections = (logs, *_trajectories(directory, done, names))
    title = f"Batch of {counted(len(rows), 'log')}"
    subtitle = "Each was run in its own process."
    page.write_page(directory, page.Page(title, subtitle, totals(rows), warnings, (), sections, collapsibles))


def names_of(logs: Sequence[str]) -> dict[str, str]:
    """Display name of each log: its file name, with as many parent folders as make it unique."""
    names = {log: source_of(log).name for log in logs}
    for depth in range(2, max((len(Path(log).parts) for log in logs), default=0) + 1):
        counts = Counter(names.values())
        names = {
            log: name if counts[name] == 1 else "/".join(Path(log).parts[-depth:]) for log, name in names.items()
        }
    return names


def _cells(row: Row) -> Sequence[page.Cell | str]:
    """Cells with the metrics of a log, or with the reason why there are none."""
    m = row.metrics
    if m is None:
        return [page.Cell(f"{row.state}: {row.why}", "wide")]
    truth = None if m.ground_truth is None else m.ground_truth.optimized
    is_far_off = m.ground_truth is not None and bool(m.ground_truth.complaint)
    return [
        page.verdict_cell(m.verdict),
        f"{m.scans:,}",
        page.bad_if(m.contradicted > MOST_CONTRADICTED * m.scans, f"{m.contradicted:,}"),
        page.bad_if(m.degenerate > MOST_OPEN * m.scans, f"{m.degenerate:,}"),
        page.bad_if(m.lost > 0.01 * m.scans, f"{m.lost:,}"),
        page.bad_if(row.warnings > 0, f"{row.warnings:,}"),
        f"{m.traveled_m:,.1f}",
        f"{m.closures_accepted:,}",
        page.bad_if(is_far_off, page.figure(None if truth is None else truth.ate_rmse_m, 1.0, 4)),
        page.figure(None if truth is None else truth.kitti_translation_share, 100.0, 3),
        f"{100.0 * m.median_inlier_share:.0f}",
        page.figure(m.median_residual_m, 1e3, 1),
        f"{m.times_real_time:.1f}",
        f"{row.duration_s:.1f}",
        f"{row.peak_mib:,.0f}",
    ]


def _link(directory: Path, row: Row) -> str:
    """Relative link to the run's report, else to the output of the last attempt; empty if there is neither."""
    for path in (Path(row.run) / page.REPORT_FILE if row.run else None, output_file(Path(), row.key)):
        if path is not None and (directory / path).is_file():
            return quote(path.as_posix())
    return ""


def _trajectories(directory: Path, done: Sequence[Row], names: dict[str, str]) -> Iterator[page.Section]:
    """Trajectories seen from above, as many as a page can hold."""
    drawings = [
        page.Drawing.of(names[row.log], row.run, _trajectory(directory / row.run / "trajectory.tum"))
        for row in done[:_MAX_TRAJECTORIES]
    ]
    text = f"The first {_MAX_TRAJECTORIES} of {len(done):,}." if len(done) > _MAX_TRAJECTORIES else ""
    if drawings:
        title = "Optimized trajectories, seen from above"
        yield page.Section(title, text, drawings=drawings, is_small=True)


def _trajectory(trajectory: Path) -> Plot:
    positions = read_tum(trajectory).poses[:, :2, -1]
    middle, size = 0.5 * (positions.min(axis=0) + positions.max(axis=0)), np.ptp(positions, axis=0)
    half = (0.5 + MARGIN) * (max(size / _BOX) or 1.0) * _BOX
    figure = Plot.of_plan(middle - half, middle + half, has_grid=True)
    figure.line(positions, color_of(0))
    figure.marks(positions[:1], "o", color_of(0), 5.0)
    return figure
