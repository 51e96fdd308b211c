"""Errors of relative poses: RPE, the KITTI odometry metric, and relations checked by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.data import Matrix, Trajectory, brief
from scanchain.errors import InputError, counted
from scanchain.evaluation.absolute import PoseErrors, Statistics, path_length
from scanchain.evaluation.pairing import Pairs, nearest
from scanchain.trajectory import posed, table

_LARGEST = 2.0  # largest length of a stretch over the requested one
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS_M = (10.0, 20.0, 40.0)
_LONG_PATH_M = 200.0  # length of the path from which on the published lengths leave a choice of starts
RELATION_LIMIT_S = 1e-3
_FIELDS = "stamp1 stamp2 x y z roll pitch yaw"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RelativeError(PoseErrors):
    """RPE over stretches of one size (Sturm et al. 2012, eq. 1; Kümmerle et al. 2009).

    Attributes
    ----------
    size : of the stretches, in words
    translation_m, rotation_rad : of E = (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j), R the reference and P the estimate
    stretches : (M, 2) int64 places i, j among the pairs
    """

    size: str
    stretches: NDArray[np.int64]

    @property
    def summary(self) -> str:
        """The figures in one line."""
        rotation = self.rotation_rad.degrees
        return (
            f"RPE over {self.size}: rmse {self.translation_m.rmse:.4f} m (mean {self.translation_m.mean:.4f}, "
            f"max {self.translation_m.maximum:.4f}), rotation rmse {rotation.rmse:.4f} deg "
            f"over {counted(self.translation_m.count, 'stretch', 'stretches')}"
        )


def relative_error_over_frames(pairs: Pairs, frames: int = 1) -> RelativeError:
    """RPE between each pair and the one ``frames`` later."""
    if frames < 1:
        raise InputError(f"RPE over {frames} frames is not defined; take at least 1")
    end = np.arange(len(pairs)) + frames
    return _relative_error(pairs, end, counted(frames, "paired pose"))


def relative_error_over_distance(pairs: Pairs, distance_m: float) -> RelativeError:
    """RPE from each pair to the first that lies at least ``distance_m`` further along the reference's path."""
    if not distance_m > 0.0:
        raise InputError(f"RPE over {distance_m:g} m is not defined; take more than 0")
    traveled_m = path_length(pairs.reference)
    end = _of_that_size(traveled_m, np.searchsorted(traveled_m, traveled_m + distance_m, side="left"), distance_m)
    return _relative_error(pairs, end, f"{distance_m:g} m along the reference")


def relative_error_over_time(pairs: Pairs, duration_s: float) -> RelativeError:
    """RPE from each pair to the first at least ``duration_s`` later; stamps that step back count as no time."""
    if not duration_s > 0.0:
        raise InputError(f"RPE over {duration_s:g} s is not defined; take more than 0")
    elapsed_ns = np.maximum.accumulate(pairs.stamps_ns - pairs.stamps_ns[0])
    duration_ns = round(duration_s * 1e9)
    end = _of_that_size(
        elapsed_ns, np.searchsorted(elapsed_ns, elapsed_ns + duration_ns, side="left"), duration_ns
    )
    return _relative_error(pairs, end, f"{duration_s:g} s")


def _of_that_size(
    along: NDArray[np.float64] | NDArray[np.int64], end: NDArray[np.int64], size: float
) -> NDArray[np.int64]:
    """The ends (N,) of stretches, N for one that has none, or whose pose after a gap makes it too large."""
    reached = along[np.minimum(end, len(along) - 1)]
    return np.where(reached - along <= _LARGEST * size, end, len(along))


def _motion_errors(pairs: Pairs, stretches: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Translation (M,) and angle (M,) of E = (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j) of each stretch (i, j)."""
    i, j = stretches[:, 0], stretches[:, 1]
    reference = lie.between(pairs.reference[i], pairs.reference[j])
    estimate = lie.between(pairs.estimate[i], pairs.estimate[j])
    return _sizes(lie.between(reference, estimate))


def _sizes(error: Matrix) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Translation (M,) and angle (M,) of motions (M, 4, 4)."""
    return np.linalg.norm(error[:, :3, 3], axis=1), lie.rotation_angle(error)


def _relative_error(pairs: Pairs, end: NDArray[np.int64], size: str) -> RelativeError:
    start = np.flatnonzero(end < len(pairs))
    if not len(start):
        raise InputError(
            f"RPE over {size}: no stretch of that length fits into {counted(len(pairs), 'paired pose')}"
        )
    stretches = np.stack([start, end[start]], axis=1)
    errors_m, errors_rad = _motion_errors(pairs, stretches)
    return RelativeError(
        size=size,
        definition=(
            f"RPE: translation and angle of (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j) over {size}, from every start, "
            f"{counted(len(stretches), 'stretch', 'stretches')}"
        ),
        pairing=pairs.description,
        stretches=stretches,
        errors_m=errors_m,
        errors_rad=errors_rad,
    )


@dataclass(frozen=True, slots=True)
class LengthError:
    """Mean drift over the stretches of one length; None where none fits."""

    length_m: float
    stretches: int
    translation_share: float | None
    rotation_rad_per_m: float | None


@dataclass(frozen=True, slots=True)
class KittiError:
    """Drift, averaged over all stretches of all lengths (Geiger et al. 2012).

    Attributes
    ----------
    definition : of the figures, as text; pairing : over which poses
    translation_share : ‖t‖ / length; times 100 it is the published per cent
    rotation_rad_per_m : angle / length
    stretches : how many there were
    by_length : the same, length by length
    """

    __repr__ = brief
    definition: str
    pairing: str
    translation_share: float
    rotation_rad_per_m: float
    stretches: int
    by_length: tuple[LengthError, ...]

    @property
    def summary(self) -> str:
        """The figures in one line, in the units they are published in."""
        return (
            f"KITTI translation {100.0 * self.translation_share:.4f} %, rotation "
            f"{np.degrees(self.rotation_rad_per_m):.6f} deg/m over "
            f"{counted(self.stretches, 'stretch', 'stretches')}"
        )


def kitti_error(pairs: Pairs, lengths_m: Sequence[float] = KITTI_LENGTHS_M, *, every: int = 10) -> KittiError:
    """Drift over stretches that start at every ``every``-th pose.

    A stretch ends at the first pose more than its length further along the reference's path, and its error is
    divided by the nominal length, as in the benchmark's own code (step 10, lengths 100 to 800 m).
    """
    if every < 1 or not lengths_m or min(lengths_m) <= 0.0:
        raise InputError(f"lengths {list(lengths_m)} m from every {every} poses: take positive ones")
    traveled_m = path_length(pairs.reference)
    by_length, shares, turns = [], [], []
    for length_m in lengths_m:
        share, turn = _drift(pairs, traveled_m, length_m, every)
        shares.append(share)
        turns.append(turn)
        by_length.append(LengthError(length_m, len(share), _mean(share), _mean(turn)))
    share, turn = np.concatenate(shares), np.concatenate(turns)
    if not len(share):
        raise InputError(
            f"KITTI metric: no stretch of {min(lengths_m):g} m fits into a path of {traveled_m[-1]:.1f} m"
        )
    starts = "pose" if every == 1 else f"{every}th pose"
    lengths = ", ".join(f"{length_m:g}" for length_m in lengths_m)
    return KittiError(
        definition=(
            f"KITTI: translation and angle of (P_i⁻¹ P_j)⁻¹ (R_i⁻¹ R_j) over the length, mean of {len(share)} "
            f"stretches of {lengths} m from every {starts}"
        ),
        pairing=pairs.description,
        translation_share=float(share.mean()),
        rotation_rad_per_m=float(turn.mean()),
        stretches=len(share),
        by_length=tuple(by_length),
    )


def kitti_error_of_any_path(pairs: Pairs) -> KittiError:
    """The published lengths where the path is long enough for them, else 10, 20 and 40 m from every pose."""
    if path_length(pairs.reference)[-1] >= _LONG_PATH_M:
        return kitti_error(pairs)
    return kitti_error(pairs, SHORT_LENGTHS_M, every=1)


def relative_errors(
    pairs: Pairs, intervals: Iterable[tuple[float, str]]
) -> tuple[dict[str, RelativeError | KittiError], dict[str, str]]:
    """RPE over each interval, as "rpe_1_pose", "rpe_1_s" or "rpe_10_m", and "kitti"; reasons for those left out.

    intervals : sizes in "pose", "s" or "m"
    """
    over: dict[str, Callable[[Pairs, float], RelativeError]] = {
        "pose": lambda pairs, size: relative_error_over_frames(pairs, int(size)),
        "s": relative_error_over_time,
        "m": relative_error_over_distance,
    }
    metrics: dict[str, Callable[[], RelativeError | KittiError]] = {
        **{f"rpe_{size:g}_{unit}": partial(over[unit], pairs, size) for size, unit in intervals},
        "kitti": partial(kitti_error_of_any_path, pairs),
    }
    found, missing = {}, {}
    for name, metric in metrics.items():
        try:
            found[name] = metric()
        except InputError as error:
            missing[name] = str(error)
    return found, missing


def _drift(
    pairs: Pairs, traveled_m: NDArray[np.float64], length_m: float, every: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Translational share and rad/m of every stretch of a length."""
    start = np.arange(0, len(pairs), every)
    end = np.searchsorted(traveled_m, traveled_m[start] + length_m, side="right")
    fits = end < len(pairs)
    errors_m, errors_rad = _motion_errors(pairs, np.stack([start[fits], end[fits]], axis=1))
    return errors_m / length_m, errors_rad / length_m


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if len(values) else None


@dataclass(frozen=True, slots=True)
class Relations:
    """Relative poses ``T_first_second`` (M, 4, 4) between the scans stamped ``stamps_ns`` (M, 2)."""

    stamps_ns: NDArray[np.int64]
    T_first_second: Matrix

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RelationError(PoseErrors):
    """Error over relations (Kümmerle et al. 2009, eq. 4, its translational and rotational parts apart).

    Attributes
    ----------
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
    """Relations of a text file, ``stamp1 stamp2 x y z roll pitch yaw`` a line, angles in radians."""
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
