"""Linear solvers of A x = b by name: those of the course report, sparse Cholesky, Schur complement; compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.errors import InputError
from scanchain.landmarks.problem import Layout, LinearSystem, Pattern
from scanchain.landmarks.solvers.direct import (
    CholeskyMethod,
    Factor,
    LinearSolver,
    QrMethod,
    SchurMethod,
    ScipyMethod,
    UndeterminedError,
)

__all__ = [
    "ESTIMATOR", "METHODS", "Factor", "LinearSolver", "MethodResult", "UndeterminedError", "compare",
    "create_solver", "methods_for", "parse_methods",
]  # fmt: skip

_MAKERS = {
    "default": lambda: ScipyMethod("default"),
    "pinv": lambda: ScipyMethod("pinv"),
    "lu": lambda: ScipyMethod("lu"),
    "lu_colamd": lambda: ScipyMethod("lu_colamd"),
    "qr": lambda: QrMethod("natural"),
    "qr_colamd": lambda: QrMethod("colamd"),
    "cholesky": CholeskyMethod,
    "schur": SchurMethod,
}
PINV_BELOW = 3_000  # largest number of unknowns: their inverse is all but dense, 110 MB, and takes seconds
METHODS = tuple(_MAKERS)
ESTIMATOR = "schur"  # the fastest: it estimates where no other is requested


def create_solver(method: str) -> LinearSolver:
    """A solver by the method of that name."""
    return LinearSolver(_MAKERS[method]())


def parse_methods(text: str) -> tuple[str, ...]:
    """The names of a list with commas; "all" stands for every method that suits the problem."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    choice = f"choose from all, {', '.join(_MAKERS)}"
    for name in names:
        if name != "all" and name not in _MAKERS:
            raise InputError(f"there is no method {name!r}; {choice}")
    if not names:
        raise InputError(f"no method is named; {choice}")
    return tuple(names)


def methods_for(requested: Sequence[str], unknowns: int) -> tuple[tuple[str, ...], dict[str, str]]:
    """Methods to run on a problem of so many unknowns, and a fact about one that "all" leaves out there.

    Raises InputError where one is named that is too slow.
    """
    chosen = dict.fromkeys(method for name in requested for method in (METHODS if name == "all" else (name,)))
    if "pinv" not in chosen or unknowns < PINV_BELOW:
        return tuple(chosen), {}
    why = f"pinv, whose inverse is all but dense: {unknowns:,} unknowns, its limit is {PINV_BELOW:,}"
    if "pinv" in requested:
        raise InputError(f"{why}; name other --methods")
    del chosen["pinv"]
    return tuple(chosen), {"not compared": why}


_SLOW_S = 1.0  # seconds of a solution above which it is not repeated


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One method on one problem.

    Attributes
    ----------
    method : its name
    build_s, factor_s, solve_s : medians over the repetitions, each with a new solver; sums over the iterations
    again_s : the whole once more with the same solver, which reuses its analysis of the pattern
    iterations : linear solves
    factor : of the last one
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
    """Let ``solve`` find the unknowns (n,) by every method in turn, slow ones once only."""
    results = list[MethodResult]()
    for method in methods:
        solver, iterations, times_s = create_solver(method), 0, list[NDArray[np.float64]]()
        x = solver.solve(_small_system())  # compiles
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


def _small_system() -> LinearSystem:
    """Two poses and a landmark, one step and two observations."""
    row_start = np.concatenate([[0, 1, 2], 2 + 2 * np.arange(1, 7)])
    columns = np.array([0, 1, 0, 2, 1, 3, 0, 4, 1, 5, 2, 4, 3, 5])
    values = np.concatenate([[1.0, 1.0], np.tile([-1.0, 1.0], 6)])
    return LinearSystem(Pattern(row_start, columns, Layout(2, 2, np.zeros(1, np.int64))), values, np.ones(8))
