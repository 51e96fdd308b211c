"""Consistency of edges with all others: how much a single edge or a group contradicts the graph without it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.covariance import difference_covariances, edge_covariances, inverse_blocks

_ROUNDING = 1e-9  # keeps edges without which their poses would be loose from a division by zero


class Consistency:
    """Squared Mahalanobis distance between what edges measure and what all the other kept edges predict.

    To first order it is what the χ² of the whole graph falls by without edges that are kept, and rises by with
    others. With P the covariance of the prediction, given all kept edges, it is
        eᵀ(Ω⁻¹ − P)⁻¹e of kept edges,    eᵀ(Ω⁻¹ + P)⁻¹e of others.
    The residual alone is too small: a kept edge bends the graph toward itself.
    """

    def __init__(self, problem: BetweenProblem, poses: Matrix, kept: NDArray[np.bool_]) -> None:
        """Kept (E,): the edges in force at these poses."""
        self._problem, self._kept = problem, kept
        self._errors = problem.errors(poses)
        self._jacobians = problem.jacobians(poses, self._errors)
        self._sparse = problem.weighed(poses, self._errors, kept)

    def of_each(self, price: float) -> NDArray[np.float64]:
        """The distance of every edge, (E,), from all others.

        Where a lower bound of that of an edge left out, by Cov(a − b) ⪯ 2 Cov(a) + 2 Cov(b), is above the price
        already, the bound is given.
        """
        problem, kept, every = self._problem, self._kept, np.arange(len(self._kept))
        blocks = inverse_blocks(self._sparse)
        if self._sparse is problem:
            return self._distances(every, edge_covariances(problem, blocks))
        i, j = problem.variable[problem.edges].T
        joint = 2.0 * (blocks[i] + blocks[j])
        joint[kept] = edge_covariances(self._sparse, blocks)
        result = self._distances(every, joint)
        near = np.flatnonzero(~kept & (result < price))
        for edge in near:
            joint[edge] = difference_covariances(self._sparse, problem.edges[[edge]])[0, 0]
        result[near] = self._distances(near, joint[near])
        return result

    def of_group(self, group: NDArray[np.int64]) -> float:
        """The distance of the edges of a group, all of them kept or none, from all others."""
        k, count = self._problem.freedom, len(group)
        J = self._jacobians[group]
        joint = difference_covariances(self._sparse, self._problem.edges[group])  # at [b, a]
        predicted = (J[None] @ joint @ np.swapaxes(J, 1, 2)[:, None]).transpose(1, 2, 0, 3)
        information = np.zeros((count, k, count, k))
        information[np.arange(count), :, np.arange(count)] = self._problem.information[group]
        size = k * count
        P, omega = predicted.reshape(1, size, size), information.reshape(1, size, size)
        return float(_distances(self._errors[group].reshape(1, size), omega, P, self._kept[group[:1]])[0])

    def _distances(self, edges: NDArray[np.int64], joint: Matrix) -> NDArray[np.float64]:
        """Those of single edges (N,), from the covariances (N, k, k) of ξ_j − ξ_i."""
        J = self._jacobians[edges]
        predicted = J @ joint @ np.swapaxes(J, 1, 2)
        return _distances(self._errors[edges], self._problem.information[edges], predicted, self._kept[edges])


def _distances(e: Matrix, omega: Matrix, P: Matrix, kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    """eᵀ(Ω⁻¹ ∓ P)⁻¹e = eᵀΩ(I ∓ PΩ)⁻¹e, (N,), of residuals (N, m) that are kept or not."""
    sign = np.where(kept, -1.0, 1.0)[:, None, None]
    matrix = (1.0 + _ROUNDING) * np.eye(e.shape[1]) + sign * (P @ omega)
    return (e[:, None] @ omega @ np.linalg.solve(matrix, e[..., None]))[:, 0, 0]
