"""A failed run: the files that are retained, and the error that names their directory."""

from __future__ import annotations

import shlex
import traceback
from collections.abc import Sequence
from pathlib import Path

import msgspec

from scanchain.errors import InputError, ScanchainError, counted, remedy_of
from scanchain.files import without_keys
from scanchain.runs.directory import CHECKPOINT_FILE, RUN_FILE, RunDirectory
from scanchain.runs.provenance import Provenance
from scanchain.runs.resume.journal import JOURNAL_FILE
from scanchain.runs.step_table import StepTable
from scanchain.trajectory import write_tum


class PartialRunError(ScanchainError):
    """A run that failed after some scans; its results so far are in a directory marked partial."""


def how_to_resume(command: Sequence[str]) -> str:
    """Command that resumes the run which this command line started; scripts have none."""
    words = [*without_keys(command[1:]), *([] if "--resume" in command else ["--resume"])]
    again = f"scanchain {shlex.join(words)}" if len(command) > 1 else "the same with --resume"
    return f"to resume: {again}"


def rescued(
    error: BaseException, directory: RunDirectory, steps: StepTable, provenance: Provenance
) -> BaseException:
    """The error to raise; the results so far are written, and the error names their directory."""
    is_bug = not isinstance(error, ScanchainError | KeyboardInterrupt | OSError)
    if not len(steps) and not is_bug:
        return error
    directory.worth_keeping()
    if isinstance(error, OSError) and error.filename is None:
        error.filename = str(directory.destination)
    reason = _reason(error)
    what = "traceback.txt and the " if is_bug else ""
    until, is_or_are = f"{counted(len(steps), 'scan')} until then", "is" if len(steps) == 1 else "are"
    where = f"{what}{until} {'are' if is_bug else is_or_are} in {directory.path}"
    try:
        _keep(
            error if is_bug else None, directory.path, steps, msgspec.structs.replace(provenance, stopped=reason)
        )
    except OSError as failure:
        why = "" if isinstance(error, OSError) else f" ({remedy_of(failure) or failure.strerror})"
        where = f"{until} {is_or_are} in {directory.path / JOURNAL_FILE} alone{why}"
    if isinstance(error, KeyboardInterrupt | OSError) and (directory.path / CHECKPOINT_FILE).is_file():
        where += f"; {how_to_resume(provenance.command)}"
    if isinstance(error, InputError):
        return InputError(f"{error.text}; {where}")
    kind = f"{type(error).__name__}: " if is_bug else ""
    return PartialRunError(f"{kind}{reason}; {where}")


def _reason(error: BaseException) -> str:
    """Reason why a run ended, as text."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    known = remedy_of(error) if isinstance(error, OSError) else ""
    return known or str(error) or type(error).__name__


def _keep(bug: BaseException | None, folder: Path, steps: StepTable, provenance: Provenance) -> None:
    """Write the results so far. Raises OSError on a full disk, after which nothing half-written is left."""
    written = [folder / name for name in ("odometry.tum", "steps.parquet", "traceback.txt")]
    try:
        provenance.write(folder / RUN_FILE)
        if bug is not None:
            written[2].write_text("".join(traceback.format_exception(bug)), encoding="utf-8")
        if len(steps) and not (folder / "metrics.json").exists():  # else the results are better
            write_tum(written[0], steps.odometry, force=True)
            steps.write(written[1], steps.best_known)
    except OSError:
        for path in written:
            path.unlink(missing_ok=True)
        raise
