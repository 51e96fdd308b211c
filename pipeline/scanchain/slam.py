"""The whole chain: odometry, keyframes, loop closures, pose graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.clock import working_s
from scanchain.config import Config, LoopsConfig
from scanchain.data import (
    AnyPoints,
    Closure,
    ClosureVerdict,
    GraphState,
    Keyframe,
    KeyframeErrors,
    Matrix,
    Pose,
    Problem,
    Scan,
    State,
    Step,
    Timing,
    Trajectory,
    brief,
)
from scanchain.errors import InputError, counted
from scanchain.graph.background import BackgroundOptimization
from scanchain.graph.growing_array import GrowingArray
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.robust.graduation import OutlierRejection
from scanchain.graph.robust.losses import rejection_limit
from scanchain.loops import ClosureTable, LoopCloser, PlaceTest, refined, spread
from scanchain.maps import SavedMap
from scanchain.odometry import FrontEnd, LiveStamps, Located, checked_start, owned
from scanchain.point_store import PointStore
from scanchain.preprocess import Prepared
from scanchain.processes import return_freed_memory

_LOST_SIGMAS = (1.0, 0.2)  # m and rad, standard deviations of the motion over one scan that was lost
_OPTIMIZE_EVERY = 10  # least number of keyframes between two optimizations
_LARGEST_SIGMAS = (300.0, 30.0)  # m and rad, of an edge: a pose that hangs on less information is lost to rounding
_GROWTH = 0.05  # share by which the graph grows between two optimizations that change little
_UPDATE_GROWTH = 0.02  # the same of a large graph, for an optimization that keeps the verdicts
_CONTRADICTING = 10.0  # times the χ² limit of a loop edge, from which on a closure contradicts a large graph
_WORK_PER_KEYFRAME = 1e6  # multiplications to optimize all of a large graph, at most, for each keyframe since
_LAG = 200  # number of the last keyframes that follow new closures while a large graph waits for that
_LARGE = 2000  # number of keyframes of a log from which on its graph is optimized less often, and live beside
_TAKEN_AFTER = 0.005  # share by which the graph grows until an optimization beside is taken over
_EXPLAINED_TAKEN_AFTER = 0.05  # the same of one that explains closures or refines the inlier set, which takes long
_LARGE_INNOVATION = 10.0  # times loops.edge_sigma_m, from which on a closure is optimized in soon


@dataclass(frozen=True, slots=True)
class SlamResult:
    """The result of a log.

    ``trajectory`` and ``odometry`` hold every scan, T_world_lidar after and before optimization; ``keyframes``
    the scans that stand in the ``graph``; ``closures`` every loop closure tried. ``elevation_offset_rad`` is what
    the vertical angles of the lidar were corrected by, from the scan ``calibrated_from`` on; 0 as a rule;
    ``elevation_sigma_rad`` its standard deviation, infinite where none was estimated.
    ``map_errors`` are those of the keyframes against the map.
    ``warnings`` has a line on wheels that were left out.
    ``map_log_odds`` are those that the log is where it was placed in a prior map, or, where they do not suffice,
    might have been; NaN without a map, and where nothing spoke for a place in it.
    ``components`` (K,) numbers the pieces that the keyframes belong to, which no loop joins; one as a rule.
    """

    __repr__ = brief
    trajectory: Trajectory
    odometry: Trajectory
    keyframes: tuple[Keyframe, ...]
    closures: Sequence[Closure]
    graph: PoseGraph
    state: GraphState
    components: NDArray[np.int64]
    map_errors: Sequence[KeyframeErrors]
    warnings: tuple[str, ...] = ()
    elevation_offset_rad: float = 0.0
    elevation_sigma_rad: float = math.inf
    calibrated_from: int = 0
    map_log_odds: float = math.nan

    @property
    def keyframe_trajectory(self) -> Trajectory:
        """Stamps and final poses of the keyframes."""
        return Trajectory(np.array([keyframe.stamp_ns for keyframe in self.keyframes]), self.T_world_keyframes)

    @property
    def T_world_keyframes(self) -> Matrix:
        """(K, d+1, d+1) final poses of the keyframes; in the plane finer than those of the graph."""
        return self.trajectory.poses[[keyframe.scan_index for keyframe in self.keyframes]]


class Slam:
    """Odometry, loop closing and pose graph: a step for every scan, the result at the end."""

    def __init__(
        self,
        config: Config | None = None,
        T_base_lidar: Pose | None = None,
        points_file: Path | None = None,
        *,
        dimension: int | None = None,
        prior: SavedMap | None = None,
        prior_is_final: bool = True,
        is_live: bool = False,
    ) -> None:
        """Start before the first scan.

        config, T_base_lidar, dimension : as in ``Odometry``
        points_file : where points go, which stay out of memory; without one, into a temporary file
        is_live : whether no scan may wait: long searches go on over several, large graphs are optimized beside
        prior : a map to localize in: its keyframes come before those of the log, and stay where they are
        prior_is_final : whether they lie as well as they ever will; else scans are matched to one pass of them
        """
        config, T_base_lidar = checked_start(config, T_base_lidar, dimension)
        self.config = config
        self.T_base_lidar, self.dimension = T_base_lidar, T_base_lidar.shape[0] - 1
        self.points = PointStore(self.dimension, points_file)
        self.spans = GrowingArray((2,), np.int64)
        self.keeps_scans = self.dimension == 2 and config.loops.enabled and config.loops.refine
        self.is_live = is_live
        self.front_end = FrontEnd(config, T_base_lidar)
        self.closer = LoopCloser(config, self.dimension, is_live=is_live)
        self.graph = PoseGraph(self.dimension)
        self.keyframes: list[Keyframe] = []
        self.closures = ClosureTable()
        self.stamps_ns = GrowingArray((), np.int64)
        self.odometry_poses = GrowingArray((self.dimension + 1,) * 2, np.float64)
        self.T_odom_last = lie.identity(self.dimension)
        self.T_world_odom = lie.identity(self.dimension)
        self.map_errors: list[KeyframeErrors] = []
        self.traveled_m = 0.0
        self.waiting_closures = 0
        self.moves_map = False
        self.joins_segment = False
        self.joined_start = 0  # first keyframe of the last segment that a loop joined to older ones
        self.lost_scans = 0
        self.optimized_at = self.updated_at = self.judged_at = self.explained_at = 0
        self.contradicting_closures = 0  # of the waiting ones
        self.smoothed_at, self.new_closures = 0, 0
        self.contradiction = _CONTRADICTING * rejection_limit(config.graph.robust_scale, self.graph.freedom)
        self.beside: BackgroundOptimization | None = None
        self.first = 0  # number of the first keyframe of this log
        self.evidence = PlaceTest(self.closer.segments, 0)
        self.by_map: Closure | None = None  # with the map, of the newest keyframe that has one
        self.live_stamps = LiveStamps()
        self.is_finished = False
        if prior is not None:
            self._begin_in(prior, prior_is_final)

    def _begin_in(self, prior: SavedMap, is_final: bool) -> None:
        """Take the keyframes of a map, fixed where they are; the log begins somewhere, perhaps in it."""
        if prior.dimension != self.dimension:
            raise InputError(
                f"{prior.folder}: is a {prior.dimension}D map, the log has {self.dimension}D scans; give a map of "
                "the same kind"
            )
        self.keyframes += prior.keyframes
        self.first = self.optimized_at = len(self.keyframes)
        for keyframe in self.keyframes:
            self.map_errors.append(KeyframeErrors(1.0, np.zeros((self.graph.freedom,) * 2), 1.0))
            self.graph.fix(self.graph.add_pose(keyframe.T_odom_lidar, keyframe.stamp_ns))
        self.evidence.of_map = self.first
        self.traveled_m = self.closer.begin_in(self.keyframes, prior.folder, is_final=is_final)

    def track(
        self,
        points: AnyPoints,
        stamp_s: float,
        times_s: NDArray[np.floating] | None = None,
        *,
        T_odom_base: Pose | None = None,
    ) -> Step:
        """Place a scan as a driver gives it, arguments as in ``Odometry.track``, and whatever it closes.

        From the first on, a large graph is optimized beside: no scan waits for it.
        """
        self.is_live = True
        scan = Scan.of(points, stamp_s, times_s, index=self.front_end.scans, T_odom_base=T_odom_base)
        return self.live_stamps.passed(scan, self.process)

    def process(self, scan: Scan | Prepared) -> Step:
        """Place one scan, and whatever it closes. Raises InputError after ``finish``."""
        self._check_unfinished()
        located = self.front_end.locate(scan)
        mine = owned(located.tracked)
        step = self.place(located)
        return replace(step, points=mine.matched, T_odom_lidar=mine.T_odom_lidar, match=mine.match)

    def place(self, located: Located) -> Step:
        """Place one scan that ``front_end`` located; nobody may write into the arrays of the step."""
        self._check_unfinished()
        tracked = located.tracked
        scan = tracked.scan
        started = working_s()
        keyframe = self._keyframe(located)
        closures: tuple[Closure, ...] = ()
        state = None
        if self.config.loops.enabled:
            closures = self._close_loops(keyframe >= 0)
            state = self._optimize_when_due()
        timing = Timing(scan.waited_s, tracked.preprocess_s, tracked.match_s, tracked.map_s, working_s() - started)
        return Step(
            scan=scan,
            points=tracked.matched,
            T_odom_lidar=tracked.T_odom_lidar,
            T_world_lidar=self.T_world_odom @ tracked.T_odom_lidar,
            match=tracked.match,
            state=tracked.state,
            reason=tracked.reason,
            keyframe=keyframe,
            local_map=located.local_map,
            closures=closures,
            graph=state,
            timing=timing,
            starts_segment=tracked.elsewhere_m > 0.0,
        )

    def finish(self, progress: Callable[[str], None] = lambda stage: None) -> SlamResult:
        """Close what is left, optimize once more, spread the corrections over all scans and refine these.

        progress : called with the name of each stage when it begins
        Raises InputError without a scan, and when called again.
        """
        self._check_unfinished()
        if not len(self.odometry_poses):
            raise InputError("no scan was processed: give Slam.process at least one before Slam.finish")
        self.is_finished = True
        if self.config.loops.enabled:
            progress("closing the last loops")
            self._take(self.closer.finish(self.keyframes, self.graph))
        self._give_up()
        if self.beside is not None:
            self._take_over(self.beside)
        progress(f"optimizing the graph of {counted(len(self.keyframes), 'keyframe')}")
        state = self._optimize("refined")
        self._set_apart()
        stamps_ns = self.stamps_ns.rows.copy()
        odometry = self.odometry_poses.rows.copy()
        numbers = np.array([keyframe.scan_index for keyframe in self.keyframes[self.first :]])
        corrected = spread(state.poses[self.first :], numbers, odometry)
        if self.keeps_scans:
            progress(f"refining {counted(len(odometry), 'scan')}")
            fixed, poses = self.keyframes[: self.first], corrected[numbers]
            world = (fixed, state.poses[: self.first]) if fixed else (self.keyframes, poses)
            corrected = refined(corrected, self.spans.rows, self.points, *world, self.config)
        return SlamResult(
            trajectory=Trajectory(stamps_ns, corrected),
            odometry=Trajectory(stamps_ns, odometry),
            keyframes=tuple(self.keyframes),
            closures=self.closures,
            graph=self.graph,
            state=state,
            components=self.closer.segments.components(self.graph),
            map_errors=tuple(self.map_errors),
            warnings=self.front_end.odometry.predictor.warnings(),
            elevation_offset_rad=self.front_end.odometry.elevation.offset_rad,
            elevation_sigma_rad=self.front_end.odometry.elevation.sigma_rad,
            calibrated_from=self.front_end.odometry.calibrated_from,
            map_log_odds=self.evidence.best,
        )

    def _check_unfinished(self) -> None:
        if self.is_finished:
            raise InputError("Slam.finish was called: its result is whole; begin another Slam for further scans")

    def _keyframe(self, located: Located) -> int:
        """Make a keyframe of a scan that moved far enough; its index, or −1."""
        tracked = located.tracked
        if len(self.odometry_poses):
            self.traveled_m += lie.apart(self.T_odom_last, tracked.T_odom_lidar)[0]
        self.T_odom_last = tracked.T_odom_lidar
        self.stamps_ns.append(tracked.scan.stamp_ns)
        scan = self.odometry_poses.append(tracked.T_odom_lidar)
        if scan == 1:  # only now is the motion known that distorted the first scan
            stored = self.points.add(located.first_points)
            self.keyframes[self.first] = replace(self.keyframes[self.first], stored=stored)
            self.spans.replace(np.array([(stored.first, stored.count)]))
        self.lost_scans += tracked.state is State.LOST
        if not located.is_keyframe and not self.keeps_scans:
            return -1
        stored = self.points.add(tracked.points)
        self.spans.append((stored.first, stored.count))
        if not located.is_keyframe:
            return -1
        keyframe = Keyframe(
            index=len(self.keyframes),
            scan_index=len(self.odometry_poses) - 1,
            stamp_ns=tracked.scan.stamp_ns,
            stored=stored,
            T_odom_lidar=tracked.T_odom_lidar,
            traveled_m=self.traveled_m,
            scale=located.scale,
        )
        if self.graph.drift.any():
            T_last_keyframe = lie.between(self.keyframes[-1].T_odom_lidar, keyframe.T_odom_lidar)
            T_world_keyframe = self.graph.poses[-1] @ self.graph.predicted(T_last_keyframe)
            self.T_world_odom = lie.normalize(T_world_keyframe @ lie.inverse(keyframe.T_odom_lidar))
        self.graph.add_pose(self.T_world_odom @ keyframe.T_odom_lidar, keyframe.stamp_ns)
        if self.keyframes:
            last = self.keyframes[-1]
            config = self.config.odometry
            sigmas = (config.edge_sigma_m, config.edge_sigma_rad)
            if self.lost_scans:
                sigmas = (self.lost_scans * _LOST_SIGMAS[0], self.lost_scans * _LOST_SIGMAS[1])
            elsewhere_m = tracked.elsewhere_m if keyframe.index > self.first else _LARGEST_SIGMAS[0]
            if elsewhere_m > 0.0:
                sigmas = (elsewhere_m, np.pi)
                self._give_up()
                self.closer.start_segment(keyframe.index)
            self.graph.add_edge(
                last.index,
                keyframe.index,
                lie.between(last.T_odom_lidar, keyframe.T_odom_lidar),
                edge_information(located.information, *sigmas),
            )
            self.lost_scans = 0
        self.keyframes.append(keyframe)
        self.map_errors.append(located.errors)
        return keyframe.index

    def _close_loops(self, is_keyframe: bool) -> tuple[Closure, ...]:
        if self.evidence.is_in_vain:
            self._give_up()
        closures = self._take(self.closer.advance(self.keyframes, self.graph))
        if is_keyframe:
            closures += self._take(self.closer.close(self.keyframes, self.graph))
        for closure in closures if self.first else ():
            is_by_map = closure.verdict is ClosureVerdict.ACCEPTED and closure.target < self.first
            if is_by_map and (self.by_map is None or closure.source >= self.by_map.source):
                self.by_map = closure
                self.T_world_odom = self._odom_by(closure)
        return closures

    def begin_at(self, T_world_lidar: Pose, sigmas: tuple[float, float]) -> None:
        """Join the first scan of this log to the nearest keyframe of the map: it is at this pose, to m and rad."""
        positions = self.graph.poses[: self.first, :-1, -1]
        nearest = int(np.argmin(np.linalg.norm(positions - T_world_lidar[:-1, -1], axis=1)))
        T_nearest_lidar = lie.between(self.graph.poses[nearest], T_world_lidar)
        information = np.diag(lie.by_component(self.graph.freedom, *sigmas) ** -2.0)
        self.graph.move(self.first, lie.normalize(T_world_lidar @ lie.inverse(self.graph.poses[self.first])))
        self.graph.remeasure(0)
        self.graph.add_edge(nearest, self.first, T_nearest_lidar, information, is_loop=True)
        self.evidence.give()
        self._optimize("gnc")

    def _odom_by(self, closure: Closure) -> Pose:
        """T_world_odom by a closure with a keyframe of the map."""
        T_world_source = self.keyframes[closure.target].T_odom_lidar @ closure.match.T_target_source
        return lie.normalize(T_world_source @ lie.inverse(self.keyframes[closure.source].T_odom_lidar))

    @property
    def is_in_map(self) -> bool:
        """True if closures in force join the newest keyframe to the map."""
        components = self.closer.segments.components(self.graph)
        return self.first > 0 and not self.evidence.is_gathering and bool(components[-1] == components[0])

    def _take(self, closures: tuple[Closure, ...]) -> tuple[Closure, ...]:
        """Keep closures; those accepted become edges of the graph."""
        if not closures:
            return ()
        closures = self._tested(closures) if self.first else closures
        taken = tuple(
            self._add(closure) if closure.verdict is ClosureVerdict.ACCEPTED else closure for closure in closures
        )
        self.closures.extend(taken)
        return taken

    def _tested(self, closures: tuple[Closure, ...]) -> tuple[Closure, ...]:
        """Closures; those that would join the newest segment to the map are rejected until they are enough."""
        start = self.closer.segments.starts[-1]
        with_map = [each for each in closures if each.target < self.first and each.source >= start]
        self.evidence.note(with_map)
        if self.is_in_map:
            return closures if self.evidence.follow(with_map, self.keyframes) else self._withdrawn(closures)
        others = [each for each in closures if each.target >= self.first or each.source < start]
        was_gathering = self.evidence.is_gathering
        joining = self.evidence.collect(with_map, self.keyframes)
        if self.evidence.is_gathering and not was_gathering:
            self._move_segment(self.evidence.waiting[0])
            self._follow_graph()
        too_few = Problem.plain("too few keyframes agree on the place in the map")
        alone = [each.rejected(too_few) if each.verdict is ClosureVerdict.ACCEPTED else each for each in with_map]
        return (*others, *(joining or alone))

    def _withdrawn(self, closures: tuple[Closure, ...]) -> tuple[Closure, ...]:
        """The newest segment is not where it was joined to the map: take back all that joins it; search again."""
        start = self.closer.segments.starts[-1]
        problem = Problem.plain("withdrawn: what was seen since contradicts the place in the map")

        def is_wrong(closure: Closure) -> bool:
            is_accepted = closure.verdict is ClosureVerdict.ACCEPTED
            return is_accepted and closure.target < self.first and closure.source >= start

        edges = self.graph.edges
        self.graph.remove_loops(self.graph.is_loop & (edges[:, 0] < self.first) & (edges[:, 1] >= start))
        self.closures.reject(is_wrong, problem)
        self.evidence.drop(start)
        self.closer.search_again()
        self.beside, self.by_map, self.joined_start = None, None, 0
        return tuple(each.rejected(problem) if is_wrong(each) else each for each in closures)

    def _give_up(self) -> None:
        """The pose in the map that is being tested is wrong: search the newest segment again."""
        if self.evidence.is_gathering:
            self.evidence.drop(self.closer.segments.starts[-1])
            self.closer.search_again()

    def _set_apart(self) -> None:
        """Take segments of the log for apart from the map that too little joins to it in the end."""
        segments, graph = self.closer.segments, self.graph
        chosen = graph.is_loop & ~graph.is_rejected & (graph.edges[:, 0] < self.first)
        in_force = graph.edges[chosen & (graph.edges[:, 1] >= self.first), 1]
        for number, start in enumerate(segments.starts[1:], 1):
            end = segments.span(start, len(graph))[1]
            if not ((in_force >= start) & (in_force < end)).any():
                continue
            placed = [replace(self.keyframes[k], T_odom_lidar=graph.poses[k]) for k in range(start, end)]
            if not self.evidence.holds(placed, self.keyframes):
                segments.apart.add(number)

    def _add(self, closure: Closure) -> Closure:
        """Make an edge of a closure; returns the closure with its innovation in the graph before."""
        config = self.config.loops
        information = loop_information(closure, config)
        Z_ij = closure.match.T_target_source
        expected = lie.between(self.graph.poses[closure.target], self.graph.poses[closure.source])
        error = lie.log(lie.between(Z_ij, expected))
        self.waiting_closures += 1
        self.new_closures += 1
        self.moves_map |= lie.apart(expected, Z_ij)[0] > _LARGE_INNOVATION * config.edge_sigma_m
        self.graph.add_edge(closure.target, closure.source, Z_ij, information, is_loop=True)
        if self._joins_segment(closure):
            self.joined_start, self.joins_segment = self.closer.segments.starts[-1], True
            self._move_segment(closure)
        chi2_before = float(error @ information @ error)
        self.contradicting_closures += chi2_before > self.contradiction
        return replace(closure, chi2_before=chi2_before)

    def _joins_segment(self, closure: Closure) -> bool:
        """True for the first closure of the newest segment to an older one."""
        start = self.closer.segments.starts[-1]
        return self.joined_start < start and closure.target < start <= closure.source

    def _move_segment(self, closure: Closure) -> None:
        """Put the newest segment where its first closure says: from far off, robust losses reject all of them."""
        start = self.closer.segments.starts[-1]
        self.beside = None  # it would put the segment back
        T_world_source = self.graph.poses[closure.target] @ closure.match.T_target_source
        T_new_old = T_world_source @ lie.inverse(self.graph.poses[closure.source])
        self.graph.move(start, lie.normalize(T_new_old))
        if start == self.first:
            self.graph.remeasure(0)  # the edge that the log hangs on: where it began in the map was not known

    def _optimize_when_due(self) -> GraphState | None:
        """Optimize when closures wait: at once where one joins a segment, soon where it moves the map.

        The required growth is a share of the graph, so that all optimizations together cost little more than a
        few of the last one. The inlier set is refined where the map moves: there a wrong one would last.
        """
        if self.evidence.is_gathering:
            return None
        grown = len(self.keyframes) - self.optimized_at
        if self.beside is not None and len(self.keyframes) >= self.beside.due:
            return self._take_over(self.beside)
        is_urgent = self.joins_segment or (self.first > 0 and self.moves_map)
        enough = 0 if is_urgent else _OPTIMIZE_EVERY
        size = len(self.keyframes) - self.first
        is_large = size >= _LARGE
        if is_large and not is_urgent:
            enough = max(enough, _UPDATE_GROWTH * size)
        elif not self.moves_map:
            enough = max(enough, _GROWTH * size)
        if not self.waiting_closures or grown < enough or self.beside is not None:
            if is_large:
                self._smooth()
            return None
        rejection: OutlierRejection = "edges" if self.moves_map else "gnc"
        if is_large and not is_urgent:
            rejection = self._rejection_of_large(size)
        if not is_large or not self.is_live:
            return self._optimize(rejection)
        is_long = rejection in ("edges", "explained") and not is_urgent
        share = _EXPLAINED_TAKEN_AFTER if is_long else _TAKEN_AFTER
        due = len(self.keyframes) + int(share * len(self.keyframes))
        self.beside = BackgroundOptimization(self.graph, self.config.graph, rejection, due)
        self._begin_waiting(rejection)
        return None

    def _smooth(self) -> None:
        """Let the last keyframes of a large graph follow the closures that wait."""
        if self.new_closures and len(self.keyframes) >= max(self.optimized_at, self.smoothed_at) + _OPTIMIZE_EVERY:
            self.graph.follow(self.config.graph, len(self.keyframes) - _LAG)
            self.smoothed_at, self.new_closures = len(self.keyframes), 0
            self._follow_graph()

    def _rejection_of_large(self, size: int) -> OutlierRejection:
        """Of the last keyframes, of all where the work for it is within bounds, or at first a verdict on all."""
        count = len(self.keyframes)
        disagree = self.contradicting_closures > 0.5 * self.waiting_closures
        if not self.judged_at:
            return "edges" if disagree else "gnc"
        if disagree and count - self.explained_at >= _GROWTH * size:
            return "explained"
        enough = max(_GROWTH * size, self.graph.work / _WORK_PER_KEYFRAME)
        return "retained" if count - self.updated_at >= enough else "recent"

    def _optimize(self, rejection: OutlierRejection) -> GraphState:
        if len(self.keyframes) >= _LARGE:
            return_freed_memory()
        state = self.graph.optimize(self.config.graph, initialize="given", rejection=rejection).state
        self._begin_waiting(rejection)
        return state

    def _take_over(self, beside: BackgroundOptimization) -> GraphState:
        """Take the result of an optimization beside, of the graph as it was when that began."""
        self.beside = None
        self.graph.take_over(beside.result())
        self._follow_graph()
        return self.graph.state()

    def _begin_waiting(self, rejection: OutlierRejection) -> None:
        """All closures so far are taken into account: wait for the next."""
        count = self.optimized_at = len(self.keyframes)
        if rejection not in ("retained", "recent"):
            self.explained_at = count
        if rejection not in ("recent", "explained"):
            self.updated_at = count
            self.judged_at = self.judged_at if rejection == "retained" else count
        self.waiting_closures = self.contradicting_closures = self.new_closures = 0
        self.moves_map = self.joins_segment = False
        self._follow_graph()

    def _follow_graph(self) -> None:
        """Put the odometry frame where the graph has the newest keyframe."""
        T_lidar_odom = lie.inverse(self.keyframes[-1].T_odom_lidar)
        self.T_world_odom = lie.normalize(self.graph.poses[-1] @ T_lidar_odom)


def loop_information(closure: Closure, config: LoopsConfig) -> Matrix:
    """Information (k, k) of the pose-graph edge of a closure."""
    return edge_information(closure.match.information, config.edge_sigma_m, config.edge_sigma_rad)


def edge_information(information: Matrix, sigma_m: float, sigma_rad: float) -> Matrix:
    """Information (k, k) of a pose-graph edge: that of the motion (k, k), with a floor under its variances.

    Residuals share the map's errors and are far from independent, so that H alone is overconfident.
    """
    k = len(information)
    largest = lie.by_component(k, *_LARGEST_SIGMAS) ** 2
    floor = np.minimum(lie.by_component(k, sigma_m, sigma_rad) ** 2, largest)
    least = np.maximum(1e-6 / floor, 1.0 / largest)
    covariance = np.linalg.inv(information + np.diag(least)) + np.diag(floor)
    result = np.linalg.inv(covariance)
    return 0.5 * (result + result.T)
