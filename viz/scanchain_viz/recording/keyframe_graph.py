"""The keyframe graph as it grows: nodes, odometry edges, loop closures by their latest verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import msgspec
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from scanchain.data import Closure, ClosureVerdict, GraphState, Step
from scanchain.runs.closures import FinalClosure, final_verdicts
from scanchain.runs.step_table import StepRow
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.messages import Message, Times

_GROWTH = 1.05  # factor of growth between two drawings: the recording stays linear in the length of the log
_DOWNWEIGHTED = 0.5  # robust weight below which an accepted closure is drawn amber


class Verdicts(msgspec.Struct, frozen=True):
    """Events of a step, one per closure with a new verdict, and the numbers accepted and rejected since."""

    events: Sequence[str]
    accepted: int
    rejected: int


class KeyframeGraph:
    """Takes in every step; returns the verdicts on closures, and draws the graph when it has grown enough."""

    def __init__(self) -> None:
        self.positions: list[NDArray[np.float32]] = []
        self.closures: list[FinalClosure] = []
        self.graph: GraphState | None = None
        self.counts = (0, 0)
        self.drawn = 0
        self.is_current = True

    def add(self, step: Step) -> Verdicts:
        """Take in a step; the verdicts on its closures are those of the matcher, then of the back end for all."""
        if step.keyframe >= 0:
            self.positions.append(shapes.positions(step.T_world_lidar[None])[0])
            self.is_current = False
        events: list[str] = []
        if step.closures:
            events += self._update([*self.closures, *(_as_found(closure) for closure in step.closures)])
        if step.graph is not None:
            self.graph = step.graph
            events += self._update(final_verdicts([item.closure for item in self.closures], step.graph))
        return Verdicts(events, *self.counts)

    def settle(self, closures: Sequence[FinalClosure], graph: GraphState) -> Verdicts:
        """Take in the final graph with every closure tried."""
        self.graph = graph
        self.is_current = False
        return Verdicts(self._update(closures), *self.counts)

    def restore(self, rows: Sequence[StepRow], closures: Sequence[Closure], graph: GraphState) -> Verdicts:
        """Restore the state after the steps of ``rows`` from the closures and the graph at that time."""
        poses = np.array([row.T_world_lidar for row in rows if row.keyframe >= 0])
        self.positions = list(shapes.positions(poses))
        self.graph = graph
        self._update(final_verdicts(closures, graph))
        for count in range(1, len(self.positions) + 1):
            self.drawn = count if count > _GROWTH * self.drawn else self.drawn
        self.is_current = self.drawn == len(self.positions)
        return Verdicts((), *self.counts)

    @property
    def has_grown(self) -> bool:
        """True if it is time to draw it."""
        return len(self.positions) > _GROWTH * self.drawn

    def draw(self, times: Times) -> list[Message]:
        """Messages of the present graph, unless it is drawn already."""
        if self.is_current or not self.positions:
            return []
        self.drawn, self.is_current = len(self.positions), True
        nodes = np.array(self.positions)
        if self.graph is not None:
            nodes[: len(self.graph.poses)] = shapes.positions(self.graph.poses)
        accepted = [item for item in self.closures if item.verdict is ClosureVerdict.ACCEPTED]
        rejected = [item for item in self.closures if item.verdict is ClosureVerdict.REJECTED]
        colors = [entities.ORANGE if item.weight < _DOWNWEIGHTED else entities.GREEN for item in accepted]
        return [
            Message(entities.KEYFRAMES, rr.Points3D.columns(positions=nodes).partition([len(nodes)]), times),
            _strips(entities.ODOMETRY_EDGES, nodes[None], times),
            _strips(entities.ACCEPTED, _edges(nodes, accepted), times, colors),
            _strips(entities.REJECTED, _edges(nodes, rejected), times),
        ]

    def _update(self, closures: Sequence[FinalClosure]) -> list[str]:
        """Store the verdicts; a line for each new one, the number being the closure's row in loops.parquet."""
        before = [item.verdict for item in self.closures]
        self.closures = list(closures)
        counts = Counter(item.verdict for item in closures)
        self.counts = (counts[ClosureVerdict.ACCEPTED], counts[ClosureVerdict.REJECTED])
        return [
            f"closure {number} ({item.closure.target} to {item.closure.source}) {item.verdict}: {item.reason}"
            for number, item in enumerate(closures)
            if number >= len(before) or item.verdict is not before[number]
        ]


def _as_found(closure: Closure) -> FinalClosure:
    """Verdict of the matcher alone, before optimization."""
    return FinalClosure(closure, closure.verdict, closure.cause, closure.reason, 1.0, float("nan"))


def _strips(
    entity: str, strips: NDArray[np.float32], times: Times, colors: Sequence[tuple[int, int, int]] = ()
) -> Message:
    columns = [*rr.LineStrips3D.columns(strips=strips).partition([len(strips)])]
    if colors:
        columns += [*rr.LineStrips3D.columns(colors=list(colors)).partition([len(colors)])]
    return Message(entity, rr.ComponentColumnList(columns), times)


def _edges(nodes: NDArray[np.float32], closures: list[FinalClosure]) -> NDArray[np.float32]:
    """Line strips (E, 2, 3) between the keyframes of closures."""
    pairs = np.array([(item.closure.target, item.closure.source) for item in closures], np.int64).reshape(-1, 2)
    return nodes[pairs]
