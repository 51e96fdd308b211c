"""Placement of the segments of a log relative to each other, and in a prior map if they were recorded there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from scanchain import lie
from scanchain.config import LoopsConfig
from scanchain.data import Closure, ClosureVerdict, GraphState, Keyframe, Matrix, Pose, Problem
from scanchain.graph.factors import edge_information
from scanchain.graph.schedule import LAG, Schedule
from scanchain.loops import ClosureTable, LoopCloser, SequentialPlaceTest
from scanchain.loops.evidence import pose_by
from scanchain.loops.recognizer import PLACE_DRIFT

_TOO_FEW = Problem.plain("too few keyframes agree on the place")
_CONTRADICTED = Problem.plain("withdrawn: later scans contradict the location")
_REPLACED = Problem.plain("withdrawn: more of the path matches at another location in the map")
_ELSEWHERE = Problem.plain("contradicts the location of the log in the map, at which more of the path matches")


class Placement:
    """Adds closures to the graph, and determines by them where the newest segment of the log lies.

    Closures of a new segment with older keyframes (of earlier segments, or of a prior map, which come first and
    are fixed) are held back until the sequential test accepts them. Then the segment is moved there. Closures that
    later scans contradict are withdrawn.

    While a log that was joined to a map does not match it, other locations are searched for and tested in
    parallel; one that more of the path matches replaces that of the log, its earlier scans included.
    """

    def __init__(
        self,
        config: LoopsConfig,
        closer: LoopCloser,
        schedule: Schedule,
        keyframes: Sequence[Keyframe],
        first: int,
    ) -> None:
        """Begin before the first scan.

        keyframes : those of the graph, which the caller adds to
        first : number of the first keyframe of the log, after those of a prior map
        """
        self.config, self.closer, self.schedule, self.keyframes = config, closer, schedule, keyframes
        self.graph = schedule.graph
        self.closures = ClosureTable()
        self.T_world_odom = lie.identity(self.graph.dimension)
        self.first = first
        self.evidence = SequentialPlaceTest(closer.segments)
        self.rival = SequentialPlaceTest(
            closer.segments
        )  # of another location in the map, while the log has no match
        self.by_map: Closure | None = None  # the closure with the map of the newest keyframe that has one
        self.joined_start = 0  # first keyframe of the last segment that a loop joined to older ones

    @property
    def is_in_map(self) -> bool:
        """True if closures in force join the newest keyframe to the map."""
        components = self.closer.segments.components(self.graph)
        return self.first > 0 and not self.evidence.is_testing and bool(components[-1] == components[0])

    def begin_at(self, T_world_lidar: Pose, sigmas: tuple[float, float]) -> None:
        """Join the first scan of the log to the map's nearest keyframe, by its pose and sigmas (m, rad)."""
        positions = self.graph.poses[: self.first, :-1, -1]
        nearest = int(np.argmin(np.linalg.norm(positions - T_world_lidar[:-1, -1], axis=1)))
        T_nearest_lidar = lie.between(self.graph.poses[nearest], T_world_lidar)
        information = np.diag(lie.by_component(self.graph.freedom, *sigmas) ** -2.0)
        self._move(self.first, T_world_lidar @ lie.inverse(self.graph.poses[self.first]))
        self.graph.add_edge(nearest, self.first, T_nearest_lidar, information, is_loop=True)
        self.evidence.accept()
        self.schedule.optimize()
        self.follow_graph()

    def close(self, *, is_keyframe: bool) -> tuple[Closure, ...]:
        """Closures of searches that this scan completes, and of the newest keyframe if the scan is one."""
        if self.evidence.is_rejected(self.keyframes[-1]):
            self.reject_location()
        if self.rival.is_rejected(self.keyframes[-1]) and not self.rival.is_accepted:
            self.rival.reject(self.closer.segments.starts[-1])
        closures = self.record(self.closer.advance())
        if is_keyframe:
            closures += self.record(self.closer.close(self.keyframes, self.graph), self._at_rival())
        for closure in closures if self.first else ():
            is_by_map = closure.verdict is ClosureVerdict.ACCEPTED and closure.target < self.first
            if is_by_map and (self.by_map is None or closure.source >= self.by_map.source):
                self.by_map = closure
                T_world_source = self.keyframes[closure.target].T_odom_lidar @ closure.match.T_target_source
                T_source_odom = lie.inverse(self.keyframes[closure.source].T_odom_lidar)
                self.T_world_odom = lie.normalize(T_world_source @ T_source_odom)
        return closures

    def record(self, closures: tuple[Closure, ...], at_rival: tuple[Closure, ...] = ()) -> tuple[Closure, ...]:
        """Record closures; those accepted become edges of the graph.

        at_rival : tried at the other location in the map that is being tested
        """
        if not closures and not at_rival:
            return ()
        closures = self._tested(closures, at_rival) if self.closer.segments.starts[-1] else closures
        recorded = tuple(
            self._add(closure) if closure.verdict is ClosureVerdict.ACCEPTED else closure for closure in closures
        )
        self.closures.extend(recorded)
        return recorded

    def optimize(self, *, is_live: bool) -> GraphState | None:
        """Optimize the graph if it is due; returns its state if more than its end moved, else None."""
        if self.evidence.is_testing:
            return None
        moved = len(self.graph) - self.schedule.advance(is_live=is_live)
        if moved:
            self.follow_graph()
        return self.graph.state() if moved > LAG or moved == len(self.graph) else None

    def predict(self, T_odom_last: Pose, T_odom_next: Pose) -> Pose:
        """T_world of the next keyframe by the last one and odometry, corrected by the drift that loops show."""
        if self.graph.drift.any():
            T_last_next = self.graph.predicted(lie.between(T_odom_last, T_odom_next))
            self.T_world_odom = lie.normalize(self.graph.poses[-1] @ T_last_next @ lie.inverse(T_odom_next))
        return self.T_world_odom @ T_odom_next

    def start_segment(self, keyframe: int) -> None:
        """Start a segment: the motion to this keyframe, the newest, is not known."""
        self.reject_location()
        self.rival.reject(keyframe)
        self.closer.start_segment(keyframe)

    def finish(self) -> None:
        """Record the last closures; a location still being tested has too little evidence and is rejected."""
        self.record(self.closer.finish(self.keyframes, self.graph))
        self.reject_location()

    def reject_location(self) -> None:
        """Reject the location that is being tested, if any; search for that of the newest segment again."""
        if self.evidence.is_testing:
            self.evidence.reject(self.closer.segments.starts[-1])
            self.closer.segments.assume(-1)
            self.closer.search_again()

    def set_apart(self) -> bool:
        """Reject closures that join segments to older ones with too little evidence in the end; True if any is."""
        segments, graph, is_any = self.closer.segments, self.graph, False
        targets, sources = graph.edges[graph.is_loop & ~graph.is_rejected].T
        for start in segments.starts[1:]:
            placed = range(*segments.span(start, len(graph)))
            is_joined = ((targets < start) & (sources >= start) & (sources < placed.stop)).any()
            world, of_same_log = (self.keyframes, graph.poses), start > self.first
            if is_joined and not self.evidence.passes_at(placed, *world, of_same_log=of_same_log):
                self._reject_joins(placed, _TOO_FEW)
                is_any = True
        return is_any

    def follow_graph(self) -> None:
        """Set T_world_odom by the pose of the newest keyframe in the graph."""
        T_lidar_odom = lie.inverse(self.keyframes[-1].T_odom_lidar)
        self.T_world_odom = lie.normalize(self.graph.poses[-1] @ T_lidar_odom)

    def _tested(self, closures: tuple[Closure, ...], at_rival: tuple[Closure, ...]) -> tuple[Closure, ...]:
        """Closures; those that would join the newest segment to older ones are rejected until the test accepts."""
        start, evidence, world = self.closer.segments.starts[-1], self.evidence, (self.keyframes, self.graph.poses)
        closures, found = self._split_elsewhere(closures)
        elsewhere = found + at_rival
        if elsewhere and not evidence.is_testing:
            self.rival.record(elsewhere)
            if replacing := self.rival.update(elsewhere, *world, least_matches=evidence.matches):
                return (*self._withdrawn(closures, _REPLACED), *replacing)
        older = [each for each in closures if each.target < start <= each.source]
        evidence.record(older)
        components = self.closer.segments.components(self.graph, with_assumed=False)
        is_joined = (components == components[-1]).tolist()
        known = [each for each in older if is_joined[each.target]]
        if known and not evidence.is_testing and not evidence.update_joined(known, *world):
            return self._withdrawn(closures, _CONTRADICTED)
        if any(each.verdict is ClosureVerdict.ACCEPTED for each in known):
            self.rival.reject(start)
        tested = [each for each in older if not is_joined[each.target]]
        was_testing = evidence.is_testing
        joining = evidence.update(tested, *world)
        self.closer.segments.assume(evidence.waiting[0].target if evidence.is_testing else -1)
        if evidence.is_testing and not was_testing:
            self._move_to(evidence.waiting[0])
            self.follow_graph()
        alone = [each.rejected(_TOO_FEW) if each.verdict is ClosureVerdict.ACCEPTED else each for each in tested]
        others = [each for each in closures if each.source < start or is_joined[each.target]]
        return (*others, *(each.rejected(_ELSEWHERE) for each in found), *(joining or alone))

    def _split_elsewhere(self, closures: tuple[Closure, ...]) -> tuple[tuple[Closure, ...], tuple[Closure, ...]]:
        """Closures in two groups: others, and those far from the log's location in the map, if it has no match."""
        if not self.first or self.closer.is_tracking(self.keyframes):
            return closures, ()
        components = self.closer.segments.components(self.graph)
        traveled_m = self.keyframes[-1].traveled_m - self.closer.search.matched_m
        limit_m = max(PLACE_DRIFT * traveled_m, self.config.min_radius_m)

        def is_elsewhere(each: Closure) -> bool:
            if each.verdict is ClosureVerdict.REJECTED or components[each.target] != components[-1]:
                return False
            T_found = pose_by(each, each.source, self.keyframes, self.graph.poses)
            return each.target < self.first and lie.apart(self.graph.poses[each.source], T_found)[0] > limit_m

        elsewhere = tuple(filter(is_elsewhere, closures))
        return tuple(each for each in closures if not is_elsewhere(each)), elsewhere

    def _at_rival(self) -> tuple[Closure, ...]:
        """The closure of the newest keyframe at the other location that is being tested, if any."""
        if not self.rival.is_testing:
            return ()
        T_world = pose_by(self.rival.waiting[-1], self.keyframes[-1].index, self.keyframes, self.graph.poses)
        return self.closer.near.in_map_at(T_world, self.keyframes)

    def _withdrawn(self, closures: tuple[Closure, ...], problem: Problem) -> tuple[Closure, ...]:
        """Withdraw all closures that joined the newest segment to older ones; search for its location again."""
        start = self.closer.segments.starts[-1]
        is_withdrawn = self._reject_joins(range(start, len(self.keyframes)), problem)
        self.evidence.reject(start)
        if problem is _REPLACED:
            self.evidence.continue_from(self.rival)
        self.rival.reject(start)
        self.closer.search_again()
        self.schedule.stop()
        self.by_map, self.joined_start = None, 0
        return tuple(each.rejected(problem) if is_withdrawn(each) else each for each in closures)

    def _reject_joins(self, segment: range, problem: Problem) -> Callable[[Closure], bool]:
        """Reject the closures that join the keyframes of a segment to older ones; returns the test for these."""

        def is_meant(closure: Closure) -> bool:
            is_accepted = closure.verdict is ClosureVerdict.ACCEPTED
            return is_accepted and closure.target < segment.start <= closure.source < segment.stop

        targets, sources = self.graph.edges.T
        is_between = (targets < segment.start) & (sources >= segment.start) & (sources < segment.stop)
        self.graph.remove_edges(self.graph.is_loop & is_between)
        self.closures.reject(is_meant, problem)
        return is_meant

    def _add(self, closure: Closure) -> Closure:
        """Make an edge of a closure; returns the closure with its innovation in the graph before."""
        information = loop_information(closure, self.config)
        Z_ij, start = closure.match.T_target_source, self.closer.segments.starts[-1]
        expected = lie.between(self.graph.poses[closure.target], self.graph.poses[closure.source])
        error = lie.log(lie.between(Z_ij, expected))
        chi2_before = float(error @ information @ error)
        joins = self.joined_start < start and closure.target < start <= closure.source
        self.schedule.record_closure(closure.source, lie.apart(expected, Z_ij)[0], chi2_before, joins=joins)
        self.graph.add_edge(closure.target, closure.source, Z_ij, information, is_loop=True)
        if joins:
            self.joined_start = start
            self._move_to(closure)
        return replace(closure, chi2_before=chi2_before)

    def _move_to(self, closure: Closure) -> None:
        """Move the newest segment to where its first closure puts it: from afar, robust losses reject all."""
        self.schedule.stop()  # it would put the segment back
        T_world_source = self.graph.poses[closure.target] @ closure.match.T_target_source
        start, T_old = self.closer.segments.starts[-1], self.graph.poses[closure.source]
        self._move(start, T_world_source @ lie.inverse(T_old))

    def _move(self, start: int, T_new_old: Pose) -> None:
        self.graph.move(start, lie.normalize(T_new_old))
        if start == self.first:
            self.graph.remeasure(0)  # the edge that joins the log to the map: its start in the map was unknown


def loop_information(closure: Closure, config: LoopsConfig) -> Matrix:
    """Information (k, k) of the pose-graph edge of a closure."""
    return edge_information(closure.match.information, config.edge_sigma_m, config.edge_sigma_rad)
