"""The verdict of the optimized graph on the loop closures that went into it."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass

from scanchain.data import REJECTED_WEIGHT, Closure, GraphState, Verdict

VERIFICATION, BACK_END = "verification", "back end"  # either may reject a closure


@dataclass(frozen=True, slots=True)
class JudgedClosure:
    """A closure with its last word: by the matcher, or by the graph that it contradicts.

    ``weight`` and ``chi2_after`` are what the optimizer left to its edge: 0 and NaN if it never became one, 1 and
    NaN until it is optimized.
    """

    closure: Closure
    verdict: Verdict
    reason: str
    weight: float
    chi2_after: float

    @property
    def rejected_by(self) -> str:
        """Verification by matching, or the back end, which found it to contradict the graph; empty if accepted."""
        if self.verdict is Verdict.ACCEPTED:
            return ""
        return BACK_END if self.closure.verdict is Verdict.ACCEPTED else VERIFICATION


def final_verdicts(closures: Sequence[Closure], state: GraphState) -> tuple[JudgedClosure, ...]:
    """Every closure with what became of its edge; those the graph contradicts are rejected after all.

    A closure accepted since the optimization that ``state`` comes from stays accepted.
    """
    edges = _loop_edges(state)
    judged = []
    for closure in closures:
        verdict, reason, weight, chi2 = closure.verdict, closure.reason, 0.0, float("nan")
        if verdict is Verdict.ACCEPTED:
            between = edges[closure.target, closure.source]
            weight, chi2 = between.popleft() if between else (1.0, float("nan"))
            if weight < REJECTED_WEIGHT:
                verdict = Verdict.REJECTED
                reason = f"contradicts the rest of the graph, χ² {chi2:.4g}"
        judged.append(JudgedClosure(closure, verdict, reason, weight, chi2))
    return tuple(judged)


def _loop_edges(state: GraphState) -> defaultdict[tuple[int, int], deque[tuple[float, float]]]:
    """Weight and χ² of the loop edges between each pair, in the order they were added."""
    edges: defaultdict[tuple[int, int], deque[tuple[float, float]]] = defaultdict(deque)
    loops = state.is_loop
    for (i, j), weight, chi2 in zip(state.edges[loops], state.weight[loops], state.edge_chi2[loops], strict=True):
        edges[int(i), int(j)].append((float(weight), float(chi2)))
    return edges
