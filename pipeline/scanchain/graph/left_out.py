"""Loop edges that an optimum leaves out, and how odometry would change what they contradict, to first order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.consistency import apart
from scanchain.graph.covariance import difference_covariance, edge_covariances, inverse_blocks, responses

_MOST = 30  # largest number of loop edges that are looked at
_MOST_ENTRIES = 4_000_000  # largest number of covariances between these and odometry, 32 MB


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Loop edges left out, L of them, none near another: those near each other may share a mistake.

    Attributes
    ----------
    problem, factored : all edges, and those kept with H factored at the poses
    edges : (L,) these loop edges, each of them for ``stride`` such edges
    odometry : (O,) the edges of odometry in the order of the poses
    errors, jacobians : (E, k), (E, k, k) residuals e and ∂e/∂ξ_j of all edges
    covariances : (L, k, k) of their residuals, by their own noise and the graph without them
    predicted : (O, k, k) covariances of what the graph predicts of odometry
    joint : (L, O, k, k) covariances of the left twists of both, Cov(ξ_end − ξ_begin, ξ_j − ξ_i)
    """

    problem: BetweenProblem
    factored: BetweenProblem
    edges: NDArray[np.int64]
    stride: int
    odometry: NDArray[np.int64]
    errors: Matrix
    jacobians: Matrix
    covariances: Matrix
    predicted: Matrix
    joint: Matrix

    @classmethod
    def at(
        cls, problem: BetweenProblem, poses: Matrix, odometry: NDArray[np.int64], kept: NDArray[np.bool_]
    ) -> LeftOut:
        """Those of a minimum with the edges kept (E,)."""
        is_loop = np.ones(len(kept), np.bool_)
        is_loop[odometry] = False
        edges = apart(problem.edges, np.flatnonzero(is_loop & ~kept))
        most = min(_MOST, _MOST_ENTRIES // (max(len(odometry), 1) * problem.freedom**2))
        stride = max(1, -(-len(edges) // max(most, 1)))
        edges = edges[::stride]
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
        begin, end = problem.edges[odometry].T
        both = np.empty((len(edges), len(odometry), *predicted.shape[1:]))
        for place, edge in enumerate(edges):
            moved = responses(factored, *problem.edges[edge])
            both[place] = moved[end] - moved[begin]
        return cls(problem, factored, edges, stride, odometry, errors, jacobians, covariances, predicted, both)

    def shifts(self, twists: Matrix, among: slice = slice(None)) -> Iterator[Matrix]:
        """∂e (n, k, p) of each of these loop edges, by right twists (n, k, p) on some edges of odometry."""
        problem, odometry = self.problem, self.odometry[among]
        pull = np.swapaxes(self.jacobians[odometry], 1, 2) @ (problem.information[odometry] @ twists)
        for edge, joint in zip(self.edges, self.joint[:, among], strict=True):
            yield self.jacobians[edge] @ (np.swapaxes(joint, 1, 2) @ pull)

    def quadratic(self, twists: Matrix, among: slice = slice(None)) -> tuple[NDArray[np.float64], Matrix]:
        """Slope b (p,) and curvature A (p, p) of right twists τ (n, k, p) on some edges of odometry.

        With g = Σ JᵀΩτ, twists τδ move the poses by H⁻¹gδ; the cost of the kept edges changes by δᵀAδ − 2 bᵀδ,
        where A = Σ τᵀΩτ − gᵀH⁻¹g and b = Σ τᵀΩe.
        """
        odometry = self.odometry[among]
        weighted = self.problem.information[odometry] @ twists
        g = self._pull(weighted, odometry)
        A = np.einsum("oap,oaq->pq", twists, weighted) - g.T @ self.factored.cholesky.solve(g)
        b = np.einsum("oap,oa->p", weighted, self.errors[odometry])
        return b, A

    def moved(self, poses: Matrix, twists: Matrix, among: slice) -> Matrix:
        """These poses after right twists (n, k) on the measurements of some edges of odometry."""
        odometry = self.odometry[among]
        weighted = self.problem.information[odometry] @ twists[..., None]
        return self.problem.moved(poses, self.factored.cholesky.solve(self._pull(weighted, odometry))[:, 0])

    def _pull(self, weighted: Matrix, edges: NDArray[np.int64]) -> Matrix:
        """Σ JᵀΩτ of the poses, (scalars, p), of Ωτ (n, k, p) of some edges."""
        problem = self.problem
        forces = np.swapaxes(self.jacobians[edges], 1, 2) @ weighted
        whole = np.zeros((len(problem.variable), *forces.shape[1:]))
        begin, end = problem.edges[edges].T
        np.add.at(whole, end, forces)
        np.add.at(whole, begin, -forces)
        return self.factored.packing.rows(whole[problem.free])
