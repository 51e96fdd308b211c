"""Every method over the stored scans, run by run, each in a process of its own with limits on time and memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from scanchain.comparison.methods import Method
from scanchain.comparison.outcome import REPORT_FILE, SECONDS_FILE, EndReport, Outcome, Status, read_outcome
from scanchain.comparison.scan_store import StoredScans
from scanchain.comparison.worker import METHOD_FILE
from scanchain.errors import counted
from scanchain.processes import Ending, KilledFor, Limits, available_mib, run_within
from scanchain.runs.job import Progress

_LEAST_S, _SCAN_S = 300.0, 1.0  # default time limit, seconds: at least, and for each scan
_SHARE = 0.75  # share of the free memory that is the default limit


def limits_for(scans: int, time_s: float | None, memory_mib: float | None) -> Limits:
    """The requested limits, else 300 s and one more a scan, and three quarters of the memory that is free."""
    return Limits(
        _LEAST_S + _SCAN_S * scans if time_s is None else time_s,
        _SHARE * available_mib() if memory_mib is None else memory_mib,
    )


def run_all(
    methods: Sequence[Method], scans: StoredScans, folder: Path, *, repeat: int, limits: Limits, progress: Progress
) -> dict[str, list[Outcome]]:
    """``repeat`` runs of every method, each round starting with another one; one not installed is tried once."""
    outcomes: dict[str, list[Outcome]] = {method.name: [] for method in methods}
    for turn in range(repeat):
        for place in range(len(methods)):
            method = methods[(place + turn) % len(methods)]
            if any(outcome.report.status is Status.MISSING for outcome in outcomes[method.name]):
                continue
            outcome = _run(method, scans, folder / f"run_{turn}_{place}", limits)
            if outcome.is_whole and outcome.report.has_compiled:
                progress.announce(f"{method.name}: compiled its kernels, once after the installation; run again")
                outcome = _run(method, scans, folder / f"run_{turn}_{place}_compiled", limits)
            outcomes[method.name].append(outcome)
            progress.announce(_progress_line(method.name, turn, repeat, outcome))
    return outcomes


def _run(method: Method, scans: StoredScans, folder: Path, limits: Limits) -> Outcome:
    folder.mkdir()
    report = run_watched(method, scans.folder, folder, limits)
    return read_outcome(folder, report, scans.stamps_ns, scans.dimension)


def _progress_line(name: str, turn: int, repeat: int, outcome: Outcome) -> str:
    which = f" {turn + 1}/{repeat}" if repeat > 1 else ""
    if outcome.report.status is Status.OK:
        return f"{name}{which}: {counted(len(outcome.seconds), 'scan')} in {outcome.seconds.sum():.1f} s"
    return f"{name}{which}: {outcome.report.status}: {outcome.report.reason}"


_INTERVAL_S = 0.02
_LAST_CHARACTERS = 300  # last characters of the output of a process that crashed, which are reported
_KILLED = -9


def run_watched(method: Method, scans: Path, folder: Path, limits: Limits) -> EndReport:
    """Run a method over stored scans; its own folder takes what it writes and prints."""
    (folder / METHOD_FILE).write_bytes(msgspec.msgpack.encode(method))
    # small_gicp's threads spin by default: where somebody else has a core, they spin away the other thread's time
    environment = os.environ | {"OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "PASSIVE")}
    ending = run_within(
        limits,
        "scanchain.comparison.worker",
        [str(scans), str(folder)],
        environment,
        output=folder / "output.txt",
        interval_s=_INTERVAL_S,
    )
    if ending.killed_for is KilledFor.TIME:
        return _ended(Status.TIMED_OUT, f"took longer than --time-limit ({limits.time_s:.3g} s)", ending, folder)
    if ending.killed_for is KilledFor.MEMORY:
        limit_gib = limits.memory_mib / 1024.0
        return _ended(Status.OUT_OF_MEMORY, f"took more than --memory-limit ({limit_gib:.3g} GiB)", ending, folder)
    if (folder / REPORT_FILE).exists():
        return _own_report(folder)
    if ending.code == _KILLED:
        return _ended(Status.OUT_OF_MEMORY, "killed, as the system does when memory runs out", ending, folder)
    output = " ".join((folder / "output.txt").read_text(errors="replace").split())[-_LAST_CHARACTERS:]
    return _ended(Status.CRASHED, f"ended by {ending.how}" + (f": {output}" if output else ""), ending, folder)


def _own_report(folder: Path) -> EndReport:
    """Report of the process itself, with the scan at which it failed."""
    report = msgspec.json.decode((folder / REPORT_FILE).read_bytes(), type=EndReport)
    if not report.status.is_failure:
        return report
    return msgspec.structs.replace(report, reason=f"{_where(folder)}: {report.reason}")


def _ended(status: Status, reason: str, ending: Ending, folder: Path) -> EndReport:
    """Report of a process that left none."""
    return EndReport(status, f"{_where(folder)}: {reason}", peak_mib=ending.peak_mib)


def _where(folder: Path) -> str:
    """Stage at which it ended."""
    if not (folder / SECONDS_FILE).exists():
        return "while starting or warming up"
    seconds = np.load(folder / SECONDS_FILE)
    tracked = int(np.isfinite(seconds).sum())
    return f"at scan {tracked}" if tracked < len(seconds) else "after the last scan"
