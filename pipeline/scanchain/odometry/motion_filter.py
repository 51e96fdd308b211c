"""Errors of motion predictions: their running statistics, and the constant-velocity filter that they drive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose

MEMORY = 0.9  # weight of a running mean so far against the next value
KNOWN = 5  # number of errors needed before their mean square is used
CAUTION = 2.0  # factor from the root mean square of errors to the standard deviation that is used
LEAST_SIGMAS = (0.002, 0.0005)  # m and rad, smallest standard deviation of a prior or a match
_SUDDEN = 0.25  # share of the last squared error below which the mean does not fall


class ErrorStatistics:
    """Prediction error statistics: a running mean of squared errors for each component of a twist."""

    def __init__(self, first_sigma: NDArray[np.float64]) -> None:
        """first_sigma : (k,) standard deviations until enough errors are known, and their upper limit."""
        self.first_sigma = first_sigma
        self.covariance = np.diag(first_sigma**2)  # (k, k) of the next prediction, conservative
        self.least = (lie.by_component(len(first_sigma), *LEAST_SIGMAS) ** 2).tolist()
        self.most = (first_sigma**2).tolist()
        self.squares = [0.0] * len(first_sigma)
        self.count = 0

    def update(self, error: NDArray[np.float64], variance: NDArray[np.float64]) -> None:
        """Add the error (k,) of a prediction against a match, whose variance (k,) is subtracted."""
        self.count += 1
        gain = max(1.0 - MEMORY, 1.0 / self.count)
        for m, (e, of_match) in enumerate(zip(error.tolist(), variance.tolist(), strict=True)):
            square = max(e * e - of_match, 0.0)
            self.squares[m] = max(self.squares[m] + gain * (square - self.squares[m]), _SUDDEN * square)
        if self.count >= KNOWN:
            bounds = zip(self.squares, self.least, self.most, strict=True)
            self.covariance = np.diag([min(max(CAUTION**2 * s, least), most) for s, least, most in bounds])


class MotionFilter:
    """Kalman filter at constant velocity: the pose advances by the motion, which changes by noise alone.

    A match measures the pose, and corrects the motion by their cross-covariance: after a slightly wrong match, the
    next one, which is right again, does not reverse the motion.

    motion : T_previous_current, (d+1, d+1), over one scan
    pose_covariance, motion_covariance : (k, k) of twists in the lidar's own frame
    covariance : (k, k) cross-covariance, pose by motion
    """

    def __init__(self, any_motion: Matrix) -> None:
        """any_motion : (k, k) covariance of the motion before the first correction."""
        self.any_motion = any_motion
        self.nothing = np.zeros_like(any_motion)
        self.begin(lie.identity(2 if len(any_motion) == 3 else 3))

    def begin(self, motion: Pose) -> None:
        """Start from a given pose and a motion of covariance ``any_motion``."""
        self.motion = motion
        self.motion_covariance = self.any_motion
        self.pose_covariance = self.covariance = self.nothing

    def turn(self, rotation: NDArray[np.float64]) -> None:
        """Set the rotation (r,) of the motion to one that is measured; its error is in the noise."""
        twist, d = lie.log(self.motion), -len(rotation)
        twist[d:] = rotation
        self.motion = lie.exp(twist)
        self.motion_covariance, self.covariance = self.motion_covariance.copy(), self.covariance.copy()
        self.motion_covariance[d:] = self.motion_covariance[:, d:] = self.covariance[:, d:] = 0.0

    def correct(self, innovation: NDArray[np.float64], information: Matrix, noise: Matrix) -> None:
        """Update by a measured pose: its innovation (k,) and information (k, k)."""
        pose, covariance, motion = self.predicted(noise)
        known = np.linalg.inv(np.linalg.inv(pose) + information)
        gain = np.linalg.solve(pose, covariance).T  # of the motion, per correction of the pose
        self.motion = lie.normalize(self.motion @ lie.exp(gain @ known @ information @ innovation))
        self.pose_covariance = known
        self.covariance = known @ gain.T
        self.motion_covariance = motion - gain @ (pose - known) @ gain.T

    def predicted(self, noise: Matrix) -> tuple[Matrix, Matrix, Matrix]:
        """Covariances (k, k) of the next pose, between pose and motion, and of the motion with its noise added."""
        motion = self.motion_covariance + noise
        A = lie.adjoint(lie.inverse(self.motion))
        covariance = A @ self.covariance
        pose = A @ self.pose_covariance @ A.T + covariance + covariance.T + motion
        return pose, covariance + motion, motion
