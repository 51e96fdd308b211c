"""The least-squares problem of a pose graph: between factors, their structure, their normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import lie
from pipeline.data import Matrix
from pipeline.graph.cholesky import BlockPattern, SparseCholesky, analyse
from pipeline.kernels import graph_between_se2, graph_between_se3, graph_scatter


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """H = Σ w JᵀΩJ as block values of the problem's pattern, and g = Σ w JᵀΩe; the step solves H ξ = −g."""

    values: NDArray[np.float64]
    gradient: NDArray[np.float64]


class BetweenProblem:
    """Between factors e = log(Z_ij⁻¹ T_i⁻¹ T_j), χ² = Σ eᵀΩe, of one graph; the structure is worked out once.

    e is the twist that the relative pose is off by on its right, T_i⁻¹ T_j = Z exp(e), so Ω is the inverse
    covariance of a right twist on Z. Poses move by left twists, T ← exp(ξ) T. The gauge is fixed by leaving the
    fixed poses out of the system: ``variable`` (K,) is the block of each pose, -1 where it is fixed, ``free`` (n,)
    the pose of each block, ``slots`` (E, 3) the blocks of i, of j and of the pair in the matrix.
    """

    def __init__(
        self, edges: NDArray[np.int64], measurements: Matrix, information: Matrix, fixed: NDArray[np.bool_]
    ) -> None:
        """Edges (E, 2) pairs (i, j), measurements (E, d+1, d+1) Z, information (E, k, k) Ω, fixed (K,)."""
        self.edges, self.measurements, self.information = edges, measurements, information
        self.freedom = information.shape[-1]
        self.free = np.flatnonzero(~fixed)
        variable = np.full(len(fixed), -1, np.int64)
        variable[self.free] = np.arange(len(self.free))
        self.variable = variable
        ends = variable[edges].reshape(-1, 2)
        joined = (ends >= 0).all(axis=1)
        count = max(len(self.free), 1)
        keys = ends[joined].max(axis=1, initial=0) * count + ends[joined].min(axis=1, initial=count)
        unique, which = np.unique(keys, return_inverse=True)
        self.slots = np.full((len(edges), 3), -1, np.int64)
        self.slots[:, :2] = ends
        self.slots[joined, 2] = len(self.free) + which
        sizes = np.full(len(self.free), self.freedom, np.int64)
        self.pattern = BlockPattern(sizes, np.stack(np.divmod(unique, count), axis=1))
        self.cholesky = SparseCholesky(self.pattern, analyse(self.pattern))

    def errors(self, poses: Matrix) -> Matrix:
        """Residuals e (E, k) at these poses (K, d+1, d+1)."""
        errors = np.empty((len(self.edges), self.freedom))
        kernel = graph_between_se2 if self.freedom == 3 else graph_between_se3
        kernel.residuals(poses, self.edges, self.measurements, errors)
        return errors

    def chi2(self, errors: Matrix) -> NDArray[np.float64]:
        """Return eᵀΩe of every edge, (E,)."""
        result = np.empty(len(errors))
        graph_scatter.squared_norms(errors, self.information, result)
        return result

    def jacobians(self, poses: Matrix, errors: Matrix) -> Matrix:
        """∂e/∂ξ_j (E, k, k); ∂e/∂ξ_i is its negative."""
        jacobian = np.empty((len(self.edges), self.freedom, self.freedom))
        if self.freedom == 3:
            graph_between_se2.jacobians(poses, self.edges, self.measurements, jacobian)
        else:
            graph_between_se3.jacobians(poses, self.edges, errors, jacobian)
        return jacobian

    def linearise(self, poses: Matrix, errors: Matrix, weights: NDArray[np.float64]) -> NormalEquations:
        """Normal equations at these poses, with these residuals and robust weights (E,)."""
        blocks = np.zeros((len(self.pattern.rows), self.freedom, self.freedom))
        gradient = np.zeros((len(self.free), self.freedom))
        jacobian = self.jacobians(poses, errors)
        graph_scatter.scatter_between(jacobian, errors, self.information, weights, self.slots, blocks, gradient)
        return NormalEquations(blocks.reshape(-1), gradient.reshape(-1))

    def moved(self, poses: Matrix, step: NDArray[np.float64]) -> Matrix:
        """Poses after left twists: exp(ξ) T of every free pose; step (n k,)."""
        result = poses.copy()
        result[self.free] = lie.exp(step.reshape(-1, self.freedom)) @ poses[self.free]
        return result


def right_information(T_ij: Matrix, left_information: Matrix) -> Matrix:
    """Information of right twists on T_ij, from that of left twists: exp(ξ) T = T exp(e), ξ = Ad(T) e."""
    adjoint = lie.adjoint(T_ij)
    return np.swapaxes(adjoint, -1, -2) @ left_information @ adjoint
