"""A log of a batch: its task, the process that runs it (``scanchain run``), and the row of its result."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from threading import Event

import msgspec
from msgspec import Struct

from scanchain.errors import spelled
from scanchain.files import source_of
from scanchain.processes import Ending, KilledFor, Limits, run_within
from scanchain.runs.directory import METRICS_FILE, RUN_FILE
from scanchain.runs.metrics import Metrics
from scanchain.runs.provenance import Provenance, package_version
from scanchain.settings import Override, dump, load_settings
from scanchain.threads import VARIABLE
from scanchain.verdict import Verdict

ROWS_FOLDER = "rows"  # folder of a batch's directory with the result of each log


class State(StrEnum):
    """End state of a log."""

    DONE = "done"
    NOT_TRUSTWORTHY = "not trustworthy"
    FAILED = "failed"
    CRASHED = "crashed"
    TIMED_OUT = "timed out"
    OUT_OF_MEMORY = "out of memory"
    NOT_RUN = "not run"

    @property
    def has_result(self) -> bool:
        """True if there is a run directory, even if its result is not trustworthy."""
        return self in (State.DONE, State.NOT_TRUSTWORTHY)


class Task(Struct, frozen=True):
    """A log to run, with arguments and limits.

    log : file, folder or address; identity : hash of its path, size and time of change, empty if unreadable
    key : hash of its identity and of everything that determines the result
    out : the batch's directory; arguments : for ``scanchain run``
    retries : further tries after a crash
    """

    log: str
    identity: str
    key: str
    out: str
    arguments: tuple[str, ...]
    limits: Limits
    retries: int

    @property
    def name(self) -> str:
        """Name of the log in messages and tables: an address without the keys in it, spelled as text."""
        return spelled(str(source_of(self.log)))

    @property
    def run(self) -> Path:
        """The run directory, named after the log and the first characters of the key."""
        return Path(self.out) / f"{source_of(self.log).resolve().stem}-{self.key[:8]}"

    @property
    def row_file(self) -> Path:
        """File of its row, in the batch's folder of rows."""
        return Path(self.out) / ROWS_FOLDER / f"{self.key}.json"


class Row(Struct, frozen=True):
    """Result of a log; ``sha256`` from its run, ``peak_mib`` and ``duration_s`` of the last try's process."""

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
        """Number of warnings of its run."""
        return 0 if self.metrics is None else len(self.metrics.warnings)

    @property
    def why(self) -> str:
        """The reason without the name of the log at its beginning."""
        return self.reason.removeprefix(f"{self.log}: ")


def output_file(out: Path, key: str) -> Path:
    """File with the output of the last try of a log."""
    return out / ROWS_FOLDER / f"{key}.txt"


def finished_row(task: Task) -> Row | None:
    """The row of a task that an earlier call completed, if its run directory still exists."""
    try:
        row = msgspec.json.decode(task.row_file.read_bytes(), type=Row)
    except (OSError, msgspec.DecodeError):
        return None
    is_done = row.state.has_result and (Path(task.out) / row.run / METRICS_FILE).is_file()
    return msgspec.structs.replace(row, log=task.name) if is_done else None


def key_of(identity: str, config_file: Path | None, overrides: Sequence[Override]) -> str:
    """Hash of a log's identity, of the configuration in effect for it, and of the version that would run it."""
    settings = [load_settings(d, file=config_file, overrides=overrides).config for d in (2, 3)]
    parts = (package_version("scanchain"), identity, *map(dump, settings))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


_THREADS = (VARIABLE, *(f"{name}_NUM_THREADS" for name in ("NUMBA", "OMP", "OPENBLAS", "MKL", "RAYON")))


def attempt(task: Task, stop: Event | None = None) -> Row:
    """Row of a log, run again after a crash while tries are left; raises nothing."""
    row = _tried(task, stop)
    while row.state is State.CRASHED and row.tries <= task.retries:
        row = msgspec.structs.replace(_tried(task, stop), tries=row.tries + 1)
    return row


def _tried(task: Task, stop: Event | None) -> Row:
    output = output_file(Path(task.out), task.key)
    output.parent.mkdir(parents=True, exist_ok=True)
    ending = run_within(
        task.limits,
        "scanchain.processes",
        ["scanchain", "run", "--out", str(task.run), "--force", *task.arguments, "--", task.log],
        os.environ | dict.fromkeys(_THREADS, "1"),  # one process per core: more threads would only compete
        output=output,
        stop=stop,
    )
    text = output.read_text(encoding="utf-8", errors="replace")
    own = _own_ending(ending, task, text.splitlines()) if ending.killed_for is KilledFor.NOTHING else None
    state, reason = own or (State(ending.how), ending.reason(task.limits, text))
    run, sha256, metrics = "", "", None
    if state.has_result:
        run, (sha256, metrics) = task.run.name, _result(task)
    return Row(task.name, sha256, task.key, run, state, reason, 1, ending.duration_s, ending.peak_mib, metrics)


def _result(task: Task) -> tuple[str, Metrics]:
    """Hash of the log and metrics of its run. Raises OSError or DecodeError where there is no result."""
    made = msgspec.json.decode((task.run / RUN_FILE).read_bytes(), type=Provenance)
    return made.logs[0].sha256, msgspec.json.decode((task.run / METRICS_FILE).read_bytes(), type=Metrics)


def _own_ending(ending: Ending, task: Task, output: list[str]) -> tuple[State, str] | None:
    """End state and reason by exit code, output and result; None for a process that crashed or left no result."""
    error = next((line for line in reversed(output) if line.startswith("error: ")), "")
    with suppress(OSError, msgspec.DecodeError):
        metrics = _result(task)[1]
        if ending.code == 0:
            return State.DONE, ""
        is_new = f"written        {task.run}" in output  # else these metrics are of an earlier run
        if ending.code == 1 and is_new and metrics.verdict is Verdict.NOT_TRUSTWORTHY:
            return State.NOT_TRUSTWORTHY, metrics.verdict_reason
    if ending.code in (1, 2) and error:
        return State.FAILED, error.removeprefix("error: ")
    return None
