"""Expected errors of a trajectory, their consistency (NEES), disagreement of methods, sharpness of their maps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import Struct
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Influence, Integers, KeyframeErrors, Mask, Matrix, Points, Scan, Trajectory, Vector
from scanchain.errors import InputError
from scanchain.graph.factors import turns
from scanchain.graph.pose_graph import PoseGraph

_BATCHES, _BATCH = 50, 10  # number and size of batches of samples: all at once would fill the memory
_RANK_TOLERANCE = 1e-9  # of the largest singular value, below which positions leave a rotation free
_DRIFT_OF_NOISE = 2.0  # drift of a map over its renewal, in standard deviations of independent errors of the scans
_DRIFT_OF_SYSTEMATIC = 5.0  # the same of errors that successive scans have in common; measured on simulated worlds
_REVISIT = 2.0  # variances of the systematic error in a loop edge: of both passes
_OVERESTIMATE = 2.0  # variance of the jackknife over the true one: see ``_scales``
_MOST_MEDIANS = 3.0  # influence of a group of directions over the median, above which the log needs the group
_MOST_OPEN = 0.5  # largest standard deviation of the instant of a pose in a distorted scan, over its duration

RADIUS_M = {2: 0.2, 3: 0.5}  # of the neighborhood whose thickness is measured, by dimension
REACH_M = 40.0  # largest range of the points that are compared: those farther off are too sparse
MAX_POINTS, MAX_QUERIES = 600_000, 15_000  # of a map, and of them those whose neighborhoods are measured: seconds
_MIN_COVERAGE = 0.5  # least share of the query points of the best map that another must cover to be compared


class ExpectedError(Struct, frozen=True):
    """Mean of an error, and its error bar; meters.

    is_random : True if systematic errors are not included
    where : the part of the log whose positions are the most uncertain, in words; empty for none
    """

    mean: float
    low: float
    high: float
    is_random: bool = True
    where: str = ""

    @property
    def bounds(self) -> str:
        """The error bar, rounded outwards."""
        low, high = math.floor(1e3 * self.low) / 1e3, math.ceil(1e3 * self.high) / 1e3
        return f"{low:.3f} to {high:.3f} m{', random errors only' if self.is_random else ''}"


class ScanPoses(NamedTuple):
    """Poses of scans, each attached to that of a keyframe.

    poses : (N, d+1, d+1); keyframe : (N,) number of the keyframe of each
    of_keyframes : (K,) numbers of the scans that are keyframes
    arms_m : (N, d) from the position of the keyframe, along the world's axes
    open_motions : (N, k) twists during a scan that may be distorted by them; 0 where it is not
    """

    poses: Matrix
    keyframe: Integers
    of_keyframes: Integers
    arms_m: Matrix
    open_motions: Matrix

    @classmethod
    def of(cls, poses: Matrix, of_keyframes: Integers, open_motions: Matrix) -> ScanPoses:
        """Each scan is attached to the last keyframe up to it."""
        keyframe = np.searchsorted(of_keyframes, np.arange(len(poses)), side="right") - 1
        positions = poses[:, :-1, -1]
        return cls(poses, keyframe, of_keyframes, positions - positions[of_keyframes][keyframe], open_motions)

    def errors(self, of_keyframes: Matrix) -> Matrix:
        """(n, N, k) errors of the scans caused by those of their keyframes (n, K, k), along the world's axes."""
        d = self.arms_m.shape[1]
        errors = of_keyframes[:, self.keyframe]
        errors[..., :d] += (turns(self.arms_m) @ errors[..., d:, None])[..., 0]
        return errors


class ExpectedErrors(NamedTuple):
    """ATE, and covariance (K, k, k) of each pose after the rigid alignment, of a twist in its own frame."""

    ate: ExpectedError
    covariances: Matrix


def expected_ate(graph: PoseGraph) -> ExpectedError:
    """ATE (rmse after rigid alignment) of the poses of a graph, if the covariances of its edges are right.

    The distribution is that of samples of the position errors δ. To first order the alignment removes what
    one twist of all positions explains:
        ATE² = min over ξ of 1/N Σ ‖δᵢ − ρ − φ × tᵢ‖²
    Raises InputError where the edges leave poses free.
    """
    alignment = _Alignment.of(graph.poses[:, :-1, -1])
    errors = (alignment.aligned(graph.pose_errors(_BATCH, seed)) for seed in range(_BATCHES))
    return _expected(np.concatenate([_rms_m(each, graph.poses.shape[-1] - 1) for each in errors]))


def expected_errors(
    graph: PoseGraph, map_errors: Sequence[KeyframeErrors], config: Config, scans: ScanPoses,
    influence: Influence | None = None,
) -> ExpectedErrors:  # fmt: skip
    """Errors of scans that were aligned to a map: random ones by ``with_map_errors``, and systematic ones.

    influence : of groups of directions on the motions; random errors only where left out
    Raises InputError without an edge, or where the edges leave poses free.
    """
    ates_m, squares = [], np.zeros((len(graph), graph.freedom, graph.freedom))
    for errors in error_samples(graph, map_errors, config, scans, influence):
        ates_m.append(_rms_m(errors, scans.arms_m.shape[1]))
        of_keyframes = errors[:, scans.of_keyframes]
        squares += np.einsum("nki,nkj->kij", of_keyframes, of_keyframes)
    R = _rotations(graph.poses, graph.freedom)
    covariances = np.swapaxes(R, 1, 2) @ (squares / (_BATCHES * _BATCH)) @ R
    ate = msgspec.structs.replace(_expected(np.concatenate(ates_m)), is_random=influence is None)
    return ExpectedErrors(ate, covariances)


def error_samples(
    graph: PoseGraph, map_errors: Sequence[KeyframeErrors], config: Config, scans: ScanPoses,
    influence: Influence | None = None,
) -> Iterator[Matrix]:  # fmt: skip
    """Samples of the errors of ``expected_errors``, some (n, N, k) of all scans at a time, after rigid alignment.

    Of position and orientation, along the world's axes. The error of a scan's pose is the sum of that of its
    keyframe; an independent one; those by groups of directions; and where scans may be distorted, one by the
    instant at which its pose holds, which changes with what the lidar sees.
    """
    if not len(graph.edges):
        raise InputError("the pose graph has no edge, so that no error is expected; give more keyframes")
    drifting, by_itself = with_map_errors(graph, map_errors, config, systematic_drift=0.0)
    alignment, R = _Alignment.of(scans.poses[:, :-1, -1]), _rotations(scans.poses, graph.freedom)
    own, influences, scale, log_sigma = by_itself[scans.keyframe], np.zeros((0, *R.shape[:2])), np.zeros(0), 0.0
    if influence is not None:
        changes = np.zeros((len(influence.kinds), *graph.information.shape[:2]))
        is_odometry = graph.is_odometry & (graph.edges[:, 1] == graph.edges[:, 0] + 1)
        changes[:, is_odometry] = influence.of_keyframes[:, graph.edges[is_odometry, 0]]
        within = (R @ influence.of_scans[..., None])[..., 0]
        influences = alignment.aligned(scans.errors(drifting.displacements(changes)) + within)
        scale, log_sigma = _scales(_rms_m(influences, scans.arms_m.shape[1]), influence.kinds)
        own[influence.is_measured] = 0.0  # the jackknife contains it
    values, vectors = np.linalg.eigh(R @ own @ np.swapaxes(R, 1, 2))
    half = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    open_motions, random = (R @ scans.open_motions[..., None])[..., 0], np.random.default_rng(0)
    for seed in range(_BATCHES):
        errors = scans.errors(drifting.pose_errors(_BATCH, seed))
        errors += (half @ random.normal(size=(*errors.shape, 1)))[..., 0]
        errors += np.tensordot(scale * random.normal(size=(_BATCH, len(scale))), influences, axes=1)
        errors *= np.exp(log_sigma * random.normal(size=(_BATCH, 1, 1)))
        instants = random.uniform(0.0, _MOST_OPEN, (_BATCH, 1)) * random.normal(size=(_BATCH, len(graph)))
        errors += instants[:, scans.keyframe, None] * open_motions
        yield alignment.aligned(errors)


def with_map_errors(
    graph: PoseGraph, map_errors: Sequence[KeyframeErrors], config: Config, *,
    systematic_drift: float = _DRIFT_OF_SYSTEMATIC,
) -> tuple[PoseGraph, Matrix]:  # fmt: skip
    """The graph with covariances of edges for expected errors, and independent covariances (K, k, k) of poses.

    Poses aligned to one map have independent errors relative to it, and common ones as it drifts. With N the
    covariance of a keyframe by its residuals, S that by the disagreement of sectors of its scans, u the share of
    the map that is new since the keyframe before, the motion between two keyframes drifts by the covariance
        (2u)² N + (5u)² S.
    A scan aligned to the mean of the m before drifts by 2/(m + 1) of its error: hence 2u. S accumulates from scan
    to scan, by a measured factor. Every pose also has the independent error N + S; loop edges, of two passes, have
    N + 2 S. The covariances of the graph have floors instead, which serve the optimizer.
    map_errors, config : of the run
    systematic_drift : the 5; 0 where systematic drift is measured instead
    """
    k, of_scans = graph.freedom, np.flatnonzero(graph.is_odometry | graph.is_loop)
    source = graph.edges[of_scans].max(axis=1)
    is_loop = graph.is_loop[of_scans]
    information = graph.information.copy()
    chosen = [map_errors[index] for index in source.tolist()]
    covariance, by_itself = edge_errors(information[of_scans], is_loop, chosen, config, systematic_drift)
    judged = np.linalg.inv(covariance + 1e-14 * np.eye(k))  # regular at standstill, too
    information[of_scans] = 0.5 * (judged + np.swapaxes(judged, 1, 2))
    own = np.zeros((len(graph), k, k))
    own[source[~is_loop]] = by_itself[~is_loop]
    return graph.with_information(information), own


def edge_errors(
    information: Matrix, is_loop: Mask, map_errors: Sequence[KeyframeErrors], config: Config,
    systematic_drift: float = _DRIFT_OF_SYSTEMATIC,
) -> tuple[Matrix, Matrix]:  # fmt: skip
    """Covariances (E, k, k) of edges, and the independent one of the later pose of each, by ``with_map_errors``.

    information : (E, k, k) of the edges in the graph; map_errors : of the later keyframe of each
    """
    of_loops, of_odometry = (
        lie.by_component(information.shape[-1], each.edge_sigma_m, each.edge_sigma_rad)
        for each in (config.loops, config.odometry)
    )
    is_loop = is_loop[:, None, None]
    floor = np.where(is_loop, np.diag(of_loops**2), np.diag(of_odometry**2))
    factor, systematic, u = (np.array(column) for column in zip(*map_errors, strict=True))
    factor, u = factor[:, None, None], u[:, None, None]
    noise: Matrix = (factor * (np.linalg.inv(information) - floor)).astype(np.float64)
    drift = np.minimum(_DRIFT_OF_NOISE * u, 1.0) ** 2 * noise + (systematic_drift * u) ** 2 * systematic
    return np.where(is_loop, noise + _REVISIT * systematic, drift), noise + systematic


def _rotations(poses: Matrix, freedom: int) -> Matrix:
    """(K, k, k) from a pose's own axes to the world's, of errors of position and orientation."""
    d = poses.shape[-1] - 1
    result = np.zeros((len(poses), freedom, freedom))
    result[:, :d, :d] = poses[:, :d, :d]
    result[:, d:, d:] = poses[:, :d, :d] if d == 3 else 1.0
    return result


class _Alignment(NamedTuple):
    """Rigid alignment of errors of positions, to first order.

    moved : (N, d, k) by which a twist moves positions; basis (N d, r) of these moves; to_twist (k, r)
    """

    moved: Matrix
    basis: Matrix
    to_twist: Matrix

    @classmethod
    def of(cls, positions: Matrix) -> _Alignment:
        """That of positions (N, d)."""
        count, d = positions.shape
        translated = np.broadcast_to(np.eye(d), (count, d, d))
        moved = np.concatenate([translated, turns(positions - positions.mean(axis=0))], axis=2)
        basis, size, Vt = np.linalg.svd(moved.reshape(count * d, -1), full_matrices=False)
        kept = size > _RANK_TOLERANCE * size[0]
        return cls(moved, basis[:, kept], Vt[kept].T / size[kept])

    def aligned(self, errors: Matrix) -> Matrix:
        """The errors (n, N, k), without what one twist of all poses explains."""
        d = self.moved.shape[1]
        twist = errors[..., :d].reshape(len(errors), len(self.basis)) @ self.basis @ self.to_twist.T
        moves = (self.moved @ twist[:, None, :, None])[..., 0]
        turned = np.broadcast_to(twist[:, None, d:], errors[..., d:].shape)
        return errors - np.concatenate([moves, turned], axis=2)


def _rms_m(errors: Matrix, d: int) -> Vector:
    """Root mean squared position error (n,), m, of errors (n, N, k)."""
    return np.sqrt((errors[..., :d] ** 2).sum(axis=2).mean(axis=1))


def _expected(ates_m: Vector) -> ExpectedError:
    """Mean and 95 % interval of samples."""
    low, high = np.percentile(ates_m, (2.5, 97.5)).tolist()
    return ExpectedError(float(ates_m.mean()), low, high)


def _scales(sizes_m: Vector, kinds: Integers) -> tuple[Vector, float]:
    """(G,) factors on the influences of groups by which their squares sum up to the variance, and its uncertainty.

    The variance of the jackknife is (G − 1)/G Σ sᵢ² over the G groups of a kind, of influences sᵢ. It is twice the
    true one: in space both kinds divide all points and show all errors, in the plane a direction often hangs on
    two groups, of leverage ½ each (MacKinnon & White 1985). The influence of a group without which the log is not
    observable is unknown: the median takes its place. The uncertainty is the standard deviation of the logarithm
    of a standard deviation with (Σ sᵢ²)² / Σ sᵢ⁴ degrees of freedom (Satterthwaite 1946).
    """
    numbers, usual_m = np.bincount(kinds)[kinds], np.median(sizes_m)
    is_usual = sizes_m <= _MOST_MEDIANS * usual_m
    scales = np.sqrt((numbers - 1) / (_OVERESTIMATE * numbers)) * np.where(
        is_usual, 1.0, usual_m / np.maximum(sizes_m, 1e-12)
    )
    squares = (scales * sizes_m) ** 2
    freedom = squares.sum() ** 2 / max((squares**2).sum(), 1e-300)
    return scales, float(1.0 / np.sqrt(2.0 * freedom)) if freedom else 0.0


def motion_nees(poses: Matrix, covariances: Matrix, reference: Matrix) -> Vector:
    """(N−1,) ξᵀ Σ⁻¹ ξ / k of the motion between each pose and the next: 1 on average is exact, more overconfident.

    poses, reference : (N, d+1, d+1) estimate and truth at the same instants
    covariances : (N, k, k) of each pose by itself, of a twist in its own frame, T exp(ξ); where one is NaN so is
        the answer. With M the motion, Σ = Σ_i+1 + Ad(M⁻¹) Σ_i Ad(M⁻¹)ᵀ, because both poses err independently.
    """
    motion = lie.between(poses[:-1], poses[1:])
    true_motion = lie.between(reference[:-1], reference[1:])
    error = lie.log(lie.between(true_motion, motion))
    Ad = lie.adjoint(lie.inverse(motion))
    covariance = covariances[1:] + Ad @ covariances[:-1] @ np.swapaxes(Ad, 1, 2)
    result = np.full(len(motion), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    weighted = np.linalg.pinv(covariance[known], hermitian=True) @ error[known, :, None]
    result[known] = np.einsum("ni,ni->n", error[known], weighted[..., 0]) / error.shape[1]
    return result


def disagreement(trajectories: Sequence[Matrix]) -> Matrix:
    """(M, M) meters: median over the scans of the distance between the motions that two methods find for a scan.

    trajectories : M times poses (N, d+1, d+1) of the same scans, (0, d+1, d+1) of a method that has failed
    NaN where one of the two has failed.
    """
    motions = [lie.between(poses[:-1], poses[1:]) for poses in trajectories]
    result = np.full((len(motions), len(motions)), np.nan)
    for row, first in enumerate(motions):
        for column, second in enumerate(motions):
            if len(first) and len(second):
                error = lie.between(first, second)
                result[row, column] = float(np.median(np.linalg.norm(error[:, :-1, -1], axis=1)))
    return result


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Lower is sharper."""

    mean_map_entropy: float
    thickness_m: float


def sharpness(maps: Sequence[Points]) -> list[Sharpness | None]:
    """Sharpness of each map of ``sampled_map``, where there is no ground truth (Razlaw et al. 2015).

    Around the same query points in every map, all neighbors within a radius make a covariance Σ (d, d) with
    smallest eigenvalue λ₁, and over the query points q
        mean map entropy       1/Q Σ_q ½ ln det(2πe Σ(q))     in nats for Σ in m²
        surface thickness      √(1/Q Σ_q λ₁(q))               in meters, the root of the mean variance across it
    A query point counts if in every map it has 10 neighbors at least and a covariance that is not flat by
    accident (λ₁ > 0). Lower is sharper. Moving objects blur all maps equally. It is not ground truth: a map that
    is distorted but sharp scores well. None for a fragmented map: it would leave too few points to compare the
    others at.
    """
    eigenvalues = np.array([_eigenvalues(points) for points in maps])
    good: Mask = np.all(np.isfinite(eigenvalues) & (eigenvalues > 0.0), axis=2)
    covered = good.sum(axis=1) >= _MIN_COVERAGE * good.sum(axis=1).max(initial=0)
    counts = good[covered].all(axis=0)
    if not counts.any():
        return [None] * len(maps)
    chosen = eigenvalues[:, counts]
    return [_sharpness(each) if is_covered else None for each, is_covered in zip(chosen, covered, strict=True)]


def sampled_map(scans: Iterable[Scan], trajectory: Trajectory, step: int) -> Points:
    """(M, d) every ``step``-th point within reach, in the frame of the trajectory, deskewed by it.

    The lidar is where the trajectory has it at the instant of a point, between two stamps along the screw that
    joins their poses.
    scans : one per pose of the trajectory
    """
    after = velocities(trajectory)
    before = np.vstack([after[:1], after[:-1]])
    rows = zip(scans, trajectory.poses, before, after, strict=True)
    return np.concatenate([lie.transform(pose, _deskewed(scan, step, v, w)) for scan, pose, v, w in rows])


def velocities(trajectory: Trajectory) -> Matrix:
    """(N, k) twist per second from each pose to the next, the last one repeated; 0 if stamps do not increase."""
    seconds = 1e-9 * np.diff(trajectory.stamps_ns)[:, None]
    twists = lie.log(lie.between(trajectory.poses[:-1], trajectory.poses[1:]))
    result = np.zeros((len(trajectory), twists.shape[1]))
    np.divide(twists, seconds, out=result[:-1], where=seconds > 0.0)
    result[-1] = result[max(len(result) - 2, 0)]
    return result


def sampling_step(points: int) -> int:
    """Step at which the points of a log are sampled."""
    return max(1, points // MAX_POINTS)


def _sharpness(eigenvalues: Vector) -> Sharpness:
    """Of eigenvalues (Q, d), ascending, m²."""
    d = eigenvalues.shape[1]
    entropy = 0.5 * (d * np.log(2.0 * np.pi * np.e) + np.log(eigenvalues).sum(axis=1)).mean()
    return Sharpness(float(entropy), float(np.sqrt(eigenvalues[:, 0].mean())))


def _deskewed(scan: Scan, step: int, before: Vector, after: Vector) -> Points:
    """Points as seen at the stamp, by the velocity up to it and the one from it on."""
    near = np.linalg.norm(scan.points[::step], axis=1) < REACH_M
    points = scan.points[::step][near].astype(np.float64)
    if not len(scan.times_s):
        return points
    times_s = scan.times_s[::step][near].astype(np.float64)[:, None]
    T_stamp_point = lie.exp(np.where(times_s < 0.0, before, after) * times_s)
    d = points.shape[1]
    return np.einsum("nij,nj->ni", T_stamp_point[:, :d, :d], points) + T_stamp_point[:, :d, d]


def _eigenvalues(points: Points) -> Matrix:
    """(Q, d) ascending, m², of the covariance around every query point; NaN where there are too few neighbors."""
    d = points.shape[1]
    queries = points[:: max(1, len(points) // MAX_QUERIES)]
    tree = KDTree(points)
    covariances = np.full((len(queries), d, d), np.nan)
    for begin in range(0, len(queries), 64):  # all neighbors of all queries take gigabytes
        some = queries[begin : begin + 64]
        for row, chosen in enumerate(tree.query_ball_point(some, RADIUS_M[d], return_sorted=False), begin):
            if len(chosen) >= 10:  # fewer give no thickness
                offsets = points[chosen] - queries[row]
                offsets -= offsets.mean(axis=0)
                covariances[row] = offsets.T @ offsets / (len(chosen) - 1)
    result, known = np.full((len(queries), d), np.nan), np.isfinite(covariances[:, 0, 0])
    result[known] = np.linalg.eigvalsh(covariances[known])
    return result
