"""Going on with a run that was killed: what it left is checked against what is asked for now."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.data import Scan
from pipeline.errors import InputError
from pipeline.runs.checkpoint import Checkpoint, read_checkpoint
from pipeline.runs.directory import CHECKPOINT_FILE, POINTS_FILE, RUN_FILE, left_behind
from pipeline.runs.journal import JOURNAL_FILE, read_journal
from pipeline.runs.step_table import StepRow, StepTable
from pipeline.words import counted

_REMEDY = "run without --resume"
_NEEDED = (RUN_FILE, "config.toml", JOURNAL_FILE, CHECKPOINT_FILE, POINTS_FILE)


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
    folder = left_behind(out)
    if folder is None:
        return None
    if (folder / "config.toml").read_text(encoding="utf-8") != configuration:
        raise InputError(f"{folder}: was run with another configuration; repeat its flags, or {_REMEDY}")
    checkpoint = read_checkpoint(folder)
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
    return scans


def set_aside(folder: Path, scans: int) -> tuple[str, ...]:
    """Keep the recording up to the checkpoint under another name, and nothing else that will be made anew.

    What to say of a run that goes on after so many scans.
    """
    for path in folder.iterdir():
        if path.name not in _NEEDED and not path.name.startswith("recording.") and not path.is_dir():
            path.unlink()
    recording, before = folder / "recording.rrd", ""
    if recording.is_file():
        number = len(list(folder.glob("recording.part_*.rrd")))
        before = recording.rename(folder / f"recording.part_{number}.rrd").name
    return (
        f"went on after {counted(scans, 'scan')}" + (f"; the recording up to there is {before}" if before else ""),
    )


def _facts(scan: Scan) -> tuple[int, int, int, int]:
    return scan.stamp_ns, scan.log_time_ns, len(scan.points), scan.dropped
