"""Absolute trajectory error (ATE), the alignment before it, and statistics of errors."""

from __future__ import annotations

from dataclasses import astuple, dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix, Pose, Trajectory
from scanchain.errors import InputError
from scanchain.evaluation.pairing import Pairs, pair
from scanchain.registration.svd_icp import DegeneratePairsError, rigid_transform

_PLANAR = 1e-9  # meters of height and radians of tilt below which poses count as planar
_FAR_OFF_SHARE, _FAR_OFF_M = 0.02, 0.1  # ATE above both of which odometry failed: share of the path, meters
_SHORTEST_PATH_M = 1.0  # shortest path of which an error is given as a share


class Alignment(StrEnum):
    """Alignment of the estimate to the reference before comparison. None changes the scale."""

    NONE = "none"
    FIRST = "first"
    RIGID = "rigid"

    @property
    def description(self) -> str:
        """Definition of the alignment as text."""
        return {
            Alignment.NONE: "frames taken as they are",
            Alignment.FIRST: "first paired poses made equal",
            Alignment.RIGID: "rigid least squares over the positions (Umeyama 1991, without scale)",
        }[self]


def align(estimate: Matrix, reference: Matrix, alignment: Alignment) -> Pose:
    """T_reference_estimate (4, 4), to be put in front of each estimated pose.

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
    if d == 3:
        return T
    T = lie.lift(T)
    T[2, 3] = reference[0, 2, 3] - estimate[0, 2, 3]
    return T


def _is_planar(poses: Matrix) -> bool:
    """True if all poses have one height and turn about the vertical only."""
    level = np.ptp(poses[:, 2, 3]) < _PLANAR
    return bool(level and np.abs(poses[:, :2, 2]).max() < _PLANAR and (poses[:, 2, 2] > 0.0).all())


def far_off(ate_rmse_m: float, share: float | None, path_length_m: float) -> str:
    """Warning that an ATE is too large for odometry that works; empty where it is not."""
    if share is None or share <= _FAR_OFF_SHARE or ate_rmse_m <= _FAR_OFF_M:
        return ""
    return (
        f"far from the ground truth: ATE {ate_rmse_m:.2f} m, {100.0 * share:.1f} % of a path of "
        f"{path_length_m:.1f} m; above {100.0 * _FAR_OFF_SHARE:g} % a trajectory is wrong somewhere, or the truth "
        "is in another unit, keeps another clock or follows another body"
    )


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
    def of(cls, errors: NDArray[np.float64]) -> Statistics:
        """The figures of (N,) errors."""
        if not len(errors):
            return cls(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return cls(
            count=len(errors),
            mean=float(errors.mean()),
            std=float(errors.std()),
            rmse=float(np.sqrt(np.mean(errors * errors))),
            median=float(np.median(errors)),
            minimum=float(errors.min()),
            maximum=float(errors.max()),
        )

    @property
    def degrees(self) -> Statistics:
        """Those of radians in degrees, for print."""
        return Statistics(self.count, *(float(np.degrees(value)) for value in astuple(self)[1:]))


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseErrors:
    """Errors of poses or of motions, one by one, and their figures.

    definition : of the figures, as text; pairing : over which poses
    errors_m, errors_rad : (N,) one by one; translation_m, rotation_rad : statistics of these
    """

    definition: str
    pairing: str = ""
    errors_m: NDArray[np.float64]
    errors_rad: NDArray[np.float64]
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
class AbsoluteError(PoseErrors):
    """ATE over paired poses (Sturm et al. 2012, eq. 3; Zhang & Scaramuzza 2018).

    Attributes
    ----------
    alignment : how the frames were brought together
    translation_m : of ‖t_ref − t_est‖
    rotation_rad : of the angle of R_refᵀ R_est; after a rigid alignment turned by the best common rotation
    path_length_m : of the reference, over the paired poses
    T_reference_estimate : the alignment that was found
    errors_m, errors_rad : (N,) in the order of the pairs
    """

    alignment: Alignment
    path_length_m: float
    T_reference_estimate: Pose

    @property
    def share_of_path(self) -> float | None:
        """Root mean squared translational error over the length of the path; None where that is too short."""
        return self.translation_m.rmse / self.path_length_m if self.path_length_m >= _SHORTEST_PATH_M else None

    @property
    def complaint(self) -> str:
        """Warning that the estimate is far from the reference; empty where it is not."""
        return far_off(self.translation_m.rmse, self.share_of_path, self.path_length_m)

    @property
    def summary(self) -> str:
        """The figures in one line."""
        rotation, share = self.rotation_rad.degrees, self.share_of_path
        of_path = "" if share is None else f"; {100.0 * share:.3f} % of {self.path_length_m:.1f} m"
        return (
            f"ATE rmse {self.translation_m.rmse:.4f} m (mean {self.translation_m.mean:.4f}, "
            f"max {self.translation_m.maximum:.4f}{of_path}), rotation rmse {rotation.rmse:.3f} deg"
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
    errors_rad = lie.rotation_angle(lie.between(pairs.reference, aligned))
    return AbsoluteError(
        definition=(
            f"ATE: ‖t_ref − t_est‖ after alignment '{alignment}' ({alignment.description}) and the angle of "
            f"{rotations}"
        ),
        pairing=pairs.description,
        alignment=alignment,
        path_length_m=float(path_length(pairs.reference)[-1]),
        T_reference_estimate=T,
        errors_m=errors_m,
        errors_rad=errors_rad,
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


def path_length(poses: Matrix) -> NDArray[np.float64]:
    """(N,) meters traveled up to each pose."""
    steps_m = np.linalg.norm(np.diff(poses[:, :-1, -1], axis=0), axis=1)
    return np.append(0.0, np.cumsum(steps_m))
