"""The closed-form rigid transformation between paired points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain import checks
from scanchain.data import AnyPoints, Pose
from scanchain.errors import InputError, ScanchainError
from scanchain.words import counted

_RANK_TOLERANCE = 1e-9  # of the largest singular value
_ROUNDINGS = 64.0  # of the products of the means, below which a singular value is noise


class DegeneratePairsError(ScanchainError):
    """The pairs leave a rotation free: all on one point, or in 3D on one line."""


def rigid_transform(source: AnyPoints, target: AnyPoints, weight: NDArray[np.floating] | None = None) -> Pose:
    """The pose T that minimizes Σ wᵢ ‖yᵢ − (R xᵢ + t)‖².

    With centered x' and y' and W = Σ wᵢ x'ᵢ y'ᵢᵀ = U Σ Vᵀ,
        R = V diag(1, …, det(V Uᵀ)) Uᵀ        t = μ_y − R μ_x
    (Arun, Huang & Blostein 1987; the determinant after Umeyama 1991, eq. 43; weights after Sorkine-Hornung &
    Rabinovich 2017, eq. 22). Without the determinant noisy or planar points give a reflection.

    source, target : (N, d) meters, pair by pair; weight : (N,), ≥ 0, 1 where left out
    Raises DegeneratePairsError where W leaves the rotation undetermined: rank below d − 1.
    """
    d = checks.dimension_of(source, "source")
    source = checks.points(source, "source", d)
    target = checks.points(target, "target", d)
    if len(target) != len(source):
        raise InputError(
            f"target has {counted(len(target), 'point')}, source {len(source)}; wanted pairs, row by row"
        )
    weight = np.ones(len(source)) if weight is None else checks.weights(weight, "weight", len(source))
    total = weight.sum()
    if len(source) < d or total <= 0.0:
        raise DegeneratePairsError(f"{len(source)} pairs of weight {total:g} do not determine a rotation in {d}D")
    mean_x, mean_y = weight @ source / total, weight @ target / total
    W = ((source - mean_x) * weight[:, None]).T @ (target - mean_y)
    U, singular, Vt = np.linalg.svd(W)
    rounding = np.finfo(float).eps * total * np.linalg.norm(mean_x) * np.linalg.norm(mean_y)
    if singular[d - 2] <= max(_RANK_TOLERANCE * singular[0] if d == 3 else 0.0, _ROUNDINGS * rounding):
        raise DegeneratePairsError(
            f"all {len(source)} pairs lie on a {'line' if d == 3 else 'point'}: the rotation about it is free"
        )
    signs = np.ones(d)
    signs[-1] = np.linalg.det(Vt.T @ U.T)
    T = np.eye(d + 1)
    T[:d, :d] = (Vt.T * np.sign(signs)) @ U.T
    T[:d, d] = mean_y - T[:d, :d] @ mean_x
    return T
