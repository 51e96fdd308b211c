"""Linear solvers of A x = b by name, comparison of their times and errors; marginal covariances."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import block_array, csc_matrix, csr_matrix, dia_array, diags_array, identity
from scipy.sparse.linalg import MatrixRankWarning, SuperLU, inv, splu, spsolve, spsolve_triangular

from scanchain.clock import working_s
from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.graph.cholesky import Analysis, SingularMatrixError, SparseCholesky, analyze, upper_factor
from scanchain.kernels.landmarks import algebra
from scanchain.landmarks.problem import Layout, LinearSystem, Pattern, landmark_columns, pose_columns

LOST_DIGITS = 1e-13  # a pivot below this share of its diagonal entry (of AᵀA) or column (of A) is rounding noise
_NAMED = 6  # largest number of unknowns that an error names


@dataclass(frozen=True, slots=True)
class Factor:
    """The triangular factor of a solution, or the inverse where there is none.

    name : such as "U of AᵀA" or "R of A"
    matrix : (n, n) with rows and columns in the order of the method; may hold explicit zeros of possible fill-in
    order : (n,) column of A at each position of that order
    """

    name: str
    matrix: csc_matrix
    order: NDArray[np.int64]

    @property
    def nnz(self) -> int:
        """Entries that are not zero."""
        return int(self.matrix.count_nonzero())


class Factored(NamedTuple):
    """A factorization: ``solve`` gives x (n,), ``factor`` assembles the factor as a matrix."""

    solve: Callable[[], NDArray[np.float64]]
    factor: Callable[[], Factor]


class LinearSolver:
    """Solves A x = b in the least-squares sense by one method, which reuses its analysis of the last pattern.

    A method builds what it factorizes, AᵀA and Aᵀb or the order of A. If A lacks full column rank it raises
    SingularMatrixError or RuntimeError.

    spent_s : (3,) time of all ``solutions``: to build, to factor with all analysis, to solve triangular systems
    """

    def __init__(self, method: Method) -> None:
        self._method = method
        self.spent_s = np.zeros(3)
        self.solutions = 0
        self._factored: Factored | None = None

    def solve(self, system: LinearSystem) -> NDArray[np.float64]:
        """Solution (n,) in the least-squares sense; raises UndeterminedError if A lacks full column rank."""
        laps_s = [working_s()]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", MatrixRankWarning)
                built: Any = self._method.build(system)
                laps_s.append(working_s())
                self._factored = self._method.factorize(system, built)
                laps_s.append(working_s())
                x = self._factored.solve()
                laps_s.append(working_s())
        except (RuntimeError, MatrixRankWarning, SingularMatrixError) as error:
            raise undetermined(system) from error
        self.spent_s += np.diff(laps_s)
        self.solutions += 1
        return x

    def factor(self) -> Factor:
        """Factor of the last solution."""
        assert self._factored is not None
        return self._factored.factor()


class UndeterminedError(InputError):
    """The equations do not determine the unknowns of these ``columns``."""

    def __init__(self, layout: Layout, columns: NDArray[np.int64]) -> None:
        names = ", ".join(layout.name(int(column)) for column in columns[:_NAMED])
        more = f" and {len(columns) - _NAMED} more" if len(columns) > _NAMED else ""
        super().__init__(
            f"A x = b is singular: its equations leave {names}{more} open;"
            " add measurements of them or a prior, or leave them out"
        )
        self.columns = columns


def undetermined(system: LinearSystem) -> UndeterminedError:
    """Error that names the undetermined unknowns: those with a component in the null space of A.

    ε (H + ε I)⁻¹ tends to the projection onto the null space of H = AᵀA, here scaled to a unit diagonal; applied
    a few times to a random vector it leaves a nonzero entry exactly where some null vector has one.
    """
    if not (np.isfinite(system.values).all() and np.isfinite(system.b).all()):
        raise InputError("A x = b holds numbers that are not finite; start from a better guess")
    A = system.A
    n = system.pattern.shape[1]
    H = csc_matrix(A.T @ A)
    scale = np.sqrt(np.asarray(H.diagonal()))
    scale[scale == 0.0] = 1.0
    H = csc_matrix(diags_array(1.0 / scale) @ H @ diags_array(1.0 / scale))
    epsilon = 1e-11
    factor = splu(csc_matrix(H + epsilon * identity(n, format="csc")), permc_spec="MMD_AT_PLUS_A")
    null = np.random.default_rng(0).uniform(1.0, 2.0, n)
    for _ in range(4):
        null = epsilon * factor.solve(null)
    null = np.abs(null) / scale
    return UndeterminedError(system.pattern.layout, np.flatnonzero(null > 1e-6 * null.max()))


def check_pivots(pivots: NDArray[np.float64], whole: NDArray[np.float64]) -> None:
    """Raise SingularMatrixError if pivots (n,) are rounding noise of the entries before elimination, ``whole``."""
    failed = np.flatnonzero(~(pivots > LOST_DIGITS * whole))
    if len(failed):
        raise SingularMatrixError(int(failed[0]), int(failed[0]))


def normal_equations(system: LinearSystem) -> tuple[csc_matrix, NDArray[np.float64]]:
    """AᵀA and Aᵀb."""
    A = system.A
    return csc_matrix(A.T @ A), A.T @ system.b


class ScipyMethod:
    """AᵀA x = Aᵀb by solvers of SciPy.

    ``default`` is spsolve, which returns no factor: that of splu with the same settings is reported. ``pinv``
    forms (AᵀA)⁻¹; ``lu`` and ``lu_colamd`` are SuperLU in the natural order and in that of COLAMD.
    """

    build = staticmethod(normal_equations)

    def __init__(self, name: Literal["default", "pinv", "lu", "lu_colamd"]) -> None:
        self._name = name

    def factorize(self, system: LinearSystem, built: tuple[csc_matrix, NDArray[np.float64]]) -> Factored:
        """U of AᵀA, or its inverse."""
        H, g = built
        if self._name == "default":
            return Factored(lambda: np.asarray(spsolve(H, g)), lambda: _upper(splu(H, permc_spec="COLAMD")))
        diagonal = np.asarray(H.diagonal(), np.float64)
        if self._name == "pinv":
            inverse = csc_matrix(inv(H))
            # if unknown k is eliminated last, its pivot is 1 / inverse[k, k]
            check_pivots(1.0 / np.asarray(inverse.diagonal(), np.float64), diagonal)
            return Factored(lambda: inverse @ g, lambda: Factor("(AᵀA)⁻¹", inverse, np.arange(len(g))))
        lu = splu(H, permc_spec="COLAMD" if self._name == "lu_colamd" else "NATURAL")
        check_pivots(np.abs(lu.U.diagonal())[lu.perm_c], diagonal)
        return Factored(lambda: lu.solve(g), lambda: _upper(lu))


def _upper(lu: SuperLU) -> Factor:
    return Factor("U of AᵀA", csc_matrix(lu.U), np.argsort(lu.perm_c))


class CholeskyMethod:
    """Multifrontal Cholesky of AᵀA; for an unchanged pattern only the numeric factorization is repeated."""

    build = staticmethod(normal_equations)

    def __init__(self) -> None:
        def analyzed(pattern: Pattern) -> SparseCholesky:
            squared = pattern.squared()
            return SparseCholesky(squared, analyze(squared))

        self._analyzed = lru_cache(maxsize=1)(analyzed)

    def factored(self, system: LinearSystem, H: csc_matrix) -> SparseCholesky:
        """The factored H = AᵀA of this system."""
        cholesky = self._analyzed(system.pattern)
        H.sum_duplicates()  # sorts it, so that entries are found by bisection
        cholesky.factorize(np.asarray(H[cholesky.pattern.rows, cholesky.pattern.columns]).ravel())
        return cholesky

    def factorize(self, system: LinearSystem, built: tuple[csc_matrix, NDArray[np.float64]]) -> Factored:
        """U with AᵀA = UᵀU."""
        H, g = built
        cholesky = self.factored(system, H)
        U, order = upper_factor, cholesky.analysis.order
        return Factored(lambda: cholesky.solve(g), lambda: Factor("U of AᵀA", csc_matrix(U(cholesky)), order))


class QrMethod:
    """A = Q R by Givens rotations, without ever forming AᵀA; the analysis of a pattern is reused as well."""

    def __init__(self, *, is_natural: bool) -> None:
        def analyzed(pattern: Pattern) -> Analysis:
            return analyze(pattern.squared(), np.arange(pattern.shape[1]) if is_natural else None)

        self._analyzed = lru_cache(maxsize=1)(analyzed)

    def build(self, system: LinearSystem) -> Analysis:
        """The order of the columns, natural or by minimum degree in AᵀA, and the sparsity pattern of R."""
        return self._analyzed(system.pattern)

    def factorize(self, system: LinearSystem, built: Analysis) -> Factored:
        """R of A, and the head of Qᵀb."""
        pattern, n = system.pattern, system.pattern.shape[1]
        place, R, z = np.argsort(built.order), np.zeros(len(built.rows) + n), np.zeros(n)
        algebra.rotate(
            _order_of_rows(pattern, place), pattern.row_start, pattern.columns, system.values, system.b,
            place, built.begin, built.rows, built.parent, R, z,
        )  # fmt: skip
        starts = built.begin + np.arange(n + 1)
        matrix = csr_matrix((R, np.insert(built.rows, built.begin[:-1], np.arange(n)), starts), shape=(n, n))
        lengths = np.sqrt(np.bincount(pattern.columns, system.values**2, n))
        check_pivots(np.abs(R[starts[:-1]]), lengths[built.order])
        return Factored(
            lambda: spsolve_triangular(matrix, z, lower=False)[place],
            lambda: Factor("R of A", csc_matrix(matrix), built.order),
        )


def _order_of_rows(pattern: Pattern, place: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nonempty rows of A, ascending by first and then descending by last column, in their places (n,)."""
    rows = np.flatnonzero(np.diff(pattern.row_start))
    places = place[pattern.columns]
    first, last = (ends.reduceat(places, pattern.row_start[rows]) for ends in (np.minimum, np.maximum))
    return rows[np.lexsort((-last, first))]


class SchurMethod:
    """Schur complement S = C − B P⁻¹ Bᵀ of AᵀA = [P, Bᵀ; B, C], dense as it couples all landmarks, then poses.

    P is banded if only odometry joins the poses. If robots see each other, or the poses have fewer unknowns than
    the landmarks, sparse Cholesky of the whole matrix is used instead.
    """

    def __init__(self) -> None:
        self._cholesky = CholeskyMethod()

    def build(self, system: LinearSystem) -> tuple[Arrow | csc_matrix, NDArray[np.float64]]:
        """AᵀA, as an arrow where that is faster, and Aᵀb."""
        layout = system.pattern.layout
        is_arrow = layout.is_chain and layout.columns <= 2 * layout.split
        return _form(system) if is_arrow else normal_equations(system)

    def factorize(self, system: LinearSystem, built: tuple[Arrow | csc_matrix, NDArray[np.float64]]) -> Factored:
        """U with AᵀA = UᵀU."""
        U, g = built
        if not isinstance(U, Arrow):
            return self._cholesky.factorize(system, (U, g))
        _eliminate(U)
        return Factored(lambda: _solved(U, g), lambda: _factor_of_arrow(U))


Method = ScipyMethod | CholeskyMethod | QrMethod | SchurMethod


@dataclass(frozen=True, slots=True)
class Arrow:
    """U of AᵀA = UᵀU, or AᵀA before it is factored: band and border (split, n − split) of the poses, corner."""

    band: NDArray[np.float64]
    border: NDArray[np.float64]
    corner: NDArray[np.float64]


class Covariance:
    """(AᵀA)⁻¹ between neighboring poses, between poses and landmarks, and between landmarks; never the whole."""

    def __init__(self, system: LinearSystem) -> None:
        """Raises UndeterminedError if A lacks full column rank."""
        self._layout = system.pattern.layout
        try:
            self._inverse = (_ArrowInverse if self._layout.is_chain else _SparseInverse)(system)
        except SingularMatrixError as error:
            raise undetermined(system) from error

    @property
    def poses(self) -> Matrix:
        """Covariance of every pose, (K, p, p), relative to the first if that is fixed; m, rad."""
        return self.of(pose_columns(self._layout, np.arange(self._layout.poses)))

    @property
    def calibration(self) -> NDArray[np.float64]:
        """Standard deviations of the calibration, (C,)."""
        columns = np.arange(self._layout.split, self._layout.landmark_start)
        return np.sqrt(self.of(columns[:, None])[:, 0, 0])

    @property
    def landmarks(self) -> Matrix:
        """Covariance of every landmark, (L, 2, 2) m²."""
        return self.of(landmark_columns(self._layout, np.arange(len(self._layout.landmarks))))

    def sample(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """A normally distributed step (n,) with this covariance: x = U⁻¹ z for AᵀA = UᵀU."""
        return self._inverse.draw(rng.normal(size=self._layout.columns))

    def of(self, columns: NDArray[np.int64]) -> Matrix:
        """Covariances of groups of unknowns, (N, c) columns of A to (N, c, c); NaN for poses far apart."""
        result = np.empty((*columns.shape, columns.shape[1]))
        self._inverse.blocks(columns, result)
        return result


class _ArrowInverse:
    """(AᵀA)⁻¹ in the band of the poses, in its border and in the corner."""

    def __init__(self, system: LinearSystem) -> None:
        """Raises SingularMatrixError."""
        self._factor, _ = _form(system)
        _eliminate(self._factor)
        U = self._factor
        self._band, self._border, self._corner = (np.empty_like(part) for part in (U.band, U.border, U.corner))
        algebra.invert(U.band, U.border, U.corner, self._band, self._border, self._corner)

    def draw(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solution x (n,) of U x = z, in place of z."""
        U, split = self._factor, self._factor.band.shape[1]
        z[split:] = solve_triangular(U.corner, z[split:], check_finite=False)
        z[:split] -= U.border @ z[split:]
        algebra.solve_backward(U.band, z[:split])
        return z

    def blocks(self, columns: NDArray[np.int64], result: Matrix) -> None:
        """Fill the blocks (N, c, c) of these columns (N, c)."""
        algebra.blocks(self._band, self._border, self._corner, columns, result)


class _SparseInverse:
    """(AᵀA)⁻¹ where AᵀA may be nonzero."""

    def __init__(self, system: LinearSystem) -> None:
        """Raises SingularMatrixError."""
        H, _ = normal_equations(system)
        self._cholesky = CholeskyMethod().factored(system, H)
        pattern, inverse = self._cholesky.pattern, self._cholesky.inverse_blocks()
        self._n = pattern.scalars
        keys = self._keys(pattern.rows, pattern.columns)
        order = np.argsort(keys)
        self._known, self._values = keys[order], inverse[order]

    def _keys(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.minimum(rows, columns) * self._n + np.maximum(rows, columns)

    def draw(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """A step (n,) of this covariance for white noise z (n,)."""
        return self._cholesky.draw(z)

    def blocks(self, columns: NDArray[np.int64], result: Matrix) -> None:
        """Fill the blocks (N, c, c) of these columns (N, c), with NaN where AᵀA is zero."""
        keys = self._keys(columns[:, :, None], columns[:, None, :])
        at = np.minimum(np.searchsorted(self._known, keys), len(self._known) - 1)
        result[:] = np.where(self._known[at] == keys, self._values[at], np.nan)


def _solved(U: Arrow, g: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve UᵀU x = g, in place of g."""
    poses, landmarks = np.split(g, [U.band.shape[1]])
    algebra.solve_forward(U.band, poses)
    landmarks -= poses @ U.border
    algebra.solve_corner(U.corner, landmarks)
    poses -= U.border @ landmarks
    algebra.solve_backward(U.band, poses)
    return g


def _form(system: LinearSystem) -> tuple[Arrow, NDArray[np.float64]]:
    """AᵀA as an arrow, and Aᵀb."""
    pattern, layout = system.pattern, system.pattern.layout
    n, split = layout.columns, layout.split
    width = 2 * layout.pose_size  # of the band, since odometry joins successive poses only
    H = Arrow(np.zeros((width, split)), np.zeros((split, n - split)), np.zeros((n - split, n - split)))
    g = np.zeros(n)
    algebra.products(
        pattern.row_start, pattern.columns, system.values, system.b, split, H.band, H.border, H.corner, g
    )
    return H, g


def _eliminate(H: Arrow) -> None:
    """Turn AᵀA into its factor, in place: P = UᵀU banded, Y = U⁻ᵀ Bᵀ, S = C − YᵀY = UᵀU dense."""
    floor = LOST_DIGITS * H.corner.diagonal()
    failed = algebra.eliminate(H.band, H.border, LOST_DIGITS)
    if failed < 0:
        algebra.complement(H.corner, H.border)
        failed = algebra.eliminate_corner(H.corner, floor)
    if failed >= 0:
        raise SingularMatrixError(failed, failed)


def _factor_of_arrow(U: Arrow) -> Factor:
    """The factor assembled from the three parts."""
    split = U.band.shape[1]
    poses = dia_array((U.band[::-1], np.arange(len(U.band))), shape=(split, split))
    matrix = block_array([[poses, csc_matrix(U.border)], [None, csc_matrix(np.triu(U.corner))]])
    return Factor("U of AᵀA", csc_matrix(matrix), np.arange(split + len(U.corner)))


_MAKERS = {
    **{name: partial(ScipyMethod, name) for name in ("default", "pinv", "lu", "lu_colamd")},
    "qr": partial(QrMethod, is_natural=True),
    "qr_colamd": partial(QrMethod, is_natural=False),
    "cholesky": CholeskyMethod,
    "schur": SchurMethod,
}
PINV_BELOW = 3_000  # number of unknowns at which the inverse, almost dense, takes 110 MB and seconds
METHODS = tuple(_MAKERS)
ESTIMATOR = "schur"  # the fastest: makes the estimate where no other is requested


def create_solver(method: str) -> LinearSolver:
    """A solver by the method of this name."""
    return LinearSolver(_MAKERS[method]())


def parse_methods(text: str) -> tuple[str, ...]:
    """The names in a comma-separated list; "all" means every method that suits the problem."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    choice = f"choose from all, {', '.join(_MAKERS)}"
    for name in names:
        if name != "all" and name not in _MAKERS:
            raise InputError(f"there is no method {name!r}; {choice}")
    if not names:
        raise InputError(f"no method is named; {choice}")
    return tuple(names)


def methods_for(requested: Sequence[str], unknowns: int) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods to run on a problem with this many unknowns, and a note on one that "all" leaves out.

    Raises InputError if a named one is too slow.
    """
    chosen = dict.fromkeys(method for name in requested for method in (METHODS if name == "all" else (name,)))
    if "pinv" not in chosen or unknowns < PINV_BELOW:
        return tuple(chosen), {}
    why = f"pinv, whose inverse is almost dense: {unknowns:,} unknowns, its limit is {PINV_BELOW:,}"
    if "pinv" in requested:
        raise InputError(f"{why}; name other --methods")
    del chosen["pinv"]
    return tuple(chosen), {"not compared": why}


_SLOW_S = 1.0  # seconds of a solution above which it is not repeated


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One method on one problem.

    build_s, factor_s, solve_s : medians over the repetitions, each with a new solver; sums over the iterations
    again_s : the whole solution repeated with the same solver, which reuses its analysis of the pattern
    iterations : linear solves; ``factor`` is of the last one
    x : (n,) the unknowns
    difference : largest entry of x minus that of the first method
    """

    method: str
    build_s: float
    factor_s: float
    solve_s: float
    again_s: float
    iterations: int
    factor: Factor
    x: NDArray[np.float64]
    difference: float

    @property
    def total_s(self) -> float:
        """Seconds of one solution from scratch."""
        return self.build_s + self.factor_s + self.solve_s


def compare(
    solve: Callable[[LinearSolver], NDArray[np.float64]], methods: Sequence[str], repeats: int
) -> tuple[MethodResult, ...]:
    """Results of ``solve``, which finds the unknowns (n,), with every method in turn; slow ones run only once."""
    results = list[MethodResult]()
    for method in methods:
        solver, x, iterations, times_s = create_solver(method), np.empty(0), 0, list[NDArray[np.float64]]()
        while len(times_s) < repeats and not (times_s and times_s[0][-1] > _SLOW_S):
            solver = create_solver(method)
            x = solve(solver)
            spent_s, iterations = solver.spent_s.copy(), solver.solutions
            solve(solver)
            times_s.append(np.append(spent_s, (solver.spent_s - spent_s).sum()))
        build_s, factor_s, solve_s, again_s = np.median(times_s, axis=0).tolist()
        difference = float(np.abs(x - results[0].x).max()) if results else 0.0
        factor = solver.factor()
        results.append(
            MethodResult(method, build_s, factor_s, solve_s, again_s, iterations, factor, x, difference)
        )
    return tuple(results)
