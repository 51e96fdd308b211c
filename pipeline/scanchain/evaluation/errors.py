"""Errors of trajectories: ATE and the alignment before it, RPE, KITTI metric, and relations checked by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.data import Matrix, Pose, Trajectory, brief
from scanchain.errors import InputError, counted
from scanchain.evaluation.pairing import ERRORS_S, Pairs, nearest, pair
from scanchain.registration.svd_icp import DegeneratePairsError, rigid_transform
from scanchain.trajectory import posed, table

Floats = NDArray[np.float64]

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)  # of the benchmark
SHORT_LENGTHS_M = (10.0, 20.0, 40.0)  # of segments of paths that are too short for these
RELATION_LIMIT_S = 2.0 * ERRORS_S[1]  # between a stamp of a relation and that of its pose
_PLANAR = 1e-9  # meters of height and radians of tilt below which poses count as planar
_FAR_OFF = (0.02, 0.1)  # ATE above both of which odometry failed: share of the path, meters
_FAR_OFF_RAD = np.radians(20.0)  # rotation error above which the axes of the truth are others
_SHORTEST_PATH_M = 1.0  # shortest path of which an error is given as a share
_LARGEST = 2.0  # largest length of a segment over the requested one
_FIELDS = "stamp1 stamp2 x y z roll pitch yaw"


class Alignment(StrEnum):
    """Alignment of the estimate to the reference before comparison. No alignment changes the scale."""

    NONE = "none"
    FIRST = "first"
    RIGID = "rigid"


_ALIGNMENTS = {
    Alignment.NONE: "frames taken as they are",
    Alignment.FIRST: "first paired poses made equal",
    Alignment.RIGID: "rigid least squares over the positions (Umeyama 1991, without scale)",
}


def align(estimate: Matrix, reference: Matrix, alignment: Alignment) -> Pose:
    """T_reference_estimate (4, 4), by which each estimated pose is multiplied from the left.

    estimate, reference : (N, 4, 4) paired poses. Planar ones are aligned within the plane, where a mirrored
    trajectory cannot be aligned by turning the plane over. Raises InputError where a rotation is unobservable.
    """
    if alignment is Alignment.NONE:
        return np.eye(4)
    if len(estimate) == 1:
        raise InputError("one paired pose alone: aligned by it the error is 0, whatever the trajectory; give two")
    if alignment is Alignment.FIRST:
        return reference[0] @ lie.inverse(estimate[0])
    d = 2 if _is_planar(estimate) and _is_planar(reference) else 3
    if len(estimate) < d:
        raise InputError(
            "rigid alignment takes 2 paired poses in the plane and 3 in space, not "
            f"{len(estimate)}; align by the first pose or not at all"
        )
    try:
        T = rigid_transform(estimate[:, :d, 3], reference[:, :d, 3], np.ones(len(estimate)))
    except DegeneratePairsError as error:
        raise InputError(
            f"rigid alignment is undetermined: {error}; align by the first pose or not at all"
        ) from None
    if d == 2:
        T = lie.lift(T)
        T[2, 3] = reference[0, 2, 3] - estimate[0, 2, 3]
    return T


def _is_planar(poses: Matrix) -> bool:
    """True if all poses have one height and turn about the vertical only."""
    level = np.ptp(poses[:, 2, 3]) < _PLANAR
    return bool(level and np.abs(poses[:, :2, 2]).max() < _PLANAR and (poses[:, 2, 2] > 0.0).all())


def path_length(poses: Matrix) -> Floats:
    """(N,) meters traveled up to each pose."""
    steps_m = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    return np.append(0.0, np.cumsum(steps_m))


@dataclass(frozen=True, slots=True)
class Statistics:
    """Figures of a set of absolute errors, in the errors' own unit.

    ``std`` is that of the errors at hand (divided by their count, not by count − 1); all are 0 for no errors.
    """

    count: int
    mean: float
    std: float
    rmse: float
    median: float
    minimum: float
    maximum: float

    @classmethod
    def of(cls, errors: Floats) -> Statistics:
        """The figures of (N,) errors."""
        if not len(errors):
            return cls(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        rmse, median = np.sqrt(np.mean(errors * errors)), np.median(errors)
        figures = (errors.mean(), errors.std(), rmse, median, errors.min(), errors.max())
        return cls(len(errors), *map(float, figures))

    @property
    def degrees(self) -> Statistics:
        """The figures of errors in radians converted to degrees, for printing."""
        return Statistics(self.count, *(float(np.degrees(value)) for value in astuple(self)[1:]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """Errors of poses or of motions, one by one, and their figures.

    definition : of the figures, as text; pairing : over which poses
    errors_m, errors_rad : (N,) one by one; translation_m, rotation_rad : statistics of these
    """

    definition: str
    pairing: str = ""
    errors_m: Floats
    errors_rad: Floats
    translation_m: Statistics = field(init=False)
    rotation_rad: Statistics = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "translation_m", Statistics.of(self.errors_m))
        object.__setattr__(self, "rotation_rad", Statistics.of(self.errors_rad))

    def __repr__(self) -> str:
        return f"<{self.summary}>"

    @property
    def summary(self) -> str:
        """The figures in one line."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class AbsoluteError(Metric):
    """ATE over paired poses (Sturm et al. 2012, eq. 3; Zhang & Scaramuzza 2018).

    translation_m : of ‖t_ref − t_est‖
    rotation_rad : of the angle of R_refᵀ R_est; after a rigid alignment turned by the best common rotation
    path_length_m : of the reference, over the paired poses
    T_reference_estimate : the alignment that was found
    """

    alignment: Alignment
    path_length_m: float
    T_reference_estimate: Pose

    @property
    def share_of_path(self) -> float | None:
        """Root mean squared translational error over the length of the path; None where that is too short."""
        return self.translation_m.rmse / self.path_length_m if self.path_length_m >= _SHORTEST_PATH_M else None

    @property
    def summary(self) -> str:
        """The figures in one line."""
        share, rotation_deg = self.share_of_path, self.rotation_rad.degrees.rmse
        of_path = "" if share is None else f"; {100.0 * share:.3f} % of {self.path_length_m:.1f} m"
        return (
            f"ATE rmse {self.translation_m.rmse:.4f} m (mean {self.translation_m.mean:.4f}, "
            f"max {self.translation_m.maximum:.4f}{of_path}), rotation rmse {rotation_deg:.3f} deg"
        )


def far_off(ate_rmse_m: float, path_length_m: float, rotation_rmse_rad: float) -> str:
    """Warning that an ATE is too large for odometry that works, or only its rotations; empty where neither is."""
    if ate_rmse_m <= max(_FAR_OFF[0] * path_length_m, _FAR_OFF[1]):
        if rotation_rmse_rad <= _FAR_OFF_RAD:
            return ""
        return (
            f"orientations are far from the ground truth, {np.degrees(rotation_rmse_rad):.0f} deg, and positions "
            "are not: it has none, or those of other axes (a camera's), which rotations, RPE and KITTI compare"
        )
    return (
        f"far from the ground truth: ATE {ate_rmse_m:.2f} m on a path of {path_length_m:.1f} m; above "
        f"{100.0 * _FAR_OFF[0]:g} % a trajectory is wrong somewhere, or the truth is in another unit, uses "
        "another clock, follows another body or does not move"
    )


def absolute_error(pairs: Pairs, alignment: Alignment = Alignment.RIGID) -> AbsoluteError:
    """Align the estimate to the reference and compare pose by pose."""
    T = align(pairs.estimate, pairs.reference, alignment)
    aligned = T @ pairs.estimate
    errors_m = np.linalg.norm(pairs.reference[:, :3, 3] - aligned[:, :3, 3], axis=1)
    rotations = "R_refᵀ R_est"
    if alignment is Alignment.RIGID:
        aligned = _turned(aligned, pairs.reference)
        rotations += " turned by the best common rotation"
    return AbsoluteError(
        definition=(
            f"ATE: ‖t_ref − t_est‖ after alignment '{alignment}' ({_ALIGNMENTS[alignment]}) and the angle of "
            f"{rotations}"
        ),
        pairing=pairs.description,
        alignment=alignment,
        path_length_m=float(path_length(pairs.reference)[-1]),
        T_reference_estimate=T,
        errors_m=errors_m,
        errors_rad=lie.rotation_angle(lie.between(pairs.reference, aligned)),
    )


def absolute_error_of_any_path(pairs: Pairs) -> AbsoluteError:
    """ATE after rigid alignment or, where a straight trajectory leaves a rotation free, by the first pose."""
    try:
        return absolute_error(pairs)
    except InputError:
        return absolute_error(pairs, Alignment.FIRST)


def on_the_estimate(estimate: Trajectory, reference: Trajectory, *, gap_s: float | None = None) -> Trajectory:
    """The reference at the stamps of the estimate, moved onto it by the alignment of the ATE.

    Raises InputError where they have no pairs.
    """
    pairs = pair(estimate, reference, gap_s=gap_s)
    T_reference_estimate = absolute_error_of_any_path(pairs).T_reference_estimate
    return Trajectory(pairs.stamps_ns, lie.inverse(T_reference_estimate) @ pairs.reference)


def _turned(estimate: Matrix, reference: Matrix) -> Matrix:
    """The estimate (N, 4, 4) turned by the one rotation R that minimizes Σ ‖R_ref − R R_est‖² (Umeyama 1991).

    Positions alone leave the roll about a straight path to the noise; a rotation error must not inherit that.
    """
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", reference[:, :3, :3], estimate[:, :3, :3]))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return T @ estimate


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RelativeError(Metric):
    """RPE over segments of one size (Sturm et al. 2012, eq. 1; Kümmerle et al. 2009).

    size : of the segments, in words
    translation_m, rotation_rad : of E = (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j), R the reference and P the estimate
    segments : (M, 2) int64 indices i, j of the first and last pair of each segment
    """

    size: str
    segments: NDArray[np.int64]

    @property
    def summary(self) -> str:
        """The figures in one line."""
        return (
            f"RPE over {self.size}: rmse {self.translation_m.rmse:.4f} m (mean {self.translation_m.mean:.4f}, "
            f"max {self.translation_m.maximum:.4f}), rotation rmse {self.rotation_rad.degrees.rmse:.4f} deg "
            f"over {counted(self.translation_m.count, 'segment')}"
        )


def relative_error_over_frames(pairs: Pairs, frames: int = 1) -> RelativeError:
    """RPE between each pair and the one ``frames`` later."""
    return _relative_error(pairs, np.arange(len(pairs)), frames, counted(frames, "paired pose"))


def relative_error_over_distance(pairs: Pairs, distance_m: float) -> RelativeError:
    """RPE from each pair to the first that lies at least ``distance_m`` further along the reference's path."""
    return _relative_error(
        pairs, path_length(pairs.reference), distance_m, f"{distance_m:g} m along the reference"
    )


def relative_error_over_time(pairs: Pairs, duration_s: float) -> RelativeError:
    """RPE from each pair to the first at least ``duration_s`` later; stamps that step back count as no time."""
    elapsed_ns = np.maximum.accumulate(pairs.stamps_ns - pairs.stamps_ns[0])
    duration_ns = round(duration_s * 1e9) if duration_s > 0.0 else 0
    return _relative_error(pairs, elapsed_ns, duration_ns, f"{duration_s:g} s")


def _relative_error(pairs: Pairs, along: Floats | NDArray[np.int64], size: float, words: str) -> RelativeError:
    """RPE from each pair to the first that lies at least a size further, unless a gap makes it over twice as far.

    along : (N,) frames, meters or nanoseconds up to each pair
    """
    if not size > 0.0:
        raise InputError(f"RPE over {words} is not defined; take more than 0")
    end = np.searchsorted(along, along + size, side="left")
    reached = along[np.minimum(end, len(along) - 1)]
    start = np.flatnonzero((end < len(pairs)) & (reached - along <= _LARGEST * size))
    if not len(start):
        raise InputError(
            f"RPE over {words}: no segment of that length fits into {counted(len(pairs), 'paired pose')}"
        )
    segments = np.stack([start, end[start]], axis=1)
    errors_m, errors_rad = _motion_errors(pairs, segments)
    return RelativeError(
        size=words,
        definition=(
            f"RPE: translation and angle of (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j) over {words}, from every start, "
            f"{counted(len(segments), 'segment')}"
        ),
        pairing=pairs.description,
        segments=segments,
        errors_m=errors_m,
        errors_rad=errors_rad,
    )


def _motion_errors(pairs: Pairs, segments: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Translation (M,) and angle (M,) of E = (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j) of each segment (i, j)."""
    i, j = segments[:, 0], segments[:, 1]
    reference = lie.between(pairs.reference[i], pairs.reference[j])
    estimate = lie.between(pairs.estimate[i], pairs.estimate[j])
    return _sizes(lie.between(reference, estimate))


def _sizes(error: Matrix) -> tuple[Floats, Floats]:
    """Translation (M,) and angle (M,) of motions (M, 4, 4)."""
    return np.linalg.norm(error[:, :3, 3], axis=1), lie.rotation_angle(error)


@dataclass(frozen=True, slots=True)
class LengthError:
    """Mean drift over the segments of one length; None where none fits."""

    length_m: float
    segments: int
    translation_share: float | None
    rotation_rad_per_m: float | None


@dataclass(frozen=True, slots=True)
class KittiError:
    """Drift, averaged over all segments of all lengths (Geiger et al. 2012).

    translation_share : ‖t‖ / length; times 100 it is the published per cent
    rotation_rad_per_m : angle / length
    segments : number of segments, in all and in ``by_length``
    """

    __repr__ = brief
    definition: str
    pairing: str
    translation_share: float
    rotation_rad_per_m: float
    segments: int
    by_length: tuple[LengthError, ...]

    @property
    def summary(self) -> str:
        """The figures in one line, in the units they are published in."""
        return (
            f"KITTI translation {100.0 * self.translation_share:.4f} %, rotation "
            f"{np.degrees(self.rotation_rad_per_m):.6f} deg/m over {counted(self.segments, 'segment')}"
        )


def kitti_error(pairs: Pairs, lengths_m: Sequence[float] = KITTI_LENGTHS_M, *, every: int = 10) -> KittiError:
    """The odometry metric of KITTI, over segments that start at every ``every``-th pose.

    A segment ends at the first pose more than its length further along the reference's path, and its error is
    divided by the nominal length, as in the benchmark's own code (step 10, lengths 100 to 800 m).
    """
    if every < 1 or not lengths_m or min(lengths_m) <= 0.0:
        raise InputError(f"lengths {list(lengths_m)} m from every {every} poses: take positive ones")
    traveled_m, start = path_length(pairs.reference), np.arange(0, len(pairs), every)
    by_length, shares, turns = [], [], []
    for length_m in lengths_m:
        end = np.searchsorted(traveled_m, traveled_m[start] + length_m, side="right")
        fits = end < len(pairs)
        errors_m, errors_rad = _motion_errors(pairs, np.stack([start[fits], end[fits]], axis=1))
        shares.append(errors_m / length_m)
        turns.append(errors_rad / length_m)
        means = (float(shares[-1].mean()), float(turns[-1].mean())) if fits.any() else (None, None)
        by_length.append(LengthError(length_m, len(errors_m), *means))
    share, turn = np.concatenate(shares), np.concatenate(turns)
    if not len(share):
        raise InputError(
            f"KITTI metric: no segment of {min(lengths_m):g} m fits into a path of {traveled_m[-1]:.1f} m"
        )
    starts = "pose" if every == 1 else f"{every}th pose"
    lengths = ", ".join(f"{length_m:g}" for length_m in lengths_m)
    return KittiError(
        definition=(
            f"KITTI: translation and angle of (P_i⁻¹ P_j)⁻¹ (R_i⁻¹ R_j) over the length, mean of {len(share)} "
            f"segments of {lengths} m from every {starts}"
        ),
        pairing=pairs.description,
        translation_share=float(share.mean()),
        rotation_rad_per_m=float(turn.mean()),
        segments=len(share),
        by_length=tuple(by_length),
    )


def kitti_error_of_any_path(pairs: Pairs) -> KittiError:
    """The published lengths where the path is long enough for them, else 10, 20 and 40 m from every pose."""
    if path_length(pairs.reference)[-1] >= KITTI_LENGTHS_M[1]:  # which allows several starts of the first one
        return kitti_error(pairs)
    return kitti_error(pairs, SHORT_LENGTHS_M, every=1)


def relative_errors(
    pairs: Pairs, intervals: Iterable[tuple[float, str]]
) -> tuple[dict[str, RelativeError | KittiError], dict[str, str]]:
    """RPE over each interval, as "rpe_1_pose", "rpe_1_s" or "rpe_10_m", and "kitti"; reasons for those left out.

    intervals : sizes in "pose", "s" or "m"
    """
    over: dict[str, Callable[..., RelativeError]] = {
        "pose": relative_error_over_frames,
        "s": relative_error_over_time,
        "m": relative_error_over_distance,
    }
    measures: dict[str, Callable[[], RelativeError | KittiError]] = {
        f"rpe_{size:g}_{unit}": partial(over[unit], pairs, int(size) if unit == "pose" else size)
        for size, unit in intervals
    }
    found, missing = {}, {}
    for name, measure in {**measures, "kitti": partial(kitti_error_of_any_path, pairs)}.items():
        try:
            found[name] = measure()
        except InputError as error:
            missing[name] = str(error)
    return found, missing


@dataclass(frozen=True, slots=True)
class Relations:
    """Relative poses ``T_first_second`` (M, 4, 4) between the scans stamped ``stamps_ns`` (M, 2)."""

    stamps_ns: NDArray[np.int64]
    T_first_second: Matrix

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RelationError(Metric):
    """Error over relations (Kümmerle et al. 2009, eq. 4, its translational and rotational parts apart).

    translation_m, translation_squared_m2 : of ‖trans(δ*⁻¹ δ)‖ and of its square
    rotation_rad, rotation_squared_rad2 : of |rot(δ*⁻¹ δ)| and of its square
    missing : relations left out because the trajectory has no pose at one of their stamps
    used : (K,) int64, the relations compared
    """

    translation_squared_m2: Statistics
    rotation_squared_rad2: Statistics
    missing: int
    used: NDArray[np.int64]

    @property
    def summary(self) -> str:
        """The figures as published: mean ± std, absolute and squared, meters and degrees."""
        rotation, squared = self.rotation_rad.degrees, self.rotation_squared_rad2.degrees.degrees
        return (
            f"relations: translation {self.translation_m.mean:.4f} ± {self.translation_m.std:.4f} m, squared "
            f"{self.translation_squared_m2.mean:.4f} ± {self.translation_squared_m2.std:.4f} m²; rotation "
            f"{rotation.mean:.3f} ± {rotation.std:.3f} deg, squared {squared.mean:.3f} ± {squared.std:.3f} deg²; "
            f"{counted(self.translation_m.count, 'relation')}, {self.missing} missing"
        )


def read_relations(path: Path | str) -> Relations:
    """Relations of a text file, ``stamp1 stamp2 x y z roll pitch yaw`` per line, angles in radians."""
    _, stamps_ns, values = table(path, "relation", _FIELDS, stamps=2)
    R = Rotation.from_euler("xyz", values[:, 3:]).as_matrix()
    return Relations(stamps_ns, posed(R, values[:, :3]))


def relation_error(
    trajectory: Trajectory, relations: Relations, *, limit_s: float = RELATION_LIMIT_S
) -> RelationError:
    """Compare every relation δ* with δ = T_first⁻¹ T_second of the trajectory.

    Each stamp takes the pose nearest in time, at most ``limit_s`` away; scans may follow each other within a
    millisecond and logs carry rounding noise of some 100 ns, so that nearest, not first within reach, is right.
    The trajectory must follow the frame that the relations were made in (here: of the lidar).
    """
    index, difference_ns = nearest(relations.stamps_ns.ravel(), trajectory.stamps_ns)
    found = (difference_ns <= round(limit_s * 1e9)).reshape(-1, 2).all(axis=1)
    used = np.flatnonzero(found)
    if not len(used):
        raise InputError(
            f"none of {len(relations)} relations has both its stamps within {limit_s:g} s of a pose; "
            "check that the relations belong to this log"
        )
    first, second = index.reshape(-1, 2)[used].T
    poses = lie.lift(trajectory.poses)
    estimated = lie.between(poses[first], poses[second])
    errors_m, errors_rad = _sizes(lie.between(relations.T_first_second[used], estimated))
    return RelationError(
        definition=(
            f"relations (Kümmerle et al. 2009): ‖trans‖ and |rot| of δ*⁻¹ δ, δ = T_first⁻¹ T_second at the poses "
            f"nearest in time within {limit_s:g} s; {len(used)} of {len(relations)} relations, "
            f"{len(relations) - len(used)} without a pose"
        ),
        translation_squared_m2=Statistics.of(errors_m**2),
        rotation_squared_rad2=Statistics.of(errors_rad**2),
        missing=len(relations) - len(used),
        used=used,
        errors_m=errors_m,
        errors_rad=errors_rad,
    )
