"""A log to be run, and what became of it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

import msgspec
from msgspec import Struct

from scanchain.logs.files import spelled
from scanchain.runs.metrics import Metrics
from scanchain.runs.provenance import package_version
from scanchain.settings import Override, dump, load_settings
from scanchain.source import source_of

ROWS_FOLDER = "rows"  # of a batch's directory: what became of each log


class State(StrEnum):
    """How a log ended."""

    DONE = "done"
    UNRELIABLE = "unreliable"
    FAILED = "failed"
    CRASHED = "crashed"
    TIMED_OUT = "timed out"
    OUT_OF_MEMORY = "out of memory"
    NOT_RUN = "not run"

    @property
    def has_result(self) -> bool:
        """Whether there is a run directory, even if most of its scans are degenerate or lost."""
        return self in (State.DONE, State.UNRELIABLE)


class Task(Struct, frozen=True):
    """A log and how it is run.

    Attributes
    ----------
    log : the file, folder or address; sha256 : that of its contents, of a remote log that of its address, size
        and version, empty where it cannot be read
    key : of its contents and all that decides about the result
    out : the batch's directory
    arguments : for ``scanchain run``
    time_s, memory_mib : what its process may take
    retries : further tries of one that crashed
    """

    log: str
    sha256: str
    key: str
    out: str
    arguments: tuple[str, ...]
    time_s: float
    memory_mib: float
    retries: int

    @property
    def name(self) -> str:
        """The log as it is called in what is written: an address without the keys in it, spelled as text."""
        return spelled(str(source_of(self.log)))

    @property
    def run(self) -> Path:
        """The run directory; its name is that of the log and the key's first letters."""
        return Path(self.out) / f"{source_of(self.log).resolve().stem}-{self.key[:8]}"

    @property
    def row_file(self) -> Path:
        """What became of it, kept beside the run directory."""
        return Path(self.out) / ROWS_FOLDER / f"{self.key}.json"

    @property
    def said_file(self) -> Path:
        """All that the last try said."""
        return said_file(Path(self.out), self.key)


class Row(Struct, frozen=True):
    """What became of a log; ``peak_mib`` and ``duration_s`` are those of the last try's process."""

    log: str
    sha256: str
    key: str
    run: str
    state: State
    reason: str
    tries: int
    duration_s: float
    peak_mib: float
    metrics: Metrics | None

    @property
    def warnings(self) -> int:
        """How many lines its run says of what was lost, left out or is wrong."""
        return 0 if self.metrics is None else len(self.metrics.warnings)

    def write(self, path: Path) -> None:
        """Write as JSON, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        new = path.with_suffix(".new")
        new.write_bytes(msgspec.json.encode(self))
        new.replace(path)


def said_file(out: Path, key: str) -> Path:
    """Where a batch keeps all that the last try of a log said."""
    return out / ROWS_FOLDER / f"{key}.txt"


def finished_row(task: Task) -> Row | None:
    """The row of a task that an earlier call has done, if its run directory is still there."""
    try:
        row = msgspec.json.decode(task.row_file.read_bytes(), type=Row)
    except (OSError, msgspec.DecodeError):
        return None
    is_done = row.state.has_result and (Path(task.out) / row.run / "metrics.json").is_file()
    return msgspec.structs.replace(row, log=task.name) if is_done else None


def unfinished_row(task: Task, state: State, reason: str) -> Row:
    """The row of a task without a process to tell of."""
    return Row(task.name, task.sha256, task.key, "", state, reason, 0, 0.0, 0.0, None)


def key_of(sha256: str, config_file: Path | None, overrides: Sequence[Override]) -> str:
    """Hash of a log's contents, of the configuration in effect for it, and of the version that would run it."""
    settings = [load_settings(d, file=config_file, overrides=overrides).config for d in (2, 3)]
    parts = (package_version("scanchain"), sha256, *map(dump, settings))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()
