"""The rigid motion that carries an estimate into the reference's frame before they are compared."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.errors import InputError
from scanchain.registration.svd import DegeneratePairsError, rigid_transform

_PLANAR = 1e-9  # meters of height and radians of tilt below which poses count as planar


class Alignment(StrEnum):
    """How the two frames are brought together. None of them changes the scale."""

    NONE = "none"
    FIRST = "first"
    RIGID = "rigid"

    @property
    def description(self) -> str:
        """What is done, in words."""
        return {
            Alignment.NONE: "frames taken as they are",
            Alignment.FIRST: "first paired poses made equal",
            Alignment.RIGID: "rigid least squares over the positions (Umeyama 1991, without scale)",
        }[self]


def align(estimate: Matrix, reference: Matrix, alignment: Alignment) -> Pose:
    """T_reference_estimate (4, 4), to be put in front of each estimated pose.

    estimate, reference : (N, 4, 4) paired poses. Planar ones are aligned within the plane, where a mirrored
    course cannot be met by turning the plane over. Raises InputError where the positions leave a rotation free.
    """
    if alignment is Alignment.NONE:
        return np.eye(4)
    if alignment is Alignment.FIRST:
        return reference[0] @ lie.inverse(estimate[0])
    d = 2 if _is_planar(estimate) and _is_planar(reference) else 3
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
    """Whether all poses have one height and turn about the vertical only."""
    level = np.ptp(poses[:, 2, 3]) < _PLANAR
    return bool(level and np.abs(poses[:, :2, 2]).max() < _PLANAR and (poses[:, 2, 2] > 0.0).all())
