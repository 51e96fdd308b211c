"""A progress bar on a terminal, silence elsewhere, and Ctrl-C that ends a run in good order."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from time import monotonic
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

import click

from scanchain.runs.job import Progress

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

    from scanchain.data import Scan

_REDRAW_S = 0.2
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Terminal(Progress):
    """Progress of a job; a context manager.

    On the first Ctrl-C (or SIGTERM, or a closed terminal) while scans are tracked no more of them come, and the
    run finishes with what it has; at any other time, and on the second, it interrupts as usual.
    """

    def __init__(self, unit: str) -> None:
        self.stopped = self.is_tracking = False
        self.started_s = self.drawn_s = 0.0
        self.handlers = {}
        self.bar = _bar(unit) if sys.stderr.isatty() else None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                self.handlers[number] = signal.signal(number, self._interrupt)
        return self

    def __exit__(self, *raised: object) -> None:
        self._close()
        for number, handler in self.handlers.items():
            signal.signal(number, handler)

    def say(self, line: str) -> None:
        """Show a line on a terminal only, above the bar."""
        if self.bar is not None:
            self.bar.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def announce(self, line: str) -> None:
        """Show a line on a terminal or in a pipe."""
        if self.bar is None:
            click.echo(line, err=True)
        self.say(line)

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """Pass the scans on until they end or the user stops."""
        self.is_tracking = True
        for done, scan in enumerate(scans, start=1):
            yield scan
            self.count(done, count)
            if self.stopped:
                break
        self.is_tracking = False
        self._close()

    def count(self, done: int, total: int) -> None:
        """Draw how many are done, but not more often than an eye can follow."""
        if self.bar is None:
            return
        now_s = monotonic()
        if not self.bar.live.is_started:
            self.started_s = now_s
            self.bar.start()
        if now_s - self.drawn_s < _REDRAW_S and done < total:
            return
        self.drawn_s = now_s
        rate = done / max(now_s - self.started_s, 1e-3)
        self.bar.update(self.bar.task_ids[0], completed=done, total=max(done, total), rate=rate)
        self.bar.refresh()

    def _close(self) -> None:
        """Leave the bar as it is."""
        if self.bar is not None and self.bar.live.is_started:
            self.bar.refresh()
            self.bar.stop()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if not self.is_tracking or self.stopped:
            raise KeyboardInterrupt
        self.stopped = True
        self.say("stopping: finishing with what there is; once more to quit at once")


def _bar(unit: str) -> Bar:
    """Progress bar of rich on stderr, drawn by hand so that no thread takes time from the run."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns: list[Any] = [
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{unit}  {{task.fields[rate]:.0f}} {unit}/s"),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
    ]
    bar = Bar(*columns, console=Console(stderr=True), auto_refresh=False)
    bar.add_task("", total=None, rate=0.0)
    return bar
