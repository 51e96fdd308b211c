"""A run: a log in, a run directory out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain.clock import announcing_compilation, compiled_s, working_s
from scanchain.config import NO_TRUTH, Config
from scanchain.data import Trajectory, brief
from scanchain.errors import InputError, counted
from scanchain.evaluation import TruthFile, check_overlap, during, read_truth
from scanchain.files import write_whole
from scanchain.logs import Log, open_log
from scanchain.logs.mounting import turned_by
from scanchain.logs.topics import other_sensors
from scanchain.runs.directory import (
    CHECKPOINT_FILE,
    POINTS_FILE,
    RUN_FILE,
    TRUTH_FILE,
    RunDirectory,
    left_without_checkpoint,
    resumable,
)
from scanchain.runs.job import Job, OpenRecorder, Progress
from scanchain.runs.metrics import (
    METRICS_FILE,
    Accuracy,
    GroundTruth,
    Metrics,
    compare_with_truth,
    measure,
    summary,
)
from scanchain.runs.processing import TruePoses, process
from scanchain.runs.provenance import Hashing, Provenance, describe_start
from scanchain.runs.resume.journal import JOURNAL_FILE
from scanchain.runs.resume.rescue import rescued
from scanchain.runs.resume.resuming import Left, find_left
from scanchain.runs.step_table import StepTable
from scanchain.settings import Settings, dump, load_settings, named
from scanchain.slam import SlamResult
from scanchain.trajectory import write_tum

_FEW_SCANS = 2  # scans whose trajectory shows at most one motion
_FOR_RESUMING = (JOURNAL_FILE, CHECKPOINT_FILE, POINTS_FILE)


def _no_report(folder: Path) -> None:
    """No report, for scripts."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A finished run; ``stopped`` is the reason why it did not process the whole log, empty if it did."""

    __repr__ = brief
    path: Path
    metrics: Metrics
    summary: str
    warnings: tuple[str, ...]
    stopped: str

    @property
    def accuracy(self) -> Accuracy:
        """Accuracy of the trajectory against the ground truth. Raises InputError where there is none."""
        if self.metrics.ground_truth is None:
            reason = next((each for each in self.warnings if each.startswith("no accuracy")), "no ground truth")
            raise InputError(f"{self.path}: {reason}; name a file by ground_truth, or a topic of the log")
        return self.metrics.ground_truth.optimized


def run(
    job: Job, record: OpenRecorder, progress: Progress, report: Callable[[Path], None] = _no_report
) -> Finished:
    """Open the log, process it, write the run directory, to which ``report`` adds its page in the end.

    Raises InputError for bad input, which leaves nothing behind unless scans were processed before it was met.
    """
    job.check_logs()
    with Hashing(job.logs) as hashing:  # from the beginning on: while the log is opened a core is idle
        return _run(job, record, progress, report, hashing)


def _run(
    job: Job, record: OpenRecorder, progress: Progress, report: Callable[[Path], None], hashing: Hashing
) -> Finished:
    started, compiled_before_s = working_s(), compiled_s()
    log, settings, truth_file = opened(job)
    left = find_left(job.out, settings.config) if job.resume else None
    directory = RunDirectory(job.out, force=job.force, left=left and left.folder)
    _check_prior(log, settings.config)
    progress.say(f"{log.topic}: {log.dimension}D, {counted(log.scan_count, 'scan')}; {settings.source}")
    for gap in log.gaps:
        progress.announce(f"warning: {gap}")
    provenance = describe_start(job.command, job.logs, settings.source)
    steps = StepTable() if left is None else left.steps
    started -= 0.0 if left is None else left.checkpoint.run_s
    _tell_beginning(job, left, progress)
    compiling = announcing_compilation(progress.say, ("scanchain.runs.warm_up", str(log.dimension)))
    with directory, compiling:
        provenance.write(directory.path / RUN_FILE)
        write_whole(directory.path / "config.toml", dump(settings.config).encode())
        try:
            poses = partial(true_poses, log, truth_file, progress)
            done = process(job, log, settings.config, directory, record, progress, steps, left, poses)
            run_s = working_s() - started - done.held_s
            compile_s = compiled_s() - compiled_before_s
            stopped = f"stopped by the user after {counted(len(steps), 'scan')}" if progress.stopped else ""
            with directory.results() as folder:
                source = str(job.ground_truth or log.ground_truth_topic)
                truth, note = accuracy_of(poses, source, job.max_gap_s, done.result, folder)
                few = _few_scans(len(steps))
                warnings = (*log.damage, *log.copies, *done.warnings, *few, *note)
                metrics = measure(
                    steps, done.result, done.cloud, done.final, done.judged, done.expected,
                    run_s=run_s, compile_s=compile_s, ground_truth=truth, warnings=warnings, stopped=stopped,
                )  # fmt: skip
                text = summary(
                    metrics,
                    _heading(log, settings.config, stopped),
                    settings.source,
                    [*log.notes, *_idle_sensors(log)],
                )
                metrics.write(folder / METRICS_FILE)
                (folder / "summary.txt").write_text(text, encoding="utf-8")
            warnings += _complete(
                directory, provenance, hashing, stopped, run_s + compile_s, partial(_draw, progress, report)
            )
        except (Exception, KeyboardInterrupt) as error:
            raise rescued(error, directory, steps, provenance) from error
    return Finished(directory.path, metrics, text, warnings, stopped)


def opened(job: Job) -> tuple[Log, Settings, TruthFile | None]:
    """The log of a job, the settings for it, and the ground truth if a file is named. Raises InputError."""
    truth_file = None if job.ground_truth is None else read_truth(job.ground_truth)
    early = load_settings(file=job.config_file, overrides=job.overrides)
    RunDirectory(job.out, force=job.force)  # refused before the log is read
    log = open_log(job.logs, early.config.log)
    settings = load_settings(log.dimension, file=job.config_file, overrides=job.overrides)
    _check_truth(job, log, truth_file)
    return log, settings, truth_file


def _tell_beginning(job: Job, left: Left | None, progress: Progress) -> None:
    """Announce that an earlier run is resumed, or that one exists and is not."""
    if left is not None:
        progress.announce(f"resuming after {counted(len(left.steps), 'scan')} of {left.folder.name}")
    elif (idle := resumable(job.out)) is not None:
        progress.announce(
            f"{idle.name} is of a run that was stopped; --resume would continue it, this run starts over and "
            "removes it once complete"
        )
    elif job.resume and (partial_names := left_without_checkpoint(job.out)):
        progress.announce(f"{', '.join(partial_names)}: no checkpoint to resume from, this run starts over")


def _draw(progress: Progress, report: Callable[[Path], None], folder: Path) -> None:
    progress.say("drawing the report")
    report(folder)


def _check_prior(log: Log, config: Config) -> None:
    """Refuse a prior that the log does not have before anything is processed."""
    if config.odometry.prior == "wheel" and not log.has_odometry:
        raise InputError(
            f"{log.name}: odometry.prior is 'wheel', but the log has no wheel odometry that is known; "
            "set log.odometry_topic, or odometry.prior to 'auto'"
        )


def _check_truth(job: Job, log: Log, file: TruthFile | None) -> None:
    """Refuse a ground truth that was named and has no time in common with the scans before they are processed."""
    if file is not None:
        file.check(log.expected_stamps(log.topic), log.scan_count)
        return
    topic = named(job.overrides, "log.ground_truth_topic")
    if topic == NO_TRUTH:
        return
    if topic and not log.ground_truth_topic:
        raise InputError(f"{log.name}: has no topic {topic}; scanchain info lists those with poses")
    if topic:
        check_overlap(topic, log.expected_stamps(topic), log.expected_stamps(log.topic))


def true_poses(
    log: Log, file: TruthFile | None, progress: Progress, stamps_ns: NDArray[np.int64]
) -> Trajectory | None:
    """Poses of the file named, else the log's own; of a KITTI file those of the scans (N,) read before a stop."""
    if file is None:
        return log.ground_truth()
    return (file.first(len(stamps_ns)) if progress.stopped else file).at(stamps_ns)


def accuracy_of(
    poses: TruePoses, source: str, gap_s: float | None, result: SlamResult, folder: Path
) -> tuple[GroundTruth | None, tuple[str, ...]]:
    """Accuracy where there is a truth; warnings where it does not fit, is of few scans, or far off."""
    try:
        reference = poses(result.odometry.stamps_ns)
        if reference is None:
            return None, ()
        truth, misleading = compare_with_truth(result, reference, source, gap_s)
        write_tum(folder / TRUTH_FILE, during(reference, result.trajectory.stamps_ns))
    except InputError as error:
        return None, (f"no accuracy against {source}: {error.text}",)
    return truth, tuple(filter(None, (truth.complaint, *misleading)))


def _few_scans(count: int) -> tuple[str, ...]:
    """Warning about a trajectory of one or two scans."""
    if count > _FEW_SCANS:
        return ()
    return (f"a trajectory of {counted(count, 'scan')} says nothing about the log; check --start, --end, --every",)


def _heading(log: Log, config: Config, stopped: str) -> str:
    paths = ", ".join(str(path) for path in log.paths)
    place, turned = log.T_base_lidar[:-1, -1], turned_by(log.T_base_lidar)
    at = ", ".join(f"{axis} {value_m:.2f}" for axis, value_m in zip("xyz", place, strict=False))
    mounting = f"lidar at {at} m of {log.mounting.base_name}{turned and f', turned by {turned}'}"
    moving = " at the first scan, moving on it" if log.mounting.motion is not None else ""
    is_stated = bool(place.any() or turned or moving)
    known = "; ".join(part for part in (_wheels(log, config), mounting + moving if is_stated else "") if part)
    return f"{paths} {log.topic} ({known})" + (f" (PARTIAL: {stopped})" if stopped else "")


def _idle_sensors(log: Log) -> list[str]:
    """A line on each IMU, GNSS or topic of poses that the log has and a run leaves aside."""
    found = other_sensors(log.indexes, wheels=log.odometry_topic, truth=log.ground_truth_topic)
    return [f"{each.sensor} {each.topic}: {each.use}" for each in found if each.use.startswith("not used")]


def _wheels(log: Log, config: Config) -> str:
    """Wheel odometry of a log, with the reason if it was not used."""
    if not log.has_odometry:
        return "no wheel odometry"
    unused = ""
    if config.odometry.prior == "constant-velocity":
        unused = ", not used: odometry.prior is constant-velocity"
    elif not log.scans_with_wheels:
        unused = ", not used: no reading is near the stamp of a scan"
    return f"wheel odometry {log.odometry_topic}{unused}"


def _complete(
    directory: RunDirectory,
    provenance: Provenance,
    hashing: Hashing,
    stopped: str,
    duration_s: float,
    report: Callable[[Path], None],
) -> tuple[str, ...]:
    """Give a complete run its name; a stopped one stays marked partial. Returns problems with the report."""
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
