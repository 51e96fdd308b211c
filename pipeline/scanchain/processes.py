"""Processes: the memory they take, limits on it and on their time, and how they ended."""

from __future__ import annotations

import ctypes
import os
import runpy
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from threading import Event
from time import monotonic

import psutil

MIB = 1 << 20  # bytes
MIB_PER_GIB = 1024.0  # as options and messages give memory in GiB
MOST_CHARACTERS = 300  # largest length of a message of other code, or of the output of a crash, in a report
MEMORY_SHARE = 0.75  # share of the free memory that processes take by default: the rest is for the system
LOOK_S = 0.05  # time between two looks at a process, for its memory, or a thread that is waited for
_READ_S, _READ_S_PER_MIB = 60.0, 1.0  # longest time to read a file of other software; a MiB takes about 0.05 s
_READ_MIB, _READ_TIMES = 1024.0, 100.0  # largest memory to read it, and times its size


def peak_mib() -> float:
    """Peak resident memory of this process, interpreter and packages included."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would also count the parent before this program was started
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    import resource  # of POSIX only

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MIB  # bytes on macOS


def resident_mib(pid: int, seen: dict[int, psutil.Process] | None = None) -> float:
    """Resident memory of a process and its children, which are added to ``seen``; 0 once it has ended."""
    total, seen = 0, {} if seen is None else seen
    for each in _family(pid):
        with suppress(psutil.Error):
            seen[each] = seen.get(each) or psutil.Process(each)
            total += seen[each].memory_info().rss
    return total / MIB


def _family(pid: int) -> list[int]:
    """A process and its descendants; by Linux's lists of children, as a search of all processes is slow."""
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
    """Return freed memory to the system; glibc keeps free blocks that lie between used ones."""
    with suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def available_mib() -> float:
    """Memory that is available without swapping."""
    return psutil.virtual_memory().available / MIB


def die_first() -> None:
    """Make the kernel kill this process, not its parent, when memory runs out."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a process and its children."""

    time_s: float
    memory_mib: float


def reading_limits(file: Path) -> Limits:
    """Limits of a process that reads a file of other software, which may be damaged."""
    size_mib = file.stat().st_size / MIB
    memory_mib = min(_READ_MIB + _READ_TIMES * size_mib, available_mib())
    return Limits(_READ_S + _READ_S_PER_MIB * size_mib, memory_mib)


class KilledFor(Enum):
    """Reason why a process was killed; the value is the resulting status."""

    NOTHING = "crashed"
    TIME = "timed out"
    MEMORY = "out of memory"
    STOP = "not run"


@dataclass(frozen=True, slots=True)
class Ending:
    """End of a process.

    ``code`` is its exit code, negative for a signal; ``peak_mib`` its largest observed memory, children
    included.
    """

    code: int
    killed_for: KilledFor
    peak_mib: float
    duration_s: float

    @property
    def how(self) -> str:
        """End state of a process that did not end by itself: out of memory, timed out, not run or crashed."""
        is_killed = self.killed_for is KilledFor.NOTHING and self.code == -signal.SIGKILL  # for want of memory
        return KilledFor.MEMORY.value if is_killed else self.killed_for.value

    def reason(self, limits: Limits, output: str) -> str:
        """The limit that it was killed for, else signal or exit code with the last of its output."""
        if self.killed_for is KilledFor.TIME:
            return f"took longer than --time-limit ({limits.time_s:.3g} s)"
        if self.killed_for is KilledFor.MEMORY:
            return f"took more than --memory-limit ({limits.memory_mib / MIB_PER_GIB:.3g} GiB)"
        if self.how == KilledFor.MEMORY.value:
            return "killed, as the system does when memory runs out"
        how = f"exit code {self.code}"
        if self.code < 0:  # most real-time signals have no name
            how = next((each.name for each in signal.Signals if each == -self.code), f"signal {-self.code}")
        last = " ".join(output.split())[-MOST_CHARACTERS:]
        return f"ended by {how}" + (f": {last}" if last else "")


def die_with_parent(leftover: Path | None = None) -> None:
    """Kill this process and its group once its parent, which called ``run_within``, has ended for any reason.

    leftover : folder to remove first
    """
    watched = os.dup(sys.stdin.fileno())  # a pipe that nobody writes to; the other end closes with the parent
    os.dup2(os.open(os.devnull, os.O_RDONLY), sys.stdin.fileno())

    def wait() -> None:
        os.read(watched, 1)
        if leftover is not None:
            shutil.rmtree(leftover, ignore_errors=True)
        _kill(os.getpid(), with_group=os.getpgrp() == os.getpid())

    threading.Thread(target=wait, name="parent", daemon=True).start()


def run_within(
    limits: Limits,
    module: str,
    arguments: Sequence[str],
    environment: Mapping[str, str],
    *,
    output: Path,
    stop: Event | None = None,
) -> Ending:
    """Run a module of Python to its end, or kill it when it exceeds a limit or ``stop`` is set.

    It has a process group of its own, which ends with it: a Ctrl-C on the terminal does not reach it. The module
    calls ``die_with_parent``, or is run by this one, ``python -m scanchain.processes MODULE``, which does.
    """
    with output.open("wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        seen: dict[int, psutil.Process] = {}  # all descendants
        began, peak, reason, stop = monotonic(), 0.0, KilledFor.NOTHING, stop or Event()
        try:
            while reason is KilledFor.NOTHING and process.poll() is None:
                peak = max(peak, resident_mib(process.pid, seen))
                if peak > limits.memory_mib:
                    reason = KilledFor.MEMORY
                elif monotonic() - began > limits.time_s:
                    reason = KilledFor.TIME
                elif stop.wait(LOOK_S):
                    reason = KilledFor.STOP
            return Ending(process.returncode or 0, reason, peak, monotonic() - began)
        finally:
            _kill(process.pid, with_group=True)
            for each in seen.values():  # including orphans in groups of their own
                with suppress(psutil.Error):
                    each.kill()
            process.communicate()


def _kill(pid: int, *, with_group: bool) -> None:
    """Kill a process, its descendants, and the group that it leads, which may contain orphans."""
    for each in reversed(_family(pid)[1:]):
        with suppress(OSError):
            os.kill(each, signal.SIGKILL)
    with suppress(OSError):
        (os.killpg if with_group else os.kill)(pid, signal.SIGKILL)


if __name__ == "__main__":
    die_with_parent()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
