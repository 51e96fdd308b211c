"""Whether a minimum of a pose graph is the global one: a lower bound of χ² by Lagrangian duality."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.clock import working_s
from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.minorant import Minorants, minorize
from scanchain.graph.solvers.cholesky import BlockPattern, Packing, SingularMatrixError, SparseCholesky
from scanchain.graph.soundness import is_connected
from scanchain.kernels.graph.dual import scatter_dual
from scanchain.words import counted

_NOTHING = 1e-9  # χ² that is zero but for rounding; this share of the largest information where that is below 1
_SHARES = (0.0, 1e-6, 1e-4, 1e-2)  # of χ² that the bound may be given away for, one after the other


@dataclass(frozen=True, slots=True)
class Certificate:
    """What is known of the distance to the global minimum.

    Attributes
    ----------
    certified : whether no poses whatever have a χ² lower than this one by more than ``gap``
    gap : χ² less its lower bound, from 0 up; as large as χ² itself where nothing is known
    chi2 : Σ w eᵀΩe that was certified
    reason : why there is no certificate; empty where there is one
    time_s : wall time
    is_zero : whether χ² is zero but for rounding
    """

    certified: bool
    gap: float
    chi2: float
    reason: str
    time_s: float
    is_zero: bool = False

    @property
    def relative_gap(self) -> float:
        """The gap as a share of χ², 0 to 1; 0 where χ² is zero."""
        return 0.0 if self.is_zero else self.gap / self.chi2

    @property
    def verdict(self) -> str:
        """One line for people."""
        if self.certified and self.is_zero:
            return "globally optimal: χ² is zero"
        if self.certified:
            return f"globally optimal to within {self.gap:.2g} of χ² ({100.0 * self.relative_gap:.1g} %)"
        return f"not certified: {self.reason}"


def certify(
    problem: BetweenProblem,
    poses: Matrix,
    weights: NDArray[np.float64],
    undetermined: str,
    names: NDArray[np.int64],
) -> Certificate:
    """Bound the global minimum of Σ w eᵀΩe from below, with the weights w (E,) as they stand and any Ω.

    Every edge's χ² is replaced by a quadratic function of rotations and positions that is nowhere above it and
    touches it at these poses (``minorize``). The Lagrangian dual of that problem (Carlone et al. 2015; Rosen et
    al. 2019, theorem 1) bounds it in turn: if S, with the gauge fixed, is positive definite, then for all poses
        χ² ≥ χ²* − tr(rᵀ S⁻¹ r),   r = S X*, which vanishes where X* is a minimum to the last digit.
    Where S is not, μ I is added to its rotations, which lowers the bound. Definite means that the Cholesky
    factorization goes through, so the claim holds to the rounding of that. A few edges too far from their
    measurements for such a function are bounded by zero instead: their χ² is part of the gap. What leaves
    poses ``undetermined``, in words, leaves nothing to certify. ``names`` (K,) are what the poses are called.
    """
    begin = working_s()
    kept = weights > 0.0
    of_edges = weights * problem.chi2(problem.errors(poses))
    chi2 = float(of_edges.sum())
    is_zero = chi2 <= _NOTHING * min(float(problem.information.max(initial=0.0)), 1.0)
    if undetermined:
        return Certificate(False, chi2, chi2, undetermined, working_s() - begin, is_zero)
    if is_zero:
        return Certificate(True, chi2, chi2, "", working_s() - begin, is_zero)
    if len(poses) - len(problem.free) > 1:
        reason = f"{len(poses) - len(problem.free)} poses are fixed; the bound is for one"
        return Certificate(False, chi2, chi2, reason, working_s() - begin)
    centered = poses.copy()
    centered[:, :-1, -1] -= centered[:, :-1, -1].mean(axis=0)
    minorants = minorize(problem, centered, weights)
    loose = kept & np.isnan(minorants.kappa)
    given_up = float(of_edges[loose].sum())
    rest = problem.edges[kept & ~loose]
    if loose.any() and (given_up > _SHARES[-1] * chi2 or not is_connected(rest, problem.variable < 0)):
        i, j = names[problem.edges[loose][0]]
        reason = f"{counted(int(loose.sum()), 'edge')} too far from what was measured to be bounded, first {i}-{j}"
        return Certificate(False, chi2, chi2, reason, working_s() - begin)
    gap = _gap(problem, minorants, kept & ~loose, chi2)
    if gap is None:
        reason = "the dual matrix is not positive definite, as at a local minimum"
        borrowing = kept & ((minorants.tau < 0.0) | (minorants.kappa < 0.0))
        if borrowing.any():
            i, j = names[problem.edges[borrowing][0]]
            edges = counted(int(borrowing.sum()), "edge")
            reason += f", or where Ω says little of some direction, first at {i}-{j} of {edges}"
        return Certificate(False, chi2, chi2, reason, working_s() - begin)
    return Certificate(True, min(gap + given_up, chi2), chi2, "", working_s() - begin)


def _gap(problem: BetweenProblem, minorants: Minorants, kept: NDArray[np.bool_], chi2: float) -> float | None:
    """χ² less the best bound that a few shifts of the dual matrix give, None where none gives any."""
    n, d = len(problem.free), minorants.leap.shape[1]
    blocks = np.zeros((len(problem.pattern.rows), d + 1, d + 1))
    residual = np.zeros((n, d + 1, d))
    scatter_dual(
        minorants.leap[kept], minorants.force[kept], minorants.torque[kept], minorants.tau[kept],
        minorants.kappa[kept], problem.slots[kept], blocks, residual,
    )  # fmt: skip
    sizes = np.where(problem.is_point[problem.free], 1, d + 1)
    pattern = BlockPattern(sizes, problem.pattern.pairs)
    packing = Packing(pattern, d + 1, at_end=True)
    factor = SparseCholesky(pattern, problem.cholesky.analysis)
    rotation = np.diag([1.0] * d + [0.0])
    for share in _SHARES:
        shift = share * chi2 / (d * max(n, 1))
        shifted = blocks.copy()
        shifted[:n] += shift * rotation
        try:
            factor.factorize(packing.values(shifted))
        except SingularMatrixError:
            continue
        right = packing.rows(residual + shift * rotation[:, :d])
        return float((right * factor.solve(right)).sum())
    return None
