"""Recordings of pose graphs and landmark problems: the timeline ``scan`` is 0 before optimization and 1 after."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain import lie
from scanchain.data import GraphState
from scanchain.graph.optimization import GraphChange
from scanchain.landmarks.results import file_stem
from scanchain.landmarks.study import Estimate, Study
from scanchain_viz.pictures.problems import ellipses
from scanchain_viz.recording import drawing, entities
from scanchain_viz.recording.blueprint import with_panels
from scanchain_viz.recording.drawing import Message, Times
from scanchain_viz.recording.sinks import write_recording

_FLAT_M = 1e-4  # height of an ellipse


def record_graph(change: GraphChange, path: Path) -> None:
    """Write a .rrd file of a pose graph, its edges colored by verdict. Raises OSError."""
    grid = rrb.LineGrid3D(visible=False)
    layout = with_panels(rrb.Spatial3DView(origin=entities.WORLD, name="graph", line_grid=grid))
    messages = [*_graph(change.before, 0), *_graph(change.after, 1)]
    dimension = change.after.poses.shape[-1] - 1
    write_recording(path, change.name, dimension, layout, messages, kind="graph")


def _graph(state: GraphState, when: int) -> Iterator[Message]:
    """Nodes, chain, loops and rejected edges at one instant."""
    times, nodes = Times.at(when, when), drawing.positions(state.poses)
    rejected, skips = state.is_rejected, np.abs(state.edges[:, 0] - state.edges[:, 1]) != 1
    yield Message(entities.KEYFRAMES, drawing.dots(nodes, entities.VIOLET, 1.5), times)
    for entity, chosen, color in (
        (entities.ODOMETRY_EDGES, ~skips & ~rejected, entities.GRAY),
        (entities.ACCEPTED, skips & ~rejected, entities.GREEN),
        (entities.REJECTED, rejected, entities.RED),
    ):
        yield Message(entity, drawing.lines(nodes[state.edges[chosen]], color, 0.75), times)


def record_landmarks(studies: Sequence[Study], path: Path) -> None:
    """Write a .rrd file with a view of each landmark problem.

    All is in the frame of the truth where there is one; landmarks after optimization carry their 95 % ellipses.
    Raises OSError.
    """
    views = [rrb.Spatial3DView(origin=_root(study), name=study.name) for study in studies]
    messages, name = (
        [message for study in studies for message in _study(study)],
        ", ".join(s.name for s in studies),
    )
    write_recording(path, name, 2, with_panels(rrb.Grid(*views)), messages, kind="landmarks")


def _root(study: Study) -> str:
    return f"{entities.WORLD}/{file_stem(study.name)}"


def _study(study: Study) -> Iterator[Message]:
    """The true trajectory and landmarks for ever, the estimates at their instants."""
    root, known = _root(study), study.true_landmarks[np.isfinite(study.true_landmarks).all(axis=1)]
    path = drawing.lines([drawing.in_space(study.true_poses)], entities.GRAY, 1.0)
    yield Message(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    yield Message(f"{root}/truth/trajectory", path)
    yield Message(f"{root}/truth/landmarks", drawing.dots(drawing.in_space(known), entities.GRAY, 4.0))
    yield from _estimate(root, study.before, Times.at(0, 0), entities.ORANGE)
    yield from _estimate(root, study.after, Times.at(1, 1), entities.BLUE)
    yield Message(f"{root}/ellipses", _ellipses(study), Times.at(1, 1))


def _estimate(root: str, estimate: Estimate, times: Times, color: drawing.Color) -> Iterator[Message]:
    """Trajectory and landmarks at one instant."""
    T = estimate.T_truth_estimate
    path = drawing.in_space(lie.transform(T, estimate.state.poses[:, :2]))
    points = drawing.in_space(lie.transform(T, estimate.state.landmarks))
    yield Message(f"{root}/trajectory", drawing.lines([path], color, 1.5), times)
    yield Message(f"{root}/landmarks", drawing.dots(points, color, 3.0), times)


def _ellipses(study: Study) -> rr.Ellipsoids3D:
    """The 95 % ellipse of every landmark after optimization."""
    axes_m, angle = ellipses(study)
    upright = np.zeros((len(axes_m), 4), np.float32)
    upright[:, 2], upright[:, 3] = np.sin(0.5 * angle), np.cos(0.5 * angle)
    return rr.Ellipsoids3D.from_fields(
        centers=drawing.in_space(lie.transform(study.after.T_truth_estimate, study.after.state.landmarks)),
        half_sizes=np.pad(axes_m, ((0, 0), (0, 1)), constant_values=_FLAT_M).astype(np.float32),
        quaternions=upright,
        colors=entities.BLUE,
    )
