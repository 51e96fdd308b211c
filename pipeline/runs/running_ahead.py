"""Odometry in a thread of its own, a few scans ahead of loops, graph and recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from pipeline.data import Scan
from pipeline.odometry import FrontEnd, Located
from pipeline.runs.checkpoint import Checkpoints
from pipeline.slam import Slam

_AHEAD = 8  # scans


def located_ahead(slam: Slam, scans: Iterable[Scan], checkpoints: Checkpoints) -> Iterator[Located]:
    """The scans as the front end leaves them, in their order; it works on those that follow in the meantime.

    When a checkpoint is due it takes up no further scan until all that it has seen are placed, and that is written.
    Errors, also those of the log, are raised after what came before them.
    """
    running: deque[Future[Located]] = deque()
    with ThreadPoolExecutor(1, thread_name_prefix="scanchain-odometry") as pool:
        try:
            for located in _begun(slam.front_end, scans, pool):
                running.append(located)
                is_due = checkpoints.are_due()
                while len(running) > (0 if is_due else _AHEAD):
                    yield running.popleft().result()
                if is_due:
                    checkpoints.write(slam)
            while running:
                yield running.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def _begun(front_end: FrontEnd, scans: Iterable[Scan], pool: ThreadPoolExecutor) -> Iterator[Future[Located]]:
    """Each scan on its way through the front end; an error of the log is the last."""
    try:
        for scan in scans:
            yield pool.submit(front_end.locate, scan)
    except Exception as error:
        failed: Future[Located] = Future()
        failed.set_exception(error)
        yield failed
