"""Loop edges that an optimum leaves out, and how odometry would change what they contradict, to first order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.covariance import difference_covariance, edge_covariances, inverse_blocks, responses
from scanchain.graph.robust.groups import apart

_MOST = 30  # largest number of loop edges that are looked at


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Loop edges left out, L of them, none near another: those near each other may share a mistake.

    Attributes
    ----------
    problem, factored : all edges, and those kept with H factored at the poses
    edges : (L,) these loop edges; odometry : (O,) the edges of odometry in the order of the poses
    errors, jacobians : (E, k), (E, k, k) residuals e and ∂e/∂ξ_j of all edges
    covariances : (L, k, k) of their residuals, by their own noise and the graph without them
    predicted : (O, k, k) covariances of what the graph predicts of odometry
    """

    problem: BetweenProblem
    factored: BetweenProblem
    edges: NDArray[np.int64]
    odometry: NDArray[np.int64]
    errors: Matrix
    jacobians: Matrix
    covariances: Matrix
    predicted: Matrix

    @classmethod
    def at(
        cls, problem: BetweenProblem, poses: Matrix, odometry: NDArray[np.int64], kept: NDArray[np.bool_]
    ) -> LeftOut:
        """Those of a minimum with the edges kept (E,)."""
        is_loop = np.ones(len(kept), np.bool_)
        is_loop[odometry] = False
        edges = apart(problem.edges, np.flatnonzero(is_loop & ~kept))
        edges = edges[:: max(1, -(-len(edges) // _MOST))]
        errors = problem.errors(poses)
        jacobians = problem.jacobians(poses, errors)
        factored = problem.factored(poses, errors, kept)
        covariances = np.linalg.pinv(problem.information[edges], hermitian=True)
        joint = edge_covariances(factored, inverse_blocks(factored))[np.cumsum(kept)[odometry] - 1]
        J = jacobians[odometry]
        for place, edge in enumerate(edges):
            joint_of_edge = difference_covariance(factored, *problem.edges[edge])
            covariances[place] += jacobians[edge] @ joint_of_edge @ jacobians[edge].T
        predicted = J @ joint @ np.swapaxes(J, 1, 2)
        return cls(problem, factored, edges, odometry, errors, jacobians, covariances, predicted)

    def shifts(self, twists: Matrix) -> Iterator[Matrix]:
        """∂e (O, k, p) of each of these loop edges, by right twists (O, k, p) on the measurements of odometry."""
        problem, odometry = self.problem, self.odometry
        pull = np.swapaxes(self.jacobians[odometry], 1, 2) @ problem.information[odometry]
        begin, end = problem.edges[odometry].T
        for edge in self.edges:
            moved = responses(self.factored, *problem.edges[edge])
            yield self.jacobians[edge] @ np.swapaxes(moved[end] - moved[begin], 1, 2) @ pull @ twists

    def quadratic(self, twists: Matrix) -> tuple[NDArray[np.float64], Matrix]:
        """Slope b (p,) and curvature A (p, p) of right twists τ (O, k, p) on the odometry.

        With g = Σ JᵀΩτ, twists τδ move the poses by H⁻¹gδ; the cost of the kept edges changes by δᵀAδ − 2 bᵀδ,
        where A = Σ τᵀΩτ − gᵀH⁻¹g and b = Σ τᵀΩe.
        """
        problem, odometry, packing = self.problem, self.odometry, self.factored.packing
        weighted = problem.information[odometry] @ twists
        forces = np.swapaxes(self.jacobians[odometry], 1, 2) @ weighted
        whole = np.zeros((len(problem.variable), *forces.shape[1:]))
        begin, end = problem.edges[odometry].T
        np.add.at(whole, end, forces)
        np.add.at(whole, begin, -forces)
        g = packing.rows(whole[problem.free])
        A = np.einsum("oap,oaq->pq", twists, weighted) - g.T @ self.factored.cholesky.solve(g)
        b = np.einsum("oap,oa->p", weighted, self.errors[odometry])
        return b, A
