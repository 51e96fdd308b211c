"""A method in a process of its own, and how it ended."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import msgspec
import numpy as np

from pipeline.compare.methods import Method
from pipeline.compare.outcome import REPORT_FILE, SECONDS_FILE, EndReport, Status
from pipeline.compare.worker import METHOD_FILE
from pipeline.watched import Ending, KilledFor, Limits, run_within

_LOOK_S = 0.02
_WORDS = 300  # of what a process said last
_KILLED = -9


def run_watched(method: Method, scans: Path, folder: Path, limits: Limits) -> EndReport:
    """Run a method over stored scans; its own folder takes what it writes and says."""
    (folder / METHOD_FILE).write_bytes(msgspec.msgpack.encode(method))
    command = [sys.executable, "-m", "pipeline.compare.worker", str(scans), str(folder)]
    # small_gicp's threads spin by default: where somebody else has a core, they spin away the other thread's time
    environment = os.environ | {"OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}
    ending = run_within(limits, command, environment, output=folder / "output.txt", look_s=_LOOK_S)
    if ending.killed_for is KilledFor.NOTHING:
        return _own_report(ending, folder)
    status, reason = Status.TIMED_OUT, f"took longer than --time-limit ({limits.time_s:.3g} s)"
    if ending.killed_for is KilledFor.MEMORY:
        status = Status.OUT_OF_MEMORY
        reason = f"took more than --memory-limit ({limits.memory_mib / 1024.0:.3g} GiB)"
    return EndReport(status, f"{reason} {_where(folder)}", "", 0.0, 0.0, ending.peak_mib)


def _own_report(ending: Ending, folder: Path) -> EndReport:
    """What the process says of itself, or what its silence means."""
    if (folder / REPORT_FILE).exists():
        report = msgspec.json.decode((folder / REPORT_FILE).read_bytes(), type=EndReport)
        if report.status.is_failure:
            return msgspec.structs.replace(report, reason=f"{report.reason} {_where(folder)}")
        return report
    if ending.code == _KILLED:
        reason = "killed, as the system does when memory runs out,"
        return EndReport(Status.OUT_OF_MEMORY, f"{reason} {_where(folder)}", "", 0.0, 0.0, 0.0)
    said = " ".join((folder / "output.txt").read_text(errors="replace").split())[-_WORDS:]
    reason = f"ended by {ending.how} {_where(folder)}" + (f": {said}" if said else "")
    return EndReport(Status.CRASHED, reason, "", 0.0, 0.0, 0.0)


def _where(folder: Path) -> str:
    """How far it came."""
    if not (folder / SECONDS_FILE).exists():
        return "while starting, or on the first scans, where it gets warm"
    return f"at scan {np.isfinite(np.load(folder / SECONDS_FILE)).sum()}"
