"""Every method over the stored scans, run by run, in turn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scanchain.comparison.methods import Method
from scanchain.comparison.outcome import Outcome, Status, read_outcome
from scanchain.comparison.scan_store import StoredScans
from scanchain.comparison.watch import run_watched
from scanchain.memory import available_mib
from scanchain.runs.progress import Progress
from scanchain.watched import Limits

_LEAST_S, _SCAN_S = 300.0, 1.0  # of the time limit
_SHARE = 0.75  # of the memory that is free


def limits_for(scans: int, time_s: float | None, memory_mib: float | None) -> Limits:
    """The limits asked for, else 300 s and one more a scan, and three quarters of the memory that is free."""
    return Limits(
        _LEAST_S + _SCAN_S * scans if time_s is None else time_s,
        _SHARE * available_mib() if memory_mib is None else memory_mib,
    )


def race(
    methods: Sequence[Method],
    scans: StoredScans,
    folder: Path,
    *,
    repeat: int,
    limits: Limits,
    progress: Progress,
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
                progress.say(f"{method.name}: compiled its kernels, once after the installation; run anew")
                outcome = _run(method, scans, folder / f"run_{turn}_{place}_compiled", limits)
            outcomes[method.name].append(outcome)
            progress.say(_said(method.name, turn, repeat, outcome))
    return outcomes


def _run(method: Method, scans: StoredScans, folder: Path, limits: Limits) -> Outcome:
    folder.mkdir()
    report = run_watched(method, scans.folder, folder, limits)
    return read_outcome(folder, report, scans.stamps_ns, scans.dimension)


def _said(name: str, turn: int, repeat: int, outcome: Outcome) -> str:
    which = f" {turn + 1}/{repeat}" if repeat > 1 else ""
    if outcome.report.status is Status.OK:
        return f"{name}{which}: {outcome.seconds.sum():.1f} s"
    return f"{name}{which}: {outcome.report.status}: {outcome.report.reason}"
