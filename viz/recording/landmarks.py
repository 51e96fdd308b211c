"""Landmark problems before and after as a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from uuid import uuid4

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain import lie
from scanchain.data import Matrix
from scanchain.landmarks.files.write import file_stem
from scanchain.landmarks.study import Estimate, Study
from scanchain.viz.recording import entities, shapes
from scanchain.viz.recording.messages import Message, Times
from scanchain.viz.recording.sinks import open_stream, write_recording

_DEVIATIONS = 2.4477  # that hold 95 % of a Gaussian in the plane
_FLAT_M = 1e-4  # height of an ellipse


def record_landmarks(studies: Sequence[Study], path: Path) -> None:
    """Write a .rrd file with a view of each problem: the timeline ``scan`` is 0 before and 1 after.

    All is in the frame of the truth where there is one; landmarks after it carry their 95 % ellipses.
    Raises OSError.
    """
    stream = open_stream(", ".join(study.name for study in studies), 2, uuid4())
    views = [rrb.Spatial3DView(origin=_root(study), name=study.name) for study in studies]
    layout = rrb.Blueprint(
        rrb.Grid(*views), rrb.TimePanel(timeline="scan", state="collapsed"), collapse_panels=True
    )
    messages: list[Message] = []
    for study in studies:
        messages += [Message(_root(study), rr.ViewCoordinates.RIGHT_HAND_Z_UP), *_truth(study)]
        messages += [*_state(study, study.before, 0), *_state(study, study.after, 1), _ellipses(study)]
    write_recording(path, stream, layout, messages)


def _root(study: Study) -> str:
    return f"{entities.WORLD}/{file_stem(study.name)}"


def _truth(study: Study) -> list[Message]:
    """True trajectory and landmarks, for ever."""
    known = study.true_landmarks[np.isfinite(study.true_landmarks).all(axis=1)]
    path = rr.LineStrips3D([shapes.in_space(study.true_poses)], colors=[entities.GRAY], radii=entities.pixels(1.0))
    marks = rr.Points3D(shapes.in_space(known), colors=[entities.GRAY], radii=entities.pixels(4.0))
    return [Message(f"{_root(study)}/truth/trajectory", path), Message(f"{_root(study)}/truth/landmarks", marks)]


def _state(study: Study, estimate: Estimate, when: int) -> list[Message]:
    """Trajectory and landmarks at one instant."""
    times, T = Times.at(when, when), estimate.T_truth_estimate
    color = entities.ORANGE if when == 0 else entities.BLUE
    path = shapes.in_space(lie.transform(T, estimate.state.poses[:, :2]))
    points = shapes.in_space(lie.transform(T, estimate.state.landmarks))
    line = rr.LineStrips3D.columns(strips=[path], colors=[color], radii=[entities.pixels(1.5)])
    marks = rr.Points3D.columns(
        positions=points, colors=[color] * len(points), radii=[entities.pixels(3.0)] * len(points)
    )
    return [
        Message(f"{_root(study)}/trajectory", line.partition([1]), times),
        Message(f"{_root(study)}/landmarks", marks.partition([len(points)]), times),
    ]


def _ellipses(study: Study) -> Message:
    """The 95 % ellipse of every landmark after optimization."""
    T = study.after.T_truth_estimate
    turn: Matrix = T[:2, :2]
    values, axes = np.linalg.eigh(turn @ study.landmark_covariance @ turn.T)
    half_sizes = np.full((len(values), 3), _FLAT_M, np.float32)
    half_sizes[:, :2] = _DEVIATIONS * np.sqrt(np.maximum(values, 0.0))
    angle = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    upright = np.zeros((len(values), 4), np.float32)
    upright[:, 2], upright[:, 3] = np.sin(0.5 * angle), np.cos(0.5 * angle)
    drawn = rr.Ellipsoids3D.columns(
        centers=shapes.in_space(lie.transform(T, study.after.state.landmarks)),
        half_sizes=half_sizes,
        quaternions=upright,
        colors=[entities.BLUE] * len(values),
    )
    return Message(f"{_root(study)}/ellipses", drawn.partition([len(values)]), Times.at(1, 1))
