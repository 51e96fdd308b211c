"""Global localization in a map: odometry, joined to the map by loop closures once its location is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import checks, lie
from scanchain.config import Config
from scanchain.data import Closure, Keyframe, Matrix, Pose, Scan, State, Step, Trajectory, brief
from scanchain.errors import counted
from scanchain.evaluation.consistency import edge_errors, with_map_errors
from scanchain.graph.odometry_errors import JUMP_SIGMAS
from scanchain.loops.evidence import is_in_sight
from scanchain.maps import SavedMap, open_saved_map
from scanchain.placement import loop_information
from scanchain.preprocess import Prepared
from scanchain.slam import Slam, SlamResult

_RECENT_KEYFRAMES = 3  # largest number since the last match with the map for a scan to count as localized
INITIAL_SIGMAS = (2.0, 0.35)  # m and rad, standard deviations of a pose that the user gives


class MapState(StrEnum):
    """What is known about the pose of a scan in the map."""

    SEARCHING = "searching"
    LOCALIZED = "localized"
    UNMATCHED = "not matched to the map"
    OUTSIDE = "outside of the map"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Placed:
    """A scan with its pose in the map as estimated online.

    state : how the pose is known; while ``LOST`` it is only predicted
    T_map_lidar : pose in the map's frame, None while ``SEARCHING``
    covariance : (k, k) of a twist in the lidar's own frame, None while ``SEARCHING``
    step : its odometry and its closures with the map
    """

    __repr__ = brief
    state: MapState
    T_map_lidar: Pose | None
    covariance: Matrix | None
    step: Step


@dataclass(frozen=True, slots=True)
class Localization:
    """A log localized in a map, after its last scan.

    states : (N,) online state of every scan
    is_placed : (N,) bool, scans that are connected to the map in the end, also those before it was found
    trajectory : final T_map_lidar of every scan; meaningless where not ``is_placed``
    live : (N, d+1, d+1) poses as estimated online, NaN while searching
    sigma_m : (N,) standard deviation of the live position, NaN while searching
    final_sigma_m : (N,) of the final position, NaN where not placed
    traveled_m : (N,) length of the path up to each scan, by odometry
    closures : tried with keyframes of the map, accepted or not
    result : of the whole SLAM chain, keyframes of the map first
    """

    __repr__ = brief
    states: NDArray[np.str_]
    is_placed: NDArray[np.bool_]
    trajectory: Trajectory
    live: Matrix
    sigma_m: NDArray[np.float64]
    final_sigma_m: NDArray[np.float64]
    traveled_m: NDArray[np.float64]
    closures: tuple[Closure, ...]
    result: SlamResult

    @property
    def placed(self) -> Trajectory:
        """The final trajectory of the scans that are placed."""
        return Trajectory(self.trajectory.stamps_ns[self.is_placed], self.trajectory.poses[self.is_placed])

    @property
    def found_at(self) -> int:
        """The first scan whose pose in the map was known online, −1 if there is none."""
        known = np.flatnonzero(self.states != MapState.SEARCHING)
        return int(known[0]) if len(known) and self.is_placed.any() else -1


class Localizer:
    """Localizes the scans of a log in a map, which stays unchanged.

    Until its location is found, the log is tracked by odometry alone. Then every keyframe is matched to the map
    around it, and every scan to those before; matches with the map that contradict the others are rejected.
    """

    def __init__(
        self,
        prior: SavedMap | Path | str,
        config: Config | None = None,
        T_base_lidar: Pose | None = None,
        *,
        initial: Pose | None = None,
        points_file: Path | None = None,
        is_live: bool = True,
    ) -> None:
        """Start in a map.

        prior : the map, or the run directory that holds it
        config, T_base_lidar, points_file : as in ``Slam``
        is_live : whether a search of a large map is spread over several scans, so that no scan waits for it; else
            it is completed at once, which localizes the log after a shorter path
        initial : T_map_lidar of the first scan if known to within a few meters and 20°
        Raises InputError for a map that cannot be read.
        """
        self.map = prior if isinstance(prior, SavedMap) else open_saved_map(checks.path(prior, "prior"))
        dimension = self.map.dimension
        self.slam = Slam(config, T_base_lidar, points_file, dimension=dimension, prior=self.map, is_live=is_live)
        self.initial = None if initial is None else checks.pose(initial, "initial", dimension)
        self.states: list[MapState] = []
        self.live: list[Pose] = []
        self.sigma_m: list[float] = []
        self.traveled_m: list[float] = []
        self.start_m = self.slam.back_end.start_m
        self.is_in_map = False
        self.state = MapState.SEARCHING  # of the newest keyframe
        self.covariance = np.empty((0, 0))  # of its pose without its own error, once it is in the map
        self.own = self.covariance  # covariance of its own error
        self.by_map: Closure | None = None  # the latest match with the map

    def __repr__(self) -> str:
        state = self.states[-1] if self.states else MapState.SEARCHING
        return f"{type(self).__name__}({counted(len(self.states), 'scan')} in {self.map.name!r}: {state})"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about rejected wheel odometry and defects of an IMU."""
        return self.slam.front_end.odometry.predictor.warnings()

    def process(self, scan: Scan | Prepared) -> Placed:
        """Localize one scan of a log."""
        step = self.slam.process(scan)
        if self.initial is not None and len(self.states) == 0:
            self.slam.back_end.placement.begin_at(self.initial, INITIAL_SIGMAS)
        placed = self._placed(step)
        T, covariance = placed.T_map_lidar, placed.covariance
        variances = [np.nan] if covariance is None else covariance.diagonal()[: self.slam.dimension].tolist()
        self.states.append(placed.state)
        self.live.append(np.full(step.T_odom_lidar.shape, np.nan) if T is None else T)
        self.sigma_m.append(math.sqrt(sum(variances)))
        self.traveled_m.append(self.slam.traveled_m - self.start_m)
        return placed

    def finish(self) -> Localization:
        """Complete matching and smooth the whole path; scans from before the log was found are placed, too."""
        result, first = self.slam.finish(), self.slam.back_end.first
        scans = [keyframe.scan_index for keyframe in result.keyframes[first:]]
        keyframe_of = np.searchsorted(scans, np.arange(len(result.trajectory)), side="right") - 1
        is_placed = (result.components[first:] == result.components[0])[keyframe_of]
        final_sigma_m = np.full(len(is_placed), np.nan)
        if is_placed.any():
            graph, own = with_map_errors(result.graph, result.map_errors, self.slam.config)  # the map is fixed
            own[first] = 0.0
            variances = np.diagonal((graph.covariances() + own)[first:], axis1=1, axis2=2)[:, : graph.dimension]
            final_sigma_m[is_placed] = np.sqrt(variances.sum(axis=1))[keyframe_of[is_placed]]
        return Localization(
            states=np.array(self.states, np.str_),
            is_placed=is_placed,
            trajectory=result.trajectory,
            live=np.array(self.live),
            sigma_m=np.array(self.sigma_m),
            final_sigma_m=final_sigma_m,
            traveled_m=np.array(self.traveled_m),
            closures=tuple(each for each in result.closures if each.target < first),
            result=result,
        )

    def _placed(self, step: Step) -> Placed:
        placement = self.slam.back_end.placement
        if step.closures or step.graph is not None or step.starts_segment or not self.states:
            self.is_in_map = placement.is_in_map
        if not self.is_in_map:
            self.covariance = np.empty((0, 0))
            return Placed(MapState.SEARCHING, None, None, step)
        if step.keyframe >= 0 or not len(self.covariance):
            self._follow()
        T_map_lidar = placement.T_world_odom @ step.T_odom_lidar
        covariance = _moved(self.covariance, self.slam.keyframes[-1], step.T_odom_lidar) + self.own
        jump = self.slam.front_end.lost * np.array(JUMP_SIGMAS)  # by scans lost since the keyframe
        covariance += np.diag(lie.by_component(len(covariance), *jump) ** 2)
        return Placed(MapState.LOST if step.state is State.LOST else self.state, T_map_lidar, covariance, step)

    def _follow(self) -> None:
        """State and covariance of the newest keyframe: by its match with the map, or by the motion to it."""
        back_end, by_map = self.slam.back_end, self.slam.back_end.placement.by_map
        graph, keyframes, newest = back_end.graph, back_end.keyframes, back_end.keyframes[-1]
        of_newest = (graph.edges[:, 1] == newest.index) & graph.is_odometry
        information = graph.added_since(int(np.flatnonzero(of_newest)[-1]))[1][:1]
        motion, own = self._errors(information, newest.index, is_loop=False)
        if by_map is not None and (by_map is not self.by_map or not len(self.covariance)):
            loop = loop_information(by_map, back_end.config.loops)[None]
            matched = self._errors(loop, by_map.source, is_loop=True)[0]
            self.covariance = _moved(matched, keyframes[by_map.source], newest.T_odom_lidar)
        elif by_map is None and not len(self.covariance):
            self.covariance = np.diag(lie.by_component(graph.freedom, *INITIAL_SIGMAS) ** 2)
        else:
            self.covariance = _moved(self.covariance, keyframes[-2], newest.T_odom_lidar) + motion
        self.by_map, self.own = by_map, own
        if by_map is not None and newest.index - by_map.source <= _RECENT_KEYFRAMES:
            self.state = MapState.LOCALIZED
        else:
            placed = replace(newest, T_odom_lidar=graph.poses[-1])
            is_known = is_in_sight(placed, keyframes[: back_end.first])
            self.state = MapState.UNMATCHED if is_known else MapState.OUTSIDE

    def _errors(self, information: Matrix, keyframe: int, *, is_loop: bool) -> tuple[Matrix, Matrix]:
        """Covariances (k, k) of an edge to a keyframe, and of that keyframe's own pose error.

        The first keyframe has none of its own: its scan begins the map of odometry.
        """
        back_end = self.slam.back_end
        errors = back_end.errors[keyframe : keyframe + 1]
        edge, own = edge_errors(information, np.array([is_loop]), errors, self.slam.config)
        return edge[0], own[0] if keyframe > back_end.first else np.zeros_like(own[0])


def _moved(covariance: Matrix, keyframe: Keyframe, T_odom_lidar: Pose) -> Matrix:
    """Covariance of a keyframe's pose, transformed to that of another pose at a known motion from it."""
    Ad = lie.adjoint(lie.between(T_odom_lidar, keyframe.T_odom_lidar))
    return Ad @ covariance @ Ad.T
