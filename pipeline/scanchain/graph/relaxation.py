"""Semidefinite relaxation of a quadratic problem of rotations and positions: its minimum, and lower bounds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from scanchain.data import Matrix
from scanchain.graph.cholesky import BlockPattern, Packing, SingularMatrixError, SparseCholesky
from scanchain.graph.problem import GraphProblem

_SHIFTS = (0.0, *np.geomspace(1e-6, 1e4, 11).tolist())  # added to the rotations' blocks of S, tried one by one
_BISECTIONS = 4  # of the last two shifts
_POSITIVE = 1e-4  # largest shift with which S counts as positive definite
_COLUMNS = 4  # largest number of columns beyond d
_PRODUCTS = 1000  # largest number of products with S, of all columns together
_FIRST_STEP = 0.3  # rad, of every pose, along the direction of negative curvature
_LEAST_STEP = 1e-6
_INVERSE_ITERATIONS = 20
_CONVERGED = 1e-6  # expected decrease, as a share of χ²
_FORCING = 0.1  # decrease of the gradient in one step, by truncated conjugate gradients (Dembo et al. 1982)


@dataclass(frozen=True, slots=True)
class DualBound:
    """Lower bound of F over all X, by the multipliers of one X.

    value : the bound; −∞ where S leaves a position free
    shift : added to S to make it positive definite, in units of χ² by the number of rotated axes
    """

    value: float
    shift: float

    @property
    def is_minimum(self) -> bool:
        """True where S − Λ is positive definite, so that X is the global minimum."""
        return self.shift <= _POSITIVE


class Relaxation:
    """F(X) = ⟨S, Δ Δᵀ⟩ + 2 ⟨R, Δ⟩, where X (N, r) holds r coordinates of every axis of every G and of every t.

    Δ is X minus the estimate, at which every G is I; the axes of each G stay orthonormal. For r = d this is the
    problem itself, for more columns its semidefinite relaxation (Burer & Monteiro 2003; Boumal et al. 2016; Rosen
    et al. 2019). Fixed poses stay where they are.
    """

    def __init__(self, problem: GraphProblem, S: Matrix, residual: Matrix, positions: Matrix, chi2: float) -> None:
        """Of S (B, d+1, d+1), as blocks of the problem's pattern, R (n, d+1, d), positions (n, d) and χ²."""
        self._count, self._d = len(problem.free), positions.shape[1]
        self._has_axes = ~problem.is_point[problem.free]
        self._pattern = BlockPattern(np.where(self._has_axes, self._d + 1, 1), problem.pattern.pairs)
        self._packing = Packing(self._pattern, self._d + 1, at_end=True)
        self._factor = SparseCholesky(self._pattern, problem.cholesky.analysis)
        self._blocks, self._residual = S, self._packing.packed(residual)
        self._chi2, self._left, self._per_axis = chi2, _PRODUCTS, chi2 / (self._d * self._count)
        self._unit = np.broadcast_to(np.eye(self._d), (self._count, self._d, self._d))
        self.estimate = self._packing.packed(np.concatenate([self._unit, positions[:, None]], axis=1))

    @cached_property
    def _S(self) -> csr_matrix:
        return self._pattern.matrix(self._packing.values(self._blocks))

    def value(self, X: Matrix) -> float:
        """F(X), zero at the estimate."""
        if X is self.estimate:
            return 0.0
        difference = self._difference(X)
        linear = (self._residual * difference[:, : self._d]).sum()
        return float((difference * (self._S @ difference)).sum() + 2.0 * linear)

    def dual(self, X: Matrix) -> DualBound:
        """F ≥ F(X) − tr(rᵀ(S − Λ + μ)⁻¹ r), with r = S Δ + R − (Λ − μ) X, for the least shift μ tried.

        Positive definite means that the Cholesky factorization succeeds; the factor is retained.
        """
        gradient = self._gradient(X)
        multipliers, value = self._multipliers(gradient, X), self.value(X)
        residual, blocks = gradient - self._scaled(multipliers, X), self._blocks.copy()
        blocks[: self._count, : self._d, : self._d] -= multipliers
        shift = next((each for each in _SHIFTS if self._is_positive(blocks, each)), np.inf)
        if not np.isfinite(shift):
            return DualBound(-np.inf, np.inf)
        if shift > _POSITIVE:
            too_low = 0.1 * shift
            for _ in range(_BISECTIONS):
                middle = float(np.sqrt(too_low * shift))
                too_low, shift = (too_low, middle) if self._is_positive(blocks, middle) else (middle, shift)
            self._is_positive(blocks, shift)
        right = residual + shift * self._per_axis * self._scaled(self._unit, X)
        return DualBound(value - float((right * self._factor.solve(right)).sum()), shift)

    def _is_positive(self, blocks: Matrix, shift: float) -> bool:
        """Factorize S − Λ with the shift."""
        shifted = blocks.copy()
        shifted[: self._count, : self._d, : self._d] += shift * self._per_axis * self._unit
        try:
            self._factor.factorize(self._packing.values(shifted))
        except SingularMatrixError:
            return False
        return True

    def minimize(self, X: Matrix, bound: DualBound) -> tuple[Matrix, DualBound]:
        """Go on from a stationary X to the minimum of the relaxation, with columns added as they are needed.

        Each new column begins along a direction of negative curvature (Boumal 2016). Returns the last X, and the
        best bound.
        """
        best, last = bound, bound
        while not last.is_minimum and np.isfinite(last.shift) and self._left > 0:
            if X.shape[1] == self._d + _COLUMNS:
                break
            X = self._descended(self._lifted(X))
            last = self.dual(X)
            best = max(best, last, key=lambda each: each.value)
        return X, best

    def _lifted(self, X: Matrix) -> Matrix:
        """X with one more column, of lower F where S − Λ has a negative eigenvalue."""
        v = np.random.default_rng(0).normal(size=(len(X), 1))
        for _ in range(_INVERSE_ITERATIONS):
            v = self._factor.solve(self._scaled(self._unit, v))
            v /= np.linalg.norm(v)
        step, value = _FIRST_STEP * np.sqrt(self._count), self.value(X)
        while (step := 0.5 * step) > _LEAST_STEP:
            trial = self._retracted(np.hstack([X, step * v]))
            if self.value(trial) < value:
                return trial
        return np.hstack([X, np.zeros_like(v)])

    def _descended(self, X: Matrix) -> Matrix:
        """Local minimum by a Riemannian trust region (Absil et al. 2007), preconditioned by the factor."""
        value, radius = self.value(X), float(np.sqrt(self._count))
        while self._left > 0:
            gradient = self._gradient(X)
            multipliers = self._multipliers(gradient, X)
            gradient -= self._scaled(multipliers, X)
            step, length, gain = self._truncated(X, gradient, multipliers, radius)
            if gain <= _CONVERGED * self._chi2:
                break
            trial = self._retracted(X + step)
            change = self.value(trial)
            quality = (value - change) / gain
            if quality > 0.1:
                X, value = trial, change
            radius = 0.25 * length if quality < 0.25 else 2.0 * radius if quality > 0.75 else radius
        return X

    def _truncated(
        self, X: Matrix, gradient: Matrix, Lambda: Matrix, radius: float
    ) -> tuple[Matrix, float, float]:
        """Step within the radius, in the norm of the preconditioner, and the decrease that the model expects.

        Truncated conjugate gradients (Steihaug 1983) on F's Hessian over the tangent space at X.
        """
        step, curved, residual = np.zeros_like(X), np.zeros_like(X), gradient.copy()
        z = self._tangent(X, self._factor.solve(residual))
        p, first = -z, float((residual * z).sum())
        length2, along, p2, rz = 0.0, 0.0, first, first
        while rz > _FORCING**2 * first and self._left > 0:
            self._left -= 1
            Hp = self._tangent(X, self._S @ p - self._scaled(Lambda, p))
            curvature = float((p * Hp).sum())
            a = rz / curvature if curvature > 0.0 else np.inf
            if not length2 + 2.0 * a * along + a * a * p2 < radius**2:
                a = (np.sqrt(along**2 + p2 * (radius**2 - length2)) - along) / p2
                step, curved, length2 = step + a * p, curved + a * Hp, radius**2
                break
            step, curved, residual = step + a * p, curved + a * Hp, residual + a * Hp
            length2 += 2.0 * a * along + a * a * p2
            z = self._tangent(X, self._factor.solve(residual))
            b, rz = float((residual * z).sum()) / rz, float((residual * z).sum())
            along, p2, p = b * (along + a * p2), rz + b * b * p2, b * p - z
        return step, float(np.sqrt(length2)), -float((step * (2.0 * gradient + curved)).sum())

    def rounded(self, X: Matrix) -> tuple[Matrix, Matrix]:
        """Rotations G (n, d, d) and positions (n, d) near X, in d dimensions, turned to the fixed poses."""
        d, r = self._d, X.shape[1]
        rows = self._packing.unpacked(X)
        axes = rows[self._has_axes, :d].reshape(-1, r)
        main = np.linalg.svd(np.vstack([axes, np.eye(d, r)]), full_matrices=False)[2][:d].T
        U, _, V = np.linalg.svd(main[:d])
        flat = rows @ (main @ (U @ V).T)
        G = np.broadcast_to(np.eye(d), (self._count, d, d)).copy()
        U, _, V = np.linalg.svd(np.swapaxes(flat[self._has_axes, :d], 1, 2))
        U[:, :, -1] *= np.linalg.det(U @ V)[:, None]
        G[self._has_axes] = U @ V
        return G, flat[:, d]

    def _difference(self, X: Matrix) -> Matrix:
        result = X.copy()
        result[:, : self._d] -= self.estimate
        return result

    def _gradient(self, X: Matrix) -> Matrix:
        """S Δ + R, half of the gradient of F."""
        if X is self.estimate:
            return self._residual.copy()
        result = self._S @ self._difference(X)
        result[:, : self._d] += self._residual
        return result

    def _multipliers(self, gradient: Matrix, X: Matrix) -> Matrix:
        """Λ of every G, (n, d, d): the symmetric part of the products of its axes with the gradient's rows."""
        of, axes = (self._packing.unpacked(each)[:, : self._d] for each in (gradient, X))
        products = of @ np.swapaxes(axes, 1, 2)
        return 0.5 * (products + np.swapaxes(products, 1, 2))

    def _scaled(self, matrices: Matrix, X: Matrix) -> Matrix:
        """Every G's axes times its matrix (n, d, d); zero for positions."""
        rows = self._packing.unpacked(X)
        result = np.zeros_like(rows)
        np.matmul(matrices, rows[:, : self._d], out=result[:, : self._d])
        return self._packing.packed(result)

    def _tangent(self, X: Matrix, V: Matrix) -> Matrix:
        return V - self._scaled(self._multipliers(V, X), X)

    def _retracted(self, X: Matrix) -> Matrix:
        rows = self._packing.unpacked(X).copy()
        U, _, V = np.linalg.svd(rows[self._has_axes, : self._d], full_matrices=False)
        rows[self._has_axes, : self._d] = U @ V
        return self._packing.packed(rows)
