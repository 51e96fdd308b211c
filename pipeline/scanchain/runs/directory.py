"""The directory of a result and its origin: complete under its own name, or absent, or marked partial."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from types import TracebackType
from typing import Self

import psutil
from msgspec import structs

from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.errors import InputError
from scanchain.files import Source, write_json, write_whole
from scanchain.georeference import Origin
from scanchain.runs.provenance import Hashing, describe_start, log_file
from scanchain.settings import dump

RUN_FILE, CONFIG_FILE = "run.json", "config.toml"
METRICS_FILE, SUMMARY_FILE = "metrics.json", "summary.txt"
TRUTH_FILE = "ground_truth.tum"  # ground-truth poses during the run, as given
CHECKPOINT_FILE = "state.checkpoint"  # of a run that is not complete
RECORDING_FILE = "recording.rrd"
POINTS_FILE = "points.store"  # next to the checkpoint: points kept on disk instead of in memory
_UNFINISHED = "unfinished"


class RunDirectory:
    """The new directory of a run, a localization, a merge or another result; a context manager.

    It is written next to its destination, as ``NAME.partial-PID``, and renamed by ``complete``. If the context
    ends before that, it stays where it is if ``worth_keeping`` was called, else it is removed. A directory that is
    replaced stays untouched until the new one is complete.

    destination : final path; path : current path
    left : the directory of a stopped run that is resumed in, instead of an empty one; None for a new one
    """

    def __init__(
        self, destination: Path, *, force: bool, sources: Sequence[Source] = (), command: Sequence[str] = (),
        resume: bool = False,
    ) -> None:  # fmt: skip
        """Check that the directory may be made, and begin to hash the sources.

        sources, command : what the result is made of, and the command line, for run.json
        resume : whether to resume in the directory of a stopped run, if there is one
        Raises InputError for a destination that must not be replaced, and where the run to resume still runs.
        """
        _check(destination, force)
        self.left = left_behind(destination) if resume else None
        if self.left is not None and (writer := writer_of(self.left)):
            raise InputError(f"{self.left}: is being written by process {writer}; wait for its end or stop it")
        self.began_s = working_s()
        self.sources, self.provenance, self.hashing = sources, describe_start(command), Hashing(sources)
        self.destination = destination.resolve()
        self.force = force
        self.path = self.destination.with_name(f"{self.destination.name}.partial-{os.getpid()}")
        self.is_worth_keeping = False

    def __enter__(self) -> Self:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists() and self.path != self.left:  # of a dead process with the same PID
                shutil.rmtree(self.path)
            if self.left is None:
                self.path.mkdir()
            else:
                self.left.rename(self.path)
                self.is_worth_keeping = True
        except OSError as error:
            raise InputError(
                f"{self.destination}: cannot be made ({error.strerror}); choose another --out"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(self.destination)
        if self.path != self.destination and not self.is_worth_keeping:
            shutil.rmtree(self.path, ignore_errors=True)

    def begin(self, configuration: str = "", config: Config | None = None) -> None:
        """Write run.json and the configuration, which is also described in words."""
        self.provenance = structs.replace(
            self.provenance, configuration=configuration, logs=[log_file(source) for source in self.sources]
        )
        write_json(self.path / RUN_FILE, self.provenance)
        if config is not None:
            write_whole(self.path / CONFIG_FILE, dump(config).encode())

    def end(
        self, *, duration_s: float | None = None, stopped: str = "", is_complete: bool = True,
        origin: Origin | None = None,
    ) -> None:  # fmt: skip
        """Write the final run.json; of a complete result, with the hashes of its sources."""
        logs = self.provenance.logs
        if is_complete:
            hashed = zip(logs, self.hashing.digests(), strict=True)
            logs = [structs.replace(file, sha256=digest) for file, digest in hashed]
        duration_s = working_s() - self.began_s if duration_s is None else duration_s
        self.provenance = structs.replace(
            self.provenance, complete=is_complete, stopped=stopped, duration_s=duration_s, logs=logs, origin=origin
        )
        write_json(self.path / RUN_FILE, self.provenance)

    def worth_keeping(self) -> None:
        """Retain the directory, marked partial, even if the run fails."""
        self.is_worth_keeping = True

    @contextmanager
    def results(self) -> Iterator[Path]:
        """A folder for files that are moved into the directory once all of them are complete."""
        folder = self.path / _UNFINISHED
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            yield folder
            for file in folder.iterdir():
                if file.is_dir():
                    shutil.rmtree(self.path / file.name, ignore_errors=True)
                file.replace(self.path / file.name)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def complete(self) -> None:
        """Rename the directory to its destination, without the checkpoint; a replaced one is removed only now.

        Raises InputError if a directory that must not be replaced has been created there in the meantime.
        """
        _check(self.destination, self.force)
        if self.destination.exists():
            self.destination.rename(self.destination.with_name(f"{self.destination.name}.replaced-{os.getpid()}"))
        for file in (CHECKPOINT_FILE, POINTS_FILE):  # only now: --resume needs them after a kill before this line
            (self.path / file).unlink(missing_ok=True)
        self.path.rename(self.destination)
        self.path = self.destination
        left = [path for path in partial_runs(self.destination) if not writer_of(path)]
        for old in (*left, *self.destination.parent.glob(f"{escape(self.destination.name)}.replaced-*")):
            shutil.rmtree(old, ignore_errors=True)  # also what a killed process left


def write_figures(folder: Path, metrics: object, summary: str) -> None:
    """Write metrics.json, in which values that are not finite become null, and summary.txt."""
    write_json(folder / METRICS_FILE, metrics)
    write_whole(folder / SUMMARY_FILE, summary.encode())


def partial_runs(destination: Path) -> list[Path]:
    """Partial directories of runs into ``destination``, stopped or still running, sorted by name."""
    destination = destination.resolve()
    return sorted(destination.parent.glob(f"{escape(destination.name)}.partial-*"))


def left_behind(destination: Path) -> Path | None:
    """The one of ``partial_runs`` with the latest checkpoint; None if none has a checkpoint."""
    files = [path / CHECKPOINT_FILE for path in partial_runs(destination) if (path / RUN_FILE).is_file()]
    checkpoints = [file for file in files if file.is_file()]
    return max(checkpoints, key=lambda file: file.stat().st_mtime_ns).parent if checkpoints else None


def stopped_run(destination: Path) -> Path | None:
    """The directory of ``left_behind``; None if another process still writes to it."""
    left = left_behind(destination)
    return left if left is not None and not writer_of(left) else None


def writer_of(partial: Path) -> int:
    """PID of another process that still writes to a directory marked partial, 0 if there is none.

    A process that started after the run file was written has the same PID by chance.
    """
    number = partial.name.rpartition("-")[2]
    if not number.isdigit() or int(number) == os.getpid():
        return 0
    run_file = partial / RUN_FILE
    try:
        process = psutil.Process(int(number))
        is_alive = process.status() != psutil.STATUS_ZOMBIE
        written_s = (run_file if run_file.exists() else partial).stat().st_mtime  # a new one has no run file yet
        return int(number) if is_alive and process.create_time() < written_s else 0
    except (psutil.Error, FileNotFoundError):
        return 0


def check_outside_runs(destination: Path) -> None:
    """Raise InputError for a path inside a run directory, since that is replaced as a whole."""
    for folder in destination.resolve().parents:
        file = folder / RUN_FILE
        if file.is_file() and b'"scanchain"' in file.read_bytes():
            raise InputError(f"{destination}: lies in the run directory {folder}; choose another --out")


def _check(destination: Path, force: bool) -> None:
    check_outside_runs(destination)
    if not destination.exists():
        return
    if not destination.is_dir():
        raise InputError(f"{destination}: is a file; choose another --out")
    if not force:
        left = stopped_run(destination)
        resume = f"; {left.name} is of a run that did not end: --force --resume continues it" if left else ""
        raise InputError(f"{destination}: exists; choose another --out or pass --force to replace it{resume}")
    if any(destination.iterdir()) and not (destination / RUN_FILE).is_file():
        raise InputError(
            f"{destination}: is not a run ({RUN_FILE} is missing), so --force does not replace it; "
            "choose another --out"
        )
