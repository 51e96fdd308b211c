"""Schedule of the optimizations of a pose graph that grows: when, of which poses, and with which verdicts."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Thread
from typing import Literal

from scanchain.config import GraphConfig
from scanchain.data import GraphState
from scanchain.graph.losses import rejection_limit
from scanchain.graph.pose_graph import PoseGraph
from scanchain.processes import return_freed_memory

_LEAST = 10  # number of keyframes between two optimizations
_GROWTH = 0.05  # share of the poses, in keyframes until they are judged again, or where no closure moves the map
LAG = 200  # number of the last poses that are updated where all are too much work
_LARGE = 2000  # number of poses that are judged together at most; from which on work is done beside a live log
_WORK_PER_KEYFRAME = 1e6  # multiplications to update all poses, at most, for each keyframe since
_CONTRADICTING = 10.0  # times the χ² limit of a loop edge, from which on a closure contradicts the graph
_TAKEN_AFTER = {"update": 0.005, "judge": 0.1}  # share of the poses moved, in keyframes until that is taken over


@dataclass(frozen=True, slots=True)
class Plan:
    """An optimization: of the poses from one on, and whether verdicts are kept or all judged anew."""

    first: int
    rejection: Literal["update", "judge"]

    def carry_out(self, graph: PoseGraph, config: GraphConfig) -> None:
        """Optimize the graph from the poses at hand."""
        if self.first:
            graph.optimize_end(config, self.first, self.rejection)
        else:
            graph.optimize(config, initialize="given", rejection=self.rejection)


class BackgroundOptimization:
    """An optimization in a thread of the graph as it was when it began.

    ``due`` is the number of poses at which it is to be taken over, so that the result does not depend on how fast
    the thread is.
    """

    def __init__(self, graph: PoseGraph, config: GraphConfig, plan: Plan, due: int) -> None:
        """Begin; a copy of the graph is optimized, from the poses at hand."""
        self.due, self.config, self.plan = due, config, plan
        self.before = graph.copy()
        self._thread: Thread | None = Thread(target=self._optimize, daemon=True)
        self._outcome: PoseGraph | Exception | None = None
        self._thread.start()

    def result(self) -> PoseGraph:
        """The optimized graph, once it is done. Raises what ``PoseGraph.optimize`` does."""
        if self._thread is not None:
            self._thread.join()
        elif self._outcome is None:  # from a checkpoint, which does not hold the thread
            self._optimize()
        if isinstance(self._outcome, Exception):
            raise self._outcome
        assert self._outcome is not None
        return self._outcome

    def _optimize(self) -> None:
        try:
            graph = self.before.copy()
            return_freed_memory()
            self.plan.carry_out(graph, self.config)
            self._outcome = graph
        except Exception as error:  # raised where the result is asked for
            self._outcome = error


class Schedule:
    """Optimizes a growing graph once the closures that wait may move its map by more than a voxel.

    As long as most closures agree with the graph, an update keeps the verdicts at hand: of all poses where the
    work for it is within bounds, else of the last ones. Where more contradict it than agree since a pose, all from
    that pose on is judged anew, with what odometry may have got wrong there.
    """

    def __init__(self, graph: PoseGraph, config: GraphConfig, voxel_m: float) -> None:
        """voxel_m : of the map, whose error is to stay below it."""
        self.graph, self.config, self.voxel_m = graph, config, voxel_m
        self.waits = self.moves = False  # whether closures wait, and may move the map by more than a voxel
        self.joins = False  # whether one of them joins a segment
        self.excess = 0  # of the closures that contradict the graph over those that agree, since a pose
        self.agreed_at = 0  # that pose: the last at which there was none
        self.optimized_at = self.updated_at = self.judged_at = 0  # number of poses: at the last, of all, judged
        self.beside: BackgroundOptimization | None = None

    def note(self, source: int, moves_m: float, chi2: float, *, joins: bool = False) -> None:
        """Note a closure that was added: its newer pose, how far it may move the map, and its χ² before.

        joins : whether it is the first to join a segment, which was moved to where it says
        """
        self.waits, self.joins = True, self.joins or joins
        self.moves |= moves_m > self.voxel_m
        limit = _CONTRADICTING * rejection_limit(self.config.robust_scale, self.graph.freedom)
        self.excess = max(self.excess + (1 if chi2 > limit else -1), 0)
        self.agreed_at = self.agreed_at if self.excess else source

    def advance(self, *, is_live: bool = False) -> int:
        """Optimize if it is time; the first pose that moved, or the number of all where none did.

        is_live : whether all but short optimizations of a large graph are made beside
        """
        count = len(self.graph)
        if self.beside is not None and count >= self.beside.due:
            return self.take_over()
        if self.joins:
            return self.optimize()
        if not self.waits:
            return count
        least = (0 if self.graph.held else _LEAST) if self.moves else max(_LEAST, _GROWTH * self._size)
        if count - self.optimized_at < least:
            return count
        plan = self._next()
        self.waits, self.moves, self.optimized_at = False, False, count
        if is_live and count >= _LARGE and plan != self._of_end:
            self._begin_waiting(plan)
            due = count + max(int(_TAKEN_AFTER[plan.rejection] * (count - plan.first)), _LEAST)
            self.beside = BackgroundOptimization(self.graph, self.config, plan, due)
            return count
        self._carry_out(plan)
        return plan.first

    def optimize(self) -> int:
        """Optimize all poses now, as a segment was moved or the first pose given; 0, the first that moves."""
        self.beside = None
        self.waits = self.moves = self.joins = False
        self.optimized_at = len(self.graph)
        self._carry_out(Plan(0, "judge"))
        return 0

    def stop(self) -> None:
        """Take nothing over of what is optimized beside: the graph was changed."""
        self.beside = None

    def finish(self) -> GraphState:
        """Optimize for the last time, all closures judged anew; the graph as it is then."""
        if self.beside is not None:
            self.take_over()
        return self.graph.optimize(self.config, initialize="given").state

    def take_over(self) -> int:
        """Take the result of the optimization beside, of the graph as it was when that began."""
        assert self.beside is not None
        self.graph.take_over(self.beside.result())
        self.beside = None
        self._count_excess()
        return 0

    @property
    def _size(self) -> int:
        """Number of poses that are not held."""
        return len(self.graph) - len(self.graph.held)

    @property
    def _of_end(self) -> Plan:
        return Plan(max(len(self.graph) - LAG, 0), "update")

    def _next(self) -> Plan:
        """What is to be optimized now, as far as the work is within bounds."""
        count = len(self.graph)
        if self.beside is not None:
            return self._of_end
        if self.excess:
            first = 0 if self._size <= _LARGE else max(self.agreed_at - LAG, count - _LARGE)
            if not first or count - self.judged_at >= _GROWTH * (count - first):
                return Plan(first, "judge")
        is_affordable = count - self.updated_at >= self.graph.work / _WORK_PER_KEYFRAME
        return Plan(0, "update") if is_affordable else self._of_end

    def _carry_out(self, plan: Plan) -> None:
        if len(self.graph) - plan.first >= _LARGE:
            return_freed_memory()
        plan.carry_out(self.graph, self.config)
        self._begin_waiting(plan)
        self._count_excess()

    def _begin_waiting(self, plan: Plan) -> None:
        count = len(self.graph)
        self.updated_at = self.updated_at if plan.first else count
        self.judged_at = count if plan.rejection == "judge" else self.judged_at

    def _count_excess(self) -> None:
        """Count anew, by the verdicts at hand."""
        graph = self.graph
        rejected = graph.is_rejected[graph.is_loop & (graph.edges[:, 1] >= self.agreed_at)]
        self.excess = max(2 * int(rejected.sum()) - len(rejected), 0)
        self.agreed_at = self.agreed_at if self.excess else len(graph) - 1
