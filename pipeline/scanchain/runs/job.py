"""A run's job: log, configuration and outputs; and its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from scanchain.data import Scan
from scanchain.files import Source
from scanchain.settings import Override

SinkName = Literal["save", "spawn", "connect", "web"]
Recorder = Any  # a Recording of scanchain_viz, which stands above runs: its type cannot be named here
OpenRecorder = Callable[..., AbstractContextManager[Recorder]]


@dataclass(frozen=True, slots=True)
class Job:
    """A log to process, with configuration and outputs.

    logs : the files of one log
    out : the run directory
    config_file : on top of the preset; overrides : on top of both
    sinks : where the recording goes
    ground_truth : a TUM or KITTI file; None where the log's own is good
    max_gap_s : between true poses to interpolate over; None for the default
    force : whether a run directory of that name is replaced
    resume : whether to resume from the last checkpoint of a run that was killed, if there is one
    checkpoint_s : seconds between two checkpoints, or more where they are large
    command : the command line, for run.json
    """

    logs: tuple[Source, ...]
    out: Path
    config_file: Path | None = None
    overrides: tuple[Override, ...] = ()
    sinks: frozenset[SinkName] = frozenset({"save"})
    ground_truth: Path | None = None
    max_gap_s: float | None = None
    force: bool = False
    resume: bool = False
    checkpoint_s: float = 10.0
    command: tuple[str, ...] = ()


class Progress:
    """Progress of a run or a batch, for scripts: nothing is shown, and nobody ends it early."""

    stopped = False  # whether the user has ended the run early

    def say(self, line: str) -> None:
        """Show a line on a terminal only."""

    def announce(self, line: str) -> None:
        """Show a line on a terminal or in a pipe."""

    def compiling(self, done: int, total: int) -> None:
        """Show that so many of all kernels are compiled."""

    def count(self, done: int, total: int) -> None:
        """Show that so many of all are done."""

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """Pass the scans on, of which there should be ``count``, until they end or the user stops."""
        return scans
