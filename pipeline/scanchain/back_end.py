"""Back end: keyframes and constraints between them in, loop closures and optimized poses out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Closure, GraphState, Keyframe, KeyframeErrors, KeyframePoints, Matrix, Pose
from scanchain.errors import InputError, counted
from scanchain.graph.factors import LARGEST_SIGMAS, Factor, Odometry, edge_information
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.schedule import Schedule
from scanchain.loops import LoopCloser
from scanchain.maps import SavedMap
from scanchain.placement import Placement


class Constraint(NamedTuple):
    """A measurement of the pose of a new keyframe.

    factor : what is measured, of ``scanchain.graph.factors`` or a custom one
    i : keyframe from which it is measured, or ``ORIGIN``
    Z : (d+1, d+1) the measurement, T_ij
    information : (m, m) inverse covariance of the m residuals of the factor
    """

    factor: Factor
    i: int
    Z: Pose
    information: Matrix


class BackEnd:
    """Pose graph of keyframes: loops between them, and their location in a prior map.

    It is fed by odometry, and by saved maps that are aligned to another one. The keyframes of a prior map come
    first and stay fixed; ``first`` is the number of the first one after them, ``start_m`` the path length there.
    ``errors`` are those of each keyframe's pose relative to the map that it was aligned to.
    """

    def __init__(
        self,
        config: Config,
        dimension: int,
        *,
        prior: SavedMap | None = None,
        prior_is_final: bool = True,
        is_live: bool = False,
    ) -> None:
        """Begin without keyframes; arguments as in ``Slam``.

        prior_is_final : whether the poses of the map are final; else scans are matched to keyframes of one pass
        """
        self.config, self.is_live = config, is_live
        self.keyframes: list[Keyframe] = []
        self.errors: list[KeyframeErrors] = []
        self.first, self.start_m = 0 if prior is None else len(prior.keyframes), 0.0
        self.graph = PoseGraph(dimension)
        self.nothing = np.zeros((self.graph.freedom,) * 2)  # information of no measurement, covariance of no error
        self.closer = LoopCloser(config, dimension, is_live=is_live)
        schedule = Schedule(self.graph, config.graph, config.maps.voxel_size_m)
        self.placement = Placement(config.loops, self.closer, schedule, self.keyframes, self.first)
        if prior is not None:
            self._add_map(prior, prior_is_final)

    def _add_map(self, prior: SavedMap, is_final: bool) -> None:
        """Add the keyframes of a map as fixed nodes; the location of the next keyframe in it is unknown."""
        dimension = self.graph.dimension
        if prior.dimension != dimension:
            raise InputError(
                f"{prior.folder}: is a {prior.dimension}D map, the log has {dimension}D scans; give a map of the "
                "same kind"
            )
        for keyframe in prior.keyframes:
            self.graph.fix(self.graph.add_pose(keyframe.T_odom_lidar, keyframe.stamp_ns))
        self.keyframes += prior.keyframes
        self.errors += [KeyframeErrors(1.0, self.nothing, 1.0)] * len(prior.keyframes)
        self.start_m = self.closer.add_map(prior.keyframes, prior.folder, is_final=is_final)

    def add(
        self,
        keyframe: Keyframe,
        constraints: Sequence[Constraint],
        errors: KeyframeErrors,
        *,
        starts_segment: bool = False,
    ) -> None:
        """Add a keyframe, whose ``index`` is the number of those before, at the pose that odometry predicts.

        constraints : none for the first keyframe, in a prior map, too; else at least the motion from the last one
        starts_segment : whether that motion is so uncertain that only loops can tell where the keyframe is
        """
        self.keyframes.append(keyframe)
        number, T_odom_lidar = keyframe.index, keyframe.T_odom_lidar
        if number == 0:
            self.graph.add_pose(self.placement.T_world_odom @ T_odom_lidar, keyframe.stamp_ns)
        else:
            T_odom_last = self.keyframes[-2].T_odom_lidar
            self.graph.add_pose(self.placement.predict(T_odom_last, T_odom_lidar), keyframe.stamp_ns)
            if number == self.first:
                starts_segment, errors = True, errors._replace(renewal=1.0)
                # almost no information, so that the graph is connected
                information = edge_information(self.nothing, LARGEST_SIGMAS[0], np.pi)
                Z = lie.between(T_odom_last, T_odom_lidar)
                constraints = [Constraint(Odometry(), self.first - 1, Z, information), *constraints]
        self.errors.append(errors)
        if starts_segment:
            self.placement.start_segment(number)
        for factor, i, Z, information in constraints:
            self.graph.add_factor(factor, number, information, Z, i)

    def replace_points(self, number: int, stored: KeyframePoints) -> None:
        """Replace the points of a keyframe, which were deskewed again."""
        self.keyframes[number] = replace(self.keyframes[number], stored=stored)

    def advance(self, *, is_keyframe: bool) -> tuple[tuple[Closure, ...], GraphState | None]:
        """Closures of the newest keyframe if the scan is one, and of searches that it completes; optimize if due.

        Returns the closures tried, and the state of the graph if more than its end moved.
        """
        if not self.config.loops.enabled:
            return (), None
        closures = self.placement.close(is_keyframe=is_keyframe)
        return closures, self.placement.optimize(is_live=self.is_live)

    def finish(self, progress: Callable[[str], None] = lambda stage: None) -> GraphState:
        """Close the remaining loops and optimize once more; the final state of the graph."""
        if self.config.loops.enabled:
            progress("closing the last loops")
            self.placement.finish()
        progress(f"optimizing the graph of {counted(len(self.keyframes), 'keyframe')}")
        state = self.placement.schedule.finish()
        return self.graph.state() if self.placement.set_apart() else state
