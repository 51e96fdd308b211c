"""What a run asks of whoever records it; the command line brings rerun in, tests may bring their own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from scanchain.config import RecordingConfig
from scanchain.data import Closure, GraphState, Matrix, Step

if TYPE_CHECKING:
    from scanchain.runs.step_table import StepRow
    from scanchain.runs.verdicts import JudgedClosure

SinkName = Literal["save", "spawn", "connect", "web"]


class Recorder(Protocol):
    """A context that takes in steps and, after the last one, results."""

    @property
    def warnings(self) -> list[str]:
        """What went wrong so far, a line each; nothing that goes wrong ends a run."""
        ...

    @property
    def web_address(self) -> str:
        """The page that shows the recording as long as it is open; empty without a web viewer."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def go_on(
        self, before: Path | None, rows: Sequence[StepRow], closures: Sequence[Closure], graph: GraphState
    ) -> None:
        """Go on after the steps of ``rows``, with all closures tried by then and the graph as it was.

        before : the recording up to there, which is copied; without one, the recording begins here
        """
        ...

    def secure(self) -> int:
        """Size of the file in bytes, once it holds all that was recorded; 0 where there is no whole one."""
        ...

    def log(self, step: Step) -> None:
        """Record one step."""
        ...

    def log_trajectory(
        self, stamps_ns: NDArray[np.int64], poses_optimized: Matrix, indices: NDArray[np.int64]
    ) -> None:
        """Record the optimized way: poses (N, d+1, d+1) of the scans ``indices``."""
        ...

    def log_closures(self, judged: Sequence[JudgedClosure], graph: GraphState) -> None:
        """Record the final graph and the final verdict on every closure."""
        ...

    def log_ground_truth(self, poses: Matrix) -> None:
        """Record true poses (N, 4, 4), moved onto the optimized way."""
        ...

    def log_map(self, points: NDArray[np.floating]) -> None:
        """Record the finished map (N, d)."""
        ...

    def log_grid(self, cells: NDArray[np.int8], *, resolution_m: float, origin_m: tuple[float, float]) -> None:
        """Record the finished occupancy grid: 0 free to 100 occupied, −1 unknown, row 0 at the lowest y."""
        ...

    def hold(self) -> None:
        """Stay until the user is done looking, where the viewer lives in this process."""
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
