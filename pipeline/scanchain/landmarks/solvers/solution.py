"""Solution, factor and error of the linear solvers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags_array, identity
from scipy.sparse.linalg import splu

from scanchain.clock import working_s
from scanchain.errors import InputError
from scanchain.landmarks.system import Layout, LinearSystem

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
