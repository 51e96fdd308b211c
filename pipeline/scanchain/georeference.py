"""Place of a trajectory on Earth by fixes of a GNSS receiver, which also correct drift that they show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from scipy.special import gammaincinv

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import Fixes, Integers, Mask, Matrix, Points, Pose, Trajectory, Vector, brief
from scanchain.errors import counted
from scanchain.geodesy import Geodesy
from scanchain.graph.consistency import is_bent
from scanchain.graph.factors import LARGEST_SIGMAS, Position, Prior, RobustPosition
from scanchain.graph.losses import rejection_limit
from scanchain.graph.pose_graph import PoseGraph
from scanchain.gravity import MOUNTED_RAD, upright

_CORRELATED_S, _SPACING_S = 20.0, 5.0  # time constant of the errors of fixes, and usual time between those used
_FEWEST, _INTERVALS = 4, 12  # least number of them that agree, and number of intervals of a short log
_COMPARED, _VOTES = 60, 300  # largest numbers of fixes whose pairs are candidates for the datum, and that vote
_APART_M = 5.0  # least distance of such a pair
_DRIFT = 0.01  # of the trajectory, as a share of the distance, that votes tolerate
_LEAST_SHARE = 0.35  # of fixes that agree with the trajectory
_STRICT = 0.5  # factor on the variance for the verdict, by which 4 % of right fixes are left out too
_LEAST_M = 0.02  # σ of a fix relative to the lidar, beyond that stated: stamps, the antenna's position and tilt
_ANTENNA_M = 1.0  # σ of the antenna's unknown position
_MOST_RAD = math.radians(15.0)  # σ of the direction above which the place is unknown
_SURE, _MOST_ALONE = 0.999, 0.1  # probability that errors as stated pass a test; share of fixes that fail it alone
_HEIGHT_M = 1e3  # σ of heights in the plane, where they are unknown
_NEAR_NS = 1_000_000_000  # longest time between the scans around a fix
_MOST_IN_INTERVAL = 100  # fixes of an interval that are compared
_FIXED = 1e12  # information of an antenna's known position, m⁻²
_ROUNDS = 5  # of the least squares of the datum


class Origin(Struct, frozen=True):
    """Place of the origin of the world frame on Earth, by fixes of a GNSS receiver.

    ``altitude_m`` is above the ellipsoid of WGS 84, ``yaw_rad`` the direction of the x axis, from east to north.
    ``sigma_m`` and ``sigma_yaw_rad`` are standard deviations, horizontally and of the direction.
    ``is_constrained`` is whether the fixes corrected the trajectory.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    yaw_rad: float
    sigma_m: float
    sigma_yaw_rad: float
    fixes: int
    fixes_rejected: int
    is_constrained: bool

    @property
    def text(self) -> str:
        """Use and quality of the fixes."""
        rejected = (
            f"{100.0 * self.fixes_rejected / self.fixes:.0f} % of {counted(self.fixes, 'fix', 'fixes')} rejected"
        )
        known = f"origin known to {self.sigma_m:.2g} m, direction to {math.degrees(self.sigma_yaw_rad):.2g}°"
        return f"{rejected}, {known}{'; they correct the trajectory' * self.is_constrained}"


@dataclass(frozen=True, slots=True)
class Georeference:
    """Place of a result on Earth.

    origin, R_enu_world : of the world frame, whose axes R (3, 3) rotates to east, north and up
    antenna_m : (3,) of the receiver, in the frame of the lidar
    stamps_ns, is_rejected : (M,) of the fixes, and which contradict the trajectory
    innovations : (M,) normalized, as in ``Step``
    """

    __repr__ = brief
    origin: Origin
    R_enu_world: Matrix
    antenna_m: Vector
    stamps_ns: Integers
    is_rejected: Mask
    innovations: Vector

    @property
    def geodesy(self) -> Geodesy:
        """The local frame at the origin."""
        return Geodesy(self.origin.latitude_deg, self.origin.longitude_deg, self.origin.altitude_m)

    def enu(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory of the world, in space, with the axes east, north and up."""
        T = np.eye(4)
        T[:3, :3] = self.R_enu_world
        return Trajectory(trajectory.stamps_ns, T @ lie.lift(trajectory.poses))

    def projected(self, points: Points) -> tuple[Points, Any]:
        """Points (N, d) of the world in the zone of UTM of the origin, with altitudes, and its pyproj.CRS."""
        return self.geodesy.projected(lie.lift_points(points) @ self.R_enu_world.T)


class _Sighted(NamedTuple):
    """Fixes (M, 3) east, north and up, their covariances, poses (M, 4, 4) of the lidar, the antenna (3,)."""

    stamps_ns: Integers
    enu_m: Points
    covariances: Matrix
    poses: Matrix
    antenna_m: Vector

    def chosen(self, which: Integers | Mask, variance: float = 1.0) -> _Sighted:
        """Some of them, with covariances multiplied by a factor."""
        of_fixes = self.stamps_ns[which], self.enu_m[which], variance * self.covariances[which], self.poses[which]
        return _Sighted(*of_fixes, self.antenna_m)

    @property
    def positions(self) -> Points:
        """(M, 3) of the antenna in the world."""
        return self.poses[:, :3, 3] + self.poses[:, :3, :3] @ self.antenna_m

    def errors(self, T_enu_world: Pose) -> Points:
        """(M, 3) east, north and up."""
        return self.enu_m - lie.transform(T_enu_world, self.positions)

    def chi2(self, T_enu_world: Pose) -> Vector:
        """χ² (M,) by the stated covariances."""
        return _chi2(self.errors(T_enu_world), self.covariances)


class _Datum(NamedTuple):
    """T_enu_world (4, 4), the antenna (3,), σ of the world's origin, horizontally, and of the direction."""

    T_enu_world: Pose
    antenna_m: Vector
    sigma_m: float
    sigma_rad: float


class Georeferencing:
    """Fixes of a log, compared with its trajectory: they place it on Earth, and correct its drift.

    The errors of fixes are a Gauss-Markov process with the time constant τ. Of one every Δ seconds, each is worth
    an independent one with coth(Δ/2τ) times the variance: T seconds are worth T/2τ fixes, however many there are.

    note : what was found, as text
    """

    def __init__(self, fixes: Sequence[Fixes], up: Vector, config: GraphConfig) -> None:
        """Take the fixes of a log; ``up`` (3,) is the upward direction in its world, known to a few degrees."""
        stamps_ns = np.concatenate([each.stamps_ns for each in fixes])
        positions = np.concatenate([each.positions for each in fixes])
        covariances = np.concatenate([each.covariances for each in fixes])
        order = np.argsort(stamps_ns, kind="stable")
        is_new = np.diff(positions[order], axis=0, prepend=np.nan).any(axis=1)  # not the last one repeated
        order = order[is_new]
        self.stamps_ns, self.covariances = stamps_ns[order], covariances[order] + _LEAST_M**2 * np.eye(3)
        self.geodesy = Geodesy(*positions[order[0]].tolist())
        self.enu_m = self.geodesy.enu(positions[order])
        self.antenna_m, self.up, self.config, self.note = fixes[0].antenna_m, up, config, ""
        self.estimates_antenna = self.antenna_m is None
        self.chosen = self.keyframes = np.empty(0, np.int64)  # independent fixes that agree with the trajectory
        self.T_enu_world, self.variance, self.is_constrained = np.eye(4), 1.0, False

    def constrained(self, trajectory: Trajectory, graph: PoseGraph, of_keyframes: Integers) -> PoseGraph | None:
        """The graph with factors of the fixes, optimized; None where they show no drift, or must not be used.

        of_keyframes : (K,) numbers of the scans that are the poses of the graph
        """
        if graph.held:
            self.note = "not used in a map of other logs"
            return None
        if not self._agree(trajectory, graph, of_keyframes) or self.config.gnss == "datum":
            return None
        ends = self._chosen(trajectory)
        if not self._show_drift(ends, graph.dimension):
            return None
        T_enu_world, constrained, state = self.T_enu_world, graph, graph.state()
        for _ in range(3):  # each with the datum for which the first pose of the last one stays where it is
            moved = state.poses[0] @ lie.inverse(graph.poses[0])
            T_enu_world = lie.normalize(T_enu_world @ lie.lift(moved))
            constrained = graph.copy()  # without the priors of the first pose, which gets another one
            constrained.remove_edges(constrained.is_of_origin & (constrained.edges[:, 1] == 0))
            poses = (lie.inverse(moved) @ state.poses)[self.keyframes]
            _constrain(constrained, self.keyframes, poses, ends, T_enu_world, self.up, Position())
            state = constrained.optimize(self.config, initialize="given").state
        if is_bent(graph.state(), state, self.config.robust_scale):
            self.note = "its fixes contradict the lidar by more than its standard deviations"
            return None
        self.is_constrained = True
        return constrained

    def _agree(self, trajectory: Trajectory, graph: PoseGraph, of_keyframes: Integers) -> bool:
        """Choose independent fixes that agree with the trajectory, by a graph; False if they are too few."""
        sighted = self._sighted(trajectory)
        unknown = _ANTENNA_M**2 * np.eye(3) if self.estimates_antenna else 0.0
        loose = None if sighted is None else sighted._replace(covariances=sighted.covariances + unknown)
        if sighted is None or loose is None or (first := _consensus(loose, self.up)) is None:
            self.note = "not used, since no two of its fixes are far enough apart"
            return False
        apart, spacing_s = _apart(loose, first)
        keyframes_ns = trajectory.stamps_ns[of_keyframes]
        nearest = np.array([np.abs(keyframes_ns - each).argmin() for each in sighted.stamps_ns[apart]])
        tied, chosen = graph.in_force(0, len(graph)), loose.chosen(apart, _STRICT)  # its edges are not robust here
        _constrain(tied, nearest, tied.poses[nearest], chosen, first, self.up, RobustPosition())
        tied.optimize(self.config, initialize="given")
        is_kept = ~tied.is_rejected[tied.is_of_origin][1:]
        if is_kept.sum() < max(_FEWEST, _LEAST_SHARE * len(apart)):
            share = f"only {is_kept.sum()} of {len(apart)} fixes, one every {spacing_s:.2g} s"
            self.note = f"not used, since {share}, agree with the trajectory"
            return False
        self.chosen, self.keyframes = apart[is_kept], nearest[is_kept]
        self.variance = 1.0 / math.tanh(0.5 * spacing_s / _CORRELATED_S)
        self.T_enu_world = first
        for each in (loose, sighted):
            ends = each.chosen(self.chosen, self.variance)
            datum = _fitted(ends, self.T_enu_world, self.up, estimates_antenna=self.estimates_antenna)
            self.T_enu_world, self.antenna_m = datum.T_enu_world, datum.antenna_m
        return True

    def _show_drift(self, ends: _Sighted, d: int) -> bool:
        """True if independent fixes, together or several of them alone, contradict the trajectory's shape."""
        chi2 = ends.chi2(self.T_enu_world)
        alone = np.mean(self.variance * chi2 > rejection_limit(self.config.robust_scale, d))
        return bool(chi2.sum() > 2.0 * gammaincinv(0.5 * d * len(chi2), _SURE) or alone > _MOST_ALONE)

    def _chosen(self, trajectory: Trajectory) -> _Sighted:
        """Independent fixes that agree with the trajectory."""
        sighted = self._sighted(trajectory)
        assert sighted is not None
        return sighted.chosen(self.chosen, self.variance)

    def place(self, trajectory: Trajectory) -> Georeference | None:
        """Place of a trajectory on Earth; None where it is unknown."""
        if not len(self.chosen) or (sighted := self._sighted(trajectory)) is None:
            return None
        ends, d = self._chosen(trajectory), trajectory.dimension
        datum = _fitted(ends, self.T_enu_world, self.up, estimates_antenna=False)
        if datum.sigma_rad > _MOST_RAD:
            self.note = "not used, since the path is too short for its direction"
            return None
        excess = np.square(ends.errors(datum.T_enu_world)) - np.einsum("nii->ni", ends.covariances) / self.variance
        own = max(float(np.median(excess[:, :d].mean(axis=1))), 0.0) * np.eye(3)  # variance of the trajectory
        chi2 = _chi2(sighted.errors(datum.T_enu_world), sighted.covariances + own)
        is_rejected, R = chi2 > rejection_limit(self.config.robust_scale, d), datum.T_enu_world[:3, :3]
        latitude, longitude, altitude_m = self.geodesy.geodetic(datum.T_enu_world[None, :3, 3])[0].tolist()
        origin = Origin(
            latitude, longitude, altitude_m, math.atan2(R[1, 0], R[0, 0]), datum.sigma_m, datum.sigma_rad,
            len(is_rejected), int(is_rejected.sum()), self.is_constrained,
        )  # fmt: skip
        self.note = "; ".join(filter(None, [origin.text, self.note]))
        return Georeference(origin, R, datum.antenna_m, sighted.stamps_ns, is_rejected, np.sqrt(chi2 / d))

    def _sighted(self, trajectory: Trajectory) -> _Sighted | None:
        """The fixes between scans of a trajectory; None without any."""
        scans_ns, poses = trajectory.stamps_ns, lie.lift(trajectory.poses)
        after = np.clip(np.searchsorted(scans_ns, self.stamps_ns), 1, len(scans_ns) - 1)
        lasted_ns = scans_ns[after] - scans_ns[after - 1]
        share = (self.stamps_ns - scans_ns[after - 1]) / np.maximum(lasted_ns, 1)
        is_between = (share >= 0.0) & (share <= 1.0) & (lasted_ns <= _NEAR_NS)
        if not is_between.any():
            return None
        before, share = after[is_between] - 1, share[is_between, None]
        T = poses[before] @ lie.exp(share * lie.log(lie.between(poses[before], poses[before + 1])))
        covariances = self.covariances[is_between].copy()
        if trajectory.dimension == 2:
            covariances[:, 2, :] = covariances[:, :, 2] = 0.0
            covariances[:, 2, 2] = _HEIGHT_M**2
        antenna = np.zeros(3) if self.antenna_m is None else self.antenna_m
        return _Sighted(self.stamps_ns[is_between], self.enu_m[is_between], covariances, T, antenna)


def _consensus(sighted: _Sighted, up: Vector) -> Pose | None:
    """T_enu_world (4, 4) on which most fixes agree, level by the mounting; None where no two are far apart.

    Candidates are the horizontal directions and the means of pairs (random sample consensus, over all pairs).
    """
    level = np.eye(4)
    level[:3, :3] = upright(up)
    count = len(sighted.stamps_ns)
    votes = sighted.chosen(np.unique(np.linspace(0, count - 1, min(count, _VOTES)).astype(int)))
    pairs = np.unique(np.linspace(0, len(votes.stamps_ns) - 1, min(count, _COMPARED)).astype(int))
    i, j = pairs[np.array(np.triu_indices(len(pairs), 1))]
    at, enu = lie.transform(level, votes.positions), votes.enu_m
    moved, seen = at[j] - at[i], enu[j] - enu[i]
    far = np.hypot(*moved[:, :2].T) > _APART_M
    if not far.any():
        return None
    i, j, moved, seen = i[far], j[far], moved[far], seen[far]
    yaws = np.arctan2(seen[:, 1], seen[:, 0]) - np.arctan2(moved[:, 1], moved[:, 0])
    best, most = np.eye(4), -1.0
    along_m = np.cumsum(np.linalg.norm(np.diff(at, axis=0, prepend=at[:1]), axis=1))
    limit = rejection_limit(0.0, 3)
    for a, b, yaw in zip(i, j, yaws, strict=True):
        T = lie.exp(yaw * np.eye(6)[5])
        T[:3, 3] = 0.5 * (enu[a] + enu[b] - (at[a] + at[b]) @ T[:3, :3].T)
        away_m = np.minimum(np.abs(along_m - along_m[a]), np.abs(along_m - along_m[b]))
        tolerated = votes.covariances + np.square(_DRIFT * away_m)[:, None, None] * np.eye(3)
        chi2 = _chi2(enu - lie.transform(T, at), tolerated)
        score = float(np.maximum(1.0 - chi2 / limit, 0.0).sum())
        if score > most:
            best, most = T, score
    return best @ level


def _apart(sighted: _Sighted, T_enu_world: Pose) -> tuple[Integers, float]:
    """One fix (N,) of each interval, the one that most others of it agree with, and their length in s."""
    times_s = 1e-9 * (sighted.stamps_ns - sighted.stamps_ns[0])
    spacing_s = min(_SPACING_S, max(float(times_s[-1]), 1e-3) / _INTERVALS)
    interval = (times_s / spacing_s).astype(int)
    found, errors, limit = list[int](), sighted.errors(T_enu_world), rejection_limit(0.0, 3)
    for each in np.unique(interval):
        among = np.flatnonzero(interval == each)
        among = among[:: -(-len(among) // _MOST_IN_INTERVAL)]
        apart = errors[among][:, None] - errors[among][None]
        covariances = sighted.covariances[among]
        agree = _chi2(apart, covariances[:, None] + covariances[None]) < limit
        middle = np.abs(times_s[among] / spacing_s - each - 0.5)
        found.append(int(among[np.lexsort([middle, -agree.sum(axis=1)])[0]]))
    return np.array(found), spacing_s


def _constrain(
    graph: PoseGraph, keyframes: Integers, poses: Matrix, sighted: _Sighted, T_enu_world: Pose, up: Vector,
    factor: Position,
) -> None:  # fmt: skip
    """Add a prior of the first pose, mainly of its tilt, and positions of keyframes (N,), about at these poses."""
    d, R = graph.dimension, T_enu_world[:3, :3]
    free_m, free_rad = LARGEST_SIGMAS
    information, R_up_lidar = np.eye(graph.freedom) * free_m**-2.0, upright(up) @ lie.lift(graph.poses[0])[:3, :3]
    of_rotation = R_up_lidar.T @ np.diag(np.array([MOUNTED_RAD, MOUNTED_RAD, free_rad]) ** -2.0) @ R_up_lidar
    information[d:, d:] = of_rotation if d == 3 else free_rad**-2.0
    graph.add_factor(Prior(), 0, information, graph.poses[0])
    at = lie.transform(lie.inverse(T_enu_world), sighted.enu_m)
    own = lie.lift(graph.poses[keyframes])
    arms = sighted.positions - own[:, :3, 3]
    arms = (lie.lift(poses)[:, :3, :3] @ np.swapaxes(own[:, :3, :3], 1, 2) @ arms[..., None])[..., 0]
    for keyframe, position, covariance in zip(keyframes.tolist(), at - arms, sighted.covariances, strict=True):
        Z = lie.identity(d)
        Z[:d, d] = position[:d]
        graph.add_factor(factor, keyframe, np.linalg.inv((R.T @ covariance @ R)[:d, :d]), Z)


def _fitted(sighted: _Sighted, T_enu_world: Pose, up: Vector, *, estimates_antenna: bool) -> _Datum:
    """The datum by least squares, with weak priors of the tilt and of an antenna at an unknown position."""
    middle, R_lidar = sighted.enu_m.mean(axis=0), sighted.poses[:, :3, :3]
    information, H = np.linalg.inv(sighted.covariances), np.eye(9)
    shift = np.eye(4)
    shift[:3, 3] = middle
    for _ in range(_ROUNDS):
        errors = sighted.errors(T_enu_world)
        away = lie.transform(T_enu_world, sighted.positions) - middle
        to_enu = T_enu_world[:3, :3] @ R_lidar
        J = np.concatenate([np.tile(np.eye(3), (len(away), 1, 1)), -lie.hat(away), to_enu], axis=2)
        tilt = T_enu_world[:3, :3] @ up
        H = np.einsum("nia,nij,njb->ab", J, information, J)
        b = np.einsum("nia,nij,nj->a", J, information, errors)
        H[[3, 4], [3, 4]] += MOUNTED_RAD**-2.0
        b[3:5] += np.array([tilt[1], -tilt[0]]) * MOUNTED_RAD**-2.0
        H[[6, 7, 8], [6, 7, 8]] += _ANTENNA_M**-2.0 if estimates_antenna else _FIXED
        b[6:] -= sighted.antenna_m * _ANTENNA_M**-2.0 if estimates_antenna else 0.0
        step = np.linalg.solve(H, b)
        T_enu_world = lie.normalize(shift @ lie.exp(step[:6]) @ lie.inverse(shift) @ T_enu_world)
        sighted = sighted._replace(antenna_m=sighted.antenna_m + (step[6:] if estimates_antenna else 0.0))
    covariance = np.linalg.inv(H)[:6, :6]
    J = np.hstack([np.eye(3), -lie.hat(T_enu_world[:3, 3] - middle)])
    sigma_m = math.sqrt(np.trace((J @ covariance @ J.T)[:2, :2]))
    return _Datum(T_enu_world, sighted.antenna_m, sigma_m, math.sqrt(covariance[5, 5]))


def _chi2(errors: Matrix, covariances: Matrix) -> Vector:
    """Squared Mahalanobis distances (...) of errors (..., 3)."""
    return np.sum(errors * np.linalg.solve(covariances, errors[..., None])[..., 0], axis=-1)
