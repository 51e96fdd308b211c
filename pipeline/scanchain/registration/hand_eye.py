"""How a lidar sits on its base, by the motions of both: hand-eye calibration in closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose

_WINDOW_M, _TURN_M_RAD = 0.3, 0.5  # path of a pair of motions, and that of a turn on the spot
_FEWEST = 6  # pairs, twelve equations, for the four numbers of the plane
_ROUNDS, _USUAL_M, _LEAST_M = 10, 0.02, 0.002  # of the robust regression; residuals at first, and at least
_PRIOR_M, _NOWHERE_M = 1.0, 1e-6  # σ of the place where nothing is known, and of the base's origin
_LARGEST_SHARE = 0.25  # of the motions that is left as residual, above which no mounting explains them
_YAW_RAD, _PLACE_M = np.radians(5.0), 0.05  # largest σ of what is observable
_APART_M, _EXPLAINED = 0.2, 0.5  # place, and share of the residual left, from which on a mounting is another
_LEAST_TURN_RAD, _LEAST_TILT_RAD = (
    1.0,
    np.radians(2.0),
)  # turns that tell which way is up; a tilt, or three σ of it
_LEARNED = 1.2  # growth of the path after which the mounting is estimated once more


class HandEye(NamedTuple):
    """The mounting T_base_lidar (d+1, d+1) by the motions; its place is 0 where it is not observable, z always.

    sigma_rad, sigma_m : of its yaw and its place
    left : share of the residuals as if lidar and base were one that it leaves
    is_mirrored : whether a planar lidar turns against the base, as one does that hangs upside down
    """

    T_base_lidar: Pose
    sigma_rad: float
    sigma_m: float
    left: float
    is_mirrored: bool

    @property
    def is_apart(self) -> bool:
        """True if lidar and base are clearly not one: motions that disagree by far are explained."""
        is_turned = abs(float(lie.yaw(self.T_base_lidar))) > _YAW_RAD + 3.0 * self.sigma_rad
        is_moved = np.linalg.norm(self.T_base_lidar[:2, -1]) > _APART_M
        return bool(is_turned or is_moved) and self.left < _EXPLAINED

    @property
    def text(self) -> str:
        """The mounting in words, with standard deviations."""
        T = lie.lift(self.T_base_lidar)
        yaw_deg, tilt_deg = np.degrees([float(lie.yaw(T)), np.arccos(np.clip(T[2, 2], -1.0, 1.0))])
        tilt = f" and tilted by {tilt_deg:.0f} deg" if tilt_deg > 0.0 else ""
        turned = (
            f"lidar turned by {(yaw_deg + 90.0) % 360.0 - 90.0:.1f} ± {np.degrees(self.sigma_rad):.1f} deg{tilt}"
        )
        if self.sigma_m >= _PLACE_M:
            return f"{turned}; its place is not observable: the log hardly turns"
        ahead, aside = "ahead of" if T[0, 3] >= 0.0 else "behind", "left" if T[1, 3] >= 0.0 else "right"
        place = f"{abs(T[0, 3]):.2f} m {ahead} the base, {abs(T[1, 3]):.2f} m to its {aside}"
        return f"{turned}, {place} (± {self.sigma_m:.2f} m)"


def hand_eye(poses: Matrix, wheels: Matrix) -> HandEye | None:
    """The mounting of a lidar with poses (N, d+1, d+1) on a base with poses by its wheels, NaN where unknown.

    Motions B of the base and L of the lidar over a path have B X = X L, X the mounting. In the plane, with t the
    place, θ the turn and (a, b) = ρ (cos φ, sin φ) the yaw φ and the scale ρ of the wheels,
        (R(θ) − I) ρ t − [a, −b; b, a] t_L = −t_B
    is linear in four numbers (after Censi, Franchi, Marchionni & Oriolo 2013), solved by reweighted least squares
    (Cauchy). In space, the lidar is leveled first: it turns about the vertical of the base.
    None where no mounting explains them, or several do: at rest, in one curve or on the spot.
    """
    is_planar, poses, wheels = poses.shape[-1] == 3, lie.lift(poses), lie.lift(wheels)
    first, last = _pairs(poses, wheels)
    if len(first) < _FEWEST:
        return None
    B, L = (lie.between(each[first], each[last]) for each in (wheels, poses))
    turned = lie.log(L)[:, 3:]
    R_level = _leveling(lie.log(B)[:, 5], turned)
    theta, (x, y) = turned @ R_level[2], (L[:, :3, 3] @ R_level.T)[:, :2].T
    c, s = np.cos(theta) - 1.0, np.sin(theta)
    J = np.stack([np.stack([c, -s, -x, y], axis=1), np.stack([s, c, -y, -x], axis=1)], axis=1)  # (M, 2, 4)
    z = -B[:, :2, 3]
    covariance, p, residual_m = _solved(J, z, _PRIOR_M)
    sigma_m, scale = float(np.sqrt(covariance[:2, :2].diagonal().max())), float(np.hypot(*p[2:]))
    if scale < _LARGEST_SHARE:
        return None
    across = np.array([-p[3], p[2]]) / scale**2  # the yaw's derivative
    sigma_rad = float(np.sqrt(across @ covariance[2:, 2:] @ across))
    if sigma_m >= _PLACE_M:
        _, p, residual_m = _solved(J, z, _NOWHERE_M)
    moved_m = float(np.median(np.hypot(*z.T) + _TURN_M_RAD * np.abs(theta)))
    if residual_m > _LARGEST_SHARE * moved_m or sigma_rad > _YAW_RAD:
        return None
    T = lie.lift(lie.pose_2d(*(p[:2] / scale * (sigma_m < _PLACE_M)), float(np.arctan2(p[3], p[2]))))
    left = residual_m / float(np.median(np.linalg.norm(z - J @ [0.0, 0.0, 1.0, 0.0], axis=1)))
    if is_planar:
        return HandEye(lie.flatten(T), sigma_rad, sigma_m, left, bool(R_level[1, 1] < 0.0))
    T[:3, :3] = T[:3, :3] @ R_level
    return HandEye(T, sigma_rad, sigma_m, left, is_mirrored=False)


def _pairs(poses: Matrix, wheels: Matrix) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last scans of pieces of the path between which all is known, and at whose ends something moved."""
    is_known = np.isfinite(wheels[:, 0, 0])
    unknown, wheels = np.cumsum(~is_known), np.where(is_known[:, None, None], wheels, np.eye(4))

    def path_m(first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.float64]:
        motions = np.stack([lie.between(each[first], each[last]) for each in (poses, wheels)])
        turns = _TURN_M_RAD * lie.rotation_angle(motions)
        return np.max(np.linalg.norm(motions[..., :3, 3], axis=-1) + turns, axis=0)

    each = np.arange(len(poses) - 1)
    steps_m = np.minimum(path_m(each, each + 1) * (is_known[1:] & is_known[:-1]), _WINDOW_M)
    pieces = np.floor(np.cumsum(np.append(0.0, steps_m)) / _WINDOW_M)
    nodes = np.flatnonzero(np.diff(pieces, prepend=-1.0) > 0.0)
    first, last = nodes[:-1], nodes[1:]
    chosen = (path_m(first, last) > 0.5 * _WINDOW_M) & is_known[first] & (unknown[first] == unknown[last])
    return first[chosen], last[chosen]


def _leveling(turn: NDArray[np.float64], turned: Matrix) -> Matrix:
    """Rotation (3, 3) that levels the lidar, by turns (M,) of the base and rotations (M, 3) of the lidar.

    The identity where the base turns too little to say, or where the lidar is level within its σ.
    """
    up, total = turn @ turned, float(turn @ turn)
    if np.abs(turn).sum() < _LEAST_TURN_RAD or np.linalg.norm(up) < 0.5 * total:
        return np.eye(3)
    up /= np.linalg.norm(up)
    off = turned - np.outer(turned @ up, up)
    sigma_rad = float(np.sqrt((off**2).sum() / (2.0 * len(turn) * total)))
    across = float(np.hypot(*up[:2]))
    tilt_rad = np.arctan2(across, up[2])
    if tilt_rad < max(3.0 * sigma_rad, _LEAST_TILT_RAD):
        return np.eye(3)
    axis = [up[1] / across, -up[0] / across, 0.0] if across > _LEAST_M else [1.0, 0.0, 0.0]
    return lie.exp(np.array([0.0, 0.0, 0.0, *(tilt_rad * np.array(axis))]))[:3, :3]


def _solved(J: Matrix, z: Matrix, prior_m: float) -> tuple[Matrix, NDArray[np.float64], float]:
    """Covariance (4, 4) and value (4,) of J (M, 2, 4) p = z (M, 2), the first two 0 ± prior_m; median residual."""
    weight, variance = np.ones(len(z)), _USUAL_M**2
    for _ in range(_ROUNDS):
        H = np.einsum("mij,m,mik->jk", J, weight, J) / variance + np.diag([prior_m**-2.0] * 2 + [1e-6] * 2)
        p = np.linalg.solve(H, np.einsum("mij,m,mi->j", J, weight, z) / variance)
        residuals = np.linalg.norm(z - J @ p, axis=1)
        weight = 1.0 / (1.0 + (residuals / max(1.5 * float(np.median(residuals)), _LEAST_M)) ** 2)
        variance = max(float(weight @ residuals**2) / max(2.0 * float(weight.sum()) - 4.0, 1.0), _LEAST_M**2)
    return np.linalg.inv(H), p, float(np.median(residuals))


class MountingEstimator:
    """The mounting of a lidar that nothing states, by all scans so far, estimated as the path grows.

    Until it is known, the wheels are no prior, except for scans after one whose pose is open.
    """

    def __init__(self) -> None:
        self.poses: list[Pose] = []  # of the lidar
        self.wheels: list[Pose] = []  # of the base, NaN where one of both is not known
        self.path_m = self.due_m = 0.0  # of the lidar, and from which on the next estimate is made
        self.found: HandEye | None = None
        self.is_usable = False  # the wheels, for the next scan

    def take(self, T_odom_lidar: Pose, T_odom_base: Pose | None, *, is_open: bool) -> None:
        """Take the poses of a scan."""
        if T_odom_base is None and not self.poses:
            return  # a log without wheels
        self.path_m += sum(lie.apart(self.poses[-1], T_odom_lidar)) if self.poses else 0.0
        self.poses.append(T_odom_lidar)
        is_known = T_odom_base is not None and not is_open
        self.wheels.append(T_odom_base.copy() if is_known else np.full_like(T_odom_lidar, np.nan))
        if self.path_m >= self.due_m:
            self.due_m = _LEARNED * self.path_m + _WINDOW_M
            self.found = hand_eye(np.array(self.poses), np.array(self.wheels))
        self.is_usable = is_open if self.found is None else not self.found.is_mirrored

    def finish(self) -> str:
        """Estimate it by all scans; what is known of it as a sentence, empty without wheels."""
        if not self.poses:
            return ""
        self.found = hand_eye(np.array(self.poses), np.array(self.wheels))
        if self.found is None:
            return (
                "mounting assumed, as if the lidar sat at the base's origin: the log has no transform, and the "
                "wheels do not show it: at rest, in one curve only, or in other motions than the lidar"
            )
        if self.found.is_mirrored:
            return (
                "the wheels are not used: the lidar turns left where they turn right, as one does that hangs "
                "upside down (--log.upside_down true); the log has no transform"
            )
        return f"mounting estimated from the wheels: {self.found.text}; the log has no transform"
