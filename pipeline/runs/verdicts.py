"""What the optimised graph says of the loop closures that went into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.data import Closure, GraphState, Verdict

_REJECTED_WEIGHT = 0.1  # robust weight below which an edge has no say


@dataclass(frozen=True, slots=True)
class JudgedClosure:
    """A closure with its last word: by the matcher, or by the graph that it contradicts."""

    closure: Closure
    verdict: Verdict
    reason: str
    weight: float


def final_verdicts(closures: Sequence[Closure], state: GraphState) -> tuple[JudgedClosure, ...]:
    """Every closure with the robust weight of its edge; those the graph contradicts are rejected after all."""
    weights = {
        (int(i), int(j)): float(weight)
        for (i, j), is_loop, weight in zip(state.edges, state.is_loop, state.weight, strict=True)
        if is_loop
    }
    judged = []
    for closure in closures:
        weight = weights.get((closure.target, closure.source), 0.0)
        if closure.verdict is Verdict.ACCEPTED and weight < _REJECTED_WEIGHT:
            reason = f"contradicts the rest of the graph: robust weight {weight:.3f} < {_REJECTED_WEIGHT}"
            judged.append(JudgedClosure(closure, Verdict.REJECTED, reason, weight))
        else:
            judged.append(JudgedClosure(closure, closure.verdict, closure.reason, weight))
    return tuple(judged)
