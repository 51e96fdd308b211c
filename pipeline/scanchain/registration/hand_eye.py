"""Mounting of a lidar on its base by the motions of both: hand-eye calibration in closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose

PAIR_M, TURN_M_RAD = 0.3, 0.5  # least path length of a pair of motions; path length per rad of rotation
_FEWEST, _LEARNED = 6, 1.2  # least number of pairs, for four unknowns; growth of it before the next estimate
_USUAL_M, _LEAST_M = 0.02, 0.002  # initial and smallest σ of a residual of the robust regression
_PRIOR = np.diag(np.array([1.0, 1.0, 1e-6, 1e-6]))  # information: position to 1 m, the rest nearly free
_LARGEST_SHARE = 0.25  # residual as a share of the motions, above which no mounting explains them
_YAW_RAD, _PLACE_M = np.radians(5.0), 0.05  # largest σ of an observable yaw and position
OPPOSED = 0.5  # least negative correlation of turns of a mirrored sensor
_LEAST_TURN_RAD = 0.3  # least turn to find a lidar upside down
_APART_M, _EXPLAINED = 0.2, 0.5  # least offset and largest ``left`` of a mounting other than identity


class HandEye(NamedTuple):
    """The mounting T_base_lidar (d+1, d+1) from motions: level, its position 0 where not observable, z always 0.

    sigma_rad, sigma_m : standard deviations of its yaw and position
    left : its residual as a share of that of the identity mounting
    """

    T_base_lidar: Pose
    sigma_rad: float
    sigma_m: float
    left: float

    @property
    def is_mirrored(self) -> bool:
        """True if a planar lidar turns opposite to the base, as when mounted upside down."""
        return len(self.T_base_lidar) == 3 and bool(np.linalg.det(self.T_base_lidar) < 0.0)

    @property
    def is_apart(self) -> bool:
        """True if the mounting clearly differs from the identity and explains the motions far better."""
        is_turned = abs(float(lie.yaw(self.T_base_lidar))) > _YAW_RAD + 3.0 * self.sigma_rad
        is_moved = np.linalg.norm(self.T_base_lidar[:2, -1]) > _APART_M
        return bool(is_turned or is_moved) and self.left < _EXPLAINED

    @property
    def text(self) -> str:
        """The mounting in words, with standard deviations."""
        yaw_deg = (float(np.degrees(lie.yaw(self.T_base_lidar))) + 90.0) % 360.0 - 90.0
        turned = f"lidar turned by {yaw_deg:.1f} ± {np.degrees(self.sigma_rad):.1f} deg"
        if len(self.T_base_lidar) == 4:
            turned += f" and {'upside down' if self.T_base_lidar[2, 2] < 0.0 else 'upright'}, assumed level"
        if self.sigma_m >= _PLACE_M:
            return f"{turned}; its position is not observable: the log hardly turns"
        x_m, y_m = self.T_base_lidar[:2, -1]
        ahead, aside = "ahead of" if x_m >= 0.0 else "behind", "left" if y_m >= 0.0 else "right"
        place = f"{abs(x_m):.2f} m {ahead} the base, {abs(y_m):.2f} m to its {aside}"
        return f"{turned}, {place} (± {self.sigma_m:.2f} m)"


def hand_eye(base: Matrix, lidar: Matrix) -> HandEye | None:
    """The mounting X of a lidar on a base from motions (M, d+1, d+1) of both: B X = X L.

    In the plane, with position t, turn θ and (a, b) = ρ (cos φ, sin φ) of the yaw φ and the scale ρ of the wheels,
        (R(θ) − I) ρ t − [a, −b; b, a] t_L = −t_B
    is linear in four numbers (after Censi, Franchi, Marchionni & Oriolo 2013), solved by reweighted least squares
    (Cauchy). In space the lidar is assumed level, upside down where it turns opposite to the base.
    None where no mounting explains the motions, or several do: at rest, on one curve or turning on the spot.
    """
    if len(base) < _FEWEST:
        return None
    turn, theta = lie.log(base)[:, -1], lie.log(lidar)[:, -1]
    is_opposed = turn @ theta < -OPPOSED * np.linalg.norm(turn) * np.linalg.norm(theta)
    up = -1.0 if is_opposed and np.linalg.norm(turn) > _LEAST_TURN_RAD else 1.0
    c, s, x, y = np.cos(theta) - 1.0, up * np.sin(theta), lidar[:, 0, -1], up * lidar[:, 1, -1]
    J = np.stack([np.stack([c, -s, -x, y], axis=1), np.stack([s, c, -y, -x], axis=1)], axis=1)  # (M, 2, 4)
    z = -base[:, :2, -1]
    covariance, p, residual_m = _solved(J, z)
    sigma_m, scale = float(np.sqrt(covariance[:2, :2].diagonal().max())), float(np.hypot(*p[2:]))
    if scale < _LARGEST_SHARE:
        return None
    across = np.array([-p[3], p[2]]) / scale**2  # derivative of the yaw
    sigma_rad = float(np.sqrt(across @ covariance[2:, 2:] @ across))
    if residual_m > _LARGEST_SHARE * float(np.median(path_m(base))) or sigma_rad > _YAW_RAD:
        return None
    x_m, y_m = p[:2] / scale if sigma_m < _PLACE_M else np.zeros(2)
    T = lie.pose_2d(x_m, y_m, float(np.arctan2(p[3], p[2])))
    T = T @ np.diag([1.0, up, 1.0]) if base.shape[-1] == 3 else lie.lift(T) @ np.diag([1.0, up, up, 1.0])
    as_one_m = float(np.median(np.linalg.norm(z - J @ [0.0, 0.0, 1.0, 0.0], axis=1)))
    return HandEye(T, sigma_rad, sigma_m, residual_m / max(as_one_m, _LEAST_M))


def path_m(motions: Matrix) -> NDArray[np.float64]:
    """Lengths (...) of motions (..., d+1, d+1), turns on the spot included."""
    return np.linalg.norm(motions[..., :-1, -1], axis=-1) + TURN_M_RAD * lie.rotation_angle(motions)


def _solved(J: Matrix, z: Matrix) -> tuple[NDArray[np.floating], NDArray[np.float64], float]:
    """Covariance (4, 4) and value (4,) of J (M, 2, 4) p = z (M, 2), with the prior; median residual."""
    weight, variance = np.ones(len(z)), _USUAL_M**2
    H, p, residuals = np.eye(4), np.zeros(4), np.zeros(len(z))
    for _ in range(10):
        H = np.einsum("mij,m,mik->jk", J, weight, J) / variance + _PRIOR
        p = np.linalg.solve(H, np.einsum("mij,m,mi->j", J, weight, z) / variance)
        residuals = np.linalg.norm(z - J @ p, axis=1)
        weight = 1.0 / (1.0 + (residuals / max(1.5 * float(np.median(residuals)), _LEAST_M)) ** 2)
        variance = max(float(weight @ residuals**2) / max(2.0 * float(weight.sum()) - 4.0, 1.0), _LEAST_M**2)
    return np.linalg.inv(H), p, float(np.median(residuals))


class MountingEstimator:
    """The mounting of a lidar: as stated, or else estimated from the motions of all scans so far.

    Until it is known, wheel odometry is not used as prior, except after a scan whose pose is undetermined.
    """

    def __init__(self, T_base_lidar: Pose, *, is_stated: bool) -> None:
        self.T_base_lidar, self.is_stated = T_base_lidar, is_stated
        self.motions: list[tuple[Pose, Pose]] = []  # of base and lidar
        self.last: tuple[Pose, Pose] | None = None  # their poses at which the next motions begin
        self.has_wheels = False
        self.due = 0  # number of motions above which the next estimate is made
        self.found: HandEye | None = None
        self.is_usable = is_stated  # whether wheel odometry is usable for the next scan

    def update(self, T_odom_lidar: Pose, T_odom_base: Pose | None, *, is_open: bool) -> None:
        """Add the poses of a scan; ``is_open`` if that of the lidar is undetermined."""
        if self.is_stated:
            return
        self.has_wheels |= T_odom_base is not None
        known = None if is_open or T_odom_base is None else (T_odom_base.copy(), T_odom_lidar)
        if known is None or self.last is None:
            self.last = known
        else:
            moved = lie.between(self.last[0], known[0]), lie.between(self.last[1], known[1])
            if max(map(path_m, moved)) >= PAIR_M:
                self.motions.append(moved)
                self.last = known
        if len(self.motions) > self.due:
            self.due = int(_LEARNED * len(self.motions))
            self._estimate()
        self.is_usable = is_open if self.found is None else not self.found.is_mirrored

    def finish(self) -> str:
        """Estimate the mounting from all scans; the result in words, "" where stated or without wheels."""
        if not self.has_wheels:
            return ""
        self._estimate()
        if self.found is None:
            why = "the wheels do not determine it: at rest, on one curve only, or contradicting the lidar"
            return f"mounting assumed, as if the lidar sat at the base's origin: no transform states it, and {why}"
        if self.found.is_mirrored:
            why = "as when mounted upside down, which no transform states: --log.upside_down true"
            return f"the wheels are not used: the lidar turns left where they turn right, {why}"
        return f"mounting estimated from the wheels: {self.found.text}; the log has no transform"

    def _estimate(self) -> None:
        if self.motions:
            self.found = hand_eye(*np.swapaxes(np.array(self.motions), 0, 1))
        if self.found is not None and not self.found.is_mirrored:
            self.T_base_lidar = self.found.T_base_lidar
