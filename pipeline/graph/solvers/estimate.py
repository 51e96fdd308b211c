"""Where a minimization is, and where it ended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix


@dataclass(frozen=True, slots=True)
class Estimate:
    """Poses with what follows from them: residuals e, χ² of every edge, and the robust cost Σ ρ(χ²)."""

    poses: Matrix
    errors: Matrix
    chi2: NDArray[np.float64]
    cost: float


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where a minimization ended, with what robust weights (E,), after how many linear solves, and why."""

    estimate: Estimate
    weights: NDArray[np.float64]
    iterations: int
    converged: bool
    reason: str
