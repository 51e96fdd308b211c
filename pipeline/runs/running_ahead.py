"""Odometry ahead of loops, graph and recording: by one scan, or by some in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from queue import SimpleQueue
from threading import Semaphore, Thread
from types import TracebackType
from typing import Self

from pipeline.data import Scan
from pipeline.odometry import FrontEnd, Located

_AHEAD = 32  # scans at most that are located and not yet placed


class InTurn:
    """Locates a scan whenever one is asked for, those before it being placed."""

    def __init__(self, front_end: FrontEnd, scans: Iterable[Scan]) -> None:
        self.front_end = front_end
        self.scans = scans
        self.is_due: Callable[[], bool] = lambda: False
        self.act: Callable[[], None] = lambda: None

    def at_rest(self, act: Callable[[], None], *, when: Callable[[], bool]) -> None:
        """Have something done, when it is due, while all that was located is placed."""
        self.act, self.is_due = act, when

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def __iter__(self) -> Iterator[Located]:
        for scan in self.scans:
            yield self.front_end.locate(scan)
            if self.is_due():
                self.act()


class RunningAhead(InTurn):
    """Locates scans in a thread of its own, which starts at once; a context that is left when they are placed.

    It pays where kernels, which do without Python's lock, take most of the time: in 3D. Errors, also those of the
    log, are raised after what came before them.
    """

    def __init__(self, front_end: FrontEnd, scans: Iterable[Scan]) -> None:
        super().__init__(front_end, scans)
        self.located: SimpleQueue[Located | BaseException | None] = SimpleQueue()
        self.room = Semaphore(_AHEAD)
        self.is_left = False
        self.thread = Thread(target=self._work, name="scanchain-odometry", daemon=True)

    def __enter__(self) -> Self:
        self.thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.is_left = True
        self.room.release(_AHEAD)
        self.thread.join()

    def __iter__(self) -> Iterator[Located]:
        while (item := self.located.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
            self.room.release()  # whoever asks for the next is done with this one

    def _work(self) -> None:
        try:
            for scan in self.scans:
                self.room.acquire()
                if self.is_left:
                    return
                self.located.put(self.front_end.locate(scan))
                if self.is_due():
                    self._rest()
            self.located.put(None)
        except BaseException as error:  # whatever it is, it is for who waits for the next scan
            self.located.put(error)

    def _rest(self) -> None:
        for _ in range(_AHEAD):
            self.room.acquire()
        if not self.is_left:
            self.act()
        self.room.release(_AHEAD)
