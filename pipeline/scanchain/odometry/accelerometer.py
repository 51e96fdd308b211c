"""The accelerometer of an IMU: the translation between scans, by a Kalman filter that scan matching corrects."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from scanchain.data import GRAVITY_M_S2, LEAST_FIT, Match, Matrix, Pose, RestForce, Vector, unit_of
from scanchain.odometry.gyro import Gyro
from scanchain.odometry.motion_filter import CAUTION

_MOTIONS = (15, 20)  # least and most whose errors decide whether the accelerometer is used
_RATIO = (0.9, 1.5)  # of its squared errors to those of the last motion, below which it comes, and stays, in use
_DETERMINED = 0.5  # least information of a match about the position, as a share of the largest of one direction
_UNKNOWN_M_S = 1.0  # σ of the velocity above which it is not used
_POSITION_M = 0.003  # least σ of a match
FASTEST_M_S = 40.0  # of any car whose speed is unknown
_GRAVITY_M_S2, _BIAS_M_S2 = 1.0, 0.05  # σ at first: tilted axes, MEMS
_TURNED = 2.0  # σ of the turn of gravity in the drifting odometry frame, in differences of gyro and match
_WALK = 0.001  # random walk of the bias: m/s² per √s
_NOISE_RAD = 0.001  # σ of the rotation of a match, by which gravity appears as an acceleration
_NORM = 0.03  # m/s², σ of the magnitude of gravity
_MOST = 100.0  # largest factor on a variance
_GAIN, _OUTLIER = 0.1, 9.0  # of these factors, and squared innovation in σ² that changes them most
_LEAST = 1e-6  # information along each direction: 1 km
_LEAK = 1e-3  # share of the information that an open direction seems to have if it is off by 2°
_CONTRADICTED = 0.04  # factor on the information of a match that its correspondences contradict
_LEAST_GROWTH_M2 = 1e-8  # of the variance of the position from scan to scan
_P, _V, _G, _B = (slice(at, at + 3) for at in (0, 3, 6, 9))  # position, velocity, gravity, bias in the state


def _block(*at: tuple[int, int]) -> Matrix:
    """(12, 12), the identity in some of its 4 x 4 blocks (position, velocity, gravity, bias), else zero."""
    blocks = np.array([[(i, j) in at for j in range(4)] for i in range(4)])
    return np.kron(blocks, np.eye(3)).astype(np.float64)


_ONCE, _TWICE = _block((0, 1), (1, 2)), _block((0, 2))  # of the motion over a time: position, velocity, gravity
_OF_P, _OF_PV, _OF_V = _block((0, 0)), _block((0, 1), (1, 0)), _block((1, 1))  # of the noise of accelerations
_WALKS = _WALK**2 * _block((3, 3))


class Accelerometer:
    """Translation by an accelerometer and the rotations of the gyro beside it, of a lidar in space.

    State x (12,): position and velocity of the IMU and gravity, in odometry frame, and the bias along the axes of
    the lidar. Velocity and gravity are first unknown; each match measures the position. The variance of the
    prediction grows where innovations have the sign of those before, that of matches where they alternate.
    It is used while it predicts positions better than the last motion continued, as far as matches determine them.
    """

    def __init__(self) -> None:
        self.x, self.P = np.zeros(12), np.zeros((12, 12))
        self.is_tracking = self.is_trusted = False
        self.p_lidar_imu = np.zeros(3)
        self.position = np.zeros(3)  # predicted, of the lidar
        self.covariance = np.zeros((3, 3))  # of it, in the lidar's frame
        self.growth = np.zeros((3, 3))  # of that of the position since the last scan, in the lidar's frame
        self.R_odom_lidar = np.eye(3)  # predicted by the gyro
        self.last_m, self.innovation = np.zeros(3), math.nan  # innovation of the last match; normalized
        self.last_C = np.zeros((3, 3))  # of the last match
        self.of_prediction = self.of_match = 1.0  # factors on variances
        self.errors: deque[tuple[float, float]] = deque(maxlen=_MOTIONS[1])  # ours and the last motion's, σ²
        self.squares, self.compared = np.zeros(2), 0  # sums of all of them in m²
        self.scans, self.used = 0, 0
        self.unit_m_s2, self.defect = 1.0, ""

    @property
    def is_used(self) -> bool:
        """True while it predicts the positions of the last scans better, and the velocity is known."""
        return self.is_trusted and self.is_tracking and self._knows_velocity

    @property
    def _knows_velocity(self) -> bool:
        return float(np.trace(self.P[_V, _V])) < _UNKNOWN_M_S**2

    def at_rest(self, T_odom_lidar: Pose) -> RestForce | None:
        """Specific force at rest in this pose; None while the accelerometer is not used."""
        if not self.is_used:
            return None
        J = np.zeros((3, 12))
        J[:, _G], J[:, _B] = -T_odom_lidar[:3, :3].T, np.eye(3)
        return RestForce(J @ self.x, J @ self.P @ J.T, self.x[_B], self.P[_B, _B])

    def predict(self, T_odom_last: Pose, gyro: Gyro) -> None:
        """Predict the position at a scan from the pose of the last one and the samples since."""
        if gyro.turning is None or gyro.size == 1 or self.defect:
            self.is_tracking = False
            return
        lasted_s, R_odom = gyro.now_s - gyro.last_s, T_odom_last[:3, :3]
        knots_s, R_last, forces = gyro.forces_since_last()
        if not self.is_tracking and not self._begin(T_odom_last, gyro, forces):
            return
        forces = self.unit_m_s2 * forces
        steps_s, left_s = np.diff(knots_s), -0.5 * (knots_s[1:] + knots_s[:-1])
        R = R_odom @ (0.5 * (R_last[1:] + R_last[:-1])) * steps_s[:, None, None]
        changes = np.einsum("nij,nj->ni", R, 0.5 * (forces[1:] + forces[:-1]))
        F = np.eye(12) + lasted_s * _ONCE + 0.5 * lasted_s**2 * _TWICE
        F[_P, _B], F[_V, _B] = -np.einsum("n,nij->ij", left_s, R), -R.sum(axis=0)
        before, self.x = self.P[_P, _P], F @ self.x
        self.x[_P] += left_s @ changes
        self.x[_V] += changes.sum(axis=0)
        self.P = F @ self.P @ F.T + self._noise(lasted_s, forces)
        R_now = self.R_odom_lidar = R_odom @ R_last[-1]
        self.position = self.x[_P] - R_now @ self.p_lidar_imu
        self.covariance = CAUTION**2 * R_now.T @ self.P[_P, _P] @ R_now
        self.growth = R_now.T @ (self.P[_P, _P] - before) @ R_now

    @property
    def gained(self) -> Matrix:
        """Covariance (3, 3) by which that of the position grew since the last scan, in the lidar's frame."""
        growth, axes = np.linalg.eigh(CAUTION**2 * self.growth)
        return (axes * np.maximum(growth, _LEAST_GROWTH_M2)) @ axes.T

    def correct(self, T_odom_lidar: Pose, match: Match | None, continued: Vector) -> None:
        """Update by the pose of a scan that is matched, None if it is lost.

        continued : (3,) position after the last motion again
        """
        self.scans += 1
        self.used += self.is_used
        self.innovation = math.nan
        if not self.is_tracking or match is None:
            return
        R, information = T_odom_lidar[:3, :3], match.information
        if match.fit < LEAST_FIT:
            information = _CONTRADICTED * information
        C = np.linalg.inv(information + _LEAST * np.eye(6))[:3, :3] + _POSITION_M**2 * np.eye(3)
        C = self._without_leaks(R @ C @ R.T)
        weight = np.linalg.inv(0.5 * (C + self.last_C)).astype(np.float64)  # of the motion since the last match
        self.last_C = C.copy()
        self._compare(T_odom_lidar[:3, 3], continued, weight)
        innovation = T_odom_lidar[:3, 3] + R @ self.p_lidar_imu - self.x[_P]
        C *= self.of_match
        weighted = np.linalg.solve(self.P[_P, _P] + C, innovation)
        square = float(innovation @ weighted) / 3.0
        self._adapt(square, persists=float(self.last_m @ weighted) > 0.0)
        self.last_m = innovation
        if self._knows_velocity:
            self.innovation = math.sqrt(square)
        if square > _OUTLIER:
            C += np.outer(innovation, innovation)
        self._update(np.eye(3, 12), innovation, C)
        turn = (
            R @ self.R_odom_lidar.T
        )  # by the match, relative to the gyro, of small angles a: 2 hat(a) = turn − turnᵀ
        turned = 0.5 * _TURNED * (turn - turn.T) @ self.x[_G]
        self.P[_G, _G] += np.outer(turned, turned)
        size, along = float(np.linalg.norm(self.x[_G])), np.zeros((1, 12))
        along[0, _G] = self.x[_G] / size
        self._update(along, np.array([GRAVITY_M_S2 - size]), np.full((1, 1), _NORM**2))

    def warnings(self) -> tuple[str, ...]:
        """Defects of the accelerometer, one per line."""
        lines = ["its accelerations are in g: converted"] if self.unit_m_s2 != 1.0 else []
        return tuple(f"IMU: {line}" for line in (*lines, self.defect) if line)

    def note(self) -> str:
        """Share of the scans that it predicts, and how well, as text; empty if it was never compared."""
        if not self.compared:
            return ""
        ours_m, others_m = np.sqrt(self.squares / self.compared).tolist()
        return (
            f"IMU: its accelerometer predicts the translation of {100.0 * self.used / self.scans:.0f} % of the "
            f"scans, to {ours_m:.2g} m (the last motion continued: {others_m:.2g} m)"
        )

    def _without_leaks(self, C: Matrix) -> Matrix:
        """Covariance (3, 3) of a match, open along the direction that the filter knows least if it nearly is.

        Scans that leave the same direction open take it for slightly different ones: together they would seem to
        measure it (Huang, Mourikis & Roumeliotis 2010).
        """
        axis, information = np.linalg.eigh(self.P[_P, _P])[1][:, -1], np.linalg.inv(C)
        if axis @ information @ axis > _LEAK * np.trace(information):
            return C
        across = np.eye(3) - np.outer(axis, axis)
        return np.linalg.inv(across @ information @ across + _LEAST * np.eye(3)).astype(np.float64)

    def _begin(self, T_odom_last: Pose, gyro: Gyro, forces: Matrix) -> bool:
        """Begin at the last scan with any velocity; False if the samples do not hold gravity."""
        mean = forces.mean(axis=0)
        size = float(np.linalg.norm(mean))
        if not (unit_m_s2 := unit_of(size)):
            self.defect = f"its accelerations do not hold gravity ({size:.2g} m/s²): only its gyro is used"
            return False
        self.p_lidar_imu, self.is_tracking, self.unit_m_s2 = gyro.p_lidar_imu, True, unit_m_s2
        R_odom = T_odom_last[:3, :3]
        self.x = np.zeros(12)
        self.x[_P] = T_odom_last[:3, 3] + R_odom @ self.p_lidar_imu
        self.x[_G] = -self.unit_m_s2 * R_odom @ mean
        self.P = np.diag(np.repeat([_POSITION_M, FASTEST_M_S, _GRAVITY_M_S2, _BIAS_M_S2], 3) ** 2)
        self.of_prediction = self.of_match = 1.0
        return True

    def _noise(self, lasted_s: float, forces: Matrix) -> Matrix:
        """Covariance (12, 12) that the state gains; the noise is that of the differences of samples (K, 3)."""
        of_sample = float(np.mean(np.diff(forces, axis=0) ** 2)) / 2.0 * lasted_s / len(forces)
        density = self.of_prediction * (of_sample + (GRAVITY_M_S2 * _NOISE_RAD) ** 2 * lasted_s)
        of_acceleration = lasted_s**2 / 3.0 * _OF_P + lasted_s / 2.0 * _OF_PV + _OF_V
        return lasted_s * (density * of_acceleration + _WALKS)

    def _compare(self, position: Vector, continued: Vector, weight: Matrix) -> None:
        """Compare the predicted position and the one after the last motion again, where a match is certain."""
        if float(np.trace(weight)) * _POSITION_M**2 < _DETERMINED or not self._knows_velocity:
            return
        ours, others = position - self.position, position - continued
        self.errors.append((float(ours @ weight @ ours), float(others @ weight @ others)))
        self.squares += ours @ ours, others @ others
        self.compared += 1
        if len(self.errors) >= _MOTIONS[0]:
            of_ours, of_others = map(sum, zip(*self.errors, strict=True))
            self.is_trusted = of_ours < _RATIO[self.is_trusted] * of_others

    def _adapt(self, square: float, *, persists: bool) -> None:
        """Adapt the factors on variances to a squared innovation, in σ², which has the last one's sign or not."""
        change = 1.0 + _GAIN * (min(square, _OUTLIER) - 1.0)
        if square < 1.0 or not persists:
            self.of_match = min(max(self.of_match * change, 1.0), _MOST)
        if square < 1.0 or persists:
            self.of_prediction = min(max(self.of_prediction * change, 1.0), _MOST)

    def _update(self, H: Matrix, innovation: Vector, R: Matrix) -> None:
        """Kalman update by m values H x (m, 12) of covariance R (m, m), in Joseph's form."""
        gain = np.linalg.solve(H @ self.P @ H.T + R, H @ self.P).T
        rest = np.eye(12) - gain @ H
        self.x = self.x + gain @ innovation
        self.P = rest @ self.P @ rest.T + gain @ R @ gain.T
