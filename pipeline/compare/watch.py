"""A method's process, watched: what it may take in time and memory, and how it ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

import msgspec
import numpy as np
import psutil

from pipeline.compare.memory import resident_mib
from pipeline.compare.methods import Method
from pipeline.compare.outcome import REPORT_FILE, SECONDS_FILE, EndReport, Status
from pipeline.compare.worker import METHOD_FILE

_LOOK_S = 0.02
_WORDS = 300  # of what a process said last
_KILLED = -9


@dataclass(frozen=True, slots=True)
class Limits:
    """What a run of a method may take."""

    time_s: float
    memory_mib: float


def run_watched(method: Method, scans: Path, folder: Path, limits: Limits) -> EndReport:
    """Run a method over stored scans; its own folder takes what it writes and says."""
    (folder / METHOD_FILE).write_bytes(msgspec.msgpack.encode(method))
    command = [sys.executable, "-m", "pipeline.compare.worker", str(scans), str(folder)]
    # small_gicp's threads spin by default: where somebody else has a core, they spin away the other thread's time
    environment = os.environ | {"OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}
    with (folder / "output.txt").open("wb") as output:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, env=environment
        )
        try:
            stopped = _watch(process, limits)
        finally:
            _end(process)
    if stopped is not None:
        status, reason, peak = stopped
        return EndReport(status, f"{reason} {_where(folder)}", "", 0.0, 0.0, peak)
    return _own_report(process.returncode, folder)


def _watch(process: subprocess.Popen[bytes], limits: Limits) -> tuple[Status, str, float] | None:
    """Wait for the end; why, and with which peak, where it was not waited for."""
    began, peak = monotonic(), 0.0
    while process.poll() is None:
        peak = max(peak, resident_mib(process.pid))
        if peak > limits.memory_mib:
            return (
                Status.OUT_OF_MEMORY,
                f"took more than --memory-limit ({limits.memory_mib / 1024.0:.3g} GiB)",
                peak,
            )
        if monotonic() - began > limits.time_s:
            return Status.TIMED_OUT, f"took longer than --time-limit ({limits.time_s:.3g} s)", peak
        sleep(_LOOK_S)
    return None


def _end(process: subprocess.Popen[bytes]) -> None:
    """Nothing of it stays, children included."""
    if process.poll() is None:
        family = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        for child in family:
            if child.is_running():
                child.kill()
    process.wait()


def _own_report(code: int, folder: Path) -> EndReport:
    """What the process says of itself, or what its silence means."""
    if (folder / REPORT_FILE).exists():
        report = msgspec.json.decode((folder / REPORT_FILE).read_bytes(), type=EndReport)
        if report.status.is_failure:
            return msgspec.structs.replace(report, reason=f"{report.reason} {_where(folder)}")
        return report
    if code == _KILLED:
        reason = "killed, as the system does when memory runs out,"
        return EndReport(Status.OUT_OF_MEMORY, f"{reason} {_where(folder)}", "", 0.0, 0.0, 0.0)
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    said = " ".join((folder / "output.txt").read_text(errors="replace").split())[-_WORDS:]
    reason = f"ended by {how} {_where(folder)}" + (f": {said}" if said else "")
    return EndReport(Status.CRASHED, reason, "", 0.0, 0.0, 0.0)


def _where(folder: Path) -> str:
    """How far it came."""
    if not (folder / SECONDS_FILE).exists():
        return "while starting, or on the first scans, where it gets warm"
    return f"at scan {np.isfinite(np.load(folder / SECONDS_FILE)).sum()}"
