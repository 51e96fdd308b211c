"""The loop over the scans of a log: SLAM, recording, checkpoints; then the result files."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from scanchain.clock import compiled_s
from scanchain.config import Config
from scanchain.data import Scan, Step, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import ExpectedErrors, on_the_estimate
from scanchain.logs import Log
from scanchain.preprocess import Prepared, Resolution, prepare, prepare_ahead
from scanchain.runs.closures import FinalClosure, final_verdicts
from scanchain.runs.directory import POINTS_FILE, RECORDING_FILE, RunDirectory
from scanchain.runs.job import Job, OpenRecorder, Progress, Recorder
from scanchain.runs.overlay import OVERLAY_FILE, write_overlay
from scanchain.runs.results import Cloud, record_results, results_of, write_results
from scanchain.runs.resume.checkpoint import Checkpoints
from scanchain.runs.resume.journal import JOURNAL_FILE, Journal
from scanchain.runs.resume.resuming import Left, after, resume_recording, set_aside
from scanchain.runs.step_table import StepTable
from scanchain.runs.vouching import evidence_of_run
from scanchain.slam import Slam, SlamResult
from scanchain.threads import threads
from scanchain.verdict import Judged, judge, worst_place

_TOGETHER = 16  # largest number of scans that are read, and of steps that are entered, together
_WAIT_S = 0.05  # longest time for which steps are gathered

TruePoses = Callable[[NDArray[np.int64]], Trajectory | None]  # of scans with these stamps; may raise InputError


@dataclass(frozen=True, slots=True)
class Processed:
    """The result of a log, its verdict, warnings of the recording, seconds that the user kept the viewer open."""

    result: SlamResult
    cloud: Cloud
    final: tuple[FinalClosure, ...]
    judged: Judged
    expected: ExpectedErrors | None
    warnings: tuple[str, ...]
    held_s: float


def process(
    job: Job,
    log: Log,
    config: Config,
    directory: RunDirectory,
    record: OpenRecorder,
    progress: Progress,
    steps: StepTable,
    left: Left | None,
    true_poses: TruePoses,
) -> Processed:
    """Process every scan, from the first on or from the checkpoint, and write the results."""
    compiled_before_s = compiled_s()
    slam, scans, checkpoints = _begin(job, log, config, directory.path, left)
    journal = Journal(directory.path / JOURNAL_FILE, after_bytes=0 if left is None else left.journal_bytes)
    with (
        record(
            directory.path / RECORDING_FILE,
            dimension=log.dimension,
            name=job.out.resolve().name,
            sinks=job.sinks,
            config=config.recording,
        ) as recording,
        journal,
        closing(scans),  # what it left out is counted then, also if the run was stopped
    ):
        if recording.web_address:
            progress.announce(f"viewer: {recording.web_address}")
        notes = () if left is None else (resume_recording(directory.path, left, recording, checkpoints),)
        read = _previewed(scans, compiled_before_s, recording) if left is None else scans
        with _Taking(recording, journal, steps) as taking:
            for scan in _ahead(progress.track(read, log.scan_count - len(steps)), slam):
                taking.take(slam.place(slam.front_end.locate(scan)))
                if checkpoints.are_due():
                    taking.enter()
                    checkpoints.write(slam, recording.secure())
        checkpoints.write(slam, recording.secure())  # an interruption from here on loses no scan
        result = slam.finish(progress.say)
        final = final_verdicts(result.closures, result.state)
        progress.say("building the maps and writing the results")
        with directory.results() as folder:
            results = results_of(log, config, steps, result, final)
            write_results(folder, results)
            evidence = evidence_of_run(folder, results.expected and results.expected.ate)
            judged = judge(evidence)
            worst = worst_place(judged.stretches, evidence)
            if worst is not None:
                write_overlay(folder / OVERLAY_FILE, worst, result)
            record_results(recording, results)
            recording.log_verdict(judged, result.trajectory)
            _record_truth(true_poses, job.max_gap_s, result, recording)
        slam.points.close()
        held_s = _hold(recording, progress)
        if job.sinks:
            progress.say("writing the rest of the recording")
    return Processed(
        result,
        results.cloud,
        final,
        judged,
        results.expected,
        (*notes, *result.warnings, *results.warnings, *recording.warnings),
        held_s,
    )


class _Taking:
    """Records steps and enters them into table and journal, a few at once: that is quicker. A context."""

    def __init__(self, recording: Recorder, journal: Journal, steps: StepTable) -> None:
        self.recording = recording
        self.journal = journal
        self.steps = steps
        self.waiting: deque[Step] = deque()
        self.since_s = perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.enter()

    def take(self, step: Step) -> None:
        """Take a step, to be entered by now or soon."""
        self.waiting.append(step)
        if len(self.waiting) >= _TOGETHER or perf_counter() - self.since_s >= _WAIT_S:
            self.enter()

    def enter(self) -> None:
        """Enter the steps that wait, and write the journal. Raises OSError where the disk is full."""
        while self.waiting:
            step = self.waiting.popleft()
            self.journal.append(self.steps.append(step))
            self.recording.log(step)
        self.journal.flush()
        self.since_s = perf_counter()


def _begin(
    job: Job, log: Log, config: Config, folder: Path, left: Left | None
) -> tuple[Slam, Generator[Scan, None, None], Checkpoints]:
    """SLAM, new or as of the checkpoint, the scans that follow, and the writer of checkpoints."""
    if left is None:
        slam = Slam(config, log.T_base_lidar, folder / POINTS_FILE)
        return slam, log.scans(config.preprocess), Checkpoints(folder, job.checkpoint_s)
    checkpoint = left.checkpoint
    checkpoint.slam.points.reopen(folder / POINTS_FILE)
    scans = after(tuple(left.steps.rows), log.scans(config.preprocess), left.folder)
    set_aside(folder, checkpoint)
    checkpoints = Checkpoints(folder, job.checkpoint_s, run_s=checkpoint.run_s, process=checkpoint.process + 1)
    return checkpoint.slam, scans, checkpoints


def _previewed(scans: Iterator[Scan], compiled_before_s: float, recording: Recorder) -> Iterator[Scan]:
    """The scans; the first one is shown as measured where its step waits for kernels that are compiled."""
    for number, scan in enumerate(scans):
        if not number and compiled_s() > compiled_before_s:
            recording.preview(scan)
        yield scan


def _ahead(scans: Iterator[Scan], slam: Slam) -> Iterator[Scan | Prepared]:
    """The scans, clouds prepared in a thread beside; laser scans a few at once, which is quicker than either."""
    resolution = slam.front_end.odometry.resolution
    if slam.dimension == 3 and threads() > 1:
        yield from prepare_ahead(scans, resolution)
    elif resolution.is_fixed:
        yield from few_at_once(scans, resolution)
    else:
        yield from scans


def few_at_once(scans: Iterator[Scan], resolution: Resolution) -> Iterator[Prepared]:
    """Scans, a few read and prepared together; those before an error come before it."""
    while True:
        some: list[Prepared] = []
        try:
            some.extend(prepare(scan, resolution) for scan in islice(scans, _TOGETHER))
        except BaseException:  # of the log, or the user's wish to end
            yield from some
            raise
        if not some:
            return
        yield from some


def _record_truth(true_poses: TruePoses, gap_s: float | None, result: SlamResult, recording: Recorder) -> None:
    """Record the ground truth aligned to the trajectory; one that does not fit is reported elsewhere."""
    with suppress(InputError):
        reference = true_poses(result.trajectory.stamps_ns)
        if reference is not None:
            moved = on_the_estimate(result.trajectory, reference, gap_s=gap_s)
            recording.log_ground_truth(moved.poses)


def _hold(recording: Recorder, progress: Progress) -> float:
    """Keep the web viewer open, which lives as long as the recording; seconds until the user ended it."""
    if not recording.web_address:
        return 0.0
    began = perf_counter()
    progress.announce(f"done; the viewer at {recording.web_address} stays until Ctrl-C")
    recording.hold()
    return perf_counter() - began
