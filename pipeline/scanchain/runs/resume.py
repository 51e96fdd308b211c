"""Resuming a run that was stopped: its checkpoints, the files that it leaves, and the error that names them."""

from __future__ import annotations

import hmac
import io
import os
import pickle
import platform
import secrets
import shlex
import traceback
import zlib
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Thread
from time import perf_counter
from typing import Any, BinaryIO

import numpy as np

from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.data import Scan
from scanchain.errors import InputError, ScanchainError, counted, one_line, remedy_of
from scanchain.files import without_keys, write_whole
from scanchain.point_store import PointStore
from scanchain.registration.matcher import CheckedMatcher, create_matcher
from scanchain.runs.directory import CHECKPOINT_FILE, POINTS_FILE, RECORDING_FILE, RUN_FILE, RunDirectory
from scanchain.runs.job import Recorder
from scanchain.runs.opening import Opened
from scanchain.runs.provenance import package_version
from scanchain.runs.step_table import steps_table, write_table
from scanchain.settings import flatten
from scanchain.slam import Slam
from scanchain.steps import Steps
from scanchain.trajectory import write_tum

_REMEDY = "run without --resume"
_NEEDED = (RUN_FILE, "config.toml", CHECKPOINT_FILE, POINTS_FILE)
_KEY_BYTES = 32  # of a key, and of a signature by SHA-256


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """State of a stopped run after some scans, which took ``run_s`` seconds of work; ``folder`` is its directory.

    The first ``recorded_bytes`` of the recording contain these scans; 0 if there was no complete recording.
    ``process`` is the number, from 0, of the process that wrote it, among those that wrote to the run directory.
    """

    folder: Path
    run_s: float
    process: int
    recorded_bytes: int
    slam: Slam


class Checkpoints:
    """Writer of checkpoints, at an interval at which they take at most 5 % of the time."""

    def __init__(self, folder: Path, every_s: float, left: Checkpoint | None = None) -> None:
        """``left`` is the checkpoint to resume from, whose time of work is added to that of this process."""
        self.left = left
        self.path = folder / CHECKPOINT_FILE
        self.version = _version()
        self.process = 0 if left is None else left.process + 1
        self.every_s = every_s
        self.began_s = working_s() - (0.0 if left is None else left.run_s)
        self.next_s = perf_counter() + every_s
        self.key, self.absent = b"", ""
        try:
            self.key = _key()
        except InputError as error:
            self.absent = f"no checkpoints, so that --resume would start over: {error.text}"

    def start(self, source: Opened) -> tuple[Slam, Generator[Scan, None, None]]:
        """SLAM, new or from the checkpoint, and the scans that follow."""
        folder, left, log = self.path.parent, self.left, source.log
        scans = log.scans(source.config.preprocess)
        if left is None:
            points_file = folder / POINTS_FILE
            return Slam(source.config, log.stated_mounting, points_file, dimension=log.dimension), scans
        left.slam.points.reopen(folder / POINTS_FILE)
        scans = _after(left, scans)
        _set_aside(folder, left)
        return left.slam, scans

    def resume(self, recording: Recorder) -> str:
        """Resume the recording where the last checkpoint left it, if there is one; returns a note about it."""
        if self.left is None:
            return ""
        left, before = self.left, _recorded_by(self.left.process, self.path.parent)
        is_whole = 0 < left.recorded_bytes <= (before.stat().st_size if before.exists() else 0)
        if is_whole:
            os.truncate(before, left.recorded_bytes)
        recording.resume(
            before if is_whole else None, left.slam.steps, left.slam.closures, left.slam.back_end.graph.state()
        )
        recorded_bytes = recording.secure()
        self.write(left.slam, recorded_bytes)
        note = f"resumed after {counted(len(left.slam.steps), 'scan')}"
        if recorded_bytes and is_whole:
            before.unlink()
        elif before.exists():
            note += f"; the recording up to there is {before.name}{'' if is_whole else ', incomplete'}"
        elif recorded_bytes:
            note += "; the recording begins there"
        return note

    def are_due(self) -> bool:
        """True when it is time for the next checkpoint."""
        return bool(self.key) and perf_counter() >= self.next_s

    def write(self, slam: Slam, recorded_bytes: int = 0) -> None:
        """Write a checkpoint atomically: a line with the version, a pickle, and the signature of both.

        Raises OSError on a full disk; the last checkpoint stays. Nothing is written if there is no key.
        """
        if not self.key:
            return
        started = perf_counter()
        slam.points.flush()
        file = io.BytesIO(self.version)
        file.seek(0, os.SEEK_END)
        _Pickler(file, slam.config).dump((working_s() - self.began_s, self.process, recorded_bytes, slam))
        file.write(hmac.digest(self.key, file.getvalue(), "sha256"))
        write_whole(self.path, file.getvalue())
        now = perf_counter()
        self.next_s = now + max(self.every_s, 20.0 * (now - started))  # a checkpoint takes 5 % of the time at most


def read_checkpoint(folder: Path, config: Config) -> Checkpoint:
    """The last checkpoint of a run. Raises InputError if it is damaged, or by another user or other code.

    Nothing is unpickled before its signature is checked, as a pickle may run any code.

    config : of the resuming run; that of the checkpoint must be equal
    """
    path = folder / CHECKPOINT_FILE
    data = path.read_bytes()
    body, signature = data[:-_KEY_BYTES], data[-_KEY_BYTES:]
    if not hmac.compare_digest(hmac.digest(_key(), body, "sha256"), signature):
        raise InputError(
            f"{path}: is damaged, or of another user or machine: not signed with {_key_file()}; {_REMEDY}"
        )
    file = io.BytesIO(body)
    version = file.readline()
    if version != _version():
        made, this = (line.decode(errors="replace").rstrip() for line in (version, _version()))
        raise InputError(f"{path}: was made by {made}, this is {this}; {_REMEDY}")
    checkpoint = Checkpoint(folder, *_Unpickler(file, config).load())
    if checkpoint.slam.config != config:
        raise InputError(f"{path}: has another configuration; repeat the flags of the run, or {_REMEDY}")
    return checkpoint


@cache
def _version() -> bytes:
    """Versions and checksum of the code at start: other code may give other bits or fail to read the pickle."""
    package = Path(__file__).parents[1]
    code = b"".join(path.read_bytes() for path in sorted(package.rglob("*.py")))
    on = f"Python {platform.python_version()}, NumPy {np.__version__}"
    return f"scanchain {package_version('scanchain')} (code {zlib.crc32(code):08x}, {on})\n".encode()


def _key_file() -> Path:
    state = os.environ.get("XDG_STATE_HOME") or Path("~/.local/state").expanduser()
    return Path(state) / "scanchain" / "checkpoints.key"


def _key() -> bytes:
    """Secret key of this user with which checkpoints are signed (HMAC): random bytes, generated at first use.

    Raises InputError if there is none and none can be created, or if other users have access to it.
    """
    remedy = "set XDG_STATE_HOME to a folder of yours"
    try:
        path = _key_file()
        if not path.exists():
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            new = path.with_name(f"{path.name}.{secrets.token_hex(8)}")
            with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(secrets.token_bytes(_KEY_BYTES))
            with suppress(FileExistsError):  # another process created it first
                os.link(new, path)
            new.unlink()
        with path.open("rb") as file:
            status, key = os.fstat(file.fileno()), file.read(_KEY_BYTES + 1)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home directory
        raise InputError(f"no key to sign them with: {one_line(error)}; {remedy}") from error
    if status.st_mode & 0o077 or status.st_uid != os.geteuid() or len(key) != _KEY_BYTES:
        raise InputError(f"{path}: is not a key of this user alone ({_KEY_BYTES} bytes, mode 600); remove it")
    return key


class _Pickler(pickle.Pickler):
    """Leaves out points (in a file of their own), matchers, threads and objects of the user's own classes."""

    def __init__(self, file: BinaryIO, config: Config) -> None:
        super().__init__(file, protocol=5)
        self.own = set(flatten(config).values())  # including any MODULE:CLASS

    def persistent_id(self, value: Any) -> tuple[Any, ...] | None:
        if isinstance(value, PointStore):
            return "points", value.dimension, value.rows, value.crc
        if isinstance(value, CheckedMatcher):
            return ("matcher",)
        kind = type(value)
        if isinstance(value, Thread) or f"{kind.__module__}:{kind.__qualname__}" in self.own:
            return ("nothing",)  # None after loading; created again where needed
        return None


class _Unpickler(pickle.Unpickler):
    """Restores points and matchers that were left out, the rest as None."""

    def __init__(self, file: BinaryIO, config: Config) -> None:
        super().__init__(file)
        self.config = config
        self.left_out: dict[tuple[Any, ...], Any] = {}

    def persistent_load(self, pid: tuple[Any, ...]) -> Any:
        if pid not in self.left_out:
            what, *size = pid
            self.left_out[pid] = create_matcher(self.config.matching) if what == "matcher" else None
            if what == "points":
                self.left_out[pid] = store = PointStore(size[0])
                store.rows, store.crc = size[1:]  # of the file that it will reopen
        return self.left_out[pid]


def _after(left: Checkpoint, scans: Generator[Scan, None, None]) -> Generator[Scan, None, None]:
    """The scans after those already processed. Raises InputError if the processed ones differ from the log."""
    names = ("index", "stamp_ns", "log_time_ns", "scan_points", "dropped")
    for index, *known in zip(*(left.slam.steps.columns[name].tolist() for name in names), strict=True):
        scan = next(scans, None)
        if scan is None or [scan.stamp_ns, scan.log_time_ns, len(scan.points), scan.dropped] != known:
            raise InputError(f"{left.folder}: scan {index} of the log is not the one that was run; {_REMEDY}")
    return scans


def _set_aside(folder: Path, left: Checkpoint) -> None:
    """Remove files that will be written again, except the recording, which is renamed.

    The new name contains the number of its process, so that it remains if this process is killed before its own
    first checkpoint.
    """
    before, recording = _recorded_by(left.process, folder), folder / RECORDING_FILE
    if recording.is_file() and not before.exists():
        recording.rename(before)
    if left.recorded_bytes:  # then it includes what the previous process recorded
        _recorded_by(left.process - 1, folder).unlink(missing_ok=True)
    for path in folder.iterdir():
        if path.name not in _NEEDED and not path.match("recording.part_*.rrd") and not path.is_dir():
            path.unlink()


def _recorded_by(process: int, folder: Path) -> Path:
    return folder / f"recording.part_{process}.rrd"


def how_to_resume(command: Sequence[str]) -> str:
    """Text on how to resume the run that this command line started; without a command for scripts."""
    words = [*without_keys(command[1:]), *([] if "--resume" in command else ["--resume"])]
    again = f"scanchain {shlex.join(words)}" if len(command) > 1 else "the same with --resume"
    return f"to resume: {again}"


def rescued(error: BaseException, directory: RunDirectory, steps: Steps) -> BaseException:
    """The error to raise; the results so far are written, and the error names their directory."""
    is_bug = not isinstance(error, ScanchainError | KeyboardInterrupt | OSError)
    directory.worth_keeping()
    reason = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or type(error).__name__
    if isinstance(error, OSError):
        error.filename = error.filename or str(directory.destination)
        reason = remedy_of(error) or reason
    until = f"{counted(len(steps), 'scan')} until then"
    is_or_are = "is" if len(steps) == 1 and not is_bug else "are"
    where = f"{'traceback.txt and the ' if is_bug else ''}{until} {is_or_are} in {directory.path}"
    try:
        directory.end(stopped=reason, is_complete=False)
        _keep(error if is_bug else None, directory.path, steps)
    except OSError as failure:
        why = "" if isinstance(error, OSError) else f" ({remedy_of(failure) or failure.strerror})"
        where = f"{until} could not be written to {directory.path}{why}"
    if isinstance(error, KeyboardInterrupt | OSError) and (directory.path / CHECKPOINT_FILE).is_file():
        where += f"; {how_to_resume(directory.provenance.command)}"
    if isinstance(error, InputError):
        return InputError(f"{error.text}; {where}")
    kind = f"{type(error).__name__}: " if is_bug else ""
    return ScanchainError(f"{kind}{reason}; {where}")


def _keep(bug: BaseException | None, folder: Path, steps: Steps) -> None:
    """Write the results so far. Raises OSError on a full disk, after which nothing half-written is left."""
    odometry, table, trace = (folder / name for name in ("odometry.tum", "steps.parquet", "traceback.txt"))
    try:
        if bug is not None:
            trace.write_text("".join(traceback.format_exception(bug)), encoding="utf-8")
        if len(steps) and not (folder / "metrics.json").exists():  # else the final results are already written
            write_tum(odometry, steps.trajectory("T_odom_lidar"), force=True)
            write_table(table, steps_table(steps, steps.trajectory("T_world_lidar")))
    except OSError:
        for path in (odometry, table, trace):
            path.unlink(missing_ok=True)
        raise
