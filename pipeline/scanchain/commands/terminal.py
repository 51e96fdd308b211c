"""A progress bar on a terminal, silence elsewhere, and Ctrl-C that ends a run in good order."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from time import monotonic
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from scanchain.data import Scan

_REDRAW_S = 0.2
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Terminal:
    """Progress of a job; a context manager.

    On the first Ctrl-C (or SIGTERM, or a closed terminal) while scans are tracked no more of them come, and the
    run finishes with what it has; at any other time, and on the second, it interrupts as usual.
    """

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self.stopped = False
        self.is_tracking = False
        self.is_shown = sys.stderr.isatty()
        self.bar = _Bar(unit) if self.is_shown else None
        self.handlers = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                self.handlers[number] = signal.signal(number, self._interrupt)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar is not None:
            self.bar.close()
        for number, handler in self.handlers.items():
            signal.signal(number, handler)

    def say(self, line: str) -> None:
        """Show a line on a terminal only."""
        if self.bar is not None:
            self.bar.say(line)

    def announce(self, line: str) -> None:
        """Show a line on a terminal or in a pipe."""
        if self.bar is None:
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()
        else:
            self.bar.say(line)

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """Pass the scans on until they end or the user stops."""
        self.is_tracking = True
        for done, scan in enumerate(scans, start=1):
            yield scan
            self.count(done, count)
            if self.stopped:
                break
        self.is_tracking = False
        if self.bar is not None:
            self.bar.close()

    def count(self, done: int, total: int) -> None:
        """Show that so many of all are done."""
        if self.bar is not None:
            self.bar.show(done, total)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if not self.is_tracking or self.stopped:
            raise KeyboardInterrupt
        self.stopped = True
        self.say("stopping: finishing with what there is; once more to quit at once")


class _Bar:
    """rich's progress bar on stderr, drawn by hand so that no thread takes time from the run."""

    def __init__(self, unit: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self.progress = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(f"{unit}  {{task.fields[rate]:.0f}} {unit}/s"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            console=Console(stderr=True),
            auto_refresh=False,
        )
        self.task = self.progress.add_task("", total=None, rate=0.0)
        self.is_open = False
        self.started_s = self.drawn_s = 0.0

    def show(self, done: int, total: int) -> None:
        """Draw, but not more often than an eye can follow."""
        now_s = monotonic()
        if not self.is_open:
            self.is_open, self.started_s = True, now_s
            self.progress.start()
        if now_s - self.drawn_s < _REDRAW_S and done < total:
            return
        self.drawn_s = now_s
        rate = done / max(now_s - self.started_s, 1e-3)
        self.progress.update(self.task, completed=done, total=max(done, total), rate=rate)
        self.progress.refresh()

    def say(self, line: str) -> None:
        """A line above the bar."""
        self.progress.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Leave the bar as it is."""
        if self.is_open:
            self.progress.refresh()
            self.progress.stop()
            self.is_open = False
