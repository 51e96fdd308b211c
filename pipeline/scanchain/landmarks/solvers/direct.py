"""A linear solver with the time it takes and the error it raises; SciPy's methods on AᵀA x = Aᵀb."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags_array, identity
from scipy.sparse.linalg import MatrixRankWarning, SuperLU, inv, splu, spsolve

from scanchain.clock import working_s
from scanchain.errors import InputError
from scanchain.graph.cholesky import SingularMatrixError
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


class Factored(NamedTuple):
    """What a method factored: ``solve`` gives x (n,), ``factor`` puts the factor together as a matrix."""

    solve: Callable[[], NDArray[np.float64]]
    factor: Callable[[], Factor]


class Method(Protocol):
    """A way to solve A x = b in the least-squares sense.

    An analysis is kept for as long as the pattern is the same object. Both raise SingularMatrixError or
    RuntimeError where A has not full column rank.
    """

    def build(self, system: LinearSystem) -> Any:
        """What is factored: AᵀA and Aᵀb, or the rows of A in their order."""
        ...

    def factorize(self, system: LinearSystem, built: Any) -> Factored:
        """Order, analyze and factor it."""
        ...


class LinearSolver:
    """Solves A x = b by one method.

    Attributes
    ----------
    spent_s : (3,) time of all solutions so far: to build, to factor with all analysis, to solve triangular systems
    solutions : their number
    """

    def __init__(self, method: Method) -> None:
        self._method = method
        self.spent_s = np.zeros(3)
        self.solutions = 0
        self._factored: Factored | None = None

    def solve(self, system: LinearSystem) -> NDArray[np.float64]:
        """Solution (n,) in the least-squares sense; raises UndeterminedError where A has not full column rank."""
        laps_s = [working_s()]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", MatrixRankWarning)
                built = self._method.build(system)
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
        """That of the last solution."""
        assert self._factored is not None
        return self._factored.factor()


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


def check_pivots(pivots: NDArray[np.float64], whole: NDArray[np.float64]) -> None:
    """Refuse pivots (n,) that are but rounding of their diagonal entries before elimination, ``whole`` (n,)."""
    failed = np.flatnonzero(~(pivots > LOST_DIGITS * whole))
    if len(failed):
        raise SingularMatrixError(int(failed[0]), int(failed[0]))


PINV_BELOW = 3_000  # largest number of unknowns: their inverse is all but dense, 110 MB, and takes seconds


def check_pinv(unknowns: int) -> None:
    """Refuse to invert a matrix of so many rows. Raises InputError."""
    if unknowns >= PINV_BELOW:
        raise InputError(
            f"pinv: the inverse of AᵀA would be all but dense for {unknowns:,} unknowns, its limit is"
            f" {PINV_BELOW:,}; name other --methods"
        )


def normal_equations(system: LinearSystem) -> tuple[csc_matrix, NDArray[np.float64]]:
    """AᵀA and Aᵀb."""
    A = system.A
    return csc_matrix(A.T @ A), A.T @ system.b


class ScipyMethod:
    """AᵀA x = Aᵀb by what SciPy offers.

    ``default`` is spsolve, which returns no factor: that of splu with the same settings stands for it. ``pinv``
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
            check_pinv(len(g))
            inverse = csc_matrix(inv(H))
            # the k-th pivot of an elimination that takes unknown k last is 1 / inverse[k, k]
            check_pivots(1.0 / np.asarray(inverse.diagonal(), np.float64), diagonal)
            return Factored(lambda: inverse @ g, lambda: Factor("(AᵀA)⁻¹", inverse, np.arange(len(g))))
        lu = splu(H, permc_spec="COLAMD" if self._name == "lu_colamd" else "NATURAL")
        check_pivots(np.abs(lu.U.diagonal())[lu.perm_c], diagonal)
        return Factored(lambda: lu.solve(g), lambda: _upper(lu))


def _upper(lu: SuperLU) -> Factor:
    return Factor("U of AᵀA", csc_matrix(lu.U), np.argsort(lu.perm_c))
