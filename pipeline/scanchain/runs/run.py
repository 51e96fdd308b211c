"""A run: processes a log and writes a run directory."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from html import escape
from pathlib import Path
from time import perf_counter

from scanchain import lie
from scanchain.ahead import compile_ahead
from scanchain.clock import announcing_compilation, compiled_s, working_s
from scanchain.data import Scan, Trajectory, brief
from scanchain.errors import InputError, OwnCodeError, ScanchainError, counted
from scanchain.evaluation import ExpectedErrors, on_the_estimate
from scanchain.georeference import Georeference
from scanchain.logs import open_log
from scanchain.logs.topics import other_sensors
from scanchain.preprocess import prepare_ahead
from scanchain.runs.closures import final_verdicts
from scanchain.runs.directory import RECORDING_FILE, RunDirectory, stopped_run, write_figures
from scanchain.runs.job import Job, OpenRecorder, Progress, Recorder
from scanchain.runs.metrics import Accuracy, Metrics, measure, summary
from scanchain.runs.opening import Opened, opened
from scanchain.runs.results import Results, expected_of, record_results, results_of, write_results
from scanchain.runs.resume import Checkpoints, read_checkpoint, rescued
from scanchain.slam import Slam, SlamResult
from scanchain.steps import Steps
from scanchain.threads import threads
from scanchain.trajectory import read_tum, write_wide_tum
from scanchain.verdict import Judged


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

    def _repr_html_(self) -> str:
        """Summary and path, which a notebook shows."""
        path = read_tum(self.path)  # lifted into space
        path = Trajectory(path.stamps_ns, lie.flatten(path.poses)) if self.metrics.dimension == 2 else path
        return f"<pre>{escape(self.summary)}</pre>{path._repr_html_()}"


def run(
    job: Job, record: OpenRecorder, progress: Progress, report: Callable[[Path], None] = lambda folder: None
) -> Finished:
    """Open the log, process it, write the run directory; at the end, ``report`` adds its page to this.

    Raises InputError for bad input; no new directory remains unless scans were processed before. Raises
    OwnCodeError where the user's own code fails; no new directory remains.
    """
    compiled_before_s = compiled_s()
    directory = RunDirectory(job.out, force=job.force, sources=job.logs, command=job.command, resume=job.resume)
    source = opened(job, progress)
    left = None if directory.left is None else read_checkpoint(directory.left, source.config)
    checkpoints = Checkpoints(directory.path, job.checkpoint_s, left)
    this = _Run(source, directory, checkpoints, progress)
    this.announce(job)
    with directory, announcing_compilation(progress.say):
        try:
            directory.begin(source.configuration, source.config)
            compile_ahead([f"{source.log.dimension}d"], progress.compiling)
            slam, scans = checkpoints.start(source)
            with record(
                directory.path / RECORDING_FILE, dimension=slam.dimension, name=directory.destination.name,
                sinks=job.sinks, config=source.config.recording,
            ) as recording:  # fmt: skip
                result = this.process(slam, scans, recording)
                results, expected, judged = this.write(result, recording)
                slam.points.close()
                held_s = this.hold(recording, is_saved=bool(job.sinks))
            run_s = working_s() - directory.began_s + (left.run_s if left else 0.0) - held_s
            times_s = run_s, compiled_s() - compiled_before_s
            metrics, text = this.measure(results, expected, judged, recording.warnings, times_s)
            return this.complete(metrics, text, result.georeference, report)
        except (Exception, KeyboardInterrupt) as error:
            is_early = not len(this.steps) and isinstance(error, ScanchainError | KeyboardInterrupt | OSError)
            if is_early or isinstance(error, OwnCodeError):
                raise
            raise rescued(error, directory, this.steps) from error


class _Run:
    """The steps of a run: process every scan, write the results, measure and complete."""

    def __init__(
        self, source: Opened, directory: RunDirectory, checkpoints: Checkpoints, progress: Progress
    ) -> None:
        self.source, self.log, self.config = source, source.log, source.config
        self.directory, self.checkpoints, self.progress = directory, checkpoints, progress
        left = checkpoints.left
        self.steps = Steps() if left is None else left.slam.steps
        self.notes, self.resumed = list[str](), ""

    def announce(self, job: Job) -> None:
        """Show what is processed, and whether from the first scan on."""
        log, left, announce = self.log, self.directory.left, self.progress.announce
        if self.checkpoints.absent:
            announce(self.checkpoints.absent)
        count = counted(log.scan_count, "scan")
        self.progress.say(f"{log.topics}: {log.dimension}D, {count}; {self.source.configuration}")
        for gap in log.gaps:
            announce(f"warning: {gap}")
        if left is not None:
            announce(f"resuming after {counted(len(self.steps), 'scan')} of {left.name}")
        elif idle := stopped_run(job.out):
            announce(
                f"{idle.name} is of a run that did not end; --resume would continue it, this run starts over and "
                "removes it once complete"
            )
        elif job.resume:
            announce(f"{job.out}: no checkpoint to resume from, this run starts at the first scan")

    def process(self, slam: Slam, scans: Generator[Scan, None, None], recording: Recorder) -> SlamResult:
        """SLAM result of all scans, processed from the first one or from the checkpoint on."""
        checkpoints = self.checkpoints
        if recording.web_address:
            self.progress.announce(f"viewer: {recording.web_address}")
        self.steps, self.resumed = slam.steps, checkpoints.resume(recording)
        with closing(scans):  # counts what the log left out, also if the run was stopped
            tracked = self.progress.track(scans, self.log.scan_count)
            if slam.dimension == 3 and threads() > 1:
                tracked = prepare_ahead(tracked, slam.front_end.odometry.resolution)
            for scan in tracked:
                step = slam.process(scan)
                recording.log(step)
                if checkpoints.are_due():
                    checkpoints.write(slam, recording.secure())
        checkpoints.write(slam, recording.secure())  # an interruption from here on loses no scan
        return slam.finish(self.progress.say)

    def write(self, result: SlamResult, recording: Recorder) -> tuple[Results, ExpectedErrors | None, Judged]:
        """Write the results to the directory, and them, the verdict and the ground truth to the recording."""
        self.progress.say("building the maps and writing the results")
        with self.directory.results() as folder:
            final = final_verdicts(result.closures, result.state)
            results = results_of(self.log, result, final)
            write_results(folder, results)
            expected = self.expected(result)
            if expected is not None:
                write_wide_tum(folder / "keyframes.tum", result.keyframe_trajectory, expected.covariances)
            judged = results.judged(expected and expected.ate)
            record_results(recording, results)
            recording.log_verdict(judged, result.trajectory)
            with suppress(InputError):  # reported with the accuracy
                reference = self.source.true_poses(result.trajectory.stamps_ns)
                if reference is not None:
                    moved = on_the_estimate(result.trajectory, reference, gap_s=self.source.max_gap_s)
                    recording.log_ground_truth(moved.poses)
        return results, expected, judged

    def expected(self, result: SlamResult) -> ExpectedErrors | None:
        """Expected errors; the systematic ones are measured by odometry on the scans, which are read again."""
        if self.config.outputs.error_bars == "full" and not self.progress.stopped:
            self.progress.say(
                "measuring systematic errors: odometry without one group of directions after the other"
            )
            try:
                again = open_log(self.source.sources, self.log.config)
                with closing(again.scans(self.config.preprocess)) as scans:
                    return expected_of(result, scans, self.log.distorted_share)
            except (InputError, OSError) as error:
                self.notes.append(f"error bars of random errors only: {error}")
        return expected_of(result)

    def hold(self, recording: Recorder, *, is_saved: bool) -> float:
        """Keep the web viewer, which ends with the recording, open until the user stops it; seconds waited."""
        began_s = perf_counter()
        if recording.web_address:
            self.progress.announce(f"done; the viewer at {recording.web_address} stays until Ctrl-C")
            recording.hold()
        if is_saved:
            self.progress.say("writing the rest of the recording")
        return perf_counter() - began_s if recording.web_address else 0.0

    def measure(
        self, results: Results, expected: ExpectedErrors | None, judged: Judged, of_recording: Sequence[str],
        times_s: tuple[float, float],
    ) -> tuple[Metrics, str]:  # fmt: skip
        """Metrics and summary of the run, which are also written to the directory."""
        log, result, (run_s, compile_s) = self.log, results.result, times_s
        stopped = self.source.stopped_after(len(self.steps))
        lost = [*log.damage, *self.notes, *result.warnings, *results.warnings, *of_recording]
        if len(self.steps) <= 2:  # at most one motion
            few = f"a trajectory of {counted(len(self.steps), 'scan')}"
            lost.append(f"{few} says nothing about the log; check --start, --end, --every")
        wheels, truth_topic = log.odometry_topic, log.ground_truth_topic
        imu = results.result.config.odometry.imu
        sensors = other_sensors(log.indexes, wheels=wheels, truth=truth_topic, placed=log.placed, uses_imu=imu)
        idle = [f"{each.sensor} {each.topic}: {each.use}" for each in sensors if each.use.startswith("not used")]
        with self.directory.results() as folder:
            truth, note = self.source.accuracy(result, folder)
            metrics = measure(
                results, expected and expected.ate, judged, run_s=run_s, compile_s=compile_s,
                ground_truth=truth, warnings=(*lost, *note), stopped=stopped,
            )  # fmt: skip
            notes = [note for note in (self.resumed, *log.notes, *result.sensor_notes, *idle) if note]
            text = summary(metrics, self.source.heading(stopped), self.source.configuration, notes)
            write_figures(folder, metrics, text)
        return metrics, text

    def complete(
        self, metrics: Metrics, text: str, place: Georeference | None, report: Callable[[Path], None]
    ) -> Finished:
        """Add the report and give a complete run its name; a stopped one stays marked partial."""
        directory, stopped, warnings = self.directory, metrics.stopped, metrics.warnings
        if stopped:
            directory.worth_keeping()
        took_s, origin = metrics.run_s + metrics.compile_s, place and place.origin
        directory.end(duration_s=took_s, stopped=stopped, is_complete=not stopped, origin=origin)
        self.progress.say("drawing the report")
        try:
            report(directory.path)
        except Exception as error:  # a report that fails must not fail the run
            warnings += (f"no report.html: {type(error).__name__}: {error}",)
        if not stopped:
            directory.complete()
        return Finished(directory.path, metrics, text, warnings, stopped)
