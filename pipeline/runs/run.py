"""The main job: a log in, a run directory out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from pipeline import lie
from pipeline.clock import compiled_s, working_s
from pipeline.config import Config
from pipeline.data import Trajectory
from pipeline.errors import InputError
from pipeline.logs import Log, open_log
from pipeline.runs.compiling import telling_of_compilation
from pipeline.runs.directory import CHECKPOINT_FILE, POINTS_FILE, RUN_FILE, RunDirectory, resumable
from pipeline.runs.job import Job
from pipeline.runs.journal import JOURNAL_FILE
from pipeline.runs.metrics import GroundTruth, Metrics, judge, measure, summary
from pipeline.runs.processing import process
from pipeline.runs.progress import Progress
from pipeline.runs.provenance import Hashing, Provenance, describe_start
from pipeline.runs.recorder import OpenRecorder
from pipeline.runs.rescue import rescued
from pipeline.runs.resuming import find_left
from pipeline.runs.step_table import StepTable
from pipeline.runs.whole_file import write_whole
from pipeline.settings import dump, load_settings
from pipeline.slam import SlamResult
from pipeline.trajectory import read_tum, write_tum
from pipeline.words import counted

TRUTH_FILE = "ground_truth.tum"
_FOR_RESUMING = (JOURNAL_FILE, CHECKPOINT_FILE, POINTS_FILE)


def _no_report(folder: Path) -> None:
    """Nobody wants one: for scripts."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A run that came to its end; ``stopped`` says why it did not see the whole log, empty where it did."""

    path: Path
    metrics: Metrics
    summary: str
    warnings: tuple[str, ...]
    stopped: str


def run(
    job: Job, record: OpenRecorder, progress: Progress, report: Callable[[Path], None] = _no_report
) -> Finished:
    """Open the log, process it, write the run directory, to which ``report`` adds its page in the end.

    Raises InputError for bad input, which leaves nothing behind unless scans were processed before it was met.
    """
    started, compiled_before_s = working_s(), compiled_s()
    job.check_logs()
    reference = None if job.ground_truth is None else read_tum(job.ground_truth)
    early = load_settings(file=job.config_file, overrides=job.overrides)
    RunDirectory(job.out, force=job.force)  # refused before the log is read
    log = open_log(job.logs, early.config.log)
    settings = load_settings(log.dimension, file=job.config_file, overrides=job.overrides)
    left = find_left(job.out, dump(settings.config)) if job.resume else None
    directory = RunDirectory(job.out, force=job.force, left=left and left.folder)
    _check_prior(log, settings.config)
    progress.say(f"{log.topic}: {log.dimension}D, {counted(log.scan_count, 'scan')}; {settings.source}")
    provenance = describe_start(job.command, job.logs, settings.source)
    steps = StepTable() if left is None else left.steps
    if not job.resume and (idle := resumable(job.out)) is not None:
        progress.tell(
            f"{idle.name} is of a run that was stopped; --resume would go on with it, this one begins anew"
        )
    if left is not None:
        started -= left.checkpoint.run_s
        progress.tell(f"going on after {counted(len(steps), 'scan')} of {left.folder.name}")
    rehearsal = ("pipeline.runs.rehearsal", str(log.dimension))
    with directory, Hashing(job.logs) as hashing, telling_of_compilation(progress, rehearsal):
        provenance.write(directory.path / RUN_FILE)
        write_whole(directory.path / "config.toml", dump(settings.config).encode())
        try:
            done = process(job, log, settings.config, directory, record, progress, steps, left)
            run_s = working_s() - started - done.held_s
            compile_s = compiled_s() - compiled_before_s
            stopped = f"stopped by the user after {counted(len(steps), 'scan')}" if progress.stopped else ""
            with directory.results() as folder:
                truth, note = _judge(job, log, done.result, reference, folder)
                warnings = (*log.damage, *done.warnings, *note)
                metrics = measure(
                    steps,
                    done.result,
                    done.cloud,
                    done.judged,
                    run_s=run_s,
                    compile_s=compile_s,
                    ground_truth=truth,
                )
                text = summary(metrics, _heading(log, stopped), settings.source, (*log.notes, *warnings))
                metrics.write(folder / "metrics.json")
                (folder / "summary.txt").write_text(text, encoding="utf-8")
            progress.say("drawing the report")
            warnings += _complete(directory, provenance, hashing, stopped, run_s + compile_s, report)
        except (Exception, KeyboardInterrupt) as error:
            raise rescued(error, directory, steps, provenance) from error
    return Finished(directory.path, metrics, text, warnings, stopped)


def _check_prior(log: Log, config: Config) -> None:
    """Refuse a prior that the log does not have before anything is processed."""
    if config.odometry.prior == "wheel" and not log.has_odometry:
        raise InputError(
            f"{log.paths[0]}: odometry.prior is 'wheel', but the log has no wheel odometry that is known; "
            "set log.odometry_topic, or odometry.prior to 'auto'"
        )


def _judge(
    job: Job, log: Log, result: SlamResult, reference: Trajectory | None, folder: Path
) -> tuple[GroundTruth | None, tuple[str, ...]]:
    """Accuracy against the file named, else against the log's own truth; a warning where they do not fit."""
    source = str(job.ground_truth) if reference is not None else log.config.ground_truth_topic
    if reference is None:
        reference = log.ground_truth()
    if reference is None:
        return None, ()
    try:
        truth = judge(result, reference, source)
        write_tum(folder / TRUTH_FILE, reference)
        return truth, ()
    except InputError as error:
        return None, (f"no accuracy against {source}: {error}",)


def _heading(log: Log, stopped: str) -> str:
    paths = ", ".join(str(path) for path in log.paths)
    place = lie.lift(log.T_base_lidar)[:3, 3]
    mounting = (
        f"lidar at x {place[0]:.2f}, y {place[1]:.2f}, z {place[2]:.2f} m of the base" if place.any() else ""
    )
    known = ", ".join(part for part in (f"wheels {log.odometry_topic or 'none'}", mounting) if part)
    return f"{paths} {log.topic} ({known})" + (f" (PARTIAL: {stopped})" if stopped else "")


def _complete(
    directory: RunDirectory,
    provenance: Provenance,
    hashing: Hashing,
    stopped: str,
    duration_s: float,
    report: Callable[[Path], None],
) -> tuple[str, ...]:
    """Give a whole run its name; one that was stopped stays marked partial. What went wrong with the report."""
    if stopped:
        directory.worth_keeping()
        replaced = msgspec.structs.replace(provenance, stopped=stopped, duration_s=duration_s)
        replaced.write(directory.path / RUN_FILE)
        return _report(directory.path, report)
    replaced = msgspec.structs.replace(provenance.hashed(hashing), complete=True, duration_s=duration_s)
    replaced.write(directory.path / RUN_FILE)
    warnings = _report(directory.path, report)
    directory.complete()
    for file in _FOR_RESUMING:  # only now: until then a kill leaves what --resume needs
        (directory.path / file).unlink(missing_ok=True)
    return warnings


def _report(folder: Path, report: Callable[[Path], None]) -> tuple[str, ...]:
    """A report that fails must not fail the run."""
    try:
        report(folder)
    except Exception as error:
        return (f"no report.html: {type(error).__name__}: {error}",)
    return ()
