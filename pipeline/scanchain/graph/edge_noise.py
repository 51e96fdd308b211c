"""Noise of edges as text files have it: order of its entries, covariance or square root, bearing and range."""

from __future__ import annotations

from typing import Literal

import numpy as np

from scanchain.data import Mask, Matrix
from scanchain.graph.edge_checks import positive_semidefinite, ranks

Noise = Literal["auto", "information", "covariance", "square-root"]
Order = tuple[int, ...]
BY_ROWS: Order = (0, 1, 2, 3, 4, 5)  # of the entries xx xy xθ yy yθ θθ: g2o, iSAM, GTSAM
TORO: Order = (0, 1, 3, 5, 2, 4)  # xx xy yy θθ xθ yθ


def order_of(entries: Matrix, preferred: Order) -> Order:
    """Order of the entries (n, 6): the preferred one unless it gives an indefinite matrix, and the other none.

    EDGE2 lines have either order, and diagonal matrices, which most are, fit only one of the two.
    """
    other = TORO if preferred == BY_ROWS else BY_ROWS
    for order in (preferred, other):
        by_rows = np.zeros((len(entries), 6))
        by_rows[:, order] = entries
        if positive_semidefinite(symmetric(by_rows)).all():
            return order
    return preferred


def symmetric(by_rows: Matrix) -> Matrix:
    """Matrices (n, k, k) from their upper triangles by rows (n, k(k+1)/2)."""
    k = int(np.sqrt(2 * by_rows.shape[1]))
    matrices = np.zeros((len(by_rows), k, k))
    a, b = np.triu_indices(k)
    matrices[:, a, b] = matrices[:, b, a] = by_rows
    return matrices


def positions(bearing_range: Matrix) -> Matrix:
    """Relative positions and covariances x y xx xy yy (n, 5) of bearing, range and their deviations (n, 4).

    With the unit vector u at the bearing and v normal to it, the covariance to first order is
        σ_range² u uᵀ + (range σ_bearing)² v vᵀ
    """
    bearing, distance, bearing_std, range_std = bearing_range.T
    c, s, along, across = np.cos(bearing), np.sin(bearing), range_std**2, (distance * bearing_std) ** 2
    C_xx, C_xy, C_yy = along * c**2 + across * s**2, (along - across) * c * s, along * s**2 + across * c**2
    return np.stack([distance * c, distance * s, C_xx, C_xy, C_yy], axis=1)


def is_invertible(covariances: Matrix) -> Mask:
    """True for each of the matrices (n, k, k) that is positive definite, (n,)."""
    return positive_semidefinite(covariances) & (ranks(covariances) == covariances.shape[1])


def squared(upper: Matrix) -> Matrix:
    """Information RᵀR of square roots, given as symmetric matrices (n, k, k) whose upper triangles are R."""
    R = np.triu(upper)
    return np.swapaxes(R, 1, 2) @ R
