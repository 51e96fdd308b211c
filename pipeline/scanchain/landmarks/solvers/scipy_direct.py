"""The methods of the course report in scipy: on the normal equations AᵀA x = Aᵀb, with SuperLU."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import MatrixRankWarning, SuperLU, inv, splu, spsolve

from scanchain.errors import InputError
from scanchain.landmarks.solvers.solution import LOST_DIGITS, Factor, Solution, Stopwatch, undetermined
from scanchain.landmarks.system import LinearSystem

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
