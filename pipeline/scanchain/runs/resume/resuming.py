"""Resuming a run that was killed: its files are checked against the present log and configuration."""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

from scanchain.config import Config
from scanchain.data import Scan
from scanchain.errors import InputError, counted
from scanchain.runs.directory import CHECKPOINT_FILE, POINTS_FILE, RECORDING_FILE, RUN_FILE, left_behind
from scanchain.runs.job import Recorder
from scanchain.runs.resume.checkpoint import Checkpoint, Checkpoints, read_checkpoint
from scanchain.runs.resume.journal import JOURNAL_FILE, read_journal
from scanchain.runs.step_table import StepRow, StepTable
from scanchain.settings import dump

_REMEDY = "run without --resume"
_NEEDED = (RUN_FILE, "config.toml", JOURNAL_FILE, CHECKPOINT_FILE, POINTS_FILE)


@dataclass(frozen=True, slots=True)
class Left:
    """State of a killed run: its directory, SLAM at the last checkpoint, the steps up to there."""

    folder: Path
    checkpoint: Checkpoint
    steps: StepTable
    journal_bytes: int


def find_left(out: Path, config: Config) -> Left | None:
    """State of an earlier run into ``out``, None if it had no checkpoint.

    config : that of now. Raises InputError where that run's, or its version, was another.
    """
    folder = left_behind(out)
    if folder is None:
        return None
    if (folder / "config.toml").read_text(encoding="utf-8") != dump(config):
        raise InputError(f"{folder}: was run with another configuration; repeat its flags, or {_REMEDY}")
    checkpoint = read_checkpoint(folder, config)
    steps, size = read_journal(folder, checkpoint.scans)
    if len(steps) < checkpoint.scans:
        raise InputError(f"{folder / JOURNAL_FILE}: is damaged at step {len(steps)}; {_REMEDY}")
    return Left(folder, checkpoint, steps, size)


def after(
    rows: Sequence[StepRow], scans: Generator[Scan, None, None], folder: Path
) -> Generator[Scan, None, None]:
    """The scans that follow those already done. Raises InputError where these were not the same."""
    for row in rows:
        scan = next(scans, None)
        if scan is None or _facts(scan) != (row.stamp_ns, row.log_time_ns, row.points, row.dropped):
            raise InputError(f"{folder}: scan {row.index} of the log is not the one that was run; {_REMEDY}")
    return scans


def set_aside(folder: Path, checkpoint: Checkpoint) -> None:
    """Remove files that will be written again, except the recording, which is renamed.

    Its name holds the number of its process: one killed before its own first checkpoint leaves it to the next.
    """
    before, recording = _recorded_by(checkpoint.process, folder), folder / RECORDING_FILE
    if recording.is_file() and not before.exists():
        recording.rename(before)
    if checkpoint.recorded_bytes:  # of what the process before recorded, too
        _recorded_by(checkpoint.process - 1, folder).unlink(missing_ok=True)
    for path in folder.iterdir():
        if path.name not in _NEEDED and not path.match("recording.part_*.rrd") and not path.is_dir():
            path.unlink()


def resume_recording(folder: Path, left: Left, recording: Recorder, checkpoints: Checkpoints) -> str:
    """Resume the recording where the last checkpoint left it; returns a note about it."""
    checkpoint, slam = left.checkpoint, left.checkpoint.slam
    before = _recorded_by(checkpoint.process, folder)
    is_whole = 0 < checkpoint.recorded_bytes <= (before.stat().st_size if before.exists() else 0)
    if is_whole:
        os.truncate(before, checkpoint.recorded_bytes)
    recording.resume(before if is_whole else None, tuple(left.steps.rows), slam.closures, slam.graph.state())
    recorded_bytes = recording.secure()
    checkpoints.write(slam, recorded_bytes)
    note = f"resumed after {counted(checkpoint.scans, 'scan')}"
    if recorded_bytes and is_whole:
        before.unlink()
    elif before.exists():
        note += f"; the recording up to there is {before.name}{'' if is_whole else ', incomplete'}"
    elif recorded_bytes:
        note += "; the recording begins there"
    return note


def _recorded_by(process: int, folder: Path) -> Path:
    return folder / f"recording.part_{process}.rrd"


def _facts(scan: Scan) -> tuple[int, int, int, int]:
    return scan.stamp_ns, scan.log_time_ns, len(scan.points), scan.dropped
