"""Odometry in a thread of its own, some scans ahead of loops, graph and recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from queue import SimpleQueue
from threading import Semaphore, Thread
from types import TracebackType
from typing import Self

from pipeline.data import Scan
from pipeline.odometry import Located
from pipeline.runs.checkpoint import Checkpoints
from pipeline.slam import Slam

_AHEAD = 32  # scans at most that are located and not yet placed


class RunningAhead:
    """Gives out scans as the front end leaves them, in their order; a context that is left when they are placed.

    The thread starts at once. When a checkpoint is due it waits until all that it located is placed, and writes
    it. Errors, also those of the log, are raised after what came before them.
    """

    def __init__(self, slam: Slam, scans: Iterable[Scan], checkpoints: Checkpoints) -> None:
        self.slam = slam
        self.scans = scans
        self.checkpoints = checkpoints
        self.located: SimpleQueue[Located | Exception | None] = SimpleQueue()
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
            if isinstance(item, Exception):
                raise item
            yield item
            self.room.release()  # whoever asks for the next is done with this one

    def _work(self) -> None:
        try:
            for scan in self.scans:
                self.room.acquire()
                if self.is_left:
                    return
                self.located.put(self.slam.front_end.locate(scan))
                if self.checkpoints.are_due():
                    self._put_down()
            self.located.put(None)
        except Exception as error:
            self.located.put(error)

    def _put_down(self) -> None:
        """Write a checkpoint once there is nothing ahead."""
        for _ in range(_AHEAD):
            self.room.acquire()
        if not self.is_left:
            self.checkpoints.write(self.slam)
        self.room.release(_AHEAD)
