"""Front end: odometry and the choice of keyframes, independent of the pose graph."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import LEAST_FIT, KeyframeErrors, Matrix, Points, Pose, Scan, State
from scanchain.odometry.keyframe_errors import KeyframeErrorTracker
from scanchain.odometry.odometry import Odometry
from scanchain.odometry.tracked import Tracked
from scanchain.preprocess import Prepared

_MOST_MOTIONS = 64  # largest number of scans whose motions are gathered before they are summed up


class Motion(NamedTuple):
    """The pose of a scan and what is known of its motion: prior and match; ``doubt`` (k, k), None in the plane."""

    T_odom_lidar: Pose
    covariance: Matrix
    is_measured: bool
    information: Matrix
    is_lost: bool
    doubt: Matrix | None


class Located(msgspec.Struct, frozen=True):
    """A scan as odometry placed it, with the state of odometry that the back end needs.

    ``scale`` is that of its voxels, dense scans or not, ``local_map`` (L, d) its map, odom frame, empty unless
    ``is_keyframe``;
    ``information`` (k, k) is that of its motion since the last keyframe, a twist in its own frame, zero unless
    ``is_keyframe``;
    ``errors`` are those of its pose against the map, of the first scan unless ``is_keyframe``;
    ``first_points`` (M, d) are those of the first scan, which the second may have deskewed again.
    """

    tracked: Tracked
    is_keyframe: bool
    scale: float
    local_map: Points
    information: Matrix
    errors: KeyframeErrors
    first_points: Points


class FrontEnd:
    """Odometry and keyframe selection, fed scan by scan; shares nothing with the back end."""

    def __init__(self, config: Config, T_base_lidar: Pose) -> None:
        self.config = config.odometry
        self.odometry = Odometry(config, T_base_lidar)
        self.T_odom_keyframe = lie.identity(self.odometry.dimension)
        self.T_odom_last = lie.identity(self.odometry.dimension)
        self.at_keyframe = np.zeros((lie.twist_size(T_base_lidar),) * 2)
        self.covariance: Matrix | None = self.at_keyframe  # of the motion since the keyframe, None where unknown
        self.doubt = self.at_keyframe  # of the motion, by scans that their correspondences contradict
        self.error_tracker = KeyframeErrorTracker(len(self.at_keyframe))
        self.errors = KeyframeErrors(1.0, self.at_keyframe, 0.0)  # of the last keyframe
        self.has_wheels = False
        self.since_keyframe = 0
        self.scans = 0
        self.no_points = np.empty((0, self.odometry.dimension))
        self.motions: list[Motion] = []  # of the last scans, not summed up yet
        self.since = self.at_keyframe  # information of the motion since the keyframe, but for those

    def locate(self, scan: Scan | Prepared) -> Located:
        """Place one scan by odometry; it becomes a keyframe where it moved far enough from the last one."""
        tracked = self.odometry.place(scan)
        is_keyframe = not self.scans or tracked.elsewhere_m > 0.0 or self._moved_enough(tracked)
        self.scans += 1
        if not tracked.is_repeated:
            self._take(tracked)
            self.error_tracker.take(tracked)
        information = self.sum_up() if is_keyframe else self.at_keyframe
        if is_keyframe:
            self.errors = self.error_tracker.at_keyframe(tracked, self.T_odom_keyframe)
            self.T_odom_keyframe = tracked.T_odom_lidar
            self.covariance, self.since_keyframe = self.at_keyframe, 0
            self.doubt = self.at_keyframe
        local_map = self.odometry.local_map
        return Located(
            tracked=tracked,
            is_keyframe=is_keyframe,
            scale=self.odometry.resolution.octave,
            local_map=local_map.points() if is_keyframe else self.no_points,
            information=information,
            errors=self.errors,
            first_points=self.odometry.first_points,
        )

    def sum_up(self) -> Matrix:
        """Sum up the motions gathered; information (k, k) of that of the last scan since the last keyframe."""
        for motion in self.motions:
            self.since = self._since(motion)
        self.motions = []
        return self.since

    def _take(self, tracked: Tracked) -> None:
        """Gather a motion: the sum is for keyframes alone, and quicker at once than one scan at a time."""
        is_lost, prior, information = tracked.state is State.LOST, tracked.prior, tracked.match.information
        doubt = _doubt_of(tracked) if self.odometry.dimension == 3 else None
        self.motions.append(
            Motion(tracked.T_odom_lidar, prior.covariance, prior.is_measured, information, is_lost, doubt)
        )
        if len(self.motions) >= _MOST_MOTIONS:
            self.sum_up()

    def _since(self, motion: Motion) -> Matrix:
        """Information of a motion since the last keyframe: of the match, and of all predictions since.

        The wheels' errors go on from scan to scan, so that their standard deviations add up, not the variances; so
        do those of scans between that have no reading. Without wheels the match is all there is.
        """
        self.since_keyframe += 1
        self.has_wheels |= motion.is_measured
        if not self.has_wheels:
            self.covariance = None
        T_last, self.T_odom_last = self.T_odom_last, motion.T_odom_lidar
        if self.covariance is None and motion.doubt is None:
            return motion.information
        n = self.since_keyframe
        Ad = lie.adjoint(lie.inverse(lie.between(T_last, motion.T_odom_lidar)))
        if motion.doubt is not None:
            self.doubt = Ad @ self.doubt @ Ad.T + motion.doubt
        if self.covariance is None:
            return self._doubted(motion.information)
        predicted = n * motion.covariance
        if n > 1:
            predicted = predicted + (n / (n - 1) * Ad).dot(self.covariance).dot(Ad.T)
        information = np.asarray(np.linalg.inv(predicted), np.float64)
        if not motion.is_lost:
            information += motion.information
        self.covariance = np.asarray(np.linalg.inv(information), np.float64)
        return information if motion.doubt is None else self._doubted(information)

    def _doubted(self, information: Matrix) -> Matrix:
        """Information with the doubt added to the covariance."""
        if not self.doubt.any():
            return information
        return np.asarray(
            np.linalg.solve(np.eye(len(information)) + information @ self.doubt, information), np.float64
        )

    def _moved_enough(self, tracked: Tracked) -> bool:
        distance_m, angle_rad = lie.apart(self.T_odom_keyframe, tracked.T_odom_lidar)
        is_far = distance_m > self.config.keyframe_distance_m or angle_rad > self.config.keyframe_angle_rad
        return is_far and tracked.state is not State.LOST


def _doubt_of(tracked: Tracked) -> Matrix:
    """Covariance (k, k) that a scan adds to the motion where its correspondences contradict the pose.

    Such a pose is known no better than predicted, which it is off by the innovation. The map that the next scans
    are aligned to holds this one, so that they inherit its error. In the plane, where most of the poses that so
    few correspondences contradict are right, doubt would let drift gather: there is none.
    """
    prior, match = tracked.prior, tracked.match
    if tracked.state is State.LOST or match.fit >= LEAST_FIT:
        return np.zeros_like(prior.covariance)
    innovation = lie.log(lie.between(prior.T_target_source, match.T_target_source))
    return prior.covariance + np.outer(innovation, innovation)
