"""The least-squares problem of a pose graph: its factors, their structure, their normal equations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Matrix
from scanchain.graph.cholesky import BlockPattern, Packing, SparseCholesky, analyze
from scanchain.kernels.graph import between


class Between:
    """e = log(Z⁻¹ T_i⁻¹ T_j): the twist that the relative pose is off by on its right, T_i⁻¹ T_j = Z exp(e).

    As every factor it depends on T_i⁻¹ T_j alone: one and the same left twist of both poses changes nothing, hence
    ∂e/∂ξ_i = −∂e/∂ξ_j. What concerns one pose only, as a prior, has a fixed pose at the origin for its i.
    """

    def residual(self, poses: Matrix, edges: NDArray[np.int64], Z: Matrix) -> Matrix:
        """Residuals e (E, k) of edges (E, 2) that measure Z (E, d+1, d+1), at these poses (K, d+1, d+1)."""
        d = poses.shape[-1] - 1
        errors = np.empty((len(edges), d * (d + 1) // 2))
        residuals = between.residuals_2d if d == 2 else between.residuals_3d
        residuals(_kept(poses), _kept(edges), _kept(Z), errors)
        return errors

    def linearize(self, poses: Matrix, edges: NDArray[np.int64], Z: Matrix, errors: Matrix) -> Matrix:
        """∂e/∂ξ_j (E, k, k) for left twists, T_j ← exp(ξ_j) T_j, where the residuals are these errors (E, k)."""
        jacobian = np.empty((*errors.shape, errors.shape[1]))
        if errors.shape[1] == 3:
            between.jacobians_2d(_kept(poses), _kept(edges), _kept(Z), jacobian)
        else:
            between.jacobians_3d(_kept(poses), _kept(edges), errors, jacobian)
        return jacobian


class Position:
    """e = (R_zᵀ(R_iᵀ(t_j − t_i) − t_z), 0): the position of j in frame i, whatever its rotation, as g2o has it."""

    def residual(self, poses: Matrix, edges: NDArray[np.int64], Z: Matrix) -> Matrix:
        """As of ``Between``, zero in the rotation."""
        d, (T_i, T_j) = poses.shape[-1] - 1, poses[edges.T]
        errors = np.zeros((len(edges), d * (d + 1) // 2))
        seen = (T_j[:, None, :d, d] - T_i[:, None, :d, d]) @ T_i[:, :d, :d]
        errors[:, :d] = ((seen - Z[:, None, :d, d]) @ Z[:, :d, :d])[:, 0]
        return errors

    def linearize(self, poses: Matrix, edges: NDArray[np.int64], Z: Matrix, errors: Matrix) -> Matrix:
        """R_zᵀ R_iᵀ [I, ∂t_j/∂φ]."""
        d, (T_i, T_j) = poses.shape[-1] - 1, poses[edges.T]
        R_t = np.swapaxes(T_i[:, :d, :d] @ Z[:, :d, :d], 1, 2)
        jacobian = np.zeros((*errors.shape, errors.shape[1]))
        jacobian[:, :d, :d], jacobian[:, :d, d:] = R_t, R_t @ turns(T_j[:, :d, d])
        return jacobian


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """H = Σ w JᵀΩJ as block values of the problem's pattern, and g = Σ w JᵀΩe; the step solves H ξ = −g."""

    values: NDArray[np.float64]
    gradient: NDArray[np.float64]


class BetweenProblem:
    """Factors of one graph, χ² = Σ eᵀΩe; the structure is worked out once.

    Poses move by left twists, T ← exp(ξ) T. The gauge is fixed by leaving the fixed poses out of the system:
    ``variable`` (K,) is the block of each pose, -1 where it is fixed, ``free`` (n,) the pose of each block,
    ``slots`` (E, 3) the blocks of i, of j and of the pair in the matrix.

    Edges whose Ω has no information about the rotation are ``sightings`` of a position. In the plane, j of these
    may be a point: a pose without a heading, its rotation the identity, whose block holds the translation alone.
    """

    def __init__(
        self,
        edges: NDArray[np.int64],
        measurements: Matrix,
        information: Matrix,
        fixed: NDArray[np.bool_],
        is_point: NDArray[np.bool_] | None = None,
    ) -> None:
        """Edges (E, 2) pairs (i, j), Z (E, d+1, d+1) measurements, Ω (E, k, k); fixed, is_point (K,)."""
        self.edges, self.measurements, self.information = _kept(edges), _kept(measurements), _kept(information)
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
        self.is_point = np.zeros(len(fixed), np.bool_) if is_point is None else is_point
        d = measurements.shape[-1] - 1
        is_seen = self.is_point[edges].any(axis=1) | ~information[:, d:].any(axis=(1, 2))
        self.sightings = np.flatnonzero(is_seen)
        factors = (Between(), np.flatnonzero(~is_seen)), (Position(), self.sightings)
        self._factors = [(factor, of) for factor, of in factors if len(of)]
        sizes = np.where(self.is_point[self.free], 2, self.freedom)
        self.pattern = BlockPattern(sizes, np.stack(np.divmod(unique, count), axis=1))
        self.packing = Packing(self.pattern, self.freedom, at_end=False)

    @cached_property
    def cholesky(self) -> SparseCholesky:
        """The solver; analyzed when it is first needed."""
        return SparseCholesky(self.pattern, analyze(self.pattern))

    def restricted(self, kept: NDArray[np.bool_]) -> BetweenProblem:
        """The problem of the same poses with some of its edges, kept (E,)."""
        measurements, information = self.measurements[kept], self.information[kept]
        return BetweenProblem(self.edges[kept], measurements, information, self.variable < 0, self.is_point)

    def factored(self, poses: Matrix, errors: Matrix, kept: NDArray[np.bool_]) -> BetweenProblem:
        """The problem of some of the edges, kept (E,), with H factored at these poses and their errors (E, k).

        The factor of this one is given up: two of a long log would take the most memory of all.
        """
        if "cholesky" in vars(self):
            self.cholesky.release()
        sparse = self.restricted(kept)
        sparse.cholesky.factorize(sparse.linearize(poses, errors[kept], np.ones(int(kept.sum()))).values)
        return sparse

    def errors(self, poses: Matrix) -> Matrix:
        """Residuals e (E, k) at these poses (K, d+1, d+1)."""
        errors = np.empty((len(self.edges), self.freedom))
        for factor, of in self._factors:
            errors[of] = factor.residual(poses, self.edges[of], self.measurements[of])
        return errors

    def chi2(self, errors: Matrix) -> NDArray[np.float64]:
        """Return eᵀΩe of every edge, (E,)."""
        result = np.empty(len(errors))
        between.squared_norms(errors, self.information, result)
        return result

    def jacobians(self, poses: Matrix, errors: Matrix) -> Matrix:
        """∂e/∂ξ_j (E, k, k); ∂e/∂ξ_i is its negative."""
        jacobian = np.empty((*errors.shape, self.freedom))
        for factor, of in self._factors:
            jacobian[of] = factor.linearize(poses, self.edges[of], self.measurements[of], errors[of])
        return jacobian

    def linearize(self, poses: Matrix, errors: Matrix, weights: NDArray[np.float64]) -> NormalEquations:
        """Normal equations at these poses, with these residuals and robust weights (E,)."""
        blocks = np.zeros((len(self.pattern.rows), self.freedom, self.freedom))
        gradient = np.zeros((len(self.free), self.freedom))
        jacobian = self.jacobians(poses, errors)
        between.scatter_between(jacobian, errors, self.information, _kept(weights), self.slots, blocks, gradient)
        return NormalEquations(self.packing.values(blocks), self.packing.rows(gradient))

    def scattered(self, of_i: Matrix, of_j: Matrix, coupling: Matrix) -> Matrix:
        """Blocks (B, b, b) of the pattern, of what every edge adds (E, b, b): to those of i, of j and of the pair.

        coupling : row i, column j
        """
        blocks = np.zeros((len(self.pattern.rows), *coupling.shape[1:]))
        i, j, pair = self.slots.T
        lower = np.where((i > j)[:, None, None], coupling, np.swapaxes(coupling, 1, 2))
        for slot, added in ((i, of_i), (j, of_j), (pair, lower)):
            np.add.at(blocks, slot[slot >= 0], added[slot >= 0])
        return blocks

    def moved(self, poses: Matrix, step: NDArray[np.float64]) -> Matrix:
        """Poses after left twists: exp(ξ) T of every free pose; step (scalars of the pattern,)."""
        result = poses.copy()
        result[self.free] = lie.exp(self.packing.spread_rows(step)) @ poses[self.free]
        return result


def turns(positions: Matrix) -> Matrix:
    """∂t/∂φ (E, d, 1 or 3) of positions (E, d) turned about the origin."""
    if positions.shape[1] == 3:
        return -lie.hat(positions)
    return np.stack([-positions[:, 1], positions[:, 0]], axis=1)[..., None]


def _kept(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only view: for one kind of array a kernel is compiled once."""
    view = array.view()
    view.flags.writeable = False
    return view
