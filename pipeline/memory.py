"""Memory of processes: of this one at its peak, of others now, of the machine."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

import psutil

_MIB = 1024.0**2


def peak_mib() -> float:
    """The most that this process ever had in memory, interpreter and packages included."""
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
    """What a process and its children have in memory now; 0 once it is gone."""
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


def available_mib() -> float:
    """What the machine can give without swapping."""
    return psutil.virtual_memory().available / _MIB


def die_first() -> None:
    """Where the machine runs out of memory, let the kernel end this process and not the one that watches it."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
