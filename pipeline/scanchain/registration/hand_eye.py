"""How a lidar sits on its base, by the motions of both: hand-eye calibration in closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose

_WINDOW_M, _TURN_M_RAD = 0.3, 0.5  # path of a pair of motions, and that of a turn on the spot
_FEWEST = 6  # pairs, twelve equations, for the four numbers of the plane
_ROUNDS = 10  # of the robust regression
_USUAL_M, _LEAST_M = 0.02, 0.002  # residuals at first, and at least
_PRIOR_M, _NOWHERE_M = 1.0, 1e-6  # σ of the place where nothing is known, and of the base's origin
_LARGEST_RESIDUAL = 0.25  # of the motions, above which no mounting explains them
_YAW_RAD, _PLACE_M = np.radians(5.0), 0.05  # largest σ of what is observable
_APART_M, _EXPLAINED = 0.2, 0.5  # place, and share of the residual left, from which on a mounting is another
_LEAST_TURN_RAD, _LEAST_OPPOSED = 1.0, 0.5  # turns in all, and share of them, that tell which way is up
_LEARNED = 1.2  # growth of the path after which the mounting is estimated once more
_SIGMAS, _LEAST_TILT_RAD = 3.0, np.radians(2.0)  # of a tilt that is one


class HandEye(NamedTuple):
    """The mounting by the motions.

    T_base_lidar : (d+1, d+1), the place at the base's origin where it is not observable, as its height never is
    sigma_rad, sigma_m : of its yaw and its place
    residual_m, unmounted_m : medians over the pairs of motions, with it and as if lidar and base were one
    is_mirrored : whether a planar lidar turns left where the base turns right, as one does that hangs upside down
    """

    T_base_lidar: Pose
    sigma_rad: float
    sigma_m: float
    residual_m: float
    unmounted_m: float
    is_mirrored: bool

    @property
    def has_place(self) -> bool:
        """True if the motions show where the lidar sits: the base turned enough."""
        return self.sigma_m < _PLACE_M

    @property
    def is_apart(self) -> bool:
        """True if lidar and base are clearly not one: motions that disagree by far are explained."""
        yaw_rad, place_m = abs(float(lie.yaw(self.T_base_lidar))), float(np.linalg.norm(self.T_base_lidar[:2, -1]))
        is_turned = yaw_rad > max(_YAW_RAD, _SIGMAS * self.sigma_rad)
        is_moved = self.has_place and place_m > max(_APART_M, _SIGMAS * self.sigma_m)
        return (is_turned or is_moved) and self.residual_m < _EXPLAINED * self.unmounted_m

    @property
    def text(self) -> str:
        """The mounting in words, with standard deviations."""
        T = self.T_base_lidar
        tilt_rad = float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        tilt = f" and tilted by {np.degrees(tilt_rad):.0f} deg" if tilt_rad > 0.0 else ""
        yaw_deg = (float(np.degrees(lie.yaw(T))) + 90.0) % 360.0 - 90.0
        turned = f"lidar turned by {yaw_deg:.1f} ± {np.degrees(self.sigma_rad):.1f} deg{tilt}"
        if not self.has_place:
            return f"{turned}; its place is not observable: the log hardly turns"
        x_m, y_m = T[:2, -1].tolist()
        ahead, aside = "ahead of" if x_m >= 0.0 else "behind", "left" if y_m >= 0.0 else "right"
        return f"{turned}, {abs(x_m):.2f} m {ahead} the base, {abs(y_m):.2f} m to its {aside} (± {self.sigma_m:.2f} m)"


def hand_eye(poses: Matrix, wheels: Matrix) -> HandEye | None:
    """The mounting of a lidar with poses (N, d+1, d+1) on a base with poses by its wheels, NaN where unknown.

    Motions B of the base and L of the lidar over a path have B X = X L, X the mounting. In the plane, with t the
    place, θ the turn and (a, b) = ρ (cos φ, sin φ) the yaw φ and the scale ρ of the wheels,
        (R(θ) − I) ρ t − [a, −b; b, a] t_L = −t_B
    is linear in four numbers (after Censi, Franchi, Marchionni & Oriolo 2013), solved by reweighted least squares
    (Cauchy). In space, the lidar is leveled first: it turns about the vertical of the base.
    None where no mounting explains them, or several do: at rest, in one curve or on the spot.
    """
    d = poses.shape[-1] - 1
    first, last = _pairs(poses, wheels)
    if len(first) < _FEWEST:
        return None
    B, L = (lie.between(each[first], each[last]) for each in (wheels, poses))
    R_level = _leveling(lie.log(B)[:, -1], lie.log(L)[:, d:])
    theta = lie.log(L)[:, d:] @ (R_level[2] if d == 3 else R_level[1, 1:])
    x, y = (L[:, :d, d] @ R_level.T)[:, :2].T
    c, s = np.cos(theta) - 1.0, np.sin(theta)
    J = np.stack([np.stack([c, -s, -x, y], axis=1), np.stack([s, c, -y, -x], axis=1)], axis=1)  # (M, 2, 4)
    z = -B[:, :2, d]
    covariance, p, residual = _solved(J, z, _PRIOR_M)
    sigma_m = float(np.sqrt(covariance[:2, :2].diagonal().max()))
    scale = float(np.hypot(*p[2:]))
    if scale < _LARGEST_RESIDUAL:
        return None
    across = np.array([-p[3], p[2]]) / scale**2  # the yaw's derivative
    sigma_rad = float(np.sqrt(across @ covariance[2:, 2:] @ across))
    if sigma_m >= _PLACE_M:
        _, p, residual = _solved(J, z, _NOWHERE_M)
    moved_m = float(np.median(np.hypot(*z.T) + _TURN_M_RAD * np.abs(theta)))
    residual_m = float(np.median(residual))
    if not residual_m < _LARGEST_RESIDUAL * moved_m or sigma_rad > _YAW_RAD:
        return None
    T = lie.identity(d)
    T[:2, :2] = lie.pose_2d(0.0, 0.0, float(np.arctan2(p[3], p[2])))[:2, :2]
    T[:d, :d] = T[:d, :d] @ (R_level if d == 3 else np.eye(2))
    T[:2, d] = p[:2] / scale if sigma_m < _PLACE_M else 0.0
    unmounted_m = float(np.median(np.linalg.norm(z - J @ [0.0, 0.0, 1.0, 0.0], axis=1)))
    return HandEye(T, sigma_rad, sigma_m, residual_m, unmounted_m, bool(d == 2 and R_level[1, 1] < 0.0))


def _pairs(poses: Matrix, wheels: Matrix) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last scans of pieces of the path between which all is known, and at whose ends something moved."""
    is_known = np.isfinite(wheels[:, 0, 0])
    both = np.where(is_known[:, None, None], wheels, lie.identity(poses.shape[-1] - 1)), poses
    steps_m = np.max([_path_m(lie.between(each[:-1], each[1:])) for each in both], axis=0)
    steps_m = np.minimum(steps_m * (is_known[1:] & is_known[:-1]), _WINDOW_M)
    piece = (np.cumsum(np.append(0.0, steps_m)) / _WINDOW_M).astype(np.int64)
    nodes = np.flatnonzero(np.diff(piece, prepend=-1) > 0)
    first, last, unknown = nodes[:-1], nodes[1:], np.cumsum(~is_known)
    has_moved = np.max([_path_m(lie.between(each[first], each[last])) for each in both], axis=0) > 0.5 * _WINDOW_M
    chosen = has_moved & is_known[first] & (unknown[first] == unknown[last])
    return first[chosen], last[chosen]


def _path_m(motions: Matrix) -> NDArray[np.float64]:
    return np.linalg.norm(motions[:, :-1, -1], axis=1) + _TURN_M_RAD * lie.rotation_angle(motions)


def _leveling(turn: NDArray[np.float64], turned: Matrix) -> Matrix:
    """Rotation (d, d) of the lidar's frame that levels it, by turns (M,) of the base and rotations (M, k) of it.

    In the plane its y axis is reversed where the lidar turns against the base. The identity where the base turns
    too little to say, or where the lidar is level within its σ.
    """
    level = np.eye(2 if turned.shape[1] == 1 else 3)
    total = float(turn @ turn)
    if np.abs(turn).sum() < _LEAST_TURN_RAD:
        return level
    up = turn @ turned / total
    if len(level) == 2:
        level[1, 1] = -1.0 if up[0] < -_LEAST_OPPOSED else 1.0
        return level
    up /= np.linalg.norm(up)
    off = turned - np.outer(turned @ up, up)
    sigma_rad = float(np.sqrt((off**2).sum() / (2.0 * len(turn) * total)))
    turn_rad = float(np.arctan2(np.hypot(*up[:2]), up[2]))
    if turn_rad < max(_SIGMAS * sigma_rad, _LEAST_TILT_RAD):
        return level
    axis = np.array([up[1], -up[0], 0.0]) if np.hypot(*up[:2]) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return lie.exp(np.append(np.zeros(3), turn_rad * axis / np.linalg.norm(axis)))[:3, :3]


def _solved(J: Matrix, z: Matrix, prior_m: float) -> tuple[Matrix, NDArray[np.float64], NDArray[np.float64]]:
    """Covariance (4, 4) and value (4,) of J (M, 2, 4) p = z (M, 2), the first two 0 ± prior_m; residuals (M,)."""
    weight, variance = np.ones(len(z)), _USUAL_M**2
    for _ in range(_ROUNDS):
        H = np.einsum("mij,m,mik->jk", J, weight, J) / variance + np.diag([prior_m**-2.0] * 2 + [1e-6] * 2)
        p = np.linalg.solve(H, np.einsum("mij,m,mi->j", J, weight, z) / variance)
        residual = np.linalg.norm(z - J @ p, axis=1)
        weight = 1.0 / (1.0 + (residual / max(1.5 * float(np.median(residual)), _LEAST_M)) ** 2)
        degrees = max(2.0 * float(weight.sum()) - 4.0, 1.0)
        variance = max(float(weight @ residual**2) / degrees, _LEAST_M**2)
    return np.linalg.inv(H), p, residual


class MountingEstimator:
    """The mounting of a lidar that nothing states, estimated scan by scan as lidar and wheels move.

    Until their motions show it, the wheels are no prior, except for scans after one whose pose is open.
    """

    def __init__(self) -> None:
        self.poses: list[Pose] = []  # of the lidar
        self.wheels: list[Pose] = []  # of the base, NaN where one of both is not known
        self.path_m = self.due_m = 0.0  # of the lidar, and from which on the next estimate is made
        self.found: HandEye | None = None
        self.is_open = False  # the last pose

    @property
    def is_usable(self) -> bool:
        """Whether the wheels are a prior of the next scan."""
        return self.is_open if self.found is None else not self.found.is_mirrored

    def take(self, T_odom_lidar: Pose, T_odom_base: Pose | None, *, is_open: bool) -> None:
        """Take the poses of a scan, and estimate where the path has grown."""
        self.is_open = is_open
        if T_odom_base is None and not self.poses:
            return  # a log without wheels
        distance_m, angle_rad = lie.apart(self.poses[-1], T_odom_lidar) if self.poses else (0.0, 0.0)
        self.path_m += distance_m + _TURN_M_RAD * angle_rad
        self.poses.append(T_odom_lidar)
        self.wheels.append(np.full_like(T_odom_lidar, np.nan) if T_odom_base is None else T_odom_base.copy())
        if self.path_m >= self.due_m:
            self.due_m = _LEARNED * self.path_m + _WINDOW_M
            self.estimate()

    def estimate(self) -> None:
        """Estimate the mounting by all poses so far."""
        if self.poses:
            self.found = hand_eye(np.array(self.poses), np.array(self.wheels))

    def covariance(self, motion: Pose) -> Matrix:
        """Covariance (k, k) that a motion by the wheels has from that of the mounting; lengths only."""
        k, variance = lie.twist_size(motion), 0.0
        if self.found is not None:
            distance_m, angle_rad = lie.apart(lie.identity(len(motion) - 1), motion)
            variance = (distance_m * self.found.sigma_rad) ** 2 + (angle_rad * self.found.sigma_m) ** 2
        return np.diag(lie.by_component(k, variance, 0.0))

    def notes(self) -> tuple[str, ...]:
        """What is known of the mounting, as a sentence; none without wheels."""
        if not self.poses:
            return ()
        if self.found is None:
            return (
                "mounting assumed, as if the lidar sat at the base's origin: the log has no transform, and the wheels "
                "do not show it: at rest, in one curve only, or in other motions than the lidar",
            )
        if self.found.is_mirrored:
            return (
                "the wheels are not used: the lidar turns left where they turn right, as one does that hangs upside "
                "down (--log.upside_down true); the log has no transform",
            )
        return (f"mounting estimated from the wheels: {self.found.text}; the log has no transform",)
