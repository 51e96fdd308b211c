"""Sums over factors: χ² of every factor, and the normal equations scattered into their blocks; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]


@njit(nogil=True)
def squared_norms(errors: _Array, information: _Array, chi2: _Array) -> None:
    """Fill χ² = eᵀ Ω e of every factor; errors (E, k), information (E, k, k), chi2 (E,)."""
    k = errors.shape[1]
    for f in range(errors.shape[0]):
        e, omega = errors[f], information[f]
        total = 0.0
        for a in range(k):
            row = 0.0
            for b in range(k):
                row += omega[a, b] * e[b]
            total += e[a] * row
        chi2[f] = total


@njit(nogil=True)
def scatter_between(
    jacobian: _Array,
    errors: _Array,
    information: _Array,
    weights: _Array,
    slots: NDArray[np.int64],
    blocks: _Array,
    gradient: _Array,
) -> None:
    """Add every between factor to H = Σ w JᵀΩJ and g = Σ w JᵀΩe.

    With left twists ∂e/∂ξ_i = −∂e/∂ξ_j, so a factor adds M = w JᵀΩJ to both diagonal blocks and −M to the block
    that joins them; M is symmetric, so the order of the pair does not matter.

    jacobian (E, k, k) ∂e/∂ξ_j, errors (E, k), information (E, k, k), weights (E,)
    slots (E, 3) : block of i, block of j, block of the pair; -1 where the pose is fixed
    blocks (B, k, k), gradient (n, k) : added to
    """
    k = errors.shape[1]
    whitened, M, g = np.empty((k, k)), np.empty((k, k)), np.empty(k)
    for f in range(errors.shape[0]):
        _weigh(jacobian[f], errors[f], information[f], weights[f], whitened, M, g)
        i, j, pair = slots[f, 0], slots[f, 1], slots[f, 2]
        if i >= 0:
            _add(blocks[i], M, 1.0)
            _add_row(gradient[i], g, -1.0)
        if j >= 0:
            _add(blocks[j], M, 1.0)
            _add_row(gradient[j], g, 1.0)
        if pair >= 0:
            _add(blocks[pair], M, -1.0)


@njit(nogil=True)
def _add(block: _Array, M: _Array, sign: float) -> None:
    """Add ±M to a block."""
    for a in range(M.shape[0]):
        for b in range(M.shape[1]):
            block[a, b] += sign * M[a, b]


@njit(nogil=True)
def _add_row(row: _Array, g: _Array, sign: float) -> None:
    """Add ±g to a row of the gradient."""
    for a in range(g.size):
        row[a] += sign * g[a]


@njit(nogil=True)
def _weigh(J: _Array, e: _Array, omega: _Array, weight: float, whitened: _Array, M: _Array, g: _Array) -> None:
    """Fill whitened = w Ω J, M = Jᵀ w Ω J and g = (w Ω J)ᵀ e of one factor."""
    k = e.size
    whitened.fill(0.0)
    M.fill(0.0)
    g.fill(0.0)
    for a in range(k):
        for c in range(k):
            scale = weight * omega[a, c]
            if scale != 0.0:
                for b in range(k):
                    whitened[a, b] += scale * J[c, b]
        for b in range(k):
            g[b] += whitened[a, b] * e[a]
    for c in range(k):
        for a in range(k):
            scale = J[c, a]
            if scale != 0.0:
                for b in range(k):
                    M[a, b] += scale * whitened[c, b]
