"""Optimization of a large pose graph beside the scans that go on growing it."""

from __future__ import annotations

from threading import Thread

from scanchain.config import GraphConfig
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.robust.graduation import OutlierRejection
from scanchain.processes import return_freed_memory


class BackgroundOptimization:
    """An optimization in a thread of the graph as it was when it began.

    ``due`` is the number of poses at which it is to be taken over, so that the result does not depend on how fast
    the thread is.
    """

    def __init__(self, graph: PoseGraph, config: GraphConfig, rejection: OutlierRejection, due: int) -> None:
        """Begin; a copy of the graph is optimized, from the poses at hand."""
        self.due = due
        self.config = config
        self.rejection: OutlierRejection = rejection
        self.before = graph.copy()
        self._thread: Thread | None = Thread(target=self._optimize, daemon=True)
        self._optimized: PoseGraph | None = None
        self._error: BaseException | None = None
        self._thread.start()

    def result(self) -> PoseGraph:
        """The optimized graph, once it is done. Raises what ``PoseGraph.optimize`` does."""
        if self._thread is not None:
            self._thread.join()
        elif self._optimized is None:  # from a checkpoint, which does not hold the thread
            self._optimize()
        if self._error is not None:
            raise self._error
        assert self._optimized is not None
        return self._optimized

    def _optimize(self) -> None:
        try:
            graph = self.before.copy()
            return_freed_memory()
            graph.optimize(self.config, initialize="given", rejection=self.rejection)
            self._optimized = graph
        except Exception as error:  # raised where the result is asked for
            self._error = error
