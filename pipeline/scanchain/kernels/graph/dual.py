"""The dual matrix of a pose graph, whose definiteness certifies a minimum as the global one; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]


@njit(nogil=True)
def scatter_dual(
    leap: _Array,
    force: _Array,
    torque: _Array,
    tau: _Array,
    kappa: _Array,
    slots: _Index,
    blocks: _Array,
    residual: _Array,
) -> None:
    """Add every edge's quadratic minorant to S = Q − Λ, and its share to the residual r = S X*.

    Unknowns are G_i, the rotation of pose i against its estimate, seen from the world, and t_i, its position; at
    the estimate X* every G is I. An edge contributes
        q = τ‖t_j − t_i − G_i l‖² + fᵀG_iᵀ(t_j − t_i) + ½ κ‖G_i − G_j‖² + ½ ⟨[g]×, G_iᵀG_j⟩
    and, by the multiplier Λ_i of G_iᵀG_i = I that makes X* stationary, −½ sym(f lᵀ) at G_i
    (Carlone et al. 2015, eq. 26; Rosen et al. 2019, eq. 22). A row of S belongs to one row of each G and of t.

    leap (E, d) l = t_j − t_i at the estimate; force (E, d) f; torque (E, d, d) [g]×; tau, kappa (E,)
    slots (E, 3) : block of i, block of j, block of the pair (higher, lower); -1 where the pose is fixed
    blocks (B, d+1, d+1), residual (n, d+1, d) : added to
    """
    d = leap.shape[1]
    for e in range(leap.shape[0]):
        i, j, pair = slots[e, 0], slots[e, 1], slots[e, 2]
        if i >= 0:
            _add_first(leap[e], force[e], tau[e], kappa[e], blocks[i])
            for a in range(d):
                residual[i, d, a] -= 0.5 * force[e, a]
                for b in range(d):
                    residual[i, a, b] += 0.25 * (force[e, a] * leap[e, b] - leap[e, a] * force[e, b])
                    residual[i, a, b] += 0.25 * torque[e, a, b]
        if j >= 0:
            for a in range(d):
                blocks[j, a, a] += 0.5 * kappa[e]
                residual[j, d, a] += 0.5 * force[e, a]
                for b in range(d):
                    residual[j, a, b] -= 0.25 * torque[e, a, b]
            blocks[j, d, d] += tau[e]
        if pair >= 0:
            _add_pair(leap[e], force[e], torque[e], tau[e], kappa[e], i > j, blocks[pair])


@njit(nogil=True)
def _add_first(leap: _Array, force: _Array, tau: float, kappa: float, block: _Array) -> None:
    """Add an edge to the diagonal block of its first pose."""
    d = leap.size
    for a in range(d):
        for b in range(d):
            block[a, b] += tau * leap[a] * leap[b] - 0.25 * (force[a] * leap[b] + leap[a] * force[b])
        block[a, a] += 0.5 * kappa
        block[a, d] += tau * leap[a] - 0.5 * force[a]
        block[d, a] += tau * leap[a] - 0.5 * force[a]
    block[d, d] += tau


@njit(nogil=True)
def _add_pair(
    leap: _Array, force: _Array, torque: _Array, tau: float, kappa: float, from_higher: bool, block: _Array
) -> None:
    """Add an edge to the block between its poses, row i and column j, turned where j is the higher."""
    d = leap.size
    for a in range(d):
        for b in range(d):
            value = 0.25 * torque[a, b] - (0.5 * kappa if a == b else 0.0)
            if from_higher:
                block[a, b] += value
            else:
                block[b, a] += value
        value = 0.5 * force[a] - tau * leap[a]
        if from_higher:
            block[a, d] += value
        else:
            block[d, a] += value
    block[d, d] -= tau
