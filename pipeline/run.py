"""The main job: a log in, a run directory out."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from pipeline.closure_table import write_closures
from pipeline.config import Config
from pipeline.data import Scan, Trajectory
from pipeline.errors import InputError, ScanchainError
from pipeline.graph.g2o import write_g2o
from pipeline.logs import Log, open_log
from pipeline.maps import OccupancyGrid, build_point_map, draw_grid, fitting_resolution, write_map, write_ply
from pipeline.provenance import Hashing, Provenance, describe_start
from pipeline.recorder import OpenRecorder, Recorder, SinkName
from pipeline.run_directory import RUN_FILE, RunDirectory
from pipeline.run_metrics import GroundTruth, Metrics, judge, measure, summary
from pipeline.settings import Override, dump, load_settings
from pipeline.slam import Slam, SlamResult
from pipeline.step_table import StepTable
from pipeline.trajectory import read_tum, write_kitti, write_tum
from pipeline.verdicts import final_verdicts


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be run.

    Attributes
    ----------
    logs : the files of one log
    out : the run directory
    config_file : instead of the preset; overrides : on top
    sinks : where the recording goes
    ground_truth : a TUM file; None where the log's own is good
    force : whether a run directory of that name is replaced
    command : the command line, for run.json
    """

    logs: tuple[Path, ...]
    out: Path
    config_file: Path | None = None
    overrides: tuple[Override, ...] = ()
    sinks: frozenset[SinkName] = frozenset({"save"})
    ground_truth: Path | None = None
    force: bool = False
    command: tuple[str, ...] = ()


class Progress(Protocol):
    """Whoever watches a run and may end it early."""

    @property
    def stopped(self) -> bool:
        """Whether the user ended the run early."""
        ...

    def say(self, line: str) -> None:
        """Tell something that happens."""
        ...

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """Pass the scans on, of which there should be ``count``, until they end or the user wants no more."""
        ...


@dataclass(frozen=True, slots=True)
class Finished:
    """A run that came to its end: where it lies, its numbers, the same as text."""

    path: Path
    metrics: Metrics
    summary: str


class PartialRunError(ScanchainError):
    """A run that failed or was stopped after some scans; what there is lies in a directory marked partial."""


def run(job: Job, record: OpenRecorder, progress: Progress) -> Finished:
    """Open the log, process it, write the run directory."""
    started = perf_counter()
    reference = None if job.ground_truth is None else read_tum(job.ground_truth)
    config = load_settings(file=job.config_file, overrides=job.overrides).config
    directory = RunDirectory(job.out, force=job.force)
    log = open_log(job.logs, config.log)
    settings = load_settings(log.dimension, file=job.config_file, overrides=job.overrides)
    provenance = describe_start(job.command, job.logs, settings.source)
    steps = StepTable()
    progress.say(f"{log.topic}, {log.dimension}D, {log.scan_count:,} scans; {settings.source}")
    with directory, Hashing(job.logs) as hashing:
        provenance.write(directory.path / RUN_FILE)
        (directory.path / "config.toml").write_text(dump(settings.config), encoding="utf-8")
        recorder = record(
            directory.path / "recording.rrd",
            dimension=log.dimension,
            name=job.out.name,
            sinks=job.sinks,
            config=settings.config.recording,
        )
        try:
            with recorder as recording:
                result = _process(log, settings.config, recording, progress, steps)
                grid = _write_results(directory.path, result, settings.config, recording)
            judged = final_verdicts(result.closures, result.state)
            write_closures(directory.path / "loops.parquet", judged, result.keyframes, log.dimension)
            steps.write(directory.path / "steps.parquet", result.trajectory)
            truth = _judge(job, log, result, reference)
        except Exception as error:
            raise _failed(error, directory, steps) from error
        ...
    raise NotImplementedError
