"""Loop edges judged one by one against all the others, and the verdicts mended until they agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from pipeline.data import Matrix
from pipeline.graph.between import BetweenProblem

_MARGIN = 6.0  # over what a pessimistic noise model would allow: residuals have longer tails than the normal law
_FEWEST = 10  # kept edges that say something about the noise model
_ROUNDING = 1e-9  # keeps an edge without which its poses would be loose from a division by zero


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


def fair_price(against: NDArray[np.float64], nominal: float, degrees: int) -> float:
    """The price, lowered where the contradictions of kept edges (L,) show that the noise model is pessimistic.

    Information matrices that are far too small would let in any edge. The median of the contradictions, against
    that of χ² with so many degrees of freedom, says by how much they are.
    """
    if len(against) < _FEWEST:
        return nominal
    expected = 2.0 * float(gammaincinv(0.5 * degrees, 0.5))
    return nominal * min(1.0, _MARGIN * float(np.median(against)) / expected)


def contradictions(problem: BetweenProblem, poses: Matrix, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much of the whole graph's χ² each edge costs, or would cost were it kept, (E,), to first order.

    It is the squared Mahalanobis distance between what the edge measures and what all the other kept edges
    predict: with P the covariance of the prediction, given all kept edges,
        eᵀ(Ω⁻¹ − P)⁻¹e of a kept edge,    eᵀ(Ω⁻¹ + P)⁻¹e of another.
    The residual alone says less: a kept edge bends the graph towards itself.
    """
    errors = problem.errors(poses)
    problem.cholesky.factorise(problem.linearise(poses, errors, weights).values)
    k = problem.freedom
    blocks = np.concatenate([problem.packing.blocks(problem.cholesky.inverse_blocks()), np.zeros((1, k, k))])
    i, j, pair = problem.slots.T  # -1, a fixed pose, finds the zeros at the end
    joint = blocks[i] + blocks[j] - blocks[pair] - np.swapaxes(blocks[pair], 1, 2)
    jacobian = problem.jacobians(poses, errors)
    P = jacobian @ joint @ np.swapaxes(jacobian, 1, 2)
    sign = np.where(weights > 0.5, -1.0, 1.0)[:, None, None]
    solved = np.linalg.solve((1.0 + _ROUNDING) * np.eye(k) + sign * (P @ problem.information), errors[..., None])
    return (errors[:, None] @ problem.information @ solved)[:, 0, 0]
