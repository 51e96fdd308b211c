"""Linear solvers of A x = b by name: those of the course report, sparse Cholesky, Schur complement."""

from __future__ import annotations

from pipeline.errors import InputError
from pipeline.landmarks.solvers.cholesky import CholeskySolver
from pipeline.landmarks.solvers.qr import QrSolver
from pipeline.landmarks.solvers.schur import SchurSolver
from pipeline.landmarks.solvers.scipy_direct import DefaultSolver, LuSolver, PinvSolver
from pipeline.landmarks.solvers.solution import Factor, LinearSolver, Solution, UndeterminedError
from pipeline.landmarks.solvers.suitesparse import SuiteSparseQrSolver

__all__ = ["METHODS", "Factor", "LinearSolver", "Solution", "UndeterminedError", "create_solver", "parse_methods"]

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


def create_solver(method: str) -> LinearSolver:
    """The solver of that name."""
    if method not in _MAKERS:
        raise InputError(f"there is no method {method!r}; choose from {', '.join(_MAKERS)}")
    return _MAKERS[method]()


def parse_methods(text: str) -> tuple[str, ...]:
    """The names of a list with commas, each once; "all" is every method of the default installation."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    chosen = [method for name in names for method in (METHODS if name == "all" else (name,))]
    for name in chosen:
        if name not in _MAKERS:
            raise InputError(f"there is no method {name!r}; choose from all, {', '.join(_MAKERS)}")
    if not chosen:
        raise InputError(f"no method is named; choose from all, {', '.join(_MAKERS)}")
    return tuple(dict.fromkeys(chosen))
