"""Loop edges judged one by one against all the others, and the verdicts mended until they agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Matrix
from pipeline.graph.between import BetweenProblem


@dataclass(frozen=True, slots=True)
class Verdicts:
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


def contradictions(problem: BetweenProblem, poses: Matrix, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much χ² of the whole graph each edge costs, or would cost were it kept, (E,), to first order.

    It is the squared Mahalanobis distance between what the edge measures and what all the other kept edges predict:
    with P the covariance of the prediction, given all kept edges,
        eᵀ(Ω⁻¹ − P)⁻¹e of a kept edge,    eᵀ(Ω⁻¹ + P)⁻¹e of another.
    The residual alone says less: a kept edge bends the graph towards itself.
    """
    errors = problem.errors(poses)
    problem.cholesky.factorise(problem.linearise(poses, errors, weights).values)
    k = problem.freedom
    blocks = np.concatenate([problem.cholesky.inverse_blocks().reshape(-1, k, k), np.zeros((1, k, k))])
    i, j, pair = problem.slots.T  # -1, a fixed pose, finds the zeros at the end
    joint = blocks[i] + blocks[j] - blocks[pair] - np.swapaxes(blocks[pair], 1, 2)
    jacobian = problem.jacobians(poses, errors)
    P = jacobian @ joint @ np.swapaxes(jacobian, 1, 2)
    sign = np.where(weights > 0.5, -1.0, 1.0)[:, None, None]
    solved = np.linalg.solve((1.0 + 1e-9) * np.eye(k) + sign * (P @ problem.information), errors[..., None])
    return (errors[:, None] @ problem.information @ solved)[:, 0, 0]
