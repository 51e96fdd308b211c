"""What a run is asked to do."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from scanchain.errors import InputError
from scanchain.runs.recorder import SinkName
from scanchain.settings import Override
from scanchain.source import Source


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be run.

    Attributes
    ----------
    logs : the files of one log
    out : the run directory
    config_file : on top of the preset; overrides : on top of both
    sinks : where the recording goes
    ground_truth : a TUM or KITTI file; None where the log's own is good
    max_gap_s : between true poses to interpolate over; None for the default
    force : whether a run directory of that name is replaced
    resume : whether to go on from the last checkpoint of a run that was killed, where there is one
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

    def check_logs(self) -> None:
        """Refuse a file named twice: each of its scans would come twice. Raises InputError."""
        for source, count in Counter(source.resolve() for source in self.logs).items():
            if count > 1:
                raise InputError(f"{source}: is named {count} times; name each file of a log once")
