"""Schedule of the optimizations of a growing pose graph: when, of which poses, and whether verdicts are kept."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Thread
from typing import Literal

from scanchain.config import GraphConfig
from scanchain.data import GraphState
from scanchain.graph.losses import rejection_limit
from scanchain.graph.optimization import LARGE
from scanchain.graph.pose_graph import PoseGraph
from scanchain.processes import return_freed_memory

_LEAST = 10  # least number of keyframes between two optimizations
_GROWTH = 0.05  # keyframes, as a share of the poses, until these are judged again, or if no closure moves the map
LAG = 200  # number of the last poses, which are updated where updating all is too much work
_WORK_PER_KEYFRAME = 1e6  # largest number of multiplications to update all poses, per keyframe since the last time
_CONTRADICTING = 10.0  # factor on the χ² limit of a loop edge, above which a closure contradicts the graph
_ADOPTED_AFTER = {"update": 0.005, "judge": 0.1}  # keyframes until a result is adopted, per pose moved


@dataclass(frozen=True, slots=True)
class Plan:
    """An optimization: index of its first pose, and whether verdicts are kept or all edges judged again."""

    first: int
    rejection: Literal["update", "judge"]

    def carry_out(self, graph: PoseGraph, config: GraphConfig) -> None:
        """Optimize the graph from its current poses."""
        if self.first:
            graph.optimize_end(config, self.first, self.rejection)
        else:
            graph.optimize(config, initialize="given", rejection=self.rejection)


class BackgroundOptimization:
    """Optimization of a copy of the graph in a background thread.

    ``due`` is the number of poses at which its result is adopted, which makes this independent of the speed of the
    thread.
    """

    def __init__(self, graph: PoseGraph, config: GraphConfig, plan: Plan, due: int) -> None:
        """Start the thread, which optimizes a copy of the graph from its current poses."""
        self.due, self.config, self.plan = due, config, plan
        self.before = graph.copy()
        self._thread: Thread | None = Thread(target=self._optimize, daemon=True)
        self._outcome: PoseGraph | Exception | None = None
        self._thread.start()

    def result(self) -> PoseGraph:
        """The optimized graph; waits for the thread. Raises what ``PoseGraph.optimize`` does."""
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
    """Optimizes a growing graph once pending closures may move its map by more than a voxel.

    As long as most closures agree with the graph, an update keeps the present verdicts. It covers all poses where
    the work is affordable, otherwise the last ones. If more closures contradict the graph than agree since some
    pose, all loop edges from that pose on are judged again, including possible odometry errors there.
    """

    def __init__(self, graph: PoseGraph, config: GraphConfig, voxel_m: float) -> None:
        """voxel_m : voxel size of the map, whose error shall stay below it."""
        self.graph, self.config, self.voxel_m = graph, config, voxel_m
        self.waits = self.moves = False  # whether closures are pending, and may move the map by more than a voxel
        self.joins = False  # whether one of them joins a segment
        self.excess = 0  # closures that contradict the graph minus those that agree, since a pose
        self.agreed_at = 0  # that pose: the last at which the excess was zero
        self.optimized_at = self.updated_at = self.judged_at = 0  # poses at the last optimization, of all, judged
        self.background: BackgroundOptimization | None = None

    def record_closure(self, source: int, moves_m: float, chi2: float, *, joins: bool = False) -> None:
        """Record an added closure: its newer pose, how far it may move the map, and its χ² before optimization.

        joins : whether it is the first to join a segment, which was moved to the pose it measures
        """
        self.waits, self.joins = True, self.joins or joins
        self.moves |= moves_m > self.voxel_m
        limit = _CONTRADICTING * rejection_limit(self.config.robust_scale, self.graph.freedom)
        self.excess = max(self.excess + (1 if chi2 > limit else -1), 0)
        self.agreed_at = self.agreed_at if self.excess else source

    def advance(self, *, is_live: bool = False) -> int:
        """Optimize if due; index of the first pose that moved, or the number of poses if none did.

        is_live : whether to optimize a large graph in a background thread, except for short optimizations
        """
        count = len(self.graph)
        if self.background is not None and count >= self.background.due:
            return self.adopt()
        if self.joins:
            return self.optimize()
        if not self.waits:
            return count
        least = (0 if self.graph.held else _LEAST) if self.moves else max(_LEAST, _GROWTH * self._size)
        if count - self.optimized_at < least:
            return count
        plan = self._next()
        self.waits, self.moves, self.optimized_at = False, False, count
        if is_live and count >= LARGE and plan != self._of_end:
            self._begin_waiting(plan)
            due = count + max(int(_ADOPTED_AFTER[plan.rejection] * (count - plan.first)), _LEAST)
            self.background = BackgroundOptimization(self.graph, self.config, plan, due)
            return count
        self._carry_out(plan)
        return plan.first

    def optimize(self) -> int:
        """Optimize all poses now, after a segment was moved or the first pose given; 0, the first that moves."""
        self.background = None
        self.waits = self.moves = self.joins = False
        self.optimized_at = len(self.graph)
        self._carry_out(Plan(0, "judge"))
        return 0

    def stop(self) -> None:
        """Discard the background optimization, since the graph was changed."""
        self.background = None

    def finish(self) -> GraphState:
        """Optimize for the last time, with all closures judged again; the resulting graph."""
        if self.background is not None:
            self.adopt()
        return self.graph.optimize(self.config, initialize="given").state

    def adopt(self) -> int:
        """Adopt the result of the background optimization; 0, the first pose that moves."""
        assert self.background is not None
        self.graph.adopt(self.background.result())
        self.background = None
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
        """The next optimization, limited to an affordable amount of work."""
        count = len(self.graph)
        if self.background is not None:
            return self._of_end
        if self.excess:
            first = 0 if self._size <= LARGE else max(self.agreed_at - LAG, count - LARGE)
            if not first or count - self.judged_at >= _GROWTH * (count - first):
                return Plan(first, "judge")
        is_affordable = count - self.updated_at >= self.graph.work / _WORK_PER_KEYFRAME
        return Plan(0, "update") if is_affordable else self._of_end

    def _carry_out(self, plan: Plan) -> None:
        if len(self.graph) - plan.first >= LARGE:
            return_freed_memory()
        plan.carry_out(self.graph, self.config)
        self._begin_waiting(plan)
        self._count_excess()

    def _begin_waiting(self, plan: Plan) -> None:
        count = len(self.graph)
        self.updated_at = self.updated_at if plan.first else count
        self.judged_at = count if plan.rejection == "judge" else self.judged_at

    def _count_excess(self) -> None:
        """Recompute the excess from the present verdicts."""
        graph = self.graph
        rejected = graph.is_rejected[graph.is_loop & (graph.edges[:, 1] >= self.agreed_at)]
        self.excess = max(2 * int(rejected.sum()) - len(rejected), 0)
        self.agreed_at = self.agreed_at if self.excess else len(graph) - 1
