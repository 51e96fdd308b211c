"""A run's job: log, configuration, and the protocols of its progress and its recorder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from scanchain.config import RecordingConfig
from scanchain.data import Closure, GraphState, Matrix, Scan, Step, Trajectory
from scanchain.errors import InputError
from scanchain.files import Source
from scanchain.settings import Override
from scanchain.verdict import Judged

if TYPE_CHECKING:
    from scanchain.runs.closures import FinalClosure
    from scanchain.runs.step_table import StepRow


@dataclass(frozen=True, slots=True)
class Job:
    """A log to process, with configuration and outputs.

    Attributes
    ----------
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

    def check_logs(self) -> None:
        """Refuse a file named twice: each of its scans would come twice. Raises InputError."""
        for source, count in Counter(source.resolve() for source in self.logs).items():
            if count > 1:
                raise InputError(f"{source}: is named {count} times; name each file of a log once")


class Progress(Protocol):
    """Progress of a run, shown to a user who may end it early."""

    @property
    def stopped(self) -> bool:
        """True once the user has ended the run early."""
        ...

    def say(self, line: str) -> None:
        """Show a line on a terminal only."""
        ...

    def announce(self, line: str) -> None:
        """Show a line on a terminal or in a pipe."""
        ...

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """Pass the scans on, of which there should be ``count``, until they end or the user stops."""
        ...


class Unwatched:
    """Progress that shows nothing, for scripts."""

    stopped = False

    def say(self, line: str) -> None:
        """Show nothing."""

    def announce(self, line: str) -> None:
        """Show nothing."""

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """The scans as they come."""
        return scans


SinkName = Literal["save", "spawn", "connect", "web"]


class Recorder(Protocol):
    """A context that takes in steps and, after the last one, results."""

    @property
    def warnings(self) -> list[str]:
        """Problems so far, a line each; none of them ends a run."""
        ...

    @property
    def web_address(self) -> str:
        """The page that shows the recording as long as it is open; empty without a web viewer."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def resume(
        self, before: Path | None, rows: Sequence[StepRow], closures: Sequence[Closure], graph: GraphState
    ) -> None:
        """Resume after the steps of ``rows``, with all closures tried by then and the graph as it was.

        before : the recording up to there, which is copied; without one, the recording begins here
        """
        ...

    def secure(self) -> int:
        """Size of the file in bytes, once it holds all that was recorded; 0 where there is no whole one."""
        ...

    def preview(self, scan: Scan) -> None:
        """Show a viewer, but no file, the first scan as measured until its step is recorded."""
        ...

    def log(self, step: Step) -> None:
        """Record one step."""
        ...

    def log_trajectory(
        self, stamps_ns: NDArray[np.int64], poses_optimized: Matrix, indices: NDArray[np.int64]
    ) -> None:
        """Record the optimized trajectory: poses (N, d+1, d+1) of the scans ``indices``."""
        ...

    def log_closures(self, closures: Sequence[FinalClosure], graph: GraphState) -> None:
        """Record the closures graph and the closures verdict on every closure."""
        ...

    def log_verdict(self, judged: Judged, trajectory: Trajectory) -> None:
        """Record the verdict, and its stretches on the optimized trajectory."""
        ...

    def log_ground_truth(self, poses: Matrix) -> None:
        """Record true poses (N, 4, 4), aligned to the optimized trajectory."""
        ...

    def log_map(self, points: NDArray[np.floating]) -> None:
        """Record the finished map (N, d)."""
        ...

    def log_grid(self, cells: NDArray[np.int8], *, resolution_m: float, origin_m: tuple[float, float]) -> None:
        """Record the finished occupancy grid: 0 free to 100 occupied, −1 unknown, row 0 at the lowest y."""
        ...

    def hold(self) -> None:
        """Keep the viewer served where it lives in this process, until the user closes it."""
        ...


class OpenRecorder(Protocol):
    """Makes a recorder; ``path`` is used by the sink "save" alone."""

    def __call__(
        self,
        path: Path | None,
        *,
        dimension: int,
        name: str,
        sinks: frozenset[SinkName],
        config: RecordingConfig,
    ) -> Recorder:
        """Make the recorder; it is entered before the first step."""
        ...
