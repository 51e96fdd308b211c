"""Sparse Cholesky factorization of a symmetric matrix of blocks; ordering and structure are computed once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spilu

from scanchain.data import Integers, Mask, Matrix, Vector
from scanchain.kernels.graph import cholesky, symbolic


class SingularMatrixError(ArithmeticError):
    """A pivot vanished: the equations do not determine the block ``variable``, at ``scalar`` of all scalars."""

    def __init__(self, variable: int, scalar: int) -> None:
        super().__init__(f"variable {variable} is not determined by the equations")
        self.variable, self.scalar = variable, scalar


class BlockPattern:
    """Blocks of a symmetric matrix that may be nonzero: every diagonal one and the given pairs.

    The values of such a matrix are one flat array: the n diagonal blocks, then one block for each pair
    (row, column), each row-major. Blocks may differ in size.
    """

    def __init__(self, sizes: Integers, pairs: Integers) -> None:
        """Sizes (n,) in scalars of the variables; pairs (P, 2) distinct variables, each pair once."""
        variables = np.arange(len(sizes))
        self.sizes = sizes
        self.pairs = pairs
        self.rows = np.concatenate([variables, pairs[:, 0]])
        self.columns = np.concatenate([variables, pairs[:, 1]])
        self.starts = np.cumsum(sizes) - sizes
        self.scalars = int(sizes.sum())
        self.value_count = int((sizes[self.rows] * sizes[self.columns]).sum())
        squares, within = np.cumsum(sizes**2) - sizes**2, np.arange(self.scalars) - np.repeat(self.starts, sizes)
        self.diagonal = np.repeat(squares, sizes) + within * (np.repeat(sizes, sizes) + 1)  # (scalars,) of values

    def entries(self) -> tuple[Integers, Integers, Mask]:
        """Row and column of every value, and whether it stands for its transpose as well, (value_count,) each."""
        counts = self.sizes[self.rows] * self.sizes[self.columns]
        block, within = np.repeat(np.arange(len(counts)), counts), symbolic.ranges(np.zeros_like(counts), counts)
        in_row, in_column = np.divmod(within, self.sizes[self.columns][block])
        row, column = (starts[block] for starts in (self.starts[self.rows], self.starts[self.columns]))
        return row + in_row, column + in_column, (self.rows != self.columns)[block]

    def multiply(self, values: Vector, x: Vector) -> Vector:
        """The product of the symmetric matrix of these values with a vector (scalars,)."""
        row, column, is_pair = self.entries()
        result = np.bincount(row, values * x[column], self.scalars)
        result += np.bincount(column[is_pair], (values * x[row])[is_pair], self.scalars)
        return result.astype(np.float64, copy=False)

    def matrix(self, values: Vector) -> csr_matrix:
        """The symmetric matrix of these values, (scalars, scalars)."""
        row, column, is_pair = self.entries()
        ends = np.append(row, column[is_pair]), np.append(column, row[is_pair])
        return csr_matrix((np.append(values, values[is_pair]), ends), shape=(self.scalars, self.scalars))


class Packing:
    """Conversion between blocks of size k, as kernels fill them, and values of a pattern with smaller blocks.

    A variable with fewer scalars uses the first of its k rows, or the last ones.
    """

    def __init__(self, pattern: BlockPattern, k: int, *, at_end: bool) -> None:
        begin = k - pattern.sizes if at_end else np.zeros_like(pattern.sizes)
        is_kept = (np.arange(k) >= begin[:, None]) & (np.arange(k) < (begin + pattern.sizes)[:, None])
        self._k = k
        self._kept_rows = is_kept
        self._kept = is_kept[pattern.rows][:, :, None] & is_kept[pattern.columns][:, None, :]
        self._is_whole = bool(is_kept.all())

    def values(self, blocks: Matrix) -> Vector:
        """Block values of blocks (B, k, k)."""
        return blocks.reshape(-1) if self._is_whole else blocks[self._kept]

    def blocks(self, values: Vector) -> Matrix:
        """Blocks (B, k, k) of block values, zero where none is stored."""
        if self._is_whole:
            return values.reshape(-1, self._k, self._k)
        result = np.zeros(self._kept.shape)
        result[self._kept] = values
        return result

    def packed(self, vectors: Matrix) -> Matrix:
        """Packed vectors (scalars, ...) of vectors (n, k, ...)."""
        return (
            vectors.reshape(self._kept_rows.size, *vectors.shape[2:])
            if self._is_whole
            else vectors[self._kept_rows]
        )

    def unpacked(self, packed: Matrix) -> Matrix:
        """Vectors (n, k, ...) of packed vectors (scalars, ...), zero where none is stored."""
        if self._is_whole:
            return packed.reshape(*self._kept_rows.shape, *packed.shape[1:])
        result = np.zeros((*self._kept_rows.shape, *packed.shape[1:]))
        result[self._kept_rows] = packed
        return result


@dataclass(frozen=True, slots=True)
class Analysis:
    """Symbolic analysis of the pairs: elimination order (n,), tree (n,), rows of the factor by column."""

    order: Integers
    parent: Integers
    begin: Integers
    rows: Integers


def analyze(pattern: BlockPattern, order: Integers | None = None) -> Analysis:
    """Symbolic analysis, independent of the block sizes; in a fill-reducing order unless one (n,) is given."""
    ends, n = np.concatenate([pattern.pairs, pattern.pairs[:, ::-1]]).T, len(pattern.sizes)
    links = csr_matrix((np.ones(ends.shape[1]), ends), shape=(n, n))
    start, neighbors = links.indptr.astype(np.int64), links.indices.astype(np.int64)
    if order is None:
        order = _fill_reducing_order(links)
        order = order[symbolic.postorder(symbolic.elimination_tree(start, neighbors, order))]
    parent = symbolic.elimination_tree(start, neighbors, order)
    return Analysis(order, parent, *symbolic.column_structures(start, neighbors, order, parent))


class SparseCholesky:
    """The factor A = Uᵀ U of a block-sparse matrix; ordering and symbolic analysis are retained.

    ``factorize`` may be called any number of times with new values of the same pattern.
    """

    def __init__(self, pattern: BlockPattern, analysis: Analysis) -> None:
        """Lay out the fronts; the analysis may come from a pattern of the same pairs and other sizes."""
        self.pattern = pattern
        self.analysis = analysis
        order, parent, begin, rows = analysis.order, analysis.parent, analysis.begin, analysis.rows
        sizes = pattern.sizes[order]
        groups = symbolic.group_columns(parent, begin, rows, sizes)
        self._fronts = symbolic.lay_out_fronts(groups, begin, rows, sizes)
        places = np.empty(len(order), np.int64)
        places[order] = np.cumsum(sizes) - sizes
        self._blocks = symbolic.lay_out_blocks(self._fronts, places, pattern.sizes, pattern.rows, pattern.columns)
        self._places = np.repeat(places - pattern.starts, pattern.sizes) + np.arange(pattern.scalars)
        self._factor: Vector | None = None
        self._floor = np.empty(pattern.scalars)
        self._every_front = np.arange(len(self._fronts.pivots))
        self._first_pivot = np.cumsum(self._fronts.pivots) - self._fronts.pivots
        self._front_of = np.repeat(self._every_front, self._fronts.pivots)

    @property
    def work(self) -> float:
        """Multiplications of a factorization, roughly: the pivots of every front times its entries."""
        return float((self._fronts.pivots * np.diff(self._fronts.row_start).astype(np.float64) ** 2).sum())

    def factorize(self, values: Vector, lost: float = 1e-13) -> None:
        """Factor the matrix of these block values; raises SingularMatrixError if it is not definite.

        lost : share of its diagonal entry up to which a pivot counts as vanished, as rounding noise
        """
        self._floor[self._places] = lost * np.abs(values[self.pattern.diagonal])
        if self._factor is None:
            self._factor = np.empty(int(self._fronts.factor_start[-1]))
        failed = cholesky.factorize(self._fronts, self._blocks, values, self._floor, self._factor, *self._room())
        if failed >= 0:
            scalar = int(np.flatnonzero(self._places == failed)[0])
            raise SingularMatrixError(int(np.searchsorted(self.pattern.starts, scalar, side="right") - 1), scalar)

    def release(self) -> None:
        """Free the memory of the factor, until the next ``factorize``."""
        self._factor = None

    @property
    def factor(self) -> Vector:
        """Values of the last factor, laid out by fronts."""
        assert self._factor is not None, "nothing was factored since the last release"
        return self._factor

    def _room(self) -> tuple[Vector, Vector]:
        """Stack and work of the kernels."""
        return np.empty(self._fronts.stack_size), np.empty(self._fronts.widest**2)

    def solve(self, right_side: Matrix) -> Matrix:
        """Solution x of A x = b by the last factor; b is (scalars,) or (scalars, m)."""
        columns = right_side[:, None] if right_side.ndim == 1 else right_side
        result, local = np.empty_like(columns), np.empty(self._fronts.widest)
        for column in range(columns.shape[1]):
            x = np.zeros(self.pattern.scalars)
            x[self._places] = columns[:, column]
            cholesky.solve_lower(self._fronts, self.factor, self._every_front, x, local)
            cholesky.solve_upper(self._fronts, self.factor, x, local)
            result[:, column] = x[self._places]
        return result.reshape(right_side.shape)

    def covariance_of(self, B: Matrix, variables: Integers) -> Matrix:
        """Bᵀ A⁻¹ B (m, m), by the last factor: covariance of x = Bᵀ y, where A is the information of y.

        B : (s, m) the scalars of these variables (v,), in their order; it is zero for the others
        With A = Uᵀ U it is CᵀC, Uᵀ C = B: forward substitution only, over the fronts between these variables and
        the roots of the elimination tree.
        """
        places = self._places[symbolic.ranges(self.pattern.starts[variables], self.pattern.sizes[variables])]
        path, local = self._path(places), np.empty(self._fronts.widest)
        reached = symbolic.ranges(self._first_pivot[path], self._fronts.pivots[path])
        x, C = np.zeros(self.pattern.scalars), np.empty((B.shape[1], len(reached)))
        for row, column in zip(C, B.T, strict=True):
            x[places] = column
            cholesky.solve_lower(self._fronts, self.factor, path, x, local)
            row[:] = x[reached]
            x[reached] = 0.0
        return np.asarray(np.einsum("is,js->ij", C, C))

    def _path(self, places: Integers) -> Integers:
        """Fronts that eliminate the scalars at these places, and all their ancestors, ascending."""
        path: set[int] = set()
        for front in np.unique(self._front_of[places]).tolist():
            while front >= 0 and front not in path:
                path.add(front)
                front = int(self._fronts.parent[front])
        return np.array(sorted(path), np.int64)

    def draw(self, noise: Vector) -> Vector:
        """Solution (scalars,) of U x = z by the last factor: of covariance A⁻¹ for white noise z of variance 1."""
        x = noise.copy()
        cholesky.solve_upper(self._fronts, self.factor, x, np.empty(self._fronts.widest))
        return x[self._places]

    def inverse_blocks(self) -> Vector:
        """A⁻¹ by the last factor, where A may be nonzero: block values, laid out as those of A."""
        result = np.empty(self.pattern.value_count)
        cholesky.selected_inverse(self._fronts, self._blocks, self.factor, result, *self._room())
        return result


def _fill_reducing_order(links: csr_matrix) -> Integers:
    """Variable to eliminate at each position, by multiple minimum degree (Liu 1985) as implemented in SuperLU.

    An incomplete factorization that drops every entry returns the ordering without the work of a full one.
    """
    n = len(links.indptr) - 1
    if n < 2:
        return np.arange(n)
    dominant = diags(np.diff(links.indptr) + 1.0) - links
    factor = spilu(
        dominant.tocsc(),
        drop_tol=1.0,
        fill_factor=1.0,
        permc_spec="MMD_AT_PLUS_A",
        options={"SymmetricMode": True},
    )
    return np.argsort(factor.perm_c).astype(np.int64)


def upper_factor(cholesky: SparseCholesky) -> csr_matrix:
    """U of the last factorization, A = Uᵀ U, in the order of elimination, with explicit zeros of the fill-in."""
    layout, size = cholesky._fronts, cholesky.pattern.scalars
    widths = np.diff(layout.row_start)
    front = np.repeat(np.arange(len(widths)), layout.pivots)
    within = symbolic.ranges(np.zeros_like(layout.pivots), layout.pivots)
    lengths = widths[front] - within
    row_start = np.concatenate([[0], np.cumsum(lengths)])
    columns = layout.rows[symbolic.ranges(layout.row_start[front] + within, lengths)]
    return csr_matrix((cholesky.factor.copy(), columns, row_start), shape=(size, size))
