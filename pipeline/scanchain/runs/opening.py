"""The input of a run or of a localization: a log, the settings for it, and its ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain.config import NO_TOPIC, Config
from scanchain.data import Trajectory
from scanchain.errors import InputError, counted
from scanchain.evaluation import TruthFile, check_overlap, during, read_truth
from scanchain.files import Source
from scanchain.logs import Log, open_log
from scanchain.logs.mounting import turned_by
from scanchain.odometry.distortion import choose_point_times
from scanchain.runs.directory import TRUTH_FILE
from scanchain.runs.job import Job, Progress
from scanchain.runs.metrics import GroundTruth, compare_with_truth
from scanchain.settings import load_settings, named
from scanchain.slam import SlamResult
from scanchain.trajectory import write_tum


@dataclass(frozen=True, slots=True)
class Opened:
    """The log of a job with its settings.

    sources : the files of the log
    configuration : the settings in words
    truth_file : ground truth if a file is named; else the log's own is used, if it has one
    max_gap_s : longest gap between true poses to interpolate over; None for the default
    """

    sources: Sequence[Source]
    progress: Progress
    log: Log
    config: Config
    configuration: str
    truth_file: TruthFile | None
    max_gap_s: float | None

    def stopped_after(self, count: int) -> str:
        """Why the log ended after so many scans; empty if it was not stopped."""
        return f"stopped by the user after {counted(count, 'scan')}" if self.progress.stopped else ""

    def true_poses(self, stamps_ns: NDArray[np.int64]) -> Trajectory | None:
        """True poses, of a KITTI file those of the scans (N,) before a stop. Raises InputError."""
        if self.truth_file is None:
            return self.log.ground_truth()
        return (self.truth_file.first(len(stamps_ns)) if self.progress.stopped else self.truth_file).at(stamps_ns)

    def accuracy(self, result: SlamResult, folder: Path) -> tuple[GroundTruth | None, tuple[str, ...]]:
        """Accuracy if there is ground truth, which is written to the folder; warnings if it may mislead."""
        source = self.log.ground_truth_topic if self.truth_file is None else str(self.truth_file.path)
        try:
            reference = self.true_poses(result.odometry.stamps_ns)
            if reference is None:
                return None, ()
            truth, misleading = compare_with_truth(result, reference, source, self.max_gap_s)
            write_tum(folder / TRUTH_FILE, during(reference, result.trajectory.stamps_ns))
        except InputError as error:
            return None, (f"no accuracy against {source}: {error.text}",)
        return truth, tuple(filter(None, (truth.complaint, *misleading)))

    def heading(self, stopped: str) -> str:
        """The log in a line: files, topic, wheels and mounting."""
        log, is_moving = self.log, self.log.mounting.motion is not None
        known = f"wheel odometry {log.wheels}" if log.odometry_topic else "no wheel odometry"
        if log.odometry_topic and self.config.odometry.prior == "constant-velocity":
            known += ", not used: odometry.prior is constant-velocity"
        elif log.odometry_topic and not log.scans_with_wheels:
            known += ", not used: no reading is near the stamp of a scan"
        place, turned = log.T_base_lidar[:-1, -1], turned_by(log.T_base_lidar)
        if place.any() or turned or is_moving:
            at = ", ".join(f"{axis} {value_m:.2f}" for axis, value_m in zip("xyz", place, strict=False))
            known += f"; lidar at {at} m of {log.mounting.base_name}{turned and f', turned by {turned}'}"
            known += " at the first scan, moving on it" if is_moving else ""
        paths = ", ".join(map(str, log.paths))
        return f"{paths} {log.topics} ({known})" + (f" (PARTIAL: {stopped})" if stopped else "")


def opened(job: Job, progress: Progress) -> Opened:
    """The log of a job. Raises InputError where log, settings and ground truth do not fit together."""
    for source, count in Counter(source.resolve() for source in job.logs).items():
        if count > 1:
            raise InputError(f"{source}: is named {count} times; name each file of a log once")
    truth = None if job.ground_truth is None else read_truth(job.ground_truth)
    early = load_settings(file=job.config_file, overrides=job.overrides)  # the preset depends on the log
    log = open_log(job.logs, early.config.log)
    choose_point_times(log, deskew=early.config.preprocess.deskew)
    settings = load_settings(log.dimension, file=job.config_file, overrides=job.overrides)
    if settings.config.odometry.prior == "wheel" and not log.odometry_topic:
        raise InputError(
            f"{log.name}: odometry.prior is 'wheel', but the log has no wheel odometry that is known; "
            "set log.odometry_topic, or odometry.prior to 'auto'"
        )
    topic = named(job.overrides, "log.ground_truth_topic")
    if truth is not None:
        truth.check(log.expected_stamps(log.topic), log.scan_count)
    elif topic not in ("", NO_TOPIC):
        if not log.ground_truth_topic:
            raise InputError(f"{log.name}: has no topic {topic}; scanchain info lists those with poses")
        check_overlap(topic, log.expected_stamps(topic), log.expected_stamps(log.topic))
    return Opened(job.logs, progress, log, settings.config, settings.source, truth, job.max_gap_s)
