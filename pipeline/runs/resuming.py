"""Going on with a run that was killed: what it left is checked against what is asked for now."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.data import Scan
from pipeline.errors import InputError
from pipeline.runs.checkpoint import CHECKPOINT_FILE, Checkpoint, read_checkpoint
from pipeline.runs.directory import left_behind
from pipeline.runs.journal import JOURNAL_FILE, read_journal
from pipeline.runs.provenance import package_version
from pipeline.runs.step_table import StepRow, StepTable

_REMEDY = "run without --resume"


@dataclass(frozen=True, slots=True)
class Left:
    """What a killed run left: its directory, the chain at the last checkpoint, the steps up to there."""

    folder: Path
    checkpoint: Checkpoint
    steps: StepTable
    journal_bytes: int


def find_left(out: Path, configuration: str) -> Left | None:
    """What there is of an earlier run into ``out``, None where it had no checkpoint.

    configuration : that of now, as TOML. Raises InputError where that run's, or its version, was another.
    """
    folder = left_behind(out, CHECKPOINT_FILE)
    if folder is None:
        return None
    if (folder / "config.toml").read_text(encoding="utf-8") != configuration:
        raise InputError(f"{folder}: was run with another configuration; repeat its flags, or {_REMEDY}")
    checkpoint = read_checkpoint(folder)
    if checkpoint.version != package_version("scanchain"):
        raise InputError(f"{folder}: was made by scanchain {checkpoint.version}; {_REMEDY}")
    steps, size = read_journal(folder, checkpoint.scans)
    if len(steps) < checkpoint.scans:
        raise InputError(f"{folder / JOURNAL_FILE}: is damaged at step {len(steps)}; {_REMEDY}")
    return Left(folder, checkpoint, steps, size)


def after(rows: Sequence[StepRow], scans: Iterator[Scan], folder: Path) -> Iterator[Scan]:
    """The scans that follow those already done. Raises InputError where these were not the same."""
    for row in rows:
        scan = next(scans, None)
        if scan is None or _facts(scan) != (row.stamp_ns, row.log_time_ns, row.points, row.dropped):
            raise InputError(f"{folder}: scan {row.index} of the log is not the one that was run; {_REMEDY}")
    yield from scans


def set_aside_recording(folder: Path) -> str:
    """Keep the recording up to the checkpoint under another name, which is given back; empty without one."""
    recording = folder / "recording.rrd"
    if not recording.is_file():
        return ""
    number = len(list(folder.glob("recording.part_*.rrd")))
    return recording.rename(folder / f"recording.part_{number}.rrd").name


def _facts(scan: Scan) -> tuple[int, int, int, int]:
    return scan.stamp_ns, scan.log_time_ns, len(scan.points), scan.dropped
