"""The inverse of a sparse matrix where the matrix itself has entries, from its Cholesky factor; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit
from scanchain.kernels.graph.fronts import Blocks, Fronts, triangle
from scanchain.kernels.graph.symbolic import families

_Array = NDArray[np.float64]


@njit(nogil=True)
def selected_inverse(
    fronts: Fronts, blocks: Blocks, factor: _Array, inverse: _Array, stack: _Array, work: _Array
) -> None:
    """Fill the blocks of Z = A⁻¹ that A has, by fronts from the root down (Takahashi et al. 1973).

    From A = Uᵀ U follows U Z = U⁻ᵀ, which is zero above the diagonal; row a of a front, Z being known below it:
        Z_ac = −Σ_{m>a} U_am Z_mc / U_aa for c > a,      Z_aa = (1 / U_aa − Σ_{m>a} U_am Z_ma) / U_aa
    What a front needs of Z beyond its pivots its parent has; it waits on the stack, as the update matrices did.

    factor : as ``graph_cholesky.factorize`` left it; inverse : block values, laid out as those of A, filled
    stack : fronts.stack_size scalars of room, work : fronts.widest² scalars of room
    """
    first_child, sibling = families(fronts.parent)
    depth = 0
    for f in range(fronts.pivots.size - 1, -1, -1):
        height, pivots = fronts.row_start[f + 1] - fronts.row_start[f], fronts.pivots[f]
        rest = height - pivots
        Z = work[: height * height].reshape(height, height)
        depth -= triangle(rest)
        at = depth
        for a in range(rest):
            for c in range(a, rest):
                Z[pivots + a, pivots + c] = Z[pivots + c, pivots + a] = stack[at]
                at += 1
        at = fronts.factor_start[f + 1]
        for a in range(pivots - 1, -1, -1):
            at -= height - a
            _fill_row(Z, a, factor[at : at + height - a])
        for b in range(blocks.start[f], blocks.start[f + 1]):
            _take_block(Z, blocks, b, inverse)
        child = first_child[f]
        while child != -1:
            place = fronts.place[fronts.row_start[child] + fronts.pivots[child] : fronts.row_start[child + 1]]
            for a in range(place.size):
                for b in range(a, place.size):
                    stack[depth] = Z[place[a], place[b]]
                    depth += 1
            child = sibling[child]


@njit(nogil=True)
def _fill_row(Z: _Array, a: int, upper: _Array) -> None:
    """Fill row and column a of Z from those beyond it; upper is row a of U from the diagonal on."""
    height = a + upper.size
    row = Z[a]
    row[a + 1 :].fill(0.0)
    for m in range(a + 1, height):
        weight, below = upper[m - a] / upper[0], Z[m]
        for c in range(a + 1, height):
            row[c] -= weight * below[c]
    total = 1.0 / upper[0]
    for m in range(a + 1, height):
        Z[m, a] = row[m]
        total -= upper[m - a] * row[m]
    row[a] = total / upper[0]


@njit(nogil=True)
def _take_block(Z: _Array, blocks: Blocks, b: int, inverse: _Array) -> None:
    """Copy one block out of its front."""
    top, left, at = blocks.top[b], blocks.left[b], blocks.offset[b]
    for r in range(blocks.height[b]):
        for c in range(blocks.width[b]):
            inverse[at] = Z[top + c, left + r] if blocks.turned[b] == 1 else Z[top + r, left + c]
            at += 1
