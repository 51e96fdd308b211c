"""A process that is watched: what it may take in time and memory, and how it ended."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path
from threading import Event
from time import monotonic

import psutil

from scanchain.memory import resident_mib


@dataclass(frozen=True, slots=True)
class Limits:
    """What a process and its children may take."""

    time_s: float
    memory_mib: float


class KilledFor(Enum):
    """Why a process did not come to its own end."""

    NOTHING = auto()
    TIME = auto()
    MEMORY = auto()
    STOP = auto()


@dataclass(frozen=True, slots=True)
class Ending:
    """How a process ended.

    ``code`` is its exit code, negative for a signal; ``peak_mib`` the most that was seen of it in memory, its
    children included.
    """

    code: int
    killed_for: KilledFor
    peak_mib: float
    duration_s: float

    @property
    def how(self) -> str:
        """In words, for one that ended by itself."""
        return signal.Signals(-self.code).name if self.code < 0 else f"exit code {self.code}"


def run_within(
    limits: Limits,
    command: Sequence[str],
    environment: Mapping[str, str],
    *,
    output: Path,
    errors: Path | None = None,
    look_s: float,
    is_own_session: bool = False,
    stop: Event | None = None,
) -> Ending:
    """Run a command to its end, or kill it and its children when it takes too much or ``stop`` is set.

    output, errors : files for what it says; without ``errors`` both go into one
    look_s : seconds between two looks at its memory
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
            return _watch(process, limits, look_s, stop or Event())
        finally:
            _end(process)


def _watch(process: subprocess.Popen[bytes], limits: Limits, look_s: float, stop: Event) -> Ending:
    """Wait for the end, or for the moment at which there is a reason to kill it."""
    began, peak = monotonic(), 0.0
    while process.poll() is None:
        peak = max(peak, resident_mib(process.pid))
        if peak > limits.memory_mib:
            return Ending(0, KilledFor.MEMORY, peak, monotonic() - began)
        if monotonic() - began > limits.time_s:
            return Ending(0, KilledFor.TIME, peak, monotonic() - began)
        if stop.wait(look_s):
            return Ending(0, KilledFor.STOP, peak, monotonic() - began)
    return Ending(process.returncode, KilledFor.NOTHING, peak, monotonic() - began)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Nothing of it stays, children included."""
    if process.poll() is None:
        family = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        for child in family:
            if child.is_running():
                child.kill()
    process.wait()
