"""The keyframe graph as it grows: nodes, odometry edges, loop closures by verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from pipeline.data import Closure, GraphState, Step, Verdict
from viz import entities, shapes
from viz.messages import Message, Times

_GROWTH = 1.05  # drawn anew when it grew by this factor: the recording stays linear in the length of the log
_DOUBT = 0.5  # robust weight below which the back end disagrees with a closure's verdict


class KeyframeGraph:
    """Feeds on steps; gives messages when the graph grew enough since it was drawn."""

    def __init__(self) -> None:
        self.positions: list[NDArray[np.float32]] = []
        self.closures: list[Closure] = []
        self.graph: GraphState | None = None
        self.drawn = 0
        self.is_current = True
        self.times = Times.at(0, 0)

    def add(self, step: Step) -> list[Message]:
        """Take in a step; those without a keyframe may be left out."""
        if step.keyframe >= 0:
            self.positions.append(shapes.positions(step.T_world_lidar[None])[0])
            self.is_current = False
        if step.closures:
            self.closures.extend(step.closures)
            self.is_current = False
        if step.graph is not None:
            self.graph = step.graph
            self.is_current = False
        if self.is_current:
            return []
        self.times = Times.at(step.scan.index, step.scan.stamp_ns)
        return self.draw() if len(self.positions) > _GROWTH * self.drawn else []

    def settle(self, closures: Sequence[Closure], graph: GraphState) -> list[Message]:
        """The final graph with every closure tried; drawn at the last scan."""
        self.closures, self.graph = list(closures), graph
        self.is_current = False
        return self.draw()

    def draw(self) -> list[Message]:
        """The graph as it is known, unless it is drawn already."""
        if self.is_current or not self.positions:
            return []
        self.drawn, self.is_current = len(self.positions), True
        nodes = np.array(self.positions)
        if self.graph is not None:
            nodes[: len(self.graph.poses)] = shapes.positions(self.graph.poses)
        accepted = [closure for closure in self.closures if closure.verdict is Verdict.ACCEPTED]
        rejected = [closure for closure in self.closures if closure.verdict is Verdict.REJECTED]
        colours = _colours(accepted, self.graph)
        return [
            Message(entities.KEYFRAMES, rr.Points3D.columns(positions=nodes).partition([len(nodes)]), self.times),
            self._strips(entities.ODOMETRY_EDGES, nodes[None]),
            self._strips(entities.ACCEPTED, _edges(nodes, accepted), colours),
            self._strips(entities.REJECTED, _edges(nodes, rejected)),
        ]

    def _strips(
        self, entity: str, strips: NDArray[np.float32], colours: Sequence[tuple[int, int, int]] = ()
    ) -> Message:
        columns = [*rr.LineStrips3D.columns(strips=strips).partition([len(strips)])]
        if colours:
            columns += [*rr.LineStrips3D.columns(colors=list(colours)).partition([len(colours)])]
        return Message(entity, rr.ComponentColumnList(columns), self.times)


def _edges(nodes: NDArray[np.float32], closures: list[Closure]) -> NDArray[np.float32]:
    """Line strips (E, 2, 3) between the keyframes of closures."""
    pairs = np.array([(closure.target, closure.source) for closure in closures], np.int64).reshape(-1, 2)
    return nodes[pairs]


def _colours(closures: list[Closure], graph: GraphState | None) -> list[tuple[int, int, int]]:
    """Green, or amber where the optimiser left an edge less than half of its weight."""
    if graph is None:
        return [entities.GREEN] * len(closures)
    pairs, weights = graph.edges[graph.is_loop].tolist(), graph.weight[graph.is_loop].tolist()
    weight = {(i, j): w for (i, j), w in zip(pairs, weights, strict=True)}
    doubted = [weight.get((closure.target, closure.source), 1.0) < _DOUBT for closure in closures]
    return [entities.ORANGE if doubt else entities.GREEN for doubt in doubted]
