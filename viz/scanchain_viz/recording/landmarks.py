"""Landmark problems before and after as a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from scanchain import lie
from scanchain.landmarks.files.write import file_stem
from scanchain.landmarks.study import Estimate, Study
from scanchain_viz.pictures.landmarks import ellipses
from scanchain_viz.recording import entities, shapes
from scanchain_viz.recording.messages import Message, Times
from scanchain_viz.recording.sinks import write_recording

_FLAT_M = 1e-4  # height of an ellipse


def record_landmarks(studies: Sequence[Study], path: Path) -> None:
    """Write a .rrd file with a view of each problem: the timeline ``scan`` is 0 before and 1 after.

    All is in the frame of the truth where there is one; landmarks after it carry their 95 % ellipses.
    Raises OSError.
    """
    views = [rrb.Spatial3DView(origin=_root(study), name=study.name) for study in studies]
    layout = rrb.Blueprint(
        rrb.Grid(*views), rrb.TimePanel(timeline="scan", state="collapsed"), collapse_panels=True
    )
    messages: list[Message] = []
    for study in studies:
        messages += [Message(_root(study), rr.ViewCoordinates.RIGHT_HAND_Z_UP), *_truth(study)]
        messages += [*_state(study, study.before, 0), *_state(study, study.after, 1), _ellipses(study)]
    write_recording(path, ", ".join(study.name for study in studies), 2, layout, messages)


def _root(study: Study) -> str:
    return f"{entities.WORLD}/{file_stem(study.name)}"


def _truth(study: Study) -> list[Message]:
    """True trajectory and landmarks, for ever."""
    known = study.true_landmarks[np.isfinite(study.true_landmarks).all(axis=1)]
    path = entities.lines(entities.GRAY, 1.0, [shapes.in_space(study.true_poses)])
    marks = entities.dots(entities.GRAY, 4.0, shapes.in_space(known))
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
    axes_m, angle = ellipses(study)
    half_sizes = np.pad(axes_m, ((0, 0), (0, 1)), constant_values=_FLAT_M).astype(np.float32)
    upright = np.zeros((len(axes_m), 4), np.float32)
    upright[:, 2], upright[:, 3] = np.sin(0.5 * angle), np.cos(0.5 * angle)
    drawn = rr.Ellipsoids3D.columns(
        centers=shapes.in_space(lie.transform(study.after.T_truth_estimate, study.after.state.landmarks)),
        half_sizes=half_sizes,
        quaternions=upright,
        colors=[entities.BLUE] * len(axes_m),
    )
    return Message(f"{_root(study)}/ellipses", drawn.partition([len(axes_m)]), Times.at(1, 1))
