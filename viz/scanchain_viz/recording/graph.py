"""A pose graph before and after optimization as a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from scanchain.data import GraphState
from scanchain.graph.optimization import GraphChange
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.messages import Message, Times
from scanchain_viz.recording.sinks import write_recording


def record_graph(change: GraphChange, path: Path) -> None:
    """Write a .rrd file: the timeline ``scan`` is 0 before and 1 after, edges are colored by verdict.

    Raises OSError.
    """
    layout = rrb.Blueprint(
        rrb.Spatial3DView(origin=entities.WORLD, name="graph", line_grid=rrb.LineGrid3D(visible=False)),
        rrb.TimePanel(timeline="scan", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
    messages = [entities.UP, *_messages(change.before, 0), *_messages(change.after, 1)]
    write_recording(path, change.name, change.after.poses.shape[-1] - 1, layout, messages)


def _messages(state: GraphState, when: int) -> list[Message]:
    """Nodes, chain, loops and rejected edges at one instant."""
    rejected = state.is_rejected
    times = Times.at(when, when)
    nodes = shapes.positions(state.poses)
    skips = np.abs(state.edges[:, 0] - state.edges[:, 1]) != 1
    dots = rr.Points3D.columns(
        positions=nodes, colors=[entities.VIOLET] * len(nodes), radii=[entities.pixels(1.5)] * len(nodes)
    )
    kinds = (
        (entities.ODOMETRY_EDGES, ~skips & ~rejected, entities.GRAY),
        (entities.ACCEPTED, skips & ~rejected, entities.GREEN),
        (entities.REJECTED, rejected, entities.RED),
    )
    lines = [_lines(entity, nodes[state.edges[chosen]], color, times) for entity, chosen, color in kinds]
    return [Message(entities.KEYFRAMES, dots.partition([len(nodes)]), times), *lines]


def _lines(entity: str, strips: NDArray[np.float32], color: tuple[int, int, int], times: Times) -> Message:
    columns = rr.LineStrips3D.columns(
        strips=strips, colors=[color] * len(strips), radii=[entities.pixels(0.75)] * len(strips)
    )
    return Message(entity, columns.partition([len(strips)]), times)
