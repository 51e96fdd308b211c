"""A run: processes a log and writes a run directory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanchain.ahead import compile_ahead
from scanchain.clock import announcing_compilation, compiled_s, working_s
from scanchain.config import NO_TRUTH, Config
from scanchain.data import Scan, Trajectory, brief
from scanchain.errors import InputError, OwnCodeError, ScanchainError, counted
from scanchain.evaluation import ExpectedErrors, TruthFile, check_overlap, during, on_the_estimate, read_truth
from scanchain.files import write_whole
from scanchain.logs import Log, open_log
from scanchain.logs.mounting import turned_by
from scanchain.logs.topics import other_sensors
from scanchain.odometry.distortion import choose_point_times
from scanchain.preprocess import prepare_ahead
from scanchain.runs.closures import final_verdicts
from scanchain.runs.directory import POINTS_FILE, RECORDING_FILE, RUN_FILE, TRUTH_FILE, RunDirectory, stopped_run
from scanchain.runs.job import Job, OpenRecorder, Progress, Recorder
from scanchain.runs.metrics import (
    METRICS_FILE,
    Accuracy,
    GroundTruth,
    Metrics,
    compare_with_truth,
    measure,
    summary,
)
from scanchain.runs.provenance import Hashing, describe_start
from scanchain.runs.results import Results, expected_of, record_results, results_of, write_results
from scanchain.runs.resume import Checkpoints, after, find_left, rescued, resume_recording, set_aside
from scanchain.runs.step_table import StepTable
from scanchain.settings import Settings, dump, load_settings, named
from scanchain.slam import Slam, SlamResult
from scanchain.threads import threads
from scanchain.trajectory import write_tum, write_wide_tum
from scanchain.verdict import Judged

_FEW_SCANS = 2  # number of scans up to which a trajectory has at most one motion
TruePoses = Callable[[NDArray[np.int64]], Trajectory | None]  # at these scan stamps; may raise InputError


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
    job: Job, record: OpenRecorder, progress: Progress, report: Callable[[Path], None] = lambda folder: None
) -> Finished:
    """Open the log, process it, write the run directory; at the end, ``report`` adds its page to this.

    Raises InputError for bad input; no new directory remains unless scans were processed before. Raises
    OwnCodeError where the user's own code fails; no new directory remains.
    """
    this = _Run(job, progress)
    with this.directory, announcing_compilation(progress.say):
        try:
            compile_ahead([f"{this.log.dimension}d"], progress.compiling)
            slam, scans = this.begin()
            with this.recording(record) as recording:
                result = this.process(slam, scans, recording)
                results, expected, judged = this.write(result, recording)
                slam.points.close()
                held_s = this.hold(recording)
            metrics, text = this.judge(results, expected, judged, recording.warnings, held_s)
            return this.complete(metrics, text, report)
        except (Exception, KeyboardInterrupt) as error:
            is_early = not len(this.steps) and isinstance(error, ScanchainError | KeyboardInterrupt | OSError)
            if is_early or isinstance(error, OwnCodeError):
                raise
            raise rescued(error, this.directory, this.steps, this.provenance) from error


class _Run:
    """The steps of a run: begin or resume, process every scan, write the results, measure and complete."""

    def __init__(self, job: Job, progress: Progress) -> None:
        """Open the log and a stopped run's checkpoint. Raises InputError where either does not fit the job."""
        self.began_s, self.compiled_before_s = working_s(), compiled_s()
        self.hashing = Hashing(job.logs)  # started first: a core is idle while the log is opened
        self.job, self.progress = job, progress
        self.log, settings, truth_file = opened(job)
        self.true_poses = partial(true_poses, self.log, truth_file, progress)
        self.config, self.source = settings.config, settings.source
        self.provenance = describe_start(job.command, job.logs, self.source)
        self.steps, self.notes, self.resumed = StepTable(), list[str](), list[str]()
        self.left = left = find_left(job.out, self.config) if job.resume else None
        self.directory = RunDirectory(job.out, force=job.force, left=left and left.folder)
        self.checkpoints = Checkpoints(self.directory.path, job.checkpoint_s, left)
        log = self.log
        if self.checkpoints.absent:
            progress.announce(self.checkpoints.absent)
        progress.say(f"{log.topic}: {log.dimension}D, {counted(log.scan_count, 'scan')}; {self.source}")
        for gap in log.gaps:
            progress.announce(f"warning: {gap}")
        if left is not None:
            self.steps = left.steps
            self.began_s -= left.run_s
            progress.announce(f"resuming after {counted(len(self.steps), 'scan')} of {left.folder.name}")
        elif idle := stopped_run(job.out):
            progress.announce(
                f"{idle.name} is of a run that did not end; --resume would continue it, this run starts over and "
                "removes it once complete"
            )
        elif job.resume:
            progress.announce(f"{job.out}: no checkpoint to resume from, this run starts at the first scan")

    def begin(self) -> tuple[Slam, Generator[Scan, None, None]]:
        """SLAM, new or from the checkpoint, and the scans that follow; writes run.json and the configuration."""
        folder, left = self.directory.path, self.left
        self.provenance.write(folder / RUN_FILE)
        write_whole(folder / "config.toml", dump(self.config).encode())
        scans = self.log.scans(self.config.preprocess)
        if left is None:
            mounting = self.log.stated_mounting
            return Slam(self.config, mounting, folder / POINTS_FILE, dimension=self.log.dimension), scans
        left.slam.points.reopen(folder / POINTS_FILE)
        scans = after(left, scans)
        set_aside(folder, left)
        return left.slam, scans

    def recording(self, record: OpenRecorder) -> AbstractContextManager[Recorder]:
        """The recording, to be entered before the first scan."""
        return record(
            self.directory.path / RECORDING_FILE,
            dimension=self.log.dimension,
            name=self.job.out.resolve().name,
            sinks=self.job.sinks,
            config=self.config.recording,
        )

    def process(self, slam: Slam, scans: Generator[Scan, None, None], recording: Recorder) -> SlamResult:
        """SLAM result of all scans, processed from the first one or from the checkpoint on."""
        checkpoints = self.checkpoints
        if recording.web_address:
            self.progress.announce(f"viewer: {recording.web_address}")
        if self.left is not None:
            self.resumed = [resume_recording(self.directory.path, self.left, recording, checkpoints)]
        with closing(scans):  # counts what the log left out, also if the run was stopped
            tracked = self.progress.track(scans, self.log.scan_count)
            if slam.dimension == 3 and threads() > 1:
                tracked = prepare_ahead(tracked, slam.front_end.odometry.resolution)
            for scan in tracked:
                step = slam.process(scan)
                self.steps.append(step)
                recording.log(step)
                if checkpoints.are_due():
                    checkpoints.write(slam, self.steps, recording.secure())
        checkpoints.write(slam, self.steps, recording.secure())  # an interruption from here on loses no scan
        return slam.finish(self.progress.say)

    def write(self, result: SlamResult, recording: Recorder) -> tuple[Results, ExpectedErrors | None, Judged]:
        """Write the results to the directory, and them, the verdict and the ground truth to the recording."""
        self.progress.say("building the maps and writing the results")
        with self.directory.results() as folder:
            final = final_verdicts(result.closures, result.state)
            results = results_of(self.log, self.config, self.steps, result, final)
            write_results(folder, results)
            expected = self.expected(result)
            if expected is not None:
                write_wide_tum(folder / "keyframes.tum", result.keyframe_trajectory, expected.covariances)
            judged = results.judged(expected and expected.ate)
            record_results(recording, results)
            recording.log_verdict(judged, result.trajectory)
            with suppress(InputError):  # reported with the accuracy
                reference = self.true_poses(result.trajectory.stamps_ns)
                if reference is not None:
                    moved = on_the_estimate(result.trajectory, reference, gap_s=self.job.max_gap_s)
                    recording.log_ground_truth(moved.poses)
        return results, expected, judged

    def expected(self, result: SlamResult) -> ExpectedErrors | None:
        """Expected errors; the systematic ones are measured by odometry on the scans, which are read again."""
        if self.config.outputs.error_bars == "full" and not self.progress.stopped:
            self.progress.say(
                "measuring systematic errors: odometry without one group of directions after the other"
            )
            try:
                again = open_log(self.job.logs, self.log.config).scans(self.config.preprocess)
                with closing(again):
                    return expected_of(result, self.config, again, self.log.distorted_share)
            except (InputError, OSError) as error:
                self.notes.append(f"error bars of random errors only: {error}")
        return expected_of(result, self.config)

    def hold(self, recording: Recorder) -> float:
        """Keep the web viewer, which ends with the recording, open until the user stops it; seconds waited."""
        began_s = perf_counter()
        if recording.web_address:
            self.progress.announce(f"done; the viewer at {recording.web_address} stays until Ctrl-C")
            recording.hold()
        if self.job.sinks:
            self.progress.say("writing the rest of the recording")
        return perf_counter() - began_s if recording.web_address else 0.0

    def judge(
        self, results: Results, expected: ExpectedErrors | None, judged: Judged, of_recording: Sequence[str],
        held_s: float,
    ) -> tuple[Metrics, str]:  # fmt: skip
        """Metrics and summary of the run, which are also written to the directory."""
        log, result = self.log, results.result
        run_s, compile_s = working_s() - self.began_s - held_s, compiled_s() - self.compiled_before_s
        stopped = f"stopped by the user after {counted(len(self.steps), 'scan')}" if self.progress.stopped else ""
        lost = [*log.damage, *self.notes, *result.warnings, *results.warnings, *of_recording]
        if len(self.steps) <= _FEW_SCANS:
            few = f"a trajectory of {counted(len(self.steps), 'scan')}"
            lost.append(f"{few} says nothing about the log; check --start, --end, --every")
        sensors = other_sensors(log.indexes, wheels=log.odometry_topic, truth=log.ground_truth_topic)
        idle = [f"{each.sensor} {each.topic}: {each.use}" for each in sensors if each.use.startswith("not used")]
        with self.directory.results() as folder:
            source = str(self.job.ground_truth or log.ground_truth_topic)
            truth, note = accuracy_of(self.true_poses, source, self.job.max_gap_s, result, folder)
            metrics = measure(
                self.steps, results, expected and expected.ate, judged, run_s=run_s, compile_s=compile_s,
                ground_truth=truth, warnings=(*lost, *note), stopped=stopped,
            )  # fmt: skip
            notes = [*self.resumed, *log.notes, *filter(None, [result.mounting_note]), *idle]
            text = summary(metrics, _heading(log, self.config, stopped), self.source, notes)
            metrics.write(folder / METRICS_FILE)
            (folder / "summary.txt").write_text(text, encoding="utf-8")
        return metrics, text

    def complete(self, metrics: Metrics, text: str, report: Callable[[Path], None]) -> Finished:
        """Add the report and give a complete run its name; a stopped one stays marked partial."""
        directory, stopped, warnings = self.directory, metrics.stopped, metrics.warnings
        if stopped:
            directory.worth_keeping()
        made = self.provenance if stopped else self.provenance.hashed(self.hashing)
        made = msgspec.structs.replace(
            made, complete=not stopped, stopped=stopped, duration_s=metrics.run_s + metrics.compile_s
        )
        made.write(directory.path / RUN_FILE)
        self.progress.say("drawing the report")
        try:
            report(directory.path)
        except Exception as error:  # a report that fails must not fail the run
            warnings += (f"no report.html: {type(error).__name__}: {error}",)
        if not stopped:
            directory.complete()
        return Finished(directory.path, metrics, text, warnings, stopped)


def opened(job: Job) -> tuple[Log, Settings, TruthFile | None]:
    """The log of a job, the settings for it, and the ground truth if a file is named.

    Raises InputError where these do not fit together, before anything is processed.
    """
    for source, count in Counter(source.resolve() for source in job.logs).items():
        if count > 1:
            raise InputError(f"{source}: is named {count} times; name each file of a log once")
    truth_file = None if job.ground_truth is None else read_truth(job.ground_truth)
    early = load_settings(file=job.config_file, overrides=job.overrides)
    RunDirectory(job.out, force=job.force)  # refused before the log is read
    log = open_log(job.logs, early.config.log)
    choose_point_times(log, deskew=early.config.preprocess.deskew)
    settings = load_settings(log.dimension, file=job.config_file, overrides=job.overrides)
    if settings.config.odometry.prior == "wheel" and not log.odometry_topic:
        raise InputError(
            f"{log.name}: odometry.prior is 'wheel', but the log has no wheel odometry that is known; "
            "set log.odometry_topic, or odometry.prior to 'auto'"
        )
    _check_truth(job, log, truth_file)
    return log, settings, truth_file


def _check_truth(job: Job, log: Log, file: TruthFile | None) -> None:
    """Refuse a ground truth that was named and has no time in common with the scans."""
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
    """True poses of the named file, else of the log; of a KITTI file, those of the scans (N,) before a stop."""
    if file is None:
        return log.ground_truth()
    return (file.first(len(stamps_ns)) if progress.stopped else file).at(stamps_ns)


def accuracy_of(
    poses: TruePoses, source: str, gap_s: float | None, result: SlamResult, folder: Path
) -> tuple[GroundTruth | None, tuple[str, ...]]:
    """Accuracy if there is ground truth; warnings if it does not fit or has few scans, or the error is large."""
    try:
        reference = poses(result.odometry.stamps_ns)
        if reference is None:
            return None, ()
        truth, misleading = compare_with_truth(result, reference, source, gap_s)
        write_tum(folder / TRUTH_FILE, during(reference, result.trajectory.stamps_ns))
    except InputError as error:
        return None, (f"no accuracy against {source}: {error.text}",)
    return truth, tuple(filter(None, (truth.complaint, *misleading)))


def _heading(log: Log, config: Config, stopped: str) -> str:
    known = f"wheel odometry {log.wheels}" if log.odometry_topic else "no wheel odometry"
    if log.odometry_topic and config.odometry.prior == "constant-velocity":
        known += ", not used: odometry.prior is constant-velocity"
    elif log.odometry_topic and not log.scans_with_wheels:
        known += ", not used: no reading is near the stamp of a scan"
    place, turned = log.T_base_lidar[:-1, -1], turned_by(log.T_base_lidar)
    is_moving = log.mounting.motion is not None
    if place.any() or turned or is_moving:
        at = ", ".join(f"{axis} {value_m:.2f}" for axis, value_m in zip("xyz", place, strict=False))
        known += f"; lidar at {at} m of {log.mounting.base_name}{turned and f', turned by {turned}'}"
        known += " at the first scan, moving on it" if is_moving else ""
    paths = ", ".join(map(str, log.paths))
    return f"{paths} {log.topic} ({known})" + (f" (PARTIAL: {stopped})" if stopped else "")
