"""The factor of a sparse Cholesky factorization as a matrix, for those who draw it or invert parts of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from scanchain.graph.solvers.cholesky import SparseCholesky
from scanchain.kernels.graph.fronts import Fronts


def upper_factor(cholesky: SparseCholesky) -> csr_matrix:
    """U of the last factorization, A = Uᵀ U, in the order of elimination; zeros kept where it may fill in."""
    return front_rows(cholesky._fronts, cholesky._factor)


def front_rows(fronts: Fronts, factor: NDArray[np.float64]) -> csr_matrix:
    """The upper triangular matrix whose rows the fronts keep, in the order of elimination."""
    widths = np.diff(fronts.row_start)
    count = int(fronts.pivots.sum())
    front = np.repeat(np.arange(len(widths)), fronts.pivots)
    within = np.arange(count) - np.repeat(np.cumsum(fronts.pivots) - fronts.pivots, fronts.pivots)
    lengths = widths[front] - within
    row_start = np.concatenate([[0], np.cumsum(lengths)])
    along = np.arange(row_start[-1]) - np.repeat(row_start[:-1], lengths)
    columns = fronts.rows[np.repeat(fronts.row_start[front] + within, lengths) + along]
    first = fronts.factor_start[front] + within * widths[front] + within
    values = factor[np.repeat(first, lengths) + along]
    return csr_matrix((values, columns, row_start), shape=(count, count))
