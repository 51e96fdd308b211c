"""Solution and error of the linear solvers; those of SciPy, on the normal equations AᵀA x = Aᵀb with SuperLU."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags_array, identity
from scipy.sparse.linalg import MatrixRankWarning, SuperLU, inv, splu, spsolve

from scanchain.clock import working_s
from scanchain.errors import InputError
from scanchain.landmarks.problem import Layout, LinearSystem

LOST_DIGITS = 1e-13  # a pivot below this share of its diagonal entry (of AᵀA) or column (of A) is rounding noise
_NAMED = 6


@dataclass(frozen=True, slots=True)
class Factor:
    """The triangular factor of a solution, or the inverse where there is none.

    Attributes
    ----------
    name : such as "U of AᵀA" or "R of A"
    matrix : (n, n) its rows and columns as the method ordered them; may hold zeros where it could have filled in
    order : (n,) column of A at each place of that order
    """

    name: str
    matrix: csc_matrix
    order: NDArray[np.int64]

    @property
    def nnz(self) -> int:
        """Entries that are not zero."""
        return int(self.matrix.count_nonzero())


@dataclass(frozen=True, slots=True)
class Solution:
    """Result of a linear solver.

    Attributes
    ----------
    x : (n,)
    build_s : time to form what is factored (AᵀA and Aᵀb), or to sort the rows of A
    factor_s : time of ordering, symbolic analysis (where not kept from before) and factorization
    solve_s : time of the triangular solves
    factor : makes the factor as a matrix; not part of the times
    """

    x: NDArray[np.float64]
    build_s: float
    factor_s: float
    solve_s: float
    factor: Callable[[], Factor]

    @property
    def total_s(self) -> float:
        """All of it."""
        return self.build_s + self.factor_s + self.solve_s


class LinearSolver(Protocol):
    """Solves A x = b; reuses its analysis for as long as the pattern is the same object."""

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; raises UndeterminedError where A has not full column rank."""
        ...


class UndeterminedError(InputError):
    """The equations do not determine some unknowns, whose ``columns`` these are."""

    def __init__(self, layout: Layout, columns: NDArray[np.int64]) -> None:
        names = ", ".join(layout.name(int(column)) for column in columns[:_NAMED])
        more = f" and {len(columns) - _NAMED} more" if len(columns) > _NAMED else ""
        super().__init__(
            f"A x = b is singular: its equations leave {names}{more} open;"
            " add measurements of them or a prior, or leave them out"
        )
        self.columns = columns


class Stopwatch:
    """Seconds since the last lap."""

    def __init__(self) -> None:
        self._last_s = working_s()

    def lap(self) -> float:
        """Time since the last lap."""
        now_s = working_s()
        lap_s, self._last_s = now_s - self._last_s, now_s
        return lap_s


def undetermined(system: LinearSystem) -> UndeterminedError:
    """Error that names the undetermined unknowns: those with a share in the null space of A.

    ε (H + ε I)⁻¹ tends to the projection onto the null space of H = AᵀA, here scaled to a unit diagonal; applied
    a few times to a random vector it leaves a nonzero entry just where some null vector has one.
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


PINV_BELOW = 3_000  # largest number of unknowns: their inverse is all but dense, 110 MB, and takes seconds


class PinvSolver:
    """``pinv``: x = (AᵀA)⁻¹ Aᵀb with the inverse formed explicitly."""

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is the inverse."""
        n = system.pattern.shape[1]
        check_pinv(n)
        watch = Stopwatch()
        H, g = _normal_equations(system)
        build_s = watch.lap()
        with _naming_the_undetermined(system):
            inverse = csc_matrix(inv(H))
        factor_s = watch.lap()
        # the k-th pivot of an elimination that takes unknown k last is 1 / inverse[k, k]
        _check_pivots(1.0 / np.asarray(inverse.diagonal(), np.float64), H, system)
        watch.lap()
        x = inverse @ g
        solve_s = watch.lap()
        return Solution(x, build_s, factor_s, solve_s, lambda: Factor("(AᵀA)⁻¹", inverse, np.arange(n)))


def check_pinv(unknowns: int) -> None:
    """Refuse to invert a matrix of so many rows. Raises InputError."""
    if unknowns >= PINV_BELOW:
        raise InputError(
            f"pinv: the inverse of AᵀA would be all but dense for {unknowns:,} unknowns, its limit is"
            f" {PINV_BELOW:,}; name other --methods"
        )


class DefaultSolver:
    """``default``: scipy's spsolve, which returns no factor.

    Its time counts as factorization. The factor is that of splu with the same settings as spsolve has.
    """

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense."""
        watch = Stopwatch()
        H, g = _normal_equations(system)
        build_s = watch.lap()
        with _naming_the_undetermined(system):
            x = spsolve(H, g)
        factor_s = watch.lap()
        return Solution(np.asarray(x), build_s, factor_s, 0.0, lambda: _upper(_factorize(H, "COLAMD", system)))


class LuSolver:
    """``lu`` and ``lu_colamd``: SuperLU on AᵀA in the natural order or in that of COLAMD."""

    def __init__(self, ordering: Literal["NATURAL", "COLAMD"]) -> None:
        self._ordering = ordering

    def solve(self, system: LinearSystem) -> Solution:
        """Solve in the least-squares sense; the factor is U."""
        watch = Stopwatch()
        H, g = _normal_equations(system)
        build_s = watch.lap()
        lu = _factorize(H, self._ordering, system)
        factor_s = watch.lap()
        x = lu.solve(g)
        solve_s = watch.lap()
        return Solution(x, build_s, factor_s, solve_s, lambda: _upper(lu))


@contextmanager
def _naming_the_undetermined(system: LinearSystem) -> Iterator[None]:
    """Raise scipy's error about a singular matrix as one that names its unknowns."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", MatrixRankWarning)
            yield
    except (RuntimeError, MatrixRankWarning) as error:
        raise undetermined(system) from error


def _normal_equations(system: LinearSystem) -> tuple[csc_matrix, NDArray[np.float64]]:
    A = system.A
    return csc_matrix(A.T @ A), A.T @ system.b


def _factorize(H: csc_matrix, ordering: str, system: LinearSystem) -> SuperLU:
    try:
        lu = splu(H, permc_spec=ordering)
    except RuntimeError as error:  # an exact zero
        raise undetermined(system) from error
    _check_pivots(np.abs(lu.U.diagonal())[lu.perm_c], H, system)
    return lu


def _check_pivots(pivots: NDArray[np.float64], H: csc_matrix, system: LinearSystem) -> None:
    """Refuse pivots (n,) by column that are no more than rounding; the factor of a singular matrix has such."""
    if not np.all(pivots > LOST_DIGITS * np.asarray(H.diagonal())):
        raise undetermined(system)


def _upper(lu: SuperLU) -> Factor:
    return Factor("U of AᵀA", csc_matrix(lu.U), np.argsort(lu.perm_c))
