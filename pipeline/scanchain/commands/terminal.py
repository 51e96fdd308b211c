"""Progress bar on a terminal, no output of it elsewhere, and a graceful stop of a run by Ctrl-C."""

from __future__ import annotations

import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from time import monotonic
from types import FrameType
from typing import TYPE_CHECKING, Self

import click

from scanchain.errors import duration, folded
from scanchain.runs.job import Progress

if TYPE_CHECKING:
    from scanchain.data import Scan

_CLEAR = "\r\033[K"  # moves to the start of the line and clears it
_WIDTH = 30  # characters of a full bar
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Terminal(Progress):
    """Progress of a job; a context manager.

    The first Ctrl-C (or SIGTERM, or a closed terminal) during tracking ends the input of scans, and the run
    finishes with those so far. A second one, or one at any other time, raises KeyboardInterrupt.
    """

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self.stopped = self.is_tracking = False
        self.is_seen = sys.stderr.isatty()
        self.started_s, self.first, self.drawn_s = 0.0, 0, 0.0  # first: number done at the start
        self.bar = ""  # as last displayed
        self.handlers = {}

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
        if self.is_seen:
            click.echo(f"{_CLEAR}{folded(line)}\n{self.bar}", nl=False, err=True)

    def announce(self, line: str) -> None:
        """Show a line on a terminal or in a pipe."""
        if not self.is_seen:
            click.echo(line, err=True)
        self.say(line)

    def track(self, scans: Iterator[Scan], count: int) -> Iterator[Scan]:
        """Pass the scans on until they end or the user stops."""
        self.is_tracking = True
        for scan in scans:
            yield scan
            self.count(scan.index + 1, count)  # includes the scans before a resumed run
            if self.stopped:
                break
        self.is_tracking = False
        self._close()

    def compiling(self, done: int, total: int) -> None:
        """Show the number of compiled kernels."""
        if self.is_seen:
            text = f"compiling kernels, once after an installation: {done} of {total}"
            click.echo(f"{_CLEAR}{text}", nl=done == total, err=True)

    def count(self, done: int, total: int) -> None:
        """Show how many are done, at most every 0.2 s."""
        now_s = monotonic()
        if not self.started_s:
            self.started_s, self.first = now_s, done
        if not self.is_seen or (now_s - self.drawn_s < 0.2 and done < total):
            return
        self.drawn_s = now_s
        bar = "━" * round(_WIDTH * min(done / max(total, 1), 1.0))
        text = f"{bar:<{_WIDTH}} {done:,}/{total:,} {self.unit}"
        if done > self.first:
            rate = (done - self.first) / max(now_s - self.started_s, 1e-3)
            text += f"  {rate:{'.0f' if rate > 10.0 else '.2g'}} {self.unit}/s"
            text += f"  {duration((total - done) / rate)} left" if done < total else ""
        self.bar = text[: shutil.get_terminal_size().columns - 1]
        click.echo(_CLEAR + self.bar, nl=False, err=True)

    def _close(self) -> None:
        if self.bar:
            click.echo(err=True)
        self.bar = ""

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if not self.is_tracking or self.stopped:
            raise KeyboardInterrupt
        self.stopped = True
        self.say("stopping: finishing with what there is; once more to quit at once")
