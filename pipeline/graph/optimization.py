"""What an optimization of the pose graph did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.data import GraphState, fit_text
from scanchain.graph.initialize import Initialization
from scanchain.graph.soundness import has_loop
from scanchain.words import counted


@dataclass(frozen=True, slots=True)
class GraphChange:
    """A graph before and after, for those who show it, each with the edges that were in force then."""

    name: str
    before: GraphState
    after: GraphState


def fit(state: GraphState) -> str:
    """How well its edges in force agree, in words."""
    count = int(state.is_rejected.sum())
    rejected = f"{counted(count, 'edge')} rejected" if count else ""
    return fit_text(state.chi2, state.degrees_of_freedom, rejected, has_loops=has_loops(state))


def has_loops(state: GraphState) -> bool:
    """Whether an edge in force joins poses that the others join already."""
    return has_loop(state.edges[~state.is_rejected], len(state.poses))


@dataclass(frozen=True, slots=True)
class Optimization:
    """The answer of ``PoseGraph.optimize``.

    Attributes
    ----------
    state : the graph as it is now
    chi2_before, chi2_after : Σ w eᵀΩe over the edges in force before and after, at the poses of then
    cost_after : what was minimized: Σ eᵀΩe of all edges, with the robust loss of the loop edges
    iterations : linear solves
    converged, reason : whether and why the iteration stopped
    initialization : where the first guess came from
    time_s : wall time
    """

    state: GraphState
    chi2_before: float
    chi2_after: float
    cost_after: float
    iterations: int
    converged: bool
    reason: str
    initialization: Initialization
    time_s: float

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(E,) bool, in the order of ``state.edges``: loop edges that contradict the rest."""
        return self.state.is_rejected
