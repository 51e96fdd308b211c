"""Front end: odometry and the choice of keyframes, independent of the pose graph."""

from __future__ import annotations

import msgspec
import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import LEAST_FIT, KeyframeErrors, Matrix, Points, Pose, RestForce, Scan, State
from scanchain.graph.factors import edge_information
from scanchain.graph.odometry_errors import JUMP_SIGMAS
from scanchain.kernels.matrices import definite_inverse
from scanchain.odometry.odometry import Odometry, Tracked
from scanchain.preprocess import Prepared

_LATEST = 0.1  # weight of the last scan in the mean of the systematic errors


class Located(msgspec.Struct, frozen=True):
    """A scan as odometry placed it, with the state of odometry that the back end needs.

    ``scale`` is that of its voxels, without the factor for dense scans;
    ``local_map`` (L, d) is its map, odom frame, empty unless ``is_keyframe``;
    ``information`` (k, k) is that of the edge from the last keyframe, a twist in its own frame, zero unless
    ``is_keyframe``;
    ``errors`` are those of the pose of the last keyframe, this scan included, against the map;
    ``first_points`` (M, d) are those of the first scan, deskewed once the second one gives its velocity;
    ``noise_m`` is the standard deviation of the ranges where it is above the one configured, else 0;
    ``at_rest`` is the force of gravity by an accelerometer, None without, and unless ``is_keyframe``.
    """

    tracked: Tracked
    is_keyframe: bool
    scale: float
    local_map: Points
    information: Matrix
    errors: KeyframeErrors
    first_points: Points
    noise_m: float = 0.0
    at_rest: RestForce | None = None


class FrontEnd:
    """Odometry and keyframe selection, fed scan by scan; shares nothing with the back end."""

    def __init__(self, config: Config, T_base_lidar: Pose | None, dimension: int | None = None) -> None:
        self.config = config.odometry
        self.odometry = Odometry(config, T_base_lidar, dimension=dimension)
        self.T_odom_keyframe = lie.identity(self.odometry.dimension)
        self.T_odom_last = lie.identity(self.odometry.dimension)
        self.nothing = np.zeros((lie.twist_size(self.T_odom_last),) * 2)
        self.covariance: Matrix | None = self.nothing  # of the motion since the keyframe, None where unknown
        self.inflation = self.nothing  # covariance that contradicted scans add to that of the motion
        self.error_tracker = KeyframeErrorTracker(len(self.nothing))
        self.errors = KeyframeErrors(1.0, self.nothing, 0.0)  # of the last keyframe
        self.is_measured = False
        self.since_keyframe = 0
        self.lost = 0  # number of scans lost since the keyframe
        self.scans = 0
        self.no_points = np.empty((0, self.odometry.dimension))
        self.information = self.nothing  # of the motion since the keyframe

    def locate(self, scan: Scan | Prepared) -> Located:
        """Place one scan by odometry; it becomes a keyframe where it moved far enough from the last one."""
        tracked = self.odometry.process(scan)
        distance_m, angle_rad = lie.apart(self.T_odom_keyframe, tracked.T_odom_lidar)
        is_far = distance_m > self.config.keyframe_distance_m or angle_rad > self.config.keyframe_angle_rad
        has_moved = is_far and tracked.state is not State.LOST
        is_keyframe = not self.scans or tracked.elsewhere_m > 0.0 or has_moved
        self.scans += 1
        self.lost += tracked.state is State.LOST
        if not tracked.is_repeated:
            self.information = self._since(tracked)
            self.error_tracker.update(tracked)
        information = self.nothing
        if is_keyframe:
            information = self._of_edge(tracked)
            self.errors = self.error_tracker.at_keyframe(tracked, self.T_odom_keyframe)
            self.T_odom_keyframe = tracked.T_odom_lidar
            self.covariance, self.inflation, self.since_keyframe, self.lost = self.nothing, self.nothing, 0, 0
        return Located(
            tracked=tracked,
            is_keyframe=is_keyframe,
            scale=self.odometry.resolution.octave,
            local_map=self.odometry.local_map.points() if is_keyframe else self.no_points,
            information=information,
            errors=self.errors,
            first_points=self.odometry.first_points,
            noise_m=self.odometry.noise_m,
            at_rest=self.odometry.predictor.at_rest(tracked.T_odom_lidar) if is_keyframe else None,
        )

    def _of_edge(self, tracked: Tracked) -> Matrix:
        """Information (k, k) of the edge from the last keyframe to this one, with a floor under its variances."""
        sigmas = self.config.edge_sigma_m, self.config.edge_sigma_rad
        if self.lost:
            sigmas = self.lost * JUMP_SIGMAS[0], self.lost * JUMP_SIGMAS[1]  # of as many scans
        if tracked.elsewhere_m > 0.0:
            sigmas = tracked.elsewhere_m, np.pi
        return edge_information(self.information, *sigmas)

    def _since(self, tracked: Tracked) -> Matrix:
        """Information (k, k) of the motion since the last keyframe, from the match and all predictions since.

        Wheel errors are correlated from scan to scan, so that their standard deviations add up, not the variances,
        for scans without a reading in between, too. An IMU tells by how much the covariance grows. Without either,
        only the match counts.
        """
        prior, of_match = tracked.prior, tracked.match.information
        self.since_keyframe += 1
        self.is_measured |= prior.is_measured
        if not self.is_measured:
            self.covariance = None
        T_last, self.T_odom_last = self.T_odom_last, tracked.T_odom_lidar
        is_planar = self.odometry.dimension == 2
        if self.covariance is None and is_planar:
            return of_match
        n, Ad = self.since_keyframe, lie.adjoint(lie.between(tracked.T_odom_lidar, T_last))
        if not is_planar:
            self.inflation = Ad @ self.inflation @ Ad.T + _inflation_of(tracked)
        if self.covariance is None:
            return self._inflated(of_match)
        predicted, growth = (
            (n * prior.covariance, n / max(n - 1, 1)) if tracked.gained is None else (tracked.gained, 1.0)
        )
        if n > 1:
            predicted = predicted + (growth * Ad).dot(self.covariance).dot(Ad.T)
        information = definite_inverse(predicted)
        if tracked.state is not State.LOST:
            information += of_match
        self.covariance = definite_inverse(information)
        return self._inflated(information)

    def _inflated(self, information: Matrix) -> Matrix:
        """Information after adding the covariance of contradicted scans."""
        if not self.inflation.any():
            return information
        scale = np.eye(len(information)) + information @ self.inflation
        return np.asarray(np.linalg.solve(scale, information), np.float64)


def _inflation_of(tracked: Tracked) -> Matrix:
    """Covariance (k, k) that a scan adds to the motion where its correspondences contradict the pose.

    Such a pose is no more certain than the prediction, from which it differs by the innovation. The next scans are
    aligned to a map that contains this one and inherit its error. It is not used in the plane, where most
    contradicted poses are right and an inflated covariance would let drift accumulate.
    """
    prior, match = tracked.prior, tracked.match
    if tracked.state is State.LOST or match.fit >= LEAST_FIT:
        return np.zeros_like(prior.covariance)
    innovation = lie.log(lie.between(prior.T_target_source, match.T_target_source))
    return prior.covariance + np.outer(innovation, innovation)


class KeyframeErrorTracker:
    """Mean systematic error of the scans, and the share of the map renewed since the last keyframe."""

    def __init__(self, freedom: int) -> None:
        self.systematic = np.zeros((freedom, freedom))
        self.scans = 0  # number of scans in the mean
        self.is_open = False  # whether a pose since the last keyframe was undetermined or lost

    def update(self, tracked: Tracked) -> None:
        """Add a scan. One whose pose is undetermined or contradicted is left out of the mean."""
        match = tracked.match
        if match.observability < 1.0 or tracked.state is State.LOST:
            self.is_open = True
        elif match.fit >= LEAST_FIT and match.systematic.size:
            self.scans += 1
            self.systematic = self.systematic + max(_LATEST, 1.0 / self.scans) * (
                match.systematic - self.systematic
            )

    def at_keyframe(self, tracked: Tracked, T_odom_keyframe: Pose) -> KeyframeErrors:
        """Errors at a new keyframe; the one before has the pose ``T_odom_keyframe``.

        A map as wide as the scans is renewed by the distance over their root mean square range, and by turning,
        since scans need not cover 360°.
        """
        distance_m, angle_rad = lie.apart(T_odom_keyframe, tracked.T_odom_lidar)
        points = tracked.matched
        range_m = float(np.sqrt(np.einsum("ij,ij->", points, points) / max(len(points), 1)))
        renewal = distance_m / max(range_m, 1e-6) + angle_rad / np.pi
        renewal = 1.0 if self.is_open else min(renewal, 1.0)
        self.is_open = False
        factor = 1.0 if tracked.state is State.LOST else tracked.match.variance_factor
        return KeyframeErrors(factor, self.systematic, renewal)
