"""Processes: the memory they take, limits on it and on their time, and how they ended."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, auto
from importlib.abc import MetaPathFinder
from pathlib import Path
from threading import Event
from time import monotonic
from types import ModuleType

import psutil

_MIB = 1024.0**2


def peak_mib() -> float:
    """Peak resident memory of this process, interpreter and packages included."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would also count the parent before this program was started
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset / _MIB
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MIB  # bytes on macOS


def resident_mib(pid: int) -> float:
    """Resident memory of a process and its children; 0 once it is gone."""
    total = 0
    for each in _family(pid):
        with suppress(psutil.Error):
            total += psutil.Process(each).memory_info().rss
    return total / _MIB


def _family(pid: int) -> list[int]:
    """A process and all below it; from Linux's lists of children, as looking through every process takes long."""
    if not Path(f"/proc/self/task/{os.getpid()}/children").exists():
        with suppress(psutil.Error):
            return [pid, *(child.pid for child in psutil.Process(pid).children(recursive=True))]
        return []
    family = [pid]
    for each in family:
        with suppress(OSError):
            for thread in Path(f"/proc/{each}/task").iterdir():
                family += map(int, (thread / "children").read_text().split())
    return family


def return_freed_memory() -> None:
    """Return memory that was freed to the system; glibc retains it between what is in use."""
    with suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def available_mib() -> float:
    """Memory that the machine can give without swapping."""
    return psutil.virtual_memory().available / _MIB


def leave_pandas_out() -> None:
    """Let pyarrow do without pandas, which it would import in a quarter of a second.

    For a process of our own: pyarrow looks for pandas once, and converts nothing to it where it found none.
    """
    if "pandas" in sys.modules:
        return
    import pyarrow as pa

    sys.meta_path.insert(0, _WithoutPandas())
    pa.scalar(0)  # it looks now
    del sys.meta_path[0]


class _WithoutPandas(MetaPathFinder):
    """Finds nothing but that pandas is not installed."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError("left out", name="pandas")


def die_first() -> None:
    """Make the kernel kill this process, not its parent, when memory runs out."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a process and its children."""

    time_s: float
    memory_mib: float


class KilledFor(Enum):
    """Reason why a process was killed."""

    NOTHING = auto()
    TIME = auto()
    MEMORY = auto()
    STOP = auto()


@dataclass(frozen=True, slots=True)
class Ending:
    """End of a process.

    ``code`` is its exit code, negative for a signal; ``peak_mib`` the most that was seen of it in memory, its
    children included.
    """

    code: int
    killed_for: KilledFor
    peak_mib: float
    duration_s: float

    @property
    def how(self) -> str:
        """Signal or exit code as text, if it was not killed here."""
        return signal.Signals(-self.code).name if self.code < 0 else f"exit code {self.code}"


def run_within(
    limits: Limits,
    command: Sequence[str],
    environment: Mapping[str, str],
    *,
    output: Path,
    errors: Path | None = None,
    interval_s: float,
    is_own_session: bool = False,
    stop: Event | None = None,
) -> Ending:
    """Run a command to its end, or kill it and its children when it takes too much or ``stop`` is set.

    output, errors : files for stdout and stderr; without ``errors`` both go into one
    interval_s : seconds between two readings of its memory
    is_own_session : whether a Ctrl-C on the terminal does not reach it
    """
    with output.open("wb") as out, (errors or output).open("ab") as err:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err if errors else subprocess.STDOUT,
            env=environment,
            start_new_session=is_own_session,
        )
        try:
            return _watch(process, limits, interval_s, stop or Event())
        finally:
            _end(process)


def _watch(process: subprocess.Popen[bytes], limits: Limits, interval_s: float, stop: Event) -> Ending:
    """Wait for the end, or for the moment at which there is a reason to kill it."""
    began, peak = monotonic(), 0.0
    while process.poll() is None:
        peak = max(peak, resident_mib(process.pid))
        if peak > limits.memory_mib:
            return Ending(0, KilledFor.MEMORY, peak, monotonic() - began)
        if monotonic() - began > limits.time_s:
            return Ending(0, KilledFor.TIME, peak, monotonic() - began)
        if stop.wait(interval_s):
            return Ending(0, KilledFor.STOP, peak, monotonic() - began)
    return Ending(process.returncode, KilledFor.NOTHING, peak, monotonic() - began)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill the process and its children."""
    if process.poll() is None:
        family = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        for child in family:
            if child.is_running():
                child.kill()
    process.wait()
