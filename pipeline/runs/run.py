"""The main job: a log in, a run directory out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import msgspec

from pipeline import lie
from pipeline.config import Config
from pipeline.data import Scan, Trajectory
from pipeline.errors import InputError
from pipeline.logs import Log, open_log
from pipeline.runs.checkpoint import CHECKPOINT_FILE, POINTS_FILE, Checkpoints
from pipeline.runs.closure_table import write_closures
from pipeline.runs.compiling import telling_of_compilation
from pipeline.runs.directory import RUN_FILE, RunDirectory
from pipeline.runs.journal import JOURNAL_FILE, Journal
from pipeline.runs.metrics import GroundTruth, Metrics, judge, measure, summary
from pipeline.runs.progress import Progress
from pipeline.runs.provenance import Hashing, Provenance, describe_start
from pipeline.runs.recorder import OpenRecorder, Recorder, SinkName
from pipeline.runs.rescue import rescued
from pipeline.runs.results import Cloud, write_results
from pipeline.runs.results_mcap import write_results_mcap
from pipeline.runs.resuming import Left, after, find_left, set_aside_recording
from pipeline.runs.step_table import StepTable
from pipeline.runs.verdicts import JudgedClosure, final_verdicts
from pipeline.settings import Override, dump, load_settings
from pipeline.slam import Slam, SlamResult
from pipeline.source import Source
from pipeline.trajectory import read_tum, write_tum

TRUTH_FILE = "ground_truth.tum"


def _no_report(folder: Path) -> None:
    """Nobody wants one: for scripts."""


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be run.

    Attributes
    ----------
    logs : the files of one log
    out : the run directory
    config_file : on top of the preset; overrides : on top of both
    sinks : where the recording goes
    ground_truth : a TUM file; None where the log's own is good
    force : whether a run directory of that name is replaced
    resume : whether to go on from the last checkpoint of a run that was killed, where there is one
    checkpoint_s : seconds between two checkpoints, or more where they are large
    command : the command line, for run.json
    """

    logs: tuple[Source, ...]
    out: Path
    config_file: Path | None = None
    overrides: tuple[Override, ...] = ()
    sinks: frozenset[SinkName] = frozenset({"save"})
    ground_truth: Path | None = None
    force: bool = False
    resume: bool = False
    checkpoint_s: float = 10.0
    command: tuple[str, ...] = ()


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
    started = perf_counter()
    _check_distinct(job.logs)
    reference = None if job.ground_truth is None else read_tum(job.ground_truth)
    early = load_settings(file=job.config_file, overrides=job.overrides)
    RunDirectory(job.out, force=job.force)  # refused before the log is read
    log = open_log(job.logs, early.config.log)
    settings = load_settings(log.dimension, file=job.config_file, overrides=job.overrides)
    left = find_left(job.out, dump(settings.config)) if job.resume else None
    directory = RunDirectory(job.out, force=job.force, left=left and left.folder)
    _check_prior(log, settings.config)
    progress.say(f"{log.topic}: {log.dimension}D, {log.scan_count:,} scans; {settings.source}")
    provenance = describe_start(job.command, job.logs, settings.source)
    steps = StepTable() if left is None else left.steps
    if left is not None:
        started -= left.checkpoint.run_s
        progress.tell(f"going on after {len(steps):,} scans of {left.folder.name}")
    with directory, Hashing(job.logs) as hashing, telling_of_compilation(progress):
        provenance.write(directory.path / RUN_FILE)
        (directory.path / "config.toml").write_text(dump(settings.config), encoding="utf-8")
        try:
            recorded = _process(job, log, settings.config, directory.path, record, progress, steps, left)
            truth, note = _judge(job, log, recorded.result, reference, directory.path)
            warnings = (*log.damage, *recorded.warnings, *note)
            run_s = perf_counter() - started - recorded.held_s
            metrics = measure(
                steps, recorded.result, recorded.cloud, recorded.judged, run_s=run_s, ground_truth=truth
            )
            stopped = f"stopped by the user after {len(steps):,} scans" if progress.stopped else ""
            text = summary(metrics, _heading(log, stopped), settings.source, (*log.notes, *warnings))
            metrics.write(directory.path / "metrics.json")
            (directory.path / "summary.txt").write_text(text, encoding="utf-8")
            warnings += _complete(directory, provenance, hashing, stopped, run_s, report)
        except (Exception, KeyboardInterrupt) as error:
            raise rescued(error, directory, steps, provenance) from error
    return Finished(directory.path, metrics, text, warnings, stopped)


def _check_distinct(sources: tuple[Source, ...]) -> None:
    """Refuse a file named twice: each of its scans would come twice."""
    for source, count in Counter(source.resolve() for source in sources).items():
        if count > 1:
            raise InputError(f"{source}: is named {count} times; name each file of a log once")


def _check_prior(log: Log, config: Config) -> None:
    """Refuse a prior that the log does not have before anything is processed."""
    if config.odometry.prior == "wheel" and not log.has_odometry:
        raise InputError(
            f"{log.paths[0]}: odometry.prior is 'wheel', but the log has no wheel odometry that is known; "
            "set log.odometry_topic, or odometry.prior to 'auto'"
        )


@dataclass(frozen=True, slots=True)
class _Recorded:
    """The result of a log that went through, what the recording has to say, and how long the user looked at it."""

    result: SlamResult
    cloud: Cloud
    judged: tuple[JudgedClosure, ...]
    warnings: tuple[str, ...]
    held_s: float


def _process(
    job: Job,
    log: Log,
    config: Config,
    folder: Path,
    record: OpenRecorder,
    progress: Progress,
    steps: StepTable,
    left: Left | None,
) -> _Recorded:
    """Every scan through the chain and into the recording, then the results into files."""
    slam, scans, notes = _start(config, log, folder, steps, left)
    journal = Journal(folder / JOURNAL_FILE, after_bytes=0 if left is None else left.journal_bytes)
    checkpoints = Checkpoints(folder, job.checkpoint_s, 0.0 if left is None else left.checkpoint.run_s)
    recorder = record(
        folder / "recording.rrd",
        dimension=log.dimension,
        name=job.out.resolve().name,
        sinks=job.sinks,
        config=config.recording,
    )
    with recorder as recording, journal:
        if recording.web_address:
            progress.tell(f"viewer: {recording.web_address}")
        for step in map(slam.process, progress.track(scans, log.scan_count - len(steps))):
            recording.log(step)
            journal.append(steps.append(step))
            checkpoints.look(slam, len(steps))
        if progress.stopped:
            checkpoints.write(slam, len(steps))
        progress.say("optimising and writing")
        result = slam.finish()
        judged = final_verdicts(result.closures, result.state)
        cloud = write_results(folder, result, judged, config, recording)
        write_closures(folder / "loops.parquet", judged, result.keyframes, log.dimension)
        steps.write(folder / "steps.parquet", result.trajectory)
        if config.outputs.mcap:
            write_results_mcap(folder, log, steps, result)
        slam.points.close()
        held_s = _hold(recording, progress)
    return _Recorded(result, cloud, judged, (*notes, *recording.warnings), held_s)


def _start(
    config: Config, log: Log, folder: Path, steps: StepTable, left: Left | None
) -> tuple[Slam, Iterator[Scan], tuple[str, ...]]:
    """The chain, new or as it was left, the scans that it has not seen, and what to say of that."""
    if left is None:
        return Slam(config, log.T_base_lidar, folder / POINTS_FILE), log.scans(), ()
    slam = left.checkpoint.slam
    slam.points.reopen(folder / POINTS_FILE)
    before = set_aside_recording(folder)
    note = f"went on after {len(steps):,} scans" + (f"; the recording up to there is {before}" if before else "")
    return slam, after(tuple(steps.rows), log.scans(), left.folder), (note,)


def _hold(recording: Recorder, progress: Progress) -> float:
    """Let the user look at a web viewer, which lives as long as the recording; how long that was."""
    if not recording.web_address:
        return 0.0
    began = perf_counter()
    progress.tell(f"done; the viewer at {recording.web_address} stays until Ctrl-C")
    recording.hold()
    return perf_counter() - began


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
    for file in (JOURNAL_FILE, CHECKPOINT_FILE, POINTS_FILE):
        (directory.path / file).unlink(missing_ok=True)
    warnings = _report(directory.path, report)
    directory.complete()
    return warnings


def _report(folder: Path, report: Callable[[Path], None]) -> tuple[str, ...]:
    """A report that fails must not fail the run."""
    try:
        report(folder)
    except Exception as error:
        return (f"no report.html: {type(error).__name__}: {error}",)
    return ()
