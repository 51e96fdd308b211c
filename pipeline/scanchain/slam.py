"""The whole pipeline: odometry, keyframes, loop closures, pose graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.data import (
    AnyPoints,
    Closure,
    GraphState,
    Keyframe,
    KeyframeErrors,
    Matrix,
    Pose,
    Scan,
    Step,
    Timing,
    Trajectory,
    brief,
)
from scanchain.errors import InputError, counted
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.schedule import Schedule
from scanchain.loops import ClosureTable, LoopCloser, refined, spread
from scanchain.maps import SavedMap
from scanchain.odometry import FrontEnd, LiveStamps, Located, checked_start, owned
from scanchain.placement import LARGEST_SIGMAS, Placement, edge_information
from scanchain.point_store import PointStore
from scanchain.preprocess import Prepared
from scanchain.range_noise import RangeNoise
from scanchain.trail import Trail

_LOST_SIGMAS = (1.0, 0.2)  # m and rad, standard deviations of the motion over one scan that was lost


@dataclass(frozen=True, slots=True)
class SlamResult:
    """SLAM result of a log.

    ``trajectory`` and ``odometry`` hold every scan, T_world_lidar after and before optimization; ``keyframes``
    the scans that are nodes of the ``graph``; ``closures`` every loop closure tried. ``elevation_offset_rad`` is
    the correction of the lidar's vertical angles, from the scan ``calibrated_from`` on; usually 0;
    ``elevation_sigma_rad`` its standard deviation, infinite where none was estimated.
    ``map_errors`` are those of the keyframes relative to the map.
    ``warnings`` has a line on wheel odometry that was not used; ``T_base_lidar`` (d+1, d+1) is the mounting as
    given, or as estimated from the wheels, which ``mounting_note`` describes.
    ``map_log_odds`` are those of the log's location in a prior map, or of the best one if none was accepted; NaN
    without a map, and if no keyframe was evidence for a location in it.
    ``map_rival_log_odds`` are those of another location in it that the last keyframes match, NaN if they do not
    suffice or there is none.
    ``map_alike_share`` is the share of the searches of the map that found several similar locations.
    ``noise`` is that of the ranges, measured on the first scans.
    ``components`` (K,) labels each keyframe's submap; no loop joins different submaps; usually there is one.
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
    mounting_note: str = ""
    T_base_lidar: Pose | None = None
    elevation_offset_rad: float = 0.0
    elevation_sigma_rad: float = math.inf
    calibrated_from: int = 0
    map_log_odds: float = math.nan
    map_rival_log_odds: float = math.nan
    map_alike_share: float = 0.0
    noise: RangeNoise = field(default_factory=RangeNoise)

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
        points_file : file for the points, which are not kept in memory; a temporary one if omitted
        is_live : whether no scan may wait: long searches are spread over several scans, large graphs optimized in
            parallel
        prior : a map to localize in: its keyframes come before those of the log, and stay where they are
        prior_is_final : whether the poses of the map are final; else scans are matched to keyframes of one pass
        """
        config, T_start = checked_start(config, T_base_lidar, dimension)
        self.config, self.dimension = config, T_start.shape[0] - 1
        self.is_live, self.is_finished = is_live, False
        self.front_end = FrontEnd(config, T_base_lidar, self.dimension)
        self.live_stamps = LiveStamps()
        self.graph = PoseGraph(self.dimension)
        self.trail = Trail(self.dimension, points_file, keeps_scans=self._refines)
        self.closer = LoopCloser(config, self.dimension, is_live=is_live)
        schedule = Schedule(self.graph, config.graph, config.maps.voxel_size_m)
        self.placement = Placement(config.loops, self.closer, schedule, self.trail.keyframes)
        if prior is not None:
            self._begin_in(prior, prior_is_final)

    def __repr__(self) -> str:
        scans = counted(len(self.trail.stamps_ns), f"{self.dimension}D scan")
        tried = counted(len(self.closures), "closure")
        return f"{type(self).__name__}({scans}, {counted(len(self.keyframes), 'keyframe')}, {tried} tried)"

    def _begin_in(self, prior: SavedMap, is_final: bool) -> None:
        """Add the keyframes of a map as fixed nodes; where the log starts, perhaps in the map, is unknown."""
        if prior.dimension != self.dimension:
            raise InputError(
                f"{prior.folder}: is a {prior.dimension}D map, the log has {self.dimension}D scans; give a map of "
                "the same kind"
            )
        for keyframe in prior.keyframes:
            self.graph.fix(self.graph.add_pose(keyframe.T_odom_lidar, keyframe.stamp_ns))
        self.placement.begin_in(len(prior.keyframes))
        traveled_m = self.closer.begin_in(prior.keyframes, prior.folder, is_final=is_final)
        self.trail.begin_in(prior.keyframes, traveled_m)

    @property
    def T_base_lidar(self) -> Pose:
        """Pose of the lidar on the robot, as given or as estimated so far."""
        return self.front_end.odometry.predictor.mounting.T_base_lidar

    @property
    def keyframes(self) -> list[Keyframe]:
        """All so far, those of a prior map first."""
        return self.trail.keyframes

    @property
    def points(self) -> PointStore:
        """Points of the keyframes, and in the plane of all scans that are refined at the end."""
        return self.trail.points

    @property
    def closures(self) -> ClosureTable:
        """All that were tried so far."""
        return self.placement.closures

    @property
    def _refines(self) -> bool:
        """Whether all scans are aligned once more at the end."""
        return self.dimension == 2 and self.config.loops.enabled and self.config.loops.refine

    def track(
        self,
        points: AnyPoints,
        stamp_s: float,
        times_s: NDArray[np.floating] | None = None,
        *,
        T_odom_base: Pose | None = None,
    ) -> Step:
        """Process a scan as a driver gives it, arguments as in ``Odometry.track``: locate it and close loops.

        From the first call on, a large graph is optimized in parallel: no scan waits for it.
        """
        self.is_live = True
        scan = Scan.of(points, stamp_s, times_s, index=self.front_end.scans, T_odom_base=T_odom_base)
        return self.live_stamps.passed(scan, self.process)

    def process(self, scan: Scan | Prepared) -> Step:
        """Locate one scan and close loops. Raises InputError after ``finish``."""
        self._check_unfinished()
        located = self.front_end.locate(scan)
        mine = owned(located.tracked)
        step = self.place(located)
        return replace(step, points=mine.matched, T_odom_lidar=mine.T_odom_lidar, match=mine.match)

    def place(self, located: Located) -> Step:
        """Add one scan that ``front_end`` located, and close loops; the arrays of the step are read-only."""
        self._check_unfinished()
        tracked = located.tracked
        started = working_s()
        is_keyframe = self._add(located)
        closures: tuple[Closure, ...] = ()
        state = None
        if self.config.loops.enabled:
            closures = self.placement.close(is_keyframe=is_keyframe)
            state = self.placement.optimize(is_live=self.is_live)
        scan, seconds = tracked.scan, (tracked.preprocess_s, tracked.match_s, tracked.map_s)
        return Step(
            scan=scan,
            points=tracked.matched,
            T_odom_lidar=tracked.T_odom_lidar,
            T_world_lidar=self.placement.T_world_odom @ tracked.T_odom_lidar,
            match=tracked.match,
            state=tracked.state,
            reason=tracked.reason,
            keyframe=self.keyframes[-1].index if is_keyframe else -1,
            local_map=located.local_map,
            closures=closures,
            graph=state,
            timing=Timing(scan.waited_s, *seconds, working_s() - started),
            starts_segment=tracked.elsewhere_m > 0.0,
        )

    def finish(self, progress: Callable[[str], None] = lambda stage: None) -> SlamResult:
        """Close the remaining loops, optimize once more, correct all scans accordingly and refine their poses.

        progress : called with the name of each stage when it begins
        Raises InputError if no scan was processed, and when called again.
        """
        self._check_unfinished()
        trail, first = self.trail, self.trail.first
        if not len(trail.stamps_ns):
            raise InputError("no scan was processed: give Slam.process at least one before Slam.finish")
        self.is_finished = True
        if self.config.loops.enabled:
            progress("closing the last loops")
            self.placement.finish()
        progress(f"optimizing the graph of {counted(len(self.keyframes), 'keyframe')}")
        state = self.placement.schedule.finish()
        if self.placement.set_apart():
            state = self.graph.state()
        odometry, scan_of = trail.odometry, trail.scan_of
        starts = [start - first for start in self.closer.segments.starts]
        corrected = spread(state.poses[first:], scan_of, odometry.poses, starts)
        if self._refines:
            progress(f"refining {counted(len(odometry), 'scan')}")
            fixed, poses = self.keyframes[:first], corrected[scan_of]
            world = (fixed, state.poses[:first]) if fixed else (self.keyframes, poses)
            corrected = refined(corrected, trail.spans.rows, trail.points, *world, self.config)
        tracking, rival = self.front_end.odometry, self.placement.rival
        return SlamResult(
            trajectory=Trajectory(odometry.stamps_ns, corrected),
            odometry=odometry,
            keyframes=tuple(self.keyframes),
            closures=self.closures,
            graph=self.graph,
            state=state,
            components=self.closer.segments.components(self.graph),
            map_errors=tuple(trail.map_errors),
            warnings=tracking.predictor.warnings(),
            mounting_note=tracking.predictor.mounting.finish(),
            T_base_lidar=self.T_base_lidar,
            elevation_offset_rad=tracking.elevation.offset_rad,
            elevation_sigma_rad=tracking.elevation.sigma_rad,
            calibrated_from=tracking.calibrated_from,
            map_log_odds=self.placement.evidence.best if first else math.nan,
            map_rival_log_odds=rival.log_odds if rival.is_accepted else math.nan,
            map_alike_share=self.closer.alike_share,
            noise=tracking.resolution.noise,
        )

    def _check_unfinished(self) -> None:
        if self.is_finished:
            raise InputError("Slam.finish was called: its result is whole; begin another Slam for further scans")

    def _add(self, located: Located) -> bool:
        """Add a scan; True if it is a keyframe, which is then joined to the last one in the graph."""
        if not self.trail.add(located):
            return False
        newest, config, tracked = self.keyframes[-1], self.config.odometry, located.tracked
        if newest.index == 0:
            self.graph.add_pose(self.placement.T_world_odom @ newest.T_odom_lidar, newest.stamp_ns)
            return True
        last = self.keyframes[-2]
        T_world = self.placement.predict(last.T_odom_lidar, newest.T_odom_lidar)
        self.graph.add_pose(T_world, newest.stamp_ns)
        lost = self.trail.lost_before
        sigmas = (config.edge_sigma_m, config.edge_sigma_rad)
        if lost:
            sigmas = (lost * _LOST_SIGMAS[0], lost * _LOST_SIGMAS[1])
        elsewhere_m = tracked.elsewhere_m if newest.index > self.trail.first else LARGEST_SIGMAS[0]
        if elsewhere_m > 0.0:
            sigmas = (elsewhere_m, np.pi)
            self.placement.start_segment(newest.index)
        information = edge_information(located.information, *sigmas)
        T_last_newest = lie.between(last.T_odom_lidar, newest.T_odom_lidar)
        self.graph.add_edge(last.index, newest.index, T_last_newest, information)
        return True
