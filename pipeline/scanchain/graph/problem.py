"""The least-squares problem of a pose graph: its factors, their structure, their normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanchain import lie
from scanchain.data import Integers, Mask, Matrix, Vector
from scanchain.graph.cholesky import BlockPattern, Packing, SparseCholesky, analyze
from scanchain.graph.factors import FACTORS, LOOPS, ODOMETRY, SIGHTINGS, WHOLE, Factor, kinds_of
from scanchain.growing_array import read_only
from scanchain.kernels.graph import between


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """H = Σ w JᵀΩJ as block values of the problem's pattern, and g = Σ w JᵀΩe; the step solves H ξ = −g."""

    values: Vector
    gradient: Vector


class GraphProblem:
    """Factors of one graph, χ² = Σ eᵀΩe; the structure is computed once.

    Poses move by left twists, T ← exp(ξ) T. The gauge is fixed by leaving the fixed poses out of the system:
    ``variable`` (K,) is the block of each pose, -1 where it is fixed, ``free`` (n,) the pose of each block,
    ``slots`` (E, 3) the blocks of i, of j and of the pair in the matrix.

    A pose may be a point of the plane: its rotation is the identity, and its block holds the translation alone.

    Kinds of edges, (E,) bool each: ``is_odometry``; ``is_loop``; ``is_whole``, of position and rotation;
    ``is_sighting``, of a position seen from a pose; ``is_robust``, with the robust loss; ``is_bounded``, for whose
    χ² the certificate has a lower bound.
    """

    def __init__(
        self,
        edges: Integers,
        measurements: Matrix,
        information: Matrix,
        fixed: Mask,
        is_point: Mask | None = None,
        kind: Integers | None = None,
        factors: Sequence[Factor] = FACTORS,
    ) -> None:
        """Edges (E, 2) pairs (i, j), Z (E, d+1, d+1) measurements, Ω (E, k, k); fixed, is_point (K,).

        kind : (E,) indices into ``factors``; by default those that ``kinds_of`` gives without loops
        """
        self.edges, self.information = read_only(edges), read_only(information)
        self.measurements = read_only(measurements)
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
        if kind is None:
            kind = kinds_of(edges, information, self.is_point)
        self.kind, self.factors = kind, factors
        self.is_odometry, self.is_bounded = kind == ODOMETRY, kind < len(FACTORS)
        self.is_loop, self.is_whole, self.is_sighting = (np.isin(kind, each) for each in (LOOPS, WHOLE, SIGHTINGS))
        self.is_robust = np.array([factor.is_robust for factor in factors], np.bool_)[kind]
        self._by_factor = [(factors[each], np.flatnonzero(kind == each)) for each in np.unique(kind).tolist()]
        sizes = np.where(self.is_point[self.free], 2, self.freedom)
        self.pattern = BlockPattern(sizes, np.stack(np.divmod(unique, count), axis=1))
        self.packing = Packing(self.pattern, self.freedom, at_end=False)

    @cached_property
    def cholesky(self) -> SparseCholesky:
        """The solver; analyzed when it is first needed."""
        return SparseCholesky(self.pattern, analyze(self.pattern))

    def restricted(self, kept: Mask, fixed: Mask | None = None) -> GraphProblem:
        """The problem of the same poses with some of its edges, kept (E,); fixed (K,) are by default the same."""
        edges, measurements, information = self.edges[kept], self.measurements[kept], self.information[kept]
        fixed = self.variable < 0 if fixed is None else fixed
        return GraphProblem(edges, measurements, information, fixed, self.is_point, self.kind[kept], self.factors)

    @property
    def residuals(self) -> Integers:
        """Number of residuals of every edge that have information, (E,)."""
        return np.count_nonzero(np.einsum("eaa->ea", self.information), axis=1)

    def factored(self, poses: Matrix, errors: Matrix, kept: Mask) -> GraphProblem:
        """The problem of some of the edges, kept (E,), with H factored at these poses and their errors (E, k).

        The factor of this problem is released: two factors of a long log would dominate the memory.
        """
        if "cholesky" in vars(self):
            self.cholesky.release()
        sparse = self.restricted(kept)
        sparse.cholesky.factorize(sparse.linearize(poses, errors[kept], np.ones(int(kept.sum()))).values)
        return sparse

    def errors(self, poses: Matrix) -> Matrix:
        """Residuals e (E, k) at these poses (K, d+1, d+1)."""
        errors = np.empty((len(self.edges), self.freedom))
        for factor, of in self._by_factor:
            errors[of] = factor.residual(poses, self.edges[of], self.measurements[of])
        return errors

    def chi2(self, errors: Matrix) -> Vector:
        """Return eᵀΩe of every edge, (E,)."""
        result = np.empty(len(errors))
        between.squared_norms(errors, self.information, result)
        return result

    def jacobians(self, poses: Matrix, errors: Matrix) -> Matrix:
        """∂e/∂ξ_j (E, k, k); ∂e/∂ξ_i is its negative."""
        jacobian = np.empty((*errors.shape, self.freedom))
        for factor, of in self._by_factor:
            jacobian[of] = factor.linearize(poses, self.edges[of], self.measurements[of], errors[of])
        return jacobian

    def linearize(self, poses: Matrix, errors: Matrix, weights: Vector) -> NormalEquations:
        """Normal equations at these poses, with these residuals and robust weights (E,)."""
        blocks = np.zeros((len(self.pattern.rows), self.freedom, self.freedom))
        gradient = np.zeros((len(self.free), self.freedom))
        jacobian = self.jacobians(poses, errors)
        between.scatter_between(
            jacobian, errors, self.information, read_only(weights), self.slots, blocks, gradient
        )
        return NormalEquations(self.packing.values(blocks), self.packing.packed(gradient))

    def scattered(self, of_i: Matrix, of_j: Matrix, coupling: Matrix) -> Matrix:
        """Blocks (B, b, b) of the pattern, summed over what every edge adds (E, b, b) for i, j and the pair.

        coupling : row i, column j
        """
        blocks = np.zeros((len(self.pattern.rows), *coupling.shape[1:]))
        i, j, pair = self.slots.T
        lower = np.where((i > j)[:, None, None], coupling, np.swapaxes(coupling, 1, 2))
        for slot, added in ((i, of_i), (j, of_j), (pair, lower)):
            np.add.at(blocks, slot[slot >= 0], added[slot >= 0])
        return blocks

    def moved(self, poses: Matrix, step: Vector) -> Matrix:
        """Poses after left twists: exp(ξ) T of every free pose; step (scalars of the pattern,)."""
        result = poses.copy()
        result[self.free] = lie.exp(self.packing.unpacked(step)) @ poses[self.free]
        return result
