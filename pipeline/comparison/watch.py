"""A method in a process of its own, and how it ended."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import msgspec
import numpy as np

from scanchain.comparison.methods import Method
from scanchain.comparison.outcome import REPORT_FILE, SECONDS_FILE, EndReport, Status
from scanchain.comparison.worker import METHOD_FILE
from scanchain.watched import Ending, KilledFor, Limits, run_within

_LOOK_S = 0.02
_WORDS = 300  # of what a process said last
_KILLED = -9


def run_watched(method: Method, scans: Path, folder: Path, limits: Limits) -> EndReport:
    """Run a method over stored scans; its own folder takes what it writes and says."""
    (folder / METHOD_FILE).write_bytes(msgspec.msgpack.encode(method))
    command = [sys.executable, "-P", "-m", "scanchain.comparison.worker", str(scans), str(folder)]
    # small_gicp's threads spin by default: where somebody else has a core, they spin away the other thread's time
    environment = os.environ | {"OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}
    ending = run_within(limits, command, environment, output=folder / "output.txt", look_s=_LOOK_S)
    if ending.killed_for is KilledFor.TIME:
        return _ended(Status.TIMED_OUT, f"took longer than --time-limit ({limits.time_s:.3g} s)", ending, folder)
    if ending.killed_for is KilledFor.MEMORY:
        limit_gib = limits.memory_mib / 1024.0
        return _ended(Status.OUT_OF_MEMORY, f"took more than --memory-limit ({limit_gib:.3g} GiB)", ending, folder)
    if (folder / REPORT_FILE).exists():
        return _own_report(folder)
    if ending.code == _KILLED:
        return _ended(Status.OUT_OF_MEMORY, "killed, as the system does when memory runs out", ending, folder)
    said = " ".join((folder / "output.txt").read_text(errors="replace").split())[-_WORDS:]
    return _ended(Status.CRASHED, f"ended by {ending.how}" + (f": {said}" if said else ""), ending, folder)


def _own_report(folder: Path) -> EndReport:
    """What the process says of itself; of a failure also how far it came."""
    report = msgspec.json.decode((folder / REPORT_FILE).read_bytes(), type=EndReport)
    if not report.status.is_failure:
        return report
    return msgspec.structs.replace(report, reason=f"{_where(folder)}: {report.reason}")


def _ended(status: Status, reason: str, ending: Ending, folder: Path) -> EndReport:
    """What is said of a process that says nothing of itself."""
    return EndReport(status, f"{_where(folder)}: {reason}", peak_mib=ending.peak_mib)


def _where(folder: Path) -> str:
    """How far it came."""
    if not (folder / SECONDS_FILE).exists():
        return "while starting or warming up"
    seconds = np.load(folder / SECONDS_FILE)
    tracked = int(np.isfinite(seconds).sum())
    return f"at scan {tracked}" if tracked < len(seconds) else "after the last scan"
