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
Recorder = Any  # a Recording of scanchain_viz, which imports this package: the type cannot be imported here
OpenRecorder = Callable[..., AbstractContextManager[Recorder]]


@dataclass(frozen=True, slots=True)
class Job:
    """A log to process, with configuration and outputs.

    logs : the files of one log
    out : the run directory
    config_file : settings that override the preset; overrides : settings that override both
    sinks : where the recording goes
    ground_truth : a TUM or KITTI file; None to use the log's own, if it has one
    max_gap_s : longest gap between true poses to interpolate over; None for the default
    force : whether an existing run directory is replaced
    resume : whether to resume from the last checkpoint of a run that was killed, if there is one
    checkpoint_s : minimum seconds between two checkpoints; more where writing one takes long
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
    """Progress of a run or a batch, for scripts: shows nothing and never ends it early."""

    stopped = False  # whether the user has ended the run early

    def say(self, line: str) -> None:
        """Show a line on a terminal only."""

    def announce(self, line: str) -> None:
        """Show a line on a terminal or in a pipe."""

    def compiling(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` kernels are compiled."""

    def count(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` items are done."""

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """The same scans, ``count`` expected, until they end or the user stops the run."""
        return scans
