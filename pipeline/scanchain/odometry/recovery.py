"""Recovery: other initial poses where a match fits poorly, wide searches after a loss, and a limit on them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import MatchingConfig
from scanchain.data import LEAST_FIT, Match, Points, Pose, State
from scanchain.odometry.motion_filter import MEMORY
from scanchain.odometry.prediction import Prediction
from scanchain.preprocess import Sweep
from scanchain.registration import Matcher, SearchGrid, VoxelMap, Wanted, Window, find, thinned
from scanchain.registration.align import AMBIGUOUS
from scanchain.registration.plicp import kernel_scale_of
from scanchain.registration.search import evenly, upright_columns

_WIDE_SCANS = 3  # number of scans with a wide search at the start and after a loss, while no velocity is known
_PATIENCE = 5  # number of consecutive lost scans at which the map is extended at the predicted pose
_UNCERTAIN = 2.0  # cost per point over its running mean, above which other initial poses are tried
_ELSEWHERE = 3.0  # cost per point over its running mean, above which a scan after a gap does not fit the map
_ROUGH = 0.05  # share of the cost of a point without a correspondence, below which no match is uncertain
_UNUSUAL = 1.5  # cost per point over its running mean, above which a contradicted pose in space is searched
CLEARLY = 0.8  # share of the cost of the current pose, below which another one replaces it
_SAME_RAD = 0.05  # largest angle between two poses of one minimum; their largest distance is a voxel
_COLUMNS = 300  # columns of upright structure that are scored, evenly spread
_LONG_S = 1.0  # shortest gap after which a robot may have turned around
_NEAR_PERCENT = 95.0  # share of the points within the radius of the map that is searched in space

_Aligned = tuple[Match, NDArray[np.float64] | None]


class Recovery:
    """Alignment of scans, also far from the predicted pose, judged by the running mean of the cost per point."""

    def __init__(self, config: MatchingConfig, matcher: Matcher) -> None:
        self.config, self.matcher = config, matcher
        self.usual_cost = 0.0
        self.wide_scans = _WIDE_SCANS
        self.lost_scans = 0
        self.rough_cost = 0.0  # of a point

    def align(self, points: Points, sweep: Sweep, surfaces: VoxelMap, prediction: Prediction) -> _Aligned:
        """The alignment from the predicted pose or, where that one is uncertain, the best of several.

        Also the twist (k,) to another pose that fits nearly as well, None where there is none.
        points : (N, d) to align; sweep : all points of the scan
        """
        wide = self.wide_scans > 0 or prediction.is_guess
        self.rough_cost = _ROUGH * 0.5 * kernel_scale_of(self.config, surfaces) ** 2
        best = self.matcher.align(points, surfaces, prediction.T_odom_lidar, prediction.prior, wide=wide)
        if wide and not prediction.is_possible(best.T_target_source):
            best = self.matcher.align(points, surfaces, prediction.T_odom_lidar, prediction.prior)
        tried = [best]
        unusual_cost = max(_UNUSUAL * self.usual_cost, self.rough_cost) * best.points
        is_contradicted = surfaces.dimension == 3 and best.fit < LEAST_FIT and best.cost > unusual_cost
        if is_contradicted:
            best = self._searched(tried, points, sweep, surfaces, prediction)
        if not (is_contradicted and is_sound(best)) and self._is_uncertain(best.cost / len(points), prediction):
            for guess in _guesses(points, surfaces, prediction):
                found = self.matcher.align(points, surfaces, guess, wide=True)
                if prediction.is_possible(found.T_target_source):
                    tried.append(found)
                    best = min(best, found, key=lambda match: self._cost(match, prediction))
        rival = None
        if _is_free(prediction):
            best, rival = self._decided(best, tried, surfaces, prediction)
        if surfaces.dimension == 2 or is_sound(best):
            cost = best.cost / len(points)
            self.usual_cost = MEMORY * self.usual_cost + (1.0 - MEMORY) * cost if self.usual_cost else cost
        return best, rival

    def fits_badly(self, match: Match, state: State, usual_cost: float) -> bool:
        """True if a scan without a reliable prediction does not fit the map at the pose found.

        usual_cost : running mean of the cost per point before this scan
        """
        return state is State.LOST or match.cost / match.points > max(_ELSEWHERE * usual_cost, self.rough_cost)

    def needs_extension(self, state: State) -> bool:
        """Update the count of lost scans; True if the map has to be extended at the predicted pose."""
        is_lost = state is State.LOST
        self.lost_scans = self.lost_scans + 1 if is_lost else 0
        self.wide_scans = _WIDE_SCANS if is_lost else max(self.wide_scans - 1, 0)
        return self.lost_scans >= _PATIENCE

    def reset(self) -> None:
        """Reset the running mean of the cost, for a new map."""
        self.usual_cost = 0.0

    def _is_uncertain(self, cost: float, prediction: Prediction) -> bool:
        """True if the cost per point is far above its running mean, and above a share of its maximum."""
        if not self.usual_cost:
            return False
        if prediction.is_guess:
            return cost > self.usual_cost
        return cost > max(_UNCERTAIN * self.usual_cost, self.rough_cost)

    def _searched(
        self, tried: list[Match], points: Points, sweep: Sweep, surfaces: VoxelMap, prediction: Prediction
    ) -> Match:
        """The best alignment in space from poses where upright structure fits, or the given one.

        tried : the given alignment; further ones are appended
        """
        structure = sweep.from_middle(prediction.scan_motion)
        best = tried[0]
        for half_width_m, half_width_rad in prediction.windows():
            radius_m = float(np.percentile(np.abs(structure[:, :2]), _NEAR_PERCENT)) + half_width_m
            window = Window(lie.identity(2), half_width_m, half_width_rad)
            for seed in from_above(structure, surfaces, prediction.T_odom_lidar, window, radius_m):
                if any(_is_near(seed, match.T_target_source, surfaces.voxels.size_m) for match in tried):
                    continue
                match = self.matcher.align(points, surfaces, seed, wide=True)
                if prediction.is_possible(match.T_target_source):
                    tried.append(match)
            found = min(tried, key=lambda match: self._cost(match, prediction))
            if found.observability >= 1.0 and found.cost < CLEARLY * best.cost:
                best = found
            if is_sound(best):
                break
        return best

    def _decided(
        self, best: Match, tried: Sequence[Match], surfaces: VoxelMap, prediction: Prediction
    ) -> _Aligned:
        """The alignment nearest to the prediction among the best and distinct ones that fit nearly as well."""
        distinct = [
            match
            for match in tried
            if match.cost < AMBIGUOUS * best.cost
            and match.inlier_share >= self.config.min_inlier_share
            and is_sound(match)
            and not _is_near(match.T_target_source, best.T_target_source, surfaces.voxels.size_m)
        ]
        if not distinct:
            return best, None
        rival = min(distinct, key=lambda match: _away(match, prediction))
        if _away(rival, prediction) < _away(best, prediction):
            best, rival = rival, best
        return best, lie.log(lie.between(best.T_target_source, rival.T_target_source))

    def _cost(self, match: Match, prediction: Prediction) -> float:
        """Cost of a match plus that of its distance from the predicted pose, m²."""
        return match.cost + 0.5 * self.config.sensor_noise_m**2 * _away(match, prediction)


def _is_free(prediction: Prediction) -> bool:
    """True after so long a gap that any motion within the search window is possible; False for uneven stamps."""
    return prediction.is_guess and prediction.interval_s > _LONG_S


def _away(match: Match, prediction: Prediction) -> float:
    """Squared distance from the predicted pose, in units of the largest standard deviations of a prediction."""
    prior = prediction.prior
    away = lie.log(lie.between(prior.T_target_source, match.T_target_source)) / prior.widest
    return float(away @ away)


def from_above(
    structure: Points, surfaces: VoxelMap, T_predicted: Pose, window: Window, radius_m: float
) -> Iterator[Pose]:
    """Initial poses in space, the best first: upright structure of scan and map projected along the lidar's z.

    window : of the motion in its xy plane; radius_m : half the side of the square of the map that is used
    """
    size_m = surfaces.voxels.size_m
    means = lie.transform(lie.inverse(T_predicted), surfaces.points())
    near = means[np.abs(means[:, :2]).max(axis=1, initial=0.0) <= radius_m]
    grid = SearchGrid.of_points(upright_columns(near, size_m), size_m)
    columns = evenly(upright_columns(structure, size_m), _COLUMNS)
    for found in find(columns, grid, window, Wanted(apart_m=3.0 * size_m, rival=0.6, answers=3)):
        yield T_predicted @ lie.lift(found.T_target_source)


def is_sound(match: Match) -> bool:
    """True if the correspondences determine the pose and agree with it."""
    return match.fit >= LEAST_FIT and match.observability >= 1.0


def _is_near(T: Pose, T_other: Pose, size_m: float) -> bool:
    """True if two poses are so close that they belong to one minimum."""
    return lie.agree(T, T_other, size_m, _SAME_RAD)


def _guesses(points: Points, surfaces: VoxelMap, prediction: Prediction) -> tuple[Pose, ...]:
    """Other initial poses; in the plane also the best ones in a window around the predicted pose."""
    alternatives = prediction.alternatives()
    if surfaces.dimension == 3:
        return alternatives
    ((half_width_m, half_width_rad),) = prediction.windows()
    reach_m = float(np.abs(points).max()) * math.sqrt(2.0) + half_width_m
    T_predicted = prediction.T_odom_lidar
    grid = SearchGrid.of_voxels(surfaces, T_predicted, reach_m)
    wanted = Wanted(apart_m=1.0, rival=0.8, answers=2 if _is_free(prediction) else 1)
    window = Window(T_predicted, half_width_m, half_width_rad)
    seeds = find(thinned(points, grid.resolution_m), grid, window, wanted)
    return (*alternatives, *(seed.T_target_source for seed in seeds))
