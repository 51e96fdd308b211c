"""Every scan of a log through the chain and into the recording, and what came of it into files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from pipeline.config import Config
from pipeline.data import Scan
from pipeline.logs import Log
from pipeline.runs.checkpoint import Checkpoints
from pipeline.runs.closure_table import write_closures
from pipeline.runs.directory import POINTS_FILE, RunDirectory
from pipeline.runs.job import Job
from pipeline.runs.journal import JOURNAL_FILE, Journal
from pipeline.runs.progress import Progress
from pipeline.runs.recorder import OpenRecorder, Recorder
from pipeline.runs.results import Cloud, write_results
from pipeline.runs.results_mcap import write_results_mcap
from pipeline.runs.resuming import Left, after, set_aside
from pipeline.runs.step_table import StepTable
from pipeline.runs.verdicts import JudgedClosure, final_verdicts
from pipeline.slam import Slam, SlamResult


@dataclass(frozen=True, slots=True)
class Processed:
    """The result of a log that went through, what the recording has to say, and how long the user looked at it."""

    result: SlamResult
    cloud: Cloud
    judged: tuple[JudgedClosure, ...]
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
) -> Processed:
    """Place every scan, from the first on or from where the run left off, and write the results."""
    slam, scans, notes = _begin(log, config, directory.path, steps, left)
    journal = Journal(directory.path / JOURNAL_FILE, after_bytes=0 if left is None else left.journal_bytes)
    checkpoints = Checkpoints(directory.path, job.checkpoint_s, 0.0 if left is None else left.checkpoint.run_s)
    with (
        record(
            directory.path / "recording.rrd",
            dimension=log.dimension,
            name=job.out.resolve().name,
            sinks=job.sinks,
            config=config.recording,
        ) as recording,
        journal,
    ):
        if recording.web_address:
            progress.tell(f"viewer: {recording.web_address}")
        for step in map(slam.process, progress.track(scans, log.scan_count - len(steps))):
            recording.log(step)
            journal.append(steps.append(step))
            if checkpoints.are_due():
                checkpoints.write(slam)
        if progress.stopped:
            checkpoints.write(slam)
        result = slam.finish(progress.say)
        judged = final_verdicts(result.closures, result.state)
        progress.say("drawing and writing the map")
        with directory.results() as folder:
            cloud = write_results(folder, result, judged, config, recording)
            write_closures(folder / "loops.parquet", judged, result.keyframes, log.dimension)
            steps.write(folder / "steps.parquet", result.trajectory)
            if config.outputs.mcap:
                write_results_mcap(folder, log, steps, result)
        slam.points.close()
        held_s = _hold(recording, progress)
        progress.say("writing the rest of the recording")
    return Processed(result, cloud, judged, (*notes, *recording.warnings), held_s)


def _begin(
    log: Log, config: Config, folder: Path, steps: StepTable, left: Left | None
) -> tuple[Slam, Iterator[Scan], tuple[str, ...]]:
    """The chain, new or as it was left, the scans that it has not seen, and what to say of that."""
    if left is None:
        return Slam(config, log.T_base_lidar, folder / POINTS_FILE), log.scans(), ()
    slam = left.checkpoint.slam
    slam.points.reopen(folder / POINTS_FILE)
    scans = after(tuple(steps.rows), log.scans(), left.folder)
    return slam, scans, set_aside(folder, left.checkpoint.scans)


def _hold(recording: Recorder, progress: Progress) -> float:
    """Let the user look at a web viewer, which lives as long as the recording; how long that was."""
    if not recording.web_address:
        return 0.0
    began = perf_counter()
    progress.tell(f"done; the viewer at {recording.web_address} stays until Ctrl-C")
    recording.hold()
    return perf_counter() - began
