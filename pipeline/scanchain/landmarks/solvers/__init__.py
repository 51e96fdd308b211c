"""Linear solvers of A x = b by name: those of the course report, sparse Cholesky, Schur complement."""

from __future__ import annotations

from collections.abc import Sequence

from scanchain.errors import InputError
from scanchain.landmarks.solvers.cholesky import CholeskySolver
from scanchain.landmarks.solvers.qr import QrSolver, SuiteSparseQrSolver
from scanchain.landmarks.solvers.schur import SchurSolver
from scanchain.landmarks.solvers.scipy_direct import PINV_BELOW, DefaultSolver, LuSolver, PinvSolver, check_pinv
from scanchain.landmarks.solvers.solution import Factor, LinearSolver, Solution, UndeterminedError

__all__ = [
    "ESTIMATOR", "METHODS", "Factor", "LinearSolver", "Solution", "UndeterminedError", "create_solver",
    "methods_for", "parse_methods",
]  # fmt: skip

_MAKERS = {
    "default": DefaultSolver,
    "pinv": PinvSolver,
    "lu": lambda: LuSolver("NATURAL"),
    "lu_colamd": lambda: LuSolver("COLAMD"),
    "qr": lambda: QrSolver("natural"),
    "qr_colamd": lambda: QrSolver("colamd"),
    "cholesky": CholeskySolver,
    "schur": SchurSolver,
    "spqr": lambda: SuiteSparseQrSolver("natural"),
    "spqr_colamd": lambda: SuiteSparseQrSolver("colamd"),
}
METHODS = tuple(name for name in _MAKERS if not name.startswith("spqr"))
ESTIMATOR = "schur"  # the fastest: it estimates where no other is requested


def create_solver(method: str) -> LinearSolver:
    """The solver of that name."""
    if method not in _MAKERS:
        raise InputError(f"there is no method {method!r}; choose from {', '.join(_MAKERS)}")
    return _MAKERS[method]()


def parse_methods(text: str) -> tuple[str, ...]:
    """The names of a list with commas; "all" stands for every method that suits the problem."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name != "all" and name not in _MAKERS:
            raise InputError(f"there is no method {name!r}; choose from all, {', '.join(_MAKERS)}")
    if not names:
        raise InputError(f"no method is named; choose from all, {', '.join(_MAKERS)}")
    if len(set(names)) < len(names):
        raise InputError(f"--methods names one twice: {', '.join(names)}; name each once")
    return tuple(names)


def methods_for(requested: Sequence[str], unknowns: int) -> tuple[tuple[str, ...], str]:
    """Methods to run on a problem of so many unknowns, and a note on one that "all" leaves out there.

    "all" is every method of the default installation. Raises InputError where one is named that is too slow.
    """
    if "pinv" in requested:
        check_pinv(unknowns)
    chosen = dict.fromkeys(method for name in requested for method in (METHODS if name == "all" else (name,)))
    if "pinv" not in chosen or unknowns < PINV_BELOW:
        return tuple(chosen), ""
    del chosen["pinv"]
    return tuple(
        chosen
    ), f"pinv, whose inverse is all but dense: {unknowns:,} unknowns, its limit is {PINV_BELOW:,}"
