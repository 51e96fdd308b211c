"""The whole pipeline: odometry, keyframes, loop closures, pose graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.back_end import BackEnd, Constraint
from scanchain.clock import working_s
from scanchain.config import Config
from scanchain.data import (
    Closure,
    Fixes,
    GraphState,
    Keyframe,
    KeyframeErrors,
    Matrix,
    Points,
    Pose,
    RaySpan,
    RestForce,
    Scan,
    Step,
    Timing,
    Trajectory,
    Vector,
    brief,
)
from scanchain.errors import InputError, counted
from scanchain.georeference import Georeference, Georeferencing
from scanchain.graph.factors import Odometry
from scanchain.graph.pose_graph import PoseGraph
from scanchain.gravity import leveled
from scanchain.ground import flattened
from scanchain.growing_array import GrowingArray
from scanchain.loops import ClosureTable, refined, spread
from scanchain.maps import SavedMap
from scanchain.odometry import FrontEnd, Located, checked_start
from scanchain.point_store import PointStore, StoredPoints
from scanchain.preprocess import Prepared
from scanchain.range_noise import RangeNoise
from scanchain.steps import Steps


@dataclass(frozen=True, slots=True)
class SlamResult:
    """SLAM result of a log.

    ``trajectory`` and ``odometry`` hold every scan, T_world_lidar after and before optimization; ``keyframes``
    the scans that are nodes of the ``graph``; ``closures`` every loop closure tried. ``elevation_offset_rad`` is
    the correction of the lidar's vertical angles, from the scan ``calibrated_from`` on; usually 0;
    ``elevation_sigma_rad`` its standard deviation, infinite where none was estimated.
    ``map_errors`` are those of the keyframes relative to the map.
    ``warnings`` has a line on wheel odometry that was not used; ``T_base_lidar`` (d+1, d+1) is the mounting as
    given, or as estimated from the wheels. ``sensor_notes`` describe what was found out about the other sensors.
    ``map_log_odds`` are those of the log's location in a prior map, or of the best one if none was accepted; NaN
    without a map, and if no keyframe was evidence for a location in it.
    ``map_rival_log_odds`` are those of another location in it that the last keyframes match, NaN if they do not
    suffice or there is none.
    ``map_ambiguous_share`` is the share of the searches of the map that found several similar locations.
    ``georeference`` is the place on Earth by the fixes of a GNSS receiver; None where it is unknown.
    ``noise`` is that of the ranges, measured on the first scans; ``steps`` has the figures of all scans.
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
    config: Config
    steps: Steps
    warnings: tuple[str, ...] = ()
    sensor_notes: tuple[str, ...] = ()
    T_base_lidar: Pose | None = None
    elevation_offset_rad: float = 0.0
    elevation_sigma_rad: float = math.inf
    calibrated_from: int = 0
    map_log_odds: float = math.nan
    map_rival_log_odds: float = math.nan
    map_ambiguous_share: float = 0.0
    georeference: Georeference | None = None
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
        is_live: bool = False,
    ) -> None:
        """Start before the first scan.

        config, T_base_lidar, dimension : as in ``Odometry``
        points_file : file for the points, which are not kept in memory; a temporary one if omitted
        is_live : whether no scan may wait: long searches are spread over several scans, large graphs optimized in
            parallel
        prior : a map to localize in: its keyframes come before those of the log, and stay where they are
        """
        config, T_start = checked_start(config, T_base_lidar, dimension)
        self.config, self.dimension = config, T_start.shape[0] - 1
        self.is_finished = False
        self.front_end = FrontEnd(config, T_base_lidar, self.dimension)
        self.back_end = BackEnd(config, self.dimension, prior=prior, is_live=is_live)
        self.steps = Steps()
        self.points = PointStore(self.dimension, points_file)
        self.spans = GrowingArray((2,), np.int64)  # rows of the points of each scan, if all are kept
        self.traveled_m = self.back_end.start_m
        self.fixes: list[Fixes] = []
        self.at_rest: dict[int, RestForce] = {}  # by keyframe

    def __repr__(self) -> str:
        scans = counted(len(self.steps), f"{self.dimension}D scan")
        tried = counted(len(self.closures), "closure")
        return f"{type(self).__name__}({scans}, {counted(len(self.keyframes), 'keyframe')}, {tried} tried)"

    @property
    def T_base_lidar(self) -> Pose:
        """Pose of the lidar on the robot, as given or as estimated so far."""
        return self.front_end.odometry.predictor.wheels.mounting.T_base_lidar

    @property
    def keyframes(self) -> list[Keyframe]:
        """All so far, those of a prior map first."""
        return self.back_end.keyframes

    @property
    def closures(self) -> ClosureTable:
        """All that were tried so far."""
        return self.back_end.placement.closures

    @property
    def _refines(self) -> bool:
        """Whether all scans are aligned once more at the end."""
        return self.dimension == 2 and self.config.loops.enabled and self.config.loops.refine

    def process(self, scan: Scan | Prepared) -> Step:
        """Locate one scan and close loops; raises InputError as ``Odometry.process``, and after ``finish``."""
        self._check_unfinished()
        located = self.front_end.locate(scan)
        tracked = located.tracked
        if tracked.scan.fixes is not None:
            self.fixes.append(tracked.scan.fixes)
        started = working_s()
        is_keyframe = self._add(located)
        closures, state = self.back_end.advance(is_keyframe=is_keyframe)
        seconds = (tracked.preprocess_s, tracked.match_s, tracked.map_s)
        step = Step(
            scan=tracked.scan,
            points=tracked.matched,
            T_odom_lidar=tracked.T_odom_lidar.copy(),  # the original is that of the keyframe
            T_world_lidar=self.back_end.placement.T_world_odom @ tracked.T_odom_lidar,
            match=tracked.match,
            state=tracked.state,
            reason=tracked.reason,
            keyframe=self.keyframes[-1].index if is_keyframe else -1,
            local_map=located.local_map,
            closures=closures,
            graph=state,
            timing=Timing(tracked.scan.waited_s, *seconds, working_s() - started),
            starts_segment=tracked.elsewhere_m > 0.0,
            innovations=tracked.innovations,
        )
        self.steps.append(step)
        return step

    def finish(self, progress: Callable[[str], None] = lambda stage: None) -> SlamResult:
        """Close the remaining loops, optimize once more, correct all scans accordingly and refine their poses.

        progress : called with the name of each stage when it begins
        Raises InputError if no scan was processed, and when called again.
        """
        self._check_unfinished()
        if not len(self.steps):
            raise InputError("no scan was processed: give Slam.process at least one before Slam.finish")
        self.is_finished = True
        back_end, odometry = self.back_end, self.steps.trajectory("T_odom_lidar")
        state, first = back_end.finish(progress), back_end.first
        scan_of = np.array([keyframe.scan_index for keyframe in self.keyframes[first:]])
        starts = [start - first for start in back_end.closer.segments.starts]
        components = back_end.closer.segments.components(back_end.graph)
        graph, up, by_sensors = self._leveled(progress)
        if graph is not back_end.graph:
            state = graph.state()
        corrected = spread(state.poses[first:], scan_of, odometry.poses, starts)
        if graph is not back_end.graph:
            from_first = lie.between(odometry.poses[0], odometry.poses)
            odometry = Trajectory(odometry.stamps_ns, corrected[0] @ from_first)
        located = Georeferencing(self.fixes, up, self.config.graph) if self.fixes else None
        if located is not None:
            progress("comparing with the fixes of the GNSS receiver")
            found = located.constrained(Trajectory(odometry.stamps_ns, corrected), graph, scan_of)
            if found is not None:
                graph, state = found, found.state()
                corrected = spread(state.poses, scan_of, odometry.poses, starts)
        if self._refines:
            progress(f"refining {counted(len(odometry), 'scan')}")
            fixed, poses = self.keyframes[:first], corrected[scan_of]
            world = (fixed, state.poses[:first]) if fixed else (self.keyframes, poses)
            corrected = refined(corrected, self._points_of, *world, self.config)
        tracking, placement = self.front_end.odometry, back_end.placement
        trajectory = Trajectory(odometry.stamps_ns, corrected)
        notes = (*tracking.predictor.notes(), *by_sensors)
        georeference = located and located.place(trajectory)
        if georeference is not None:
            self.steps.compare("GNSS", georeference.stamps_ns, georeference.innovations)
        if located is not None:
            notes = (*notes, f"GNSS: {located.note}")
        return SlamResult(
            trajectory=trajectory,
            odometry=odometry,
            keyframes=tuple(self.keyframes),
            closures=self.closures,
            graph=graph,
            state=state,
            components=components,
            map_errors=tuple(back_end.errors),
            config=self.config,
            steps=self.steps,
            warnings=tracking.predictor.warnings(),
            sensor_notes=tuple(filter(None, notes)),
            T_base_lidar=self.T_base_lidar,
            elevation_offset_rad=tracking.elevation.offset_rad,
            elevation_sigma_rad=tracking.elevation.sigma_rad,
            calibrated_from=tracking.calibrated_from,
            map_log_odds=placement.evidence.best if first else math.nan,
            map_rival_log_odds=placement.rival.log_odds if placement.rival.is_accepted else math.nan,
            map_ambiguous_share=back_end.closer.ambiguous_share,
            georeference=georeference,
            noise=tracking.resolution.noise,
        )

    def _leveled(self, progress: Callable[[str], None]) -> tuple[PoseGraph, Vector, list[str]]:
        """The graph corrected by gravity and by the ground, the upward direction (3,) in its world, and notes."""
        graph, up = self.back_end.graph, lie.lift(self.T_base_lidar)[2, :3]
        by_gravity, by_ground, use = "", "", self.config.graph.ground
        if self.at_rest and not self.back_end.first:
            graph, by_gravity = leveled(graph, self.at_rest, self.config.graph)
        on_wheels = use == "on" or (use == "auto" and bool(self.steps.columns["has_wheels"].any()))
        alone = not self.back_end.first and len(self.back_end.closer.segments.starts) == 1
        if on_wheels and alone and self.dimension == 3:
            progress("testing whether the ground is flat")
            graph, by_ground = flattened(graph, self.back_end.errors, up, self.config, levels=not by_gravity)
        if graph is not self.back_end.graph:
            up = np.array([0.0, 0.0, 1.0]) if by_gravity else graph.poses[0, :3, :3] @ up
        return graph, up, [by_gravity, by_ground]

    def _check_unfinished(self) -> None:
        if self.is_finished:
            raise InputError("Slam.finish was called: its result is whole; begin another Slam for further scans")

    def _add(self, located: Located) -> bool:
        """Add a scan; True if it is a keyframe, which the motion from the last one joins to the graph."""
        tracked, number, back_end = located.tracked, len(self.steps), self.back_end
        if number:
            self.traveled_m += lie.apart(self.steps.columns["T_odom_lidar"][-1], tracked.T_odom_lidar)[0]
        if number == 1:  # only now is the motion known that distorted the first scan
            self.spans.replace(np.empty((0, 2)))
            first = self.keyframes[back_end.first].stored
            back_end.replace_points(back_end.first, self._stored(located.first_points, first.spans))
        if not located.is_keyframe and not self._refines:
            return False
        stored = self._stored(tracked.points, tracked.spans)
        if not located.is_keyframe:
            return False
        keyframe = Keyframe(
            index=len(self.keyframes),
            scan_index=number,
            stamp_ns=tracked.scan.stamp_ns,
            stored=stored,
            T_odom_lidar=tracked.T_odom_lidar,
            traveled_m=self.traveled_m,
            scale=located.scale,
            noise_m=located.noise_m,
        )
        if located.at_rest is not None:
            self.at_rest[keyframe.index] = located.at_rest
        motion: list[Constraint] = []
        if number:
            Z = lie.between(self.keyframes[-1].T_odom_lidar, keyframe.T_odom_lidar)
            motion.append(Constraint(Odometry(), keyframe.index - 1, Z, located.information))
        back_end.add(keyframe, motion, located.errors, starts_segment=tracked.elsewhere_m > 0.0)
        return True

    def _stored(self, points: Points, spans: tuple[RaySpan, ...]) -> StoredPoints:
        """Points (M, d) of the newest scan, stored in the file."""
        stored = self.points.add(points, spans)
        self.spans.append((stored.first, stored.count))
        return stored

    def _points_of(self, scan: int) -> Points:
        """(M, d) points of a scan, if all scans are kept."""
        return StoredPoints(self.points, *self.spans.rows[scan].tolist()).read()
