"""Kalman filter of the pose and of the motion from one scan to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose


class MotionFilter:
    """Constant velocity: the pose moves on by the motion, the motion stays but for its noise.

    A match measures the pose. One that is a little off moves the pose, and the motion by as much as their errors
    are known to go together: the next match, which is right again, does not reverse the motion.

    Attributes
    ----------
    motion : T_previous_current, (d+1, d+1), over one scan
    pose_covariance, motion_covariance : (k, k) of twists in the lidar's own frame
    covariance : (k, k) of both, pose by motion
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

    def predicted_covariance(self, noise: NDArray[np.float64]) -> Matrix:
        """(k, k) of the next pose; noise (k,): variances of the motion's change."""
        return self._predicted(noise)[0]

    def correct(self, innovation: NDArray[np.float64], information: Matrix, noise: NDArray[np.float64]) -> None:
        """Take a pose that was measured (k,) away from the predicted one, with this information (k, k)."""
        pose, covariance, motion = self._predicted(noise)
        known = np.linalg.inv(np.linalg.inv(pose) + information)
        gain = np.linalg.solve(pose, covariance).T  # how the motion follows the pose
        self.motion = lie.normalize(self.motion @ lie.exp(gain @ known @ information @ innovation))
        self.pose_covariance = known
        self.covariance = known @ gain.T
        self.motion_covariance = motion - gain @ (pose - known) @ gain.T

    def _predicted(self, noise: NDArray[np.float64]) -> tuple[Matrix, Matrix, Matrix]:
        """Covariances (k, k) of the next pose, of pose and motion, and of the motion."""
        motion = self.motion_covariance + np.diag(noise)
        A = lie.adjoint(lie.inverse(self.motion))
        covariance = A @ self.covariance
        pose = A @ self.pose_covariance @ A.T + covariance + covariance.T + motion
        return pose, covariance + motion, motion
