"""Bounds on the error of a trajectory by independent estimates of the same motion.

Two estimates whose errors are independent differ by more than either errs: e₁² ≤ e₁² + e₂², in the mean.
"""

from __future__ import annotations

import numpy as np

from scanchain import lie
from scanchain.data import Matrix
from scanchain.registration.svd import DegeneratePairsError, rigid_transform
from scanchain.verdict.checks import Floats


def apart_m(positions: Floats, others: Floats) -> float:
    """Root mean squared distance of positions (N, d) after rigid alignment, as of an ATE."""
    weights = np.ones(len(positions))
    try:
        moved = lie.transform(rigid_transform(positions, others, weights), positions)
    except DegeneratePairsError:  # on a line, about which a rotation is free
        moved = positions - positions.mean(axis=0) + others.mean(axis=0)
    return float(np.sqrt(((moved - others) ** 2).sum(axis=1).mean()))


def wheel_bound_m(poses: Matrix, wheels: Matrix) -> float:
    """Difference of a trajectory (N, d+1, d+1) from the wheels, NaN where unknown, seen from above."""
    known = np.flatnonzero(np.isfinite(wheels[:, 0, 0]))
    level = wheels[known[0]] @ lie.between(poses[known[0]], poses[known])  # in the frame of the wheels
    return apart_m(level[:, :2, -1], wheels[known, :2, -1])
