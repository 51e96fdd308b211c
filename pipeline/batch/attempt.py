"""One log in a process of its own, ``scanchain run``: whatever it does to that process ends up in a row."""

from __future__ import annotations

import os
import sys
from threading import Event

import msgspec

from scanchain.batch.task import Row, State, Task
from scanchain.runs.metrics import Metrics
from scanchain.watched import Ending, KilledFor, Limits, run_within

_LOOK_S = 0.1
_SYSTEM_KILL = -9
_WORDS = 300  # of what a process said last
_THREADS = tuple(f"{name}_NUM_THREADS" for name in ("NUMBA", "OMP", "OPENBLAS", "MKL", "RAYON"))


def attempt(task: Task, stop: Event | None = None) -> Row:
    """Run a log, again where it crashed and has tries left; nothing it does is raised."""
    row = _tried(task, stop)
    while row.state is State.CRASHED and row.tries <= task.retries:
        row = msgspec.structs.replace(_tried(task, stop), tries=row.tries + 1)
    return row


def _tried(task: Task, stop: Event | None) -> Row:
    command = [sys.executable, "-P", "-m", "scanchain", "run", "--out", str(task.run), "--force", *task.arguments]
    task.said_file.parent.mkdir(parents=True, exist_ok=True)
    ending = run_within(
        Limits(task.time_s, task.memory_mib),
        [*command, "--", task.log],
        os.environ | dict.fromkeys(_THREADS, "1"),  # a process a core: threads would only get in each other's way
        output=task.said_file,
        look_s=_LOOK_S,
        is_own_session=True,
        stop=stop,
    )
    state, reason = _verdict(task, ending)
    metrics = _metrics(task) if state.has_result else None
    run = task.run.name if metrics is not None else ""
    return Row(
        task.name, task.sha256, task.key, run, state, reason, 1, ending.duration_s, ending.peak_mib, metrics
    )


def _metrics(task: Task) -> Metrics:
    return msgspec.json.decode((task.run / "metrics.json").read_bytes(), type=Metrics)


def _verdict(task: Task, ending: Ending) -> tuple[State, str]:
    """How it ended, and why in words where it did not end well."""
    match ending.killed_for:
        case KilledFor.MEMORY:
            gib = task.memory_mib / 1024.0
            return State.OUT_OF_MEMORY, f"took more than --memory-limit ({gib:.3g} GiB)"
        case KilledFor.TIME:
            return State.TIMED_OUT, f"took longer than --time-limit ({task.time_s:.3g} s)"
        case KilledFor.STOP:
            return State.NOT_RUN, "stopped by the user"
        case KilledFor.NOTHING:
            return _own_ending(ending, task)


def _own_ending(ending: Ending, task: Task) -> tuple[State, str]:
    """What the exit code and what it said mean."""
    if ending.code == 0:
        return State.DONE, ""
    said = task.said_file.read_text(encoding="utf-8", errors="replace").splitlines()
    error = next((line for line in reversed(said) if line.startswith("error: ")), "")
    if ending.code == 1 and (task.run / "metrics.json").is_file():
        unreliable = _metrics(task).unreliable
        if unreliable and error.endswith(unreliable):
            return State.UNRELIABLE, unreliable
    if ending.code in (1, 2) and error:
        return State.FAILED, error.removeprefix("error: ")
    if ending.code == _SYSTEM_KILL:
        return State.OUT_OF_MEMORY, "killed, as the system does when memory runs out"
    last = " ".join(" ".join(said).split())[-_WORDS:]
    return State.CRASHED, f"ended by {ending.how}" + (f": {last}" if last else "")
