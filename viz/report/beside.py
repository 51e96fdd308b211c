"""A process beside a run that loads what draws its report, which takes most of a second, and then draws it."""

from __future__ import annotations

import gc
import multiprocessing
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from scanchain.processes import leave_pandas_out
from scanchain.threads import threads

_OF_THE_RUN = (signal.SIGINT, signal.SIGTERM)  # which ends in good order and wants its report


class Reporter:
    """Writes the report of a run; a context, entered before there are threads.

    The process is a copy of this one, so that it need not import the same once more, and ends with this one,
    however that ends. On one core, and where processes cannot be copied, the report is drawn in this one.

    draw : adds report.html to a run directory
    beside : False to draw it in this process, where it is not our own
    """

    def __init__(self, draw: Callable[[Path], None], *, beside: bool) -> None:
        self._draw = draw
        self._is_beside = beside and sys.platform == "linux" and threads() > 1
        self._process: BaseProcess | None = None
        self._pipe: Any = None  # a Connection, by another name on Windows

    def __enter__(self) -> Self:
        if self._is_beside:
            self._pipe, theirs = multiprocessing.Pipe()
            context = multiprocessing.get_context("fork")
            self._process = context.Process(target=_serve, args=(self._draw, theirs, self._pipe), daemon=True)
            self._process.start()
            theirs.close()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None and self._pipe is not None:
            self._pipe.close()
            self._process.kill()
            self._process.join()

    def write(self, directory: Path) -> None:
        """Add report.html to a run directory. Raises what drawing it raised."""
        if self._pipe is None:
            return self._draw(directory)
        try:
            self._pipe.send(directory)
            error = self._pipe.recv()
        except (EOFError, OSError):  # the process was killed, for its memory for example
            return self._draw(directory)
        if error is not None:
            raise error


def _serve(draw: Callable[[Path], None], pipe: Connection, other_end: Connection) -> None:
    """Draw the report once its directory is known; the end of the run before that ends this, too."""
    other_end.close()
    gc.disable()  # imports make much that lasts, and this process ends soon
    leave_pandas_out()
    for number in _OF_THE_RUN:
        signal.signal(number, signal.SIG_IGN)
    with suppress(Exception):  # which drawing meets again, and raises there
        _load()
    with suppress(EOFError, OSError):
        directory = pipe.recv()
        error = None
        try:
            draw(directory)
        except Exception as raised:
            error = raised
        pipe.send(error)


def _load() -> None:
    """Import what draws a report, and load the kernels that check a trajectory."""
    import numpy as np

    from scanchain.data import Trajectory
    from scanchain.viz.pictures import figure
    from scanchain.viz.report import run  # noqa: F401

    Trajectory(np.zeros(1, np.int64), np.eye(4)[None])
    figure.load()
