"""The metric of relations: relative poses checked by hand, each compared with those of the trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.data import Matrix, Trajectory
from scanchain.errors import InputError, counted
from scanchain.evaluation.pairing import PoseErrors, Statistics, nearest
from scanchain.trajectory import posed, table

RELATION_LIMIT_S = 1e-3
_FIELDS = "stamp1 stamp2 x y z roll pitch yaw"


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
    error = lie.between(relations.T_first_second[used], estimated)
    errors_m, errors_rad = np.linalg.norm(error[:, :3, 3], axis=1), lie.rotation_angle(error)
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
