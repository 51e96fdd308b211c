"""What an optimisation of the pose graph did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.data import GraphState
from pipeline.graph.initialise import Initialisation


@dataclass(frozen=True, slots=True)
class GraphChange:
    """A graph before and after, for those who show it; ``rejected`` (E,) in the order of ``after.edges``."""

    name: str
    before: GraphState
    after: GraphState
    rejected: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Optimisation:
    """The answer of ``PoseGraph.optimise``.

    Attributes
    ----------
    state : the graph as it is now
    chi2_before, chi2_after : Σ eᵀΩe over all edges, unweighted, at the poses before and of the answer
    cost_after : what was minimised: as chi2_after, with the robust loss of the loop edges
    rejected : (E,) bool, in the order of ``state.edges``: loop edges that contradict the rest
    iterations : linear solves
    converged, reason : whether and why the iteration stopped
    initialisation : where the first guess came from
    time_s : wall time
    """

    state: GraphState
    chi2_before: float
    chi2_after: float
    cost_after: float
    rejected: NDArray[np.bool_]
    iterations: int
    converged: bool
    reason: str
    initialisation: Initialisation
    time_s: float
