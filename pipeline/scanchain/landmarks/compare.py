"""The same landmark problem through several linear solvers, one after the other, with time and agreement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.landmarks.bearing_range import BearingRangeProblem
from scanchain.landmarks.minimize import Optimizer, minimize
from scanchain.landmarks.problem import Values
from scanchain.landmarks.solvers import Factor, LinearSolver, Solution, create_solver
from scanchain.landmarks.system import Layout, LinearSystem, Pattern

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


def compare_linear(system: LinearSystem, methods: Sequence[str], repeats: int) -> tuple[MethodResult, ...]:
    """Solve A x = b by every method, interleaved; slow ones once only."""
    return _compare(lambda solver: solver.solve(system).x, methods, repeats)


def compare_nonlinear(
    problem: BearingRangeProblem, guess: Values, optimizer: Optimizer, methods: Sequence[str], repeats: int
) -> tuple[MethodResult, ...]:
    """Minimize from the guess with every method, interleaved; slow ones once only."""

    def solve(solver: _Tally) -> NDArray[np.float64]:
        return minimize(problem, guess, solver, optimizer=optimizer).state.unknowns

    return _compare(solve, methods, repeats)


def _compare(
    solve: Callable[[_Tally], NDArray[np.float64]], methods: Sequence[str], repeats: int
) -> tuple[MethodResult, ...]:
    rounds: dict[str, list[_Round]] = {method: [] for method in methods}
    for method in methods:
        create_solver(method).solve(_small_system())  # compiles
    for _ in range(repeats):
        for method in methods:
            if rounds[method] and rounds[method][0].again_s > _SLOW_S:
                continue
            solver = _Tally(create_solver(method))
            x, first = solve(solver), solver.taken()
            solve(solver)
            again_s = sum(solution.total_s for solution in solver.taken())
            rounds[method].append(_Round(first, x, again_s))
    reference = rounds[methods[0]][-1].x
    return tuple(_result(method, each, reference) for method, each in rounds.items())


def _small_system() -> LinearSystem:
    """Two poses and a landmark, one step and two observations."""
    row_start = np.concatenate([[0, 1, 2], 2 + 2 * np.arange(1, 7)])
    columns = np.array([0, 1, 0, 2, 1, 3, 0, 4, 1, 5, 2, 4, 3, 5])
    values = np.concatenate([[1.0, 1.0], np.tile([-1.0, 1.0], 6)])
    return LinearSystem(Pattern(row_start, columns, Layout(2, 2, np.zeros(1, np.int64))), values, np.ones(8))


@dataclass(frozen=True, slots=True)
class _Round:
    solutions: Sequence[Solution]
    x: NDArray[np.float64]
    again_s: float


class _Tally:
    """A linear solver that stores all its solutions."""

    def __init__(self, solver: LinearSolver) -> None:
        self._solver = solver
        self._solutions: list[Solution] = []

    def solve(self, system: LinearSystem) -> Solution:
        solution = self._solver.solve(system)
        self._solutions.append(solution)
        return solution

    def taken(self) -> list[Solution]:
        """Solutions since the last call."""
        solutions, self._solutions = self._solutions, []
        return solutions


def _result(method: str, rounds: list[_Round], reference: NDArray[np.float64]) -> MethodResult:
    def median(part: str) -> float:
        return float(np.median([sum(getattr(s, part) for s in each.solutions) for each in rounds]))

    last = rounds[-1]
    return MethodResult(
        method=method,
        build_s=median("build_s"),
        factor_s=median("factor_s"),
        solve_s=median("solve_s"),
        again_s=float(np.median([each.again_s for each in rounds])),
        iterations=len(last.solutions),
        factor=last.solutions[-1].factor(),
        x=last.x,
        difference=float(np.abs(last.x - reference).max()),
    )
