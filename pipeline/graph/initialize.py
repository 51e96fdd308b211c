"""First guesses for a pose graph from its measurements: odometry chain, spanning tree, chordal relaxation."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from scanchain.data import Matrix
from scanchain.graph.between import BetweenProblem
from scanchain.graph.chordal import relax_chordally
from scanchain.graph.solvers.cholesky import SingularMatrixError
from scanchain.kernels.graph.tree import follow_tree

Initialization = Literal["auto", "given", "odometry", "spanning-tree", "chordal"]

_GOOD_GUESS = 2.0  # χ² per degree of freedom up to which the poses at hand need no better guess


def first_guess(
    problem: BetweenProblem, poses: Matrix, initialize: Initialization, *, trusted: bool
) -> tuple[Matrix, Initialization]:
    """Poses to start from, and which of the ways they come from.

    "auto" keeps the poses at hand where they fit, else takes the better of them and the chordal relaxation. Where
    not every edge is trusted it keeps them in any case: no other guess is safe from a false loop.
    """
    if problem.is_point.any():
        return _with_points(problem, poses, initialize, trusted=trusted)
    fixed = problem.variable < 0
    if initialize == "odometry":
        return follow_odometry(poses, fixed, problem.edges, problem.measurements), initialize
    if initialize == "spanning-tree":
        return follow_spanning_tree(poses, fixed, problem.edges, problem.measurements), initialize
    if initialize == "chordal":
        return relax_chordally(problem, poses), initialize
    chi2 = problem.chi2(problem.errors(poses)).sum()
    redundancy = problem.freedom * max(len(problem.edges) - len(problem.free), 1)
    if initialize == "auto" and trusted and chi2 > _GOOD_GUESS * redundancy:
        try:
            relaxed = relax_chordally(problem, poses)
        except SingularMatrixError:
            return poses.copy(), "given"
        if problem.chi2(problem.errors(relaxed)).sum() < chi2:
            return relaxed, "chordal"
    return poses.copy(), "given"


def place_points(problem: BetweenProblem, poses: Matrix) -> Matrix:
    """Poses with every free point where it is seen from its poses, on average."""
    i, j = problem.edges[problem.sightings].T
    seen = (poses[i] @ problem.measurements[problem.sightings])[:, :-1, -1]
    total, count = np.zeros((len(poses), seen.shape[1])), np.zeros(len(poses))
    np.add.at(total, j, seen)
    np.add.at(count, j, 1.0)
    placed = (count > 0) & (problem.variable >= 0)
    result = poses.copy()
    result[placed, :-1, -1] = total[placed] / count[placed, None]
    return result


def _with_points(
    problem: BetweenProblem, poses: Matrix, initialize: Initialization, *, trusted: bool
) -> tuple[Matrix, Initialization]:
    """The guess for the poses alone, and the points as they are seen from there, if that fits better."""
    ways = np.flatnonzero(~problem.is_point)
    place = np.cumsum(~problem.is_point) - 1
    between = np.setdiff1d(np.arange(len(problem.edges)), problem.sightings)
    alone = BetweenProblem(
        place[problem.edges[between]],
        problem.measurements[between],
        problem.information[between],
        problem.variable[ways] < 0,
    )
    try:
        guess, source = first_guess(alone, poses[ways], initialize, trusted=trusted)
    except SingularMatrixError:
        return poses.copy(), "given"
    result = poses.copy()
    result[ways] = guess
    placed = place_points(problem, result)
    if source != "given" or initialize == "auto":
        chi2 = [problem.chi2(problem.errors(candidate)).sum() for candidate in (poses, placed)]
        if source != "given" or chi2[1] < chi2[0]:
            return placed, source
    return poses.copy(), source


def follow_spanning_tree(poses: Matrix, fixed: NDArray[np.bool_], edges: NDArray[np.int64], Z: Matrix) -> Matrix:
    """Poses (K, d+1, d+1) chained from the fixed ones along the shortest paths; unreachable ones stay."""
    result, reached = poses.copy(), fixed.astype(np.int64)
    ends = edges.T.reshape(-1)
    order = np.argsort(ends, kind="stable")
    start = np.searchsorted(ends[order], np.arange(len(poses) + 1))
    follow_tree(start, order % max(len(edges), 1), edges, Z, result, reached)
    return result


def follow_odometry(poses: Matrix, fixed: NDArray[np.bool_], edges: NDArray[np.int64], Z: Matrix) -> Matrix:
    """Poses chained along the edges between successive poses, and where one is missing, the next shortest leap."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, first = np.unique(low * len(poses) + high, return_index=True)
    leaps = csr_matrix(((high - low)[first], (low[first], high[first])), shape=(len(poses), len(poses)))
    tree = minimum_spanning_tree(leaps).tocoo()
    kept = first[np.isin((low * len(poses) + high)[first], tree.row.astype(np.int64) * len(poses) + tree.col)]
    return follow_spanning_tree(poses, fixed, edges[kept], Z[kept])
