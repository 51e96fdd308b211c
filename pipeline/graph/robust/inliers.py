"""Inlier set of the loop edges, and how much each edge contradicts all the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.covariance import difference_covariance, edge_covariances, inverse_blocks

_MARGIN = 6.0  # factor over the share of a pessimistic noise model: residuals have long tails
_FEWEST = 10  # least number of inlier edges from which a noise model is estimated
_ROUNDING = 1e-9  # keeps an edge without which its poses would be loose from a division by zero


@dataclass(frozen=True, slots=True)
class InlierSet:
    """Loop edges kept or not, as a loss: a kept edge costs its χ², another its price.

    Attributes
    ----------
    kept : (L,) bool, of the loop edges
    price : what leaving an edge out costs, in χ²
    """

    kept: NDArray[np.bool_]
    price: float
    kernel: Literal["truncated"] = "truncated"

    def weight(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """1 or 0, whatever the residuals."""
        return self.kept.astype(np.float64)

    def loss(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """χ² or the price."""
        return np.where(self.kept, chi2, self.price)


def fair_price(against: NDArray[np.float64], nominal: float, degrees: int) -> float:
    """The price, lowered where the contradictions of kept edges (L,) show that the noise model is pessimistic.

    Information matrices that are far too small would let in any edge. The median of the contradictions, against
    that of χ² with so many degrees of freedom, is the factor.
    """
    if len(against) < _FEWEST:
        return nominal
    expected = 2.0 * float(gammaincinv(0.5 * degrees, 0.5))
    return nominal * min(1.0, _MARGIN * float(np.median(against)) / expected)


def contradictions(problem: BetweenProblem, poses: Matrix, kept: NDArray[np.bool_], price: float) -> Matrix:
    """Share of each edge in the χ² of the whole graph, or its rise were the edge an inlier, (E,), to first order.

    It is the squared Mahalanobis distance between what the edge measures and what all the other kept edges (E,)
    predict: with P the covariance of the prediction, given all kept edges,
        eᵀ(Ω⁻¹ − P)⁻¹e of a kept edge,    eᵀ(Ω⁻¹ + P)⁻¹e of another.
    The residual alone is too small: a kept edge bends the graph toward itself. Where a lower bound of the second,
    by Cov(a − b) ⪯ 2 Cov(a) + 2 Cov(b), is above the price already, the bound is given.
    """
    errors = problem.errors(poses)
    jacobians = problem.jacobians(poses, errors)
    sparse = problem.factored(poses, errors, kept)
    blocks = inverse_blocks(sparse)
    i, j = problem.variable[problem.edges].T
    joint = 2.0 * (blocks[i] + blocks[j])
    joint[kept] = edge_covariances(sparse, blocks)
    result = _distances(errors, jacobians, problem.information, joint, kept)
    near = np.flatnonzero(~kept & (result < price))
    for edge in near:
        joint[edge] = difference_covariance(sparse, *problem.edges[edge])
    result[near] = _distances(errors[near], jacobians[near], problem.information[near], joint[near], kept[near])
    return result


def _distances(
    errors: Matrix, jacobians: Matrix, information: Matrix, joint: Matrix, kept: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """The squared distances (E,), from the covariances (E, k, k) of ξ_j − ξ_i."""
    P = jacobians @ joint @ np.swapaxes(jacobians, 1, 2)
    sign = np.where(kept, -1.0, 1.0)[:, None, None]
    matrix = (1.0 + _ROUNDING) * np.eye(errors.shape[1]) + sign * (P @ information)
    return (errors[:, None] @ information @ np.linalg.solve(matrix, errors[..., None]))[:, 0, 0]
